"""The route from a vehicle to a server over several paths, each an address with a socket.

`client.several` uses this route in place of `client.route.Route` for a server with several
addresses. `shared.wire.paths` chooses the paths of each message.
"""

from collections.abc import Callable, Sequence
from typing import Any

from skytether.client.route import Conversation, Route
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.events.flight import address_text
from skytether.shared.events.paths import PathDied, PathHealed
from skytether.shared.wire.framing import Report
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.paths import EVERYWHERE, Paths
from skytether.shared.wire.protocol import Close, Message, encode


class SeveralPaths(Route):
    """See `Route`.

    Args:
        events: list to which events for the operator are appended.
        names: name of each path in the log; empty: the addresses are the names.
        prices: price of a packet on each path; only their ratios matter.
        spread: `link.spread`.
        timeout_ns: time without a packet after which an end considers the link lost [ns].
    """

    def __init__(
        self,
        addresses: Sequence[Address],
        sockets: Sequence[int],
        out: list[Datagram],
        *,
        events: Events,
        names: Sequence[str],
        prices: Sequence[float],
        spread: str,
        timeout_ns: int,
    ) -> None:
        super().__init__(addresses, sockets, out)
        self._events, self._prices = events, prices
        self._names = names or [address_text(*each) for each in addresses]
        self._spread, self._timeout_ns = spread, timeout_ns
        self._all = range(len(addresses))
        self._paths: Paths | None = None
        """State of the paths in the present session; None before the first session."""
        self._proofs: dict[int, int] = {}
        """Proof of each path to be returned: the number in the server's newest request, by path."""
        self._greeted = 0
        """Path of the next HELLO."""

    def begin(self) -> None:
        self._proofs.clear()
        self._paths = Paths(self._prices, self._timeout_ns, self._spread)

    def greet(self, hello: bytes) -> None:
        self.put(hello, self._greeted)
        self._greeted = (self._greeted + 1) % len(self.addresses)

    def is_copy(self, datagram: bytes, path: int) -> bool:
        return self._paths is not None and self._paths.is_copy(datagram, path)

    def heard(
        self, report: Report, message: Message, datagram: bytes, path: int, now_ns: int
    ) -> None:
        if self._paths:
            is_recent = not isinstance(message, PathProof)
            self._paths.heard(report, datagram, path, now_ns, is_recent=is_recent)

    def take(self, session: Conversation, message: Message, path: int, now_ns: int) -> bool:
        if not isinstance(message, PathProof):
            return False
        session.note_heard(now_ns)
        if message.proof:
            self._proofs[path] = message.proof
            self._name(session, path, now_ns)
        return True

    def watch(self, session: Conversation, now_ns: int) -> None:
        """Repeat the newest packet if it was lost; probe paths; log paths that fail or recover."""
        if self._paths is None:
            return
        if resent := self._paths.again(session.hearing.silence_ns, now_ns, self._all):
            self.put(*resent)
        for path in self._paths.looks(now_ns):
            self._name(session, path, now_ns)
        for path, is_dead in self._paths.turned(now_ns):
            turned = PathDied if is_dead else PathHealed
            self._events.append(turned(vehicle=session.vehicle, path=path, via=self._names[path]))

    def post(self, seal: Callable[[bytes], bytes], message: Message, now_ns: int) -> None:
        assert self._paths is not None
        worth = EVERYWHERE if isinstance(message, Close) else 1.0
        chosen = self._paths.choose(worth, now_ns, self._all)
        self._send(self._paths, seal, encode(message), chosen, now_ns, worth=worth)

    def figures(self, now_ns: int) -> dict[str, Any]:
        return {"paths": self._paths.figures(now_ns)} if self._paths else {}

    def _name(self, session: Conversation, path: int, now_ns: int) -> None:
        """Send a PATH message on a path: its number, the proof, and the prices of all paths."""
        if session.number is not None and self._paths:
            least, proof = min(self._prices), self._proofs.get(path, 0)
            prices = tuple(round(1000 * price / least) for price in self._prices)
            named = encode(PathProof(session.vehicle, session.number, path, proof, prices))
            self._send(self._paths, session.link.seal, named, (path,), now_ns, is_probe=True)

    def _send(
        self,
        paths: Paths,
        seal: Callable[[bytes], bytes],
        payload: bytes,
        on: Sequence[int],
        now_ns: int,
        *,
        worth: float = 0.0,
        is_probe: bool = False,
    ) -> None:
        datagram = seal(paths.report() + payload)
        paths.sent(datagram, on, now_ns, worth=worth, is_probe=is_probe)
        for path in on:
            self.put(datagram, path)
