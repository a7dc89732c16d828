"""Routes to vehicles that have one address each, stored in their sessions.

`server.paths` replaces these routes if a vehicle has several paths.
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
"""Module for vehicles with several paths, loaded at the first observation with a loss report."""


class Route(Protocol):
    """Sends packets to a vehicle with several paths, see `Session.route`."""

    @property
    def is_ready(self) -> bool:
        """Whether the route may be used."""

    def sealed(self, payload: bytes, line: ReplyPath, now_ns: int) -> Sequence[Datagram]:
        """Datagrams that carry a message; see `Session.sealed`."""


class Routes:
    """Routes to all vehicles of a server; each `session` is a `sessions.Session`."""

    def of_several(self, entropy: Callable[[int], bytes], spread: str, timeout_ns: int) -> "Routes":
        """Routes to vehicles with one or several paths, which replace these routes.

        Args:
            entropy: function that returns a number of random bytes.
            spread: `link.spread`.
            timeout_ns: time without a packet after which a vehicle considers the link lost [ns].
        """
        routes: Routes = load(ROOM, "paths").make(entropy, spread, timeout_ns)
        return routes

    def is_copy(self, datagram: Datagram, now_ns: int) -> bool:
        """Whether the same datagram has arrived before, over another path."""
        return False

    def is_repeat(self, session: Any, datagram: Datagram) -> bool:
        """Whether a datagram refused as a repeat is a copy that came over another path."""
        return False

    def hear(
        self, session: Any, report: Report, message: Message, datagram: Datagram, now_ns: int
    ) -> None:
        """Note the loss report that precedes a message of a session."""

    def observe(
        self,
        session: Any,
        report: Report,
        datagram: Datagram,
        now_ns: int,
        *,
        is_newest: bool,
    ) -> Message | None:
        """Note the loss report before an observation; return a request for a proof."""
        return None

    def take(
        self, session: Any, message: Message, datagram: Datagram, now_ns: int
    ) -> Message | None:
        """Process a message about paths; returns the answer.

        Raises:
            ProtocolError: the vehicle of the session has one path.
        """
        raise ProtocolError(Drop.FIELD)

    def narrow(self, session: Any) -> None:
        """Note that a client with several paths has restarted with one address."""

    def restart(self, session: Any) -> None:
        """Note that a client may have restarted and continued its session."""

    def forget(self, session: Any) -> None:
        """Forget a session that has ended."""

    def appraise(self, decisions: Any) -> None:
        """Note the trigger's decisions and the costs of not sending, before plans are sent."""

    def watch(
        self, put: Callable[[int, Sequence[Datagram]], None], events: Events, now_ns: int
    ) -> None:
        """Send the datagrams that are due, by row; called at each tick."""

    def figures(self, session: Any, now_ns: int) -> dict[str, Any]:
        return {}
