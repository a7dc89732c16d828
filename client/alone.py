"""A client with one server that leads its vehicle, and without saved state.

Rooms may put others in their places: `client.servers` with a standby server, and `client.memory`,
with which the next run of a client continues in the middle of a flight.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from skytether.client.failsafe import Failsafe
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import Message

LEADER_KEY = "link.leader"
NAMES = ("server", "standby")
"""Values of that key, by the number of the server."""


class MotionInForce(NamedTuple):
    """Motion of a mission that a vehicle flies."""

    step: int
    """Step of its plan."""
    observed: int
    """Step of the observation that the plan was made from."""
    since: int
    """First step whose input came from it."""
    spacing: int
    """Steps from one knot to the next."""
    numbers: bytes
    """Position [m] and velocity [m/s] of each knot, float32 of shape (axes, knots, 2)."""


class Fresh:
    """A client that saves nothing: its vehicle begins on the ground."""

    leadership, heard_ns = 0, 0
    began_ns: int | None = None
    motion: Any = None

    def __init__(self, boot_id: int) -> None:
        self.before: Any = self
        """What an earlier run has saved: nothing."""
        self.boot_id = boot_id

    @property
    def unsaved(self) -> bool:
        """Whether the next run would not go on from the present state, although it should."""
        return False

    @property
    def is_stale(self) -> bool:
        """Whether the client, if it was started again now, would go on from an earlier state."""
        return False

    def keep(self, state: Callable[[], dict[str, Any]], *, now_ns: int) -> bytes | None:
        """Bytes to be written, if the state has changed."""
        return None

    def may_tell(self, state: Callable[[], dict[str, Any]], *, now_ns: int) -> bool:
        """Whether messages may be sent before the state is saved."""
        return True

    def kept(self, *, nothing: bool) -> None:
        """Note that the bytes returned last were written, or that the file was removed."""


class Watch(Protocol):
    """What has to know of a server's packets and faults: the failsafe, or nobody."""

    def heard(self, *, now_ns: int) -> None:
        """Note a packet of the session."""

    def malformed(self, *, now_ns: int) -> None:
        """Note a malformed message that was sent by the server itself."""

    def meet(self, cause: Reason, *, now_ns: int) -> None:
        """Act on a cause on the server's side."""


class OneServer:
    """Servers of a vehicle: one, which leads and is sent no LEAD.

    Args:
        failsafe: receives the packets and faults of the server that leads.
    """

    leader = 0
    """Which server leads."""
    number = 0
    """Number of its leadership."""

    def __init__(self, failsafe: Failsafe) -> None:
        self.failsafe = failsafe
        self.sessions: list[Any] = []
        """Session with each server; the caller appends them."""

    @property
    def leading(self) -> Any:
        """Session with the server that leads."""
        return self.sessions[self.leader]

    def watch(self, server: int) -> Watch:
        """What notes the packets and faults of a server."""
        return self.failsafe

    def begin(self, server: int) -> None:
        """Note another session with a server."""

    def take(self, server: int, message: Message, now_ns: int) -> bool:
        """Take a message of the room; False if it has none."""
        return False

    def follow(self, *, step: int, on_ground: bool, now_ns: int) -> None:
        """Decide which server leads; called at each step, and on the ground.

        Args:
            step: step of the vehicle.
        """

    def may_observe(self, server: int) -> bool:
        """Whether a server may be sent observations."""
        return True

    def name(self, server: int, *, now_ns: int) -> None:
        """Let a server lead, on an operator's order."""

    def objection(self, named: str) -> str:
        """Why a server cannot be made the leader by `link.leader`; empty if it can."""
        if named == NAMES[0]:
            return ""
        return f"{LEADER_KEY}: got {named!r}, expected 'server' without a standby server"

    def figures(self) -> dict[str, Any]:
        return {}
