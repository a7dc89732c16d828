"""Paths from the server to a vehicle: the proven addresses, and what is sent to each."""

import hashlib
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

from skytether.server.gate import ReplyPath
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram
from skytether.shared.core.events import PathDied, PathHealed, address_text
from skytether.shared.wire.paths import Paths
from skytether.shared.wire.protocol import PathProof, encode

PLACES = 2
"""Number of addresses of a path that are in use at once."""
FORMER_NS = 2 * SECOND_NS
"""Time for which packets are also sent to a path's former address after it was last heard [ns]."""


class Place(NamedTuple):
    """Address of a vehicle, and the server's socket at which it is heard."""

    peer: Address
    socket: int


class ServerPaths:
    """Paths of one session.

    A path is used once the vehicle has returned a number from its address that was sent only there:
    somebody who copies its packets from elsewhere cannot. As with a cookie, the number is computed
    from the address and a secret, so questions are not stored.

    Somebody who forwards copies in both directions can: his address is then proven as well. So the
    former address of a path stays in use for as long as packets still come from it, and he cannot
    take the path away when he stops.

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
        self.paths, self.prices = Paths(prices, timeout_ns, spread), prices
        self._secret = entropy(hashlib.blake2s.MAX_KEY_SIZE)
        self._places: dict[int, dict[Place, int]] = {}
        """Proven addresses of each path, and when they were last heard [ns]; the newest is last."""

    def number(self, place: Place) -> int | None:
        """Number of the path with a proven address; None if there is none."""
        return next((path for path, places in self._places.items() if place in places), None)

    def hear(self, place: Place, now_ns: int) -> int | None:
        """Note that a datagram has come from an address; returns `number`."""
        path = self.number(place)
        if path is not None:
            self._places[path][place] = now_ns
        return path

    @property
    def places(self) -> Collection[Place]:
        """Proven addresses."""
        return [*chain.from_iterable(self._places.values())]

    def set_prices(self, prices: tuple[int, ...]) -> None:
        if prices != self.prices and len(prices) == len(self.prices):
            self.prices = prices
            self.paths.set_prices(prices)

    def prove(self, message: PathProof, place: Place, now_ns: int) -> PathProof | None:
        """Question to send to an address that names a path; None if it is proven."""
        path = message.path
        if path >= len(self.paths.each) or place in self._places.get(path, ()):
            return None
        if message.proof != self._proof(place):
            return self.question(message.vehicle, message.session, place, path)
        places = self._places.setdefault(path, {})
        places[place] = now_ns
        if len(places) > PLACES:
            del places[min(places, key=places.__getitem__)]
        return None

    def question(self, vehicle: int, session: int, place: Place, path: int = 0) -> PathProof:
        """Question to an address; the vehicle knows which path it is."""
        return PathProof(vehicle, session, path, self._proof(place), self.prices)

    def _proof(self, place: Place) -> int:
        (host, port), socket = place
        text = f"{host} {port} {socket}".encode()
        digest = hashlib.blake2s(text, key=self._secret, digest_size=8).digest()
        # The highest bit is set, so that msgpack uses nine bytes for every number.
        return int.from_bytes(digest) | 2**63

    def sealed(self, payload: bytes, line: ReplyPath, now_ns: int, worth: float) -> list[Datagram]:
        among = sorted(self._places)
        chosen = self.paths.choose(worth, now_ns, among)
        return self._put(payload, line, chosen, now_ns, worth=worth)

    def watched(
        self, vehicle: int, session: int, line: ReplyPath, silence_ns: int, now_ns: int
    ) -> list[Datagram]:
        """Datagrams that are due: the newest one again if it was lost, and one on each path that
        was not used for long.
        """
        due = []
        if resent := self.paths.again(silence_ns, now_ns, sorted(self._places)):
            datagram, path = resent
            due += self._to(path, datagram, now_ns)
        for path in self.paths.looks(now_ns):
            if path in self._places:
                payload = encode(PathProof(vehicle, session, path, 0, self.prices))
                due += self._put(payload, line, (path,), now_ns, is_probe=True)
        return due

    def turned(self, vehicle: int, now_ns: int) -> Iterator[PathDied | PathHealed]:
        """Paths that have died, or are well again, since the last call."""
        for path, is_dead in self.paths.turned(now_ns):
            newest = next(reversed(self._places.get(path, {})), None)
            via = address_text(*newest.peer) if newest else "unproven"
            yield (PathDied if is_dead else PathHealed)(vehicle=vehicle, path=path, via=via)

    def _put(
        self,
        payload: bytes,
        line: ReplyPath,
        on: Sequence[int],
        now_ns: int,
        *,
        worth: float = 0.0,
        is_probe: bool = False,
    ) -> list[Datagram]:
        datagram = line.seal(self.paths.report() + payload)
        self.paths.sent(datagram, on, now_ns, worth=worth, is_probe=is_probe)
        return [*chain.from_iterable(self._to(path, datagram, now_ns) for path in on)]

    def _to(self, path: int, datagram: bytes, now_ns: int) -> list[Datagram]:
        """A datagram to a path's newest address, and to the former one while that is heard."""
        places = self._places[path]
        newest = next(reversed(places))
        return [
            Datagram(datagram, *place)
            for place, heard_ns in places.items()
            if place == newest or now_ns - heard_ns <= FORMER_NS
        ]

    @property
    def is_ready(self) -> bool:
        return bool(self._places)
