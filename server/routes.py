"""Routes to vehicles. The plain form: each vehicle has one address, which its session knows.

A room may put another in its place, as `server.paths` does for vehicles with several paths.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from skytether.server.gate import ReplyPath
from skytether.shared.endpoints.endpoint import Datagram, Events
from skytether.shared.scenario.registry import load
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import Report
from skytether.shared.wire.protocol import Message

ROOM = "skytether.server.paths"
"""Module of vehicles with several paths; the first report in front of an observation loads it."""


class Route(Protocol):
    """Sends packets to a vehicle with several paths, see `Session.route`."""

    @property
    def is_ready(self) -> bool:
        """Whether it may be used."""

    def sealed(self, payload: bytes, line: ReplyPath, now_ns: int) -> Sequence[Datagram]:
        """Datagrams that carry a message; see `Session.sealed`."""


class Routes:
    """Routes to all vehicles of a server; a session is a `sessions.Session`."""

    def of_several(self, entropy: Callable[[int], bytes], spread: str, timeout_ns: int) -> "Routes":
        """Routes to vehicles of which some have several paths.

        Args:
            entropy: returns this many random bytes.
            spread: `link.spread`.
            timeout_ns: time without a packet after which a vehicle takes the link for lost [ns].
        """
        routes: Routes = load(ROOM, "paths").RoutesOverPaths(entropy, spread, timeout_ns)
        return routes

    def is_copy(self, datagram: Datagram, now_ns: int) -> bool:
        """Whether a datagram has come before, over another path."""
        return False

    def is_repeat(self, session: Any, datagram: Datagram) -> bool:
        """Whether a datagram that the channel refused as a repeat came before over another path."""
        return False

    def hear(
        self, session: Any, report: Report, message: Message, datagram: Datagram, now_ns: int
    ) -> None:
        """Note the report in front of a message of a session."""

    def observe(
        self,
        session: Any,
        report: Report,
        datagram: Datagram,
        now_ns: int,
        *,
        is_newest: bool,
    ) -> Message | None:
        """Note the report in front of an observation; returns a question to its sender."""
        return None

    def take(
        self, session: Any, message: Message, datagram: Datagram, now_ns: int
    ) -> Message | None:
        """Take a message of the room; returns the answer.

        Raises:
            ProtocolError: the session has no such messages.
        """
        raise ProtocolError(Drop.FIELD)

    def narrow(self, session: Any) -> None:
        """Note that a client was started again with one address."""

    def restart(self, session: Any) -> None:
        """Note that a client may have been started again in its session."""

    def forget(self, session: Any) -> None:
        """Forget a session that has ended."""

    def appraise(self, decisions: Any) -> None:
        """Note what is decided for vehicles, before their plans are sent."""

    def watch(
        self, put: Callable[[int, Sequence[Datagram]], None], events: Events, now_ns: int
    ) -> None:
        """Send what is due, by row; called at each tick."""

    def figures(self, session: Any, now_ns: int) -> dict[str, Any]:
        return {}
