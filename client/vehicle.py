"""Vehicle as the pilot knows it: it takes a velocity, and gives measurements.

A vehicle measures at its own rate, by stamps of its own, and tells it late, or not at all; nobody
aboard knows more of its state than that. `client.simulated` is one that is computed. One that is
real talks to its autopilot through a `port`, which is driven as any endpoint is: by datagrams and
time. `client.vehicles` has the table of all.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from skytether.shared.core.endpoint import Endpoint
from skytether.shared.core.events import Failure
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason


class Measurement(NamedTuple):
    """Part of a vehicle's state, as it was measured: position, velocity, or both."""

    stamp_ns: int
    """Time at which the state was so [ns; the client's clock]."""
    position: list[float] | None
    """Position on each axis [m]; None where it was not measured."""
    velocity: list[float] | None
    """Velocity on each axis [m/s]; None where it was not measured."""

    def numbers(self) -> Array:
        """Positions and velocities, NaN where not measured; shape (2, axes)."""
        _, position, velocity = self
        if position is None or velocity is None:
            missing = [math.nan] * len(position or velocity or ())
            position, velocity = position or missing, velocity or missing
        # Of this type whatever a vehicle measures in: machine code takes it for that unasked.
        return np.array((position, velocity), dtype=np.float64)


Coordinate = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""Coordinate of an origin that is believed [m]."""


class Frame(msgspec.Struct, frozen=True, kw_only=True):
    """What a vehicle keeps for the next life of its client, see `client.memory`."""

    armed: bool = False
    """Whether a client has armed it since a person last said that it may be armed."""
    origin: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Origin of the scenario's frame in the autopilot's local frame, in our axes [m]; None where it
    is not known."""
    leap_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Displacement in `origin` that nobody has decided about, see `Vehicle.leap_m` [m]."""
    boot_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)] = 0
    """Time since the autopilot's boot at which that was so last [ms]."""
    at_ns: Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)] = 0
    """Time of the host's clock then [ns]; as bytes, relative to that of writing."""


class Vehicle(ABC):
    """A vehicle whose velocity can be commanded."""

    changeable: frozenset[str] = frozenset()
    """Keys of its scenario that may change in flight."""
    port: Endpoint | None = None
    """Endpoint that talks to the vehicle's own hardware, beside the link; None where there is
    none."""
    returns = False
    """Whether it can return home by itself, see `return_home`."""
    leap_m: tuple[float, ...] | None = None
    """Displacement of its measured position, on each axis, that nobody has decided about [m]; it is
    subtracted meanwhile. None: there is none, or the vehicle does not watch for any."""
    failure: Failure | None = None
    """Event after which the vehicle cannot be flown, and no session is asked for."""

    @abstractmethod
    def fly(self, velocity: Array) -> None:
        """Fly with this desired velocity from now on [m/s]; shape (axes,)."""

    @abstractmethod
    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        """Measurements that are there by now and were not told before, the oldest first.

        Args:
            now_ns: time now, never earlier than before; the flight begins at the first.
        """

    def set_parameters(self) -> bool:
        """Allow unsafe parameters of its hardware to be set; False for a vehicle without any.

        It is called before anything else, if at all.
        """
        return False

    @property
    def is_ready(self) -> bool:
        """Whether a server may be asked for a session: the vehicle is there, and set up safely."""
        return True

    @property
    def waits_for(self) -> str:
        """What is missing before it can be flown, in words; empty where nothing is."""
        return ""

    def take_off(self, *, now_ns: int) -> bool:  # noqa: ARG002 - most fly from the start
        """Whether the vehicle can be flown by velocities; asked until it can, it sees to that."""
        return True

    def is_up(self, *, now_ns: int) -> bool:  # noqa: ARG002 - most fly from the start
        """Whether the vehicle is in the air, and can be flown by velocities; it is not armed."""
        return True

    @property
    def took_off(self) -> bool:
        """Whether it has taken off since its client began: no earlier motion of it goes on."""
        return False

    def hindrance(self, *, now_ns: int) -> Reason | None:  # noqa: ARG002 - most know of none
        """Cause on the vehicle's side for which it must not follow a plan now, if there is any."""
        return None

    def decide(self, *, keeps_frame: bool) -> None:  # noqa: B027 - most watch for no leap
        """Let `leap_m` be subtracted for good, or count from now on.

        Args:
            keeps_frame: whether it is subtracted.
        """

    def land(self) -> bool:
        """Land by itself from now on; False of a vehicle that cannot, and has to be flown down."""
        return False

    def return_home(self) -> None:  # noqa: B027 - most cannot
        """Return home by itself from now on, and land there; only asked of one that `returns`."""

    @property
    def is_down(self) -> bool:
        """Whether the vehicle needs no more care after its flight."""
        return True

    @property
    def frame(self) -> Frame:
        """What the next life of its client needs to know of it."""
        return Frame()

    def recall(self, frame: Frame) -> None:  # noqa: B027 - most keep nothing
        """Take what an earlier life of the client has kept; before anything else, if at all."""

    def arm(self) -> None:  # noqa: B027 - most need not be armed
        """Take a person's word that the vehicle may be armed, given in flight."""

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        """Why a change of `changeable` keys is refused; empty where it is not."""
        return ""

    def truth(self) -> Array | None:
        """True position [m] and velocity [m/s] now, shape (axes, 2); None where nobody knows."""
        return None

    def change(self, scenario: Scenario) -> None:  # noqa: B027 - most have nothing that changes
        """Take over the `changeable` keys of another scenario from now on."""
