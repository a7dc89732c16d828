"""Interface of a vehicle to the pilot: it accepts a velocity and returns measurements.

A vehicle measures at its own rate with its own time stamps, and may return measurements late or not
at all. Measurements are the client's only source of the vehicle's state. `client.simulated`
contains simulated vehicles. A real one communicates with its autopilot through a `port`, an
endpoint like any other, driven by datagrams and time. `client.vehicles` has the table of all kinds.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple

import msgspec
import numpy as np

from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.flight import Failure
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

if TYPE_CHECKING:
    from skytether.ros2.graph import Node


class Measurement(NamedTuple):
    """Measured part of a vehicle's state: position, velocity, or both."""

    stamp_ns: int
    """Time at which the state was measured [ns; the client's clock]."""
    position: list[float] | None
    """Position on each axis [m]; None if not measured."""
    velocity: list[float] | None
    """Velocity on each axis [m/s]; None if not measured."""

    def numbers(self) -> Array:
        """Positions and velocities, NaN if not measured; shape (2, axes)."""
        _, position, velocity = self
        if position is None or velocity is None:
            missing = [math.nan] * len(position or velocity or ())
            position, velocity = position or missing, velocity or missing
        # Always float64: compiled code assumes it without checking.
        return np.array((position, velocity), dtype=np.float64)


Coordinate = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""Coordinate of an origin, within the range accepted from a file [m]."""


class VehicleMemory(msgspec.Struct, frozen=True, kw_only=True):
    """State of a vehicle that is saved for the next run of its client, see `client.memory`."""

    armed: bool = False
    """Whether a client has armed the vehicle since an operator last allowed arming."""
    origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Origin of the scenario's frame in the autopilot's local frame, z up [m]; None if unknown."""
    leap_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Part of `origin` that comes from a leap about which no operator has decided yet [m], see
    `Vehicle.leap_m`."""
    boot_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)] = 0
    """Time since the autopilot's boot at which the fields above were last valid [ms]."""
    at_ns: Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)] = 0
    """Host's clock at `boot_ms` [ns]; in the encoded bytes, relative to the time of writing."""


class Vehicle(ABC):
    """A vehicle that flies commanded velocities."""

    changeable: frozenset[str] = frozenset()
    """Keys of the scenario that may change in flight."""
    port: Endpoint | None = None
    """Endpoint that talks to the vehicle's own hardware; None if there is none."""
    node: "Node | None" = None
    """Node of the ROS graph whose topics the port is connected to; None: the port is connected to
    the line at `vehicle.address`."""
    drifts = False
    """Whether the vehicle drifts at a commanded velocity of zero."""
    returns = False
    """Whether the vehicle can return home by itself, see `return_home`."""
    leap_m: tuple[float, ...] | None = None
    """Displacement of the measured position on each axis about which no operator has decided yet
    [m]; until then it is subtracted. None: no leap, or the vehicle does not detect leaps."""
    failure: Failure | None = None
    """Event that makes the vehicle unusable, so that no session is requested."""

    @abstractmethod
    def fly(self, velocity: Array) -> None:
        """Fly with this desired velocity from now on [m/s]; shape (axes,)."""

    @abstractmethod
    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        """Measurements that became available since the last call, oldest first.

        Args:
            now_ns: time now, never decreasing; the flight begins at the first call.
        """

    def set_parameters(self) -> bool:
        """Allow the client to change unsafe parameters of the hardware; False if it has none.

        The client calls this before any other method, or never.
        """
        return False

    @property
    def is_ready(self) -> bool:
        """Whether a session may be requested: the vehicle is present, and configured safely."""
        return True

    @property
    def waits_for(self) -> str:
        """Reason why the vehicle cannot fly yet, in words; empty if there is none."""
        return ""

    def take_off(self, *, now_ns: int) -> bool:  # noqa: ARG002 - ignored by default
        """Take off if needed; True once the vehicle can be flown by velocities."""
        return True

    def is_up(self, *, now_ns: int) -> bool:  # noqa: ARG002 - ignored by default
        """Whether the vehicle is in the air and can be flown by velocities; never arms."""
        return True

    @property
    def took_off(self) -> bool:
        """Whether the vehicle has taken off during this run of the client. If so, the motion of an
        earlier run is not continued.
        """
        return False

    def hindrance(self, *, now_ns: int) -> Reason | None:  # noqa: ARG002 - ignored by default
        """Reason on the vehicle's side that forbids following a plan now; None without one."""
        return None

    def decide(self, *, keeps_frame: bool) -> None:  # noqa: B027 - optional
        """Decide about `leap_m` after a leap.

        Args:
            keeps_frame: True to subtract the displacement permanently (keep the old frame), False
                to use the new frame.
        """

    def land(self) -> bool:
        """Land without further commands; False if the client has to command the descent."""
        return False

    def return_home(self) -> None:  # noqa: B027 - optional
        """Return home and land there without further commands; only called if `returns` is True."""

    @property
    def is_down(self) -> bool:
        """Whether the vehicle needs no more control after its flight."""
        return True

    @property
    def frame(self) -> VehicleMemory:
        """State that the next run of the client needs."""
        return VehicleMemory()

    def recall(self, frame: VehicleMemory) -> None:  # noqa: B027 - optional
        """Restore the state that an earlier run of the client saved. The client calls this before
        any other method, or never.
        """

    def arm(self) -> None:  # noqa: B027 - optional
        """Allow arming, on an operator's order in flight."""

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        """Why a change of `changeable` keys is refused; empty if it is accepted."""
        return ""

    def truth(self) -> Array | None:
        """True position [m] and velocity [m/s], shape (axes, 2); None if unknown."""
        return None

    def change(self, scenario: Scenario) -> None:  # noqa: B027 - optional
        """Apply the `changeable` keys of another scenario from now on."""
