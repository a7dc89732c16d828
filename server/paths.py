"""Paths from the server to a vehicle: the proven addresses, and what is sent to each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from skytether.server.gate import ReplyPath
from skytether.shared.core.endpoint import Address, Datagram
from skytether.shared.wire.paths import Paths
from skytether.shared.wire.protocol import PathProof, encode


class Place(NamedTuple):
    """Address of a vehicle, and the server's socket at which it is heard."""

    peer: Address
    socket: int


class _Asked(NamedTuple):
    place: Place
    proof: int


class ServerPaths:
    """Paths of one session.

    A path is used once the vehicle has returned a random number from its address: somebody who
    copies its packets from elsewhere cannot.

    Args:
        spread: `link.spread`.
        entropy: returns this many random bytes.
        timeout_ns: time without a packet after which the vehicle takes the link for lost [ns].
    """

    def __init__(
        self,
        prices: tuple[int, ...],
        spread: str,
        entropy: Callable[[int], bytes],
        timeout_ns: int,
    ) -> None:
        self.paths, self._prices = Paths(prices, spread), prices
        self._entropy, self._timeout_ns = entropy, timeout_ns
        self._places: dict[int, Place] = {}
        self._asked: dict[int, _Asked] = {}

    def number(self, place: Place) -> int | None:
        """Number of the path with a proven address; None if there is none."""
        return next((path for path, each in self._places.items() if each == place), None)

    def prove(self, message: PathProof, place: Place) -> PathProof | None:
        """Question to send to an address that names a path; None if it is proven."""
        path = message.path
        if path >= len(self.paths.each) or self._places.get(path) == place:
            return None
        asked = self._asked.get(path)
        if asked and asked == (place, message.proof):
            self._places[path] = place
            del self._asked[path]
            return None
        if asked is None or asked.place != place:
            # The highest bit is set, so that msgpack uses nine bytes for every number.
            asked = _Asked(place, int.from_bytes(self._entropy(8)) | 2**63)
            self._asked[path] = asked
        return message._replace(proof=asked.proof)

    def sealed(self, payload: bytes, line: ReplyPath, now_ns: int, worth: float) -> list[Datagram]:
        among = sorted(self._places)
        worth = max(worth, self.paths.alive_worth(self._timeout_ns, now_ns))
        return self._put(payload, line, self.paths.choose(worth, now_ns, among), now_ns)

    def watched(
        self, vehicle: int, session: int, line: ReplyPath, silence_ns: int, now_ns: int
    ) -> list[Datagram]:
        """Datagrams that are due: the newest one again if it was lost, and one on each path that
        was not used for long.
        """
        due = []
        if resent := self.paths.again(silence_ns, now_ns, sorted(self._places)):
            datagram, path = resent
            due.append(Datagram(datagram, *self._places[path]))
        for path in self.paths.looks(now_ns):
            if path in self._places:
                payload = encode(PathProof(vehicle, session, path, 0, self._prices))
                due += self._put(payload, line, (path,), now_ns)
        return due

    def _put(
        self, payload: bytes, line: ReplyPath, on: Sequence[int], now_ns: int
    ) -> list[Datagram]:
        datagram = line.seal(self.paths.report() + payload)
        self.paths.sent(datagram, on, now_ns)
        return [Datagram(datagram, *self._places[path]) for path in on]

    @property
    def is_ready(self) -> bool:
        return bool(self._places)
