"""Assignment of vehicles to a server; in this base class the server plans for all vehicles.

The class in `server.standby` replaces this class once a vehicle reports that it has two servers.
"""

from collections.abc import Iterable
from typing import Any, Protocol

from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.model import Indices
from skytether.shared.scenario.registry import load
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Message, Observation, RoomMessage

ROOM, MESSAGES = "skytether.server.standby", "skytether.shared.wire.lead"
"""Names of the module for vehicles with two servers, and of the module with their messages."""


class Decider(Protocol):
    """Interface of `Controller` to the modules that receive messages of vehicles."""

    observed_step: Indices
    """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""

    def begin(self, row: int, vehicle: int) -> None:
        """Assign a new vehicle to a free row."""

    def forget(self, row: int) -> None:
        """Forget everything about the vehicle of a row."""

    def restart(self, row: int) -> bool:
        """Note that a client has restarted without saved state; return whether to report this."""

    def observe(self, row: int, observation: Observation) -> bool:
        """Store an observation unless a newer one is stored; True if stored."""

    def assign(
        self, row: int, message: RoomMessage | None, *, is_own: bool = True, plans_due: int = 0
    ) -> None:
        """Note whether this server plans for a vehicle.

        Args:
            message: the vehicle's message about its servers; None if it has no other server.
            plans_due: number of plans to send next, whatever the trigger says.
        """


class Assignment:
    """Vehicles that a server plans for. Each `session` is of type `sessions.Session`."""

    def __init__(self, controller: Decider, limits: Any) -> None:
        self.controller, self.limits = controller, limits
        """Limits of motions, see `Scheme.limits`; None if vehicles may have different leaders."""
        self.changes = 0
        """Number of changes of `limits` in flight."""
        self.changed_ns: int | None = None
        """Time of the newest change of `limits` [ns]."""

    def change(self, limits: Any, now_ns: int) -> None:
        if limits is not self.limits:
            self.limits, self.changed_ns = limits, now_ns
            self.changes += 1

    def takes(self, message: Message) -> bool:
        """Whether a message says which server plans for a vehicle."""
        return type(message).__module__ == MESSAGES

    def of_several(self) -> "Assignment":
        """Assignment that replaces this one when a vehicle has several servers."""
        assignment: Assignment = load(ROOM, "a standby server").AssignmentOfTwo(self)
        return assignment

    def begin(self, session: Any) -> None:
        """Assign the vehicle of a new session."""
        self.controller.assign(session.row, None)

    def take(self, session: Any, message: Message) -> Message:
        """Process a message about the vehicle's servers; returns the answer.

        Raises:
            ProtocolError: the vehicle of the session has one server.
        """
        raise ProtocolError(Drop.FIELD)

    def signed(self, session: Any, plan: bytes) -> bytes:
        """Encoded plan as it is sent to a vehicle; unchanged in this base class."""
        return plan

    def spread(self, sessions: Iterable[Any], now_ns: int) -> Iterable[Datagram]:
        """Datagrams to vehicles about this server's limits, due once a second; none here."""
        return ()
