"""Vehicle as the pilot knows it: it takes a velocity, and gives measurements.

A vehicle measures at its own rate, by stamps of its own, and tells it late, or not at all; nobody
aboard knows more of its state than that. `client.simulated` is one that is computed. One that is
real talks to its autopilot through a `port`, which is driven as any endpoint is: by datagrams and
time. `client.vehicles` has the table of all.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from skytether.shared.core.endpoint import Endpoint
from skytether.shared.core.events import Failure
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason


class Measurement(NamedTuple):
    """Part of a vehicle's state, as it was measured."""

    stamp_ns: int
    """Time at which the state was so [ns; the client's clock]."""
    position: list[float] | None
    """Position on each axis [m]; None where it was not measured."""
    velocity: list[float] | None
    """Velocity on each axis [m/s]; None where it was not measured."""


class Vehicle(ABC):
    """A vehicle whose velocity can be commanded."""

    changeable: frozenset[str] = frozenset()
    """Keys of its scenario that may change in flight."""
    port: Endpoint | None = None
    """Endpoint that talks to the vehicle's own hardware, beside the link; None where there is
    none."""
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

    def take_off(self, *, now_ns: int) -> bool:  # noqa: ARG002 - most fly from the start
        """Whether the vehicle can be flown by velocities; asked until it can, it sees to that."""
        return True

    def hindrance(self, *, now_ns: int) -> Reason | None:  # noqa: ARG002 - most know of none
        """Cause on the vehicle's side for which it must not follow a plan now, if there is any."""
        return None

    def land(self) -> bool:
        """Land by itself from now on; False of a vehicle that cannot, and has to be flown down."""
        return False

    @property
    def is_down(self) -> bool:
        """Whether the vehicle needs no more care after its flight."""
        return True

    def truth(self) -> Array | None:
        """True position [m] and velocity [m/s] now, shape (axes, 2); None where nobody knows."""
        return None

    def change(self, scenario: Scenario) -> None:  # noqa: B027 - most have nothing that changes
        """Take over the `changeable` keys of another scenario from now on."""
