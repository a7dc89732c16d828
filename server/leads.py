"""Who leads vehicles. The plain form: this server leads each of them.

A room may put another in its place, as `server.standby` does for vehicles with two servers.
"""

from collections.abc import Iterable
from typing import Any, Protocol

from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.terms import Limits
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Message, RoomMessage


class Leader(Protocol):
    """The server's planning, as far as it depends on who leads; see `Controller`."""

    def lead(
        self, row: int, message: RoomMessage | None, *, leads: bool = True, plans_due: int = 0
    ) -> None:
        """Note whether this server leads a vehicle.

        Args:
            message: what the vehicle has said of it; None if it has no other server.
            plans_due: number of plans to send next, whatever the trigger says.
        """


class Leads:
    """Leaders of all vehicles of a server; a session is a `sessions.Session`."""

    def __init__(self, controller: Leader, limits: Limits | None) -> None:
        self.controller, self.limits = controller, limits
        """Limits of motions, see `Scheme.limits`; None if vehicles may follow different servers."""
        self.changes = 0
        """Number of their changes in flight."""
        self.changed_ns: int | None = None
        """Time of the newest change."""

    def change(self, limits: Limits | None, now_ns: int) -> None:
        if limits is not self.limits:
            self.limits, self.changed_ns = limits, now_ns
            self.changes += 1

    def begin(self, session: Any) -> None:
        """Begin with a vehicle in a row that was forgotten."""
        self.controller.lead(session.row, None)

    def take(self, session: Any, message: Message) -> Message:
        """Take a message of the room; returns the answer.

        Raises:
            ProtocolError: the session has no such messages.
        """
        raise ProtocolError(Drop.FIELD)

    def signed(self, session: Any, plan: bytes) -> bytes:
        """Plan as it is sent to a vehicle."""
        return plan

    def spread(self, sessions: Iterable[Any], now_ns: int) -> Iterable[Datagram]:
        """What vehicles have to know of their leader, once a second."""
        return ()
