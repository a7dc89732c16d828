"""Paths from the server to a vehicle: the vehicle's addresses, and the datagrams sent to each.

`RoutesOverPaths` replaces `server.routes.Routes` at the first report of a vehicle with several
paths (`server.reception`); a server in real time loads this module before its first packet.
"""

import hashlib
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from skytether.server.controller import Decisions
from skytether.server.gate import ReplyPath
from skytether.server.routes import Routes
from skytether.server.sessions import Session
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.events.flight import address_text
from skytether.shared.events.paths import PathDied, PathHealed
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import Report
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.paths import EVERYWHERE, Paths
from skytether.shared.wire.protocol import (
    Close,
    Horizon,
    Message,
    Trajectory,
    encode,
    kind_of,
    number_of,
)

CLOSE, PLANS = number_of(Close), (number_of(Horizon), number_of(Trajectory))
PLACES = 2
"""Largest number of addresses of a path that are in use at once."""
FORMER_NS = 2 * SECOND_NS
"""Time for which packets are still sent to a former address after its last packet [ns]."""


class Place(NamedTuple):
    """Address of a vehicle, and the server's socket that receives its packets."""

    peer: Address
    socket: int


class ServerPaths:
    """Paths of one session.

    A path is used once its address is proven: the server sends a number to the address, and the
    vehicle returns it from that address. An attacker elsewhere who copies packets cannot do so.
    The number is computed from the address and a secret, like a cookie, so no request is stored.

    An attacker who forwards copies in both directions can prove an address of its own. So the
    former address of a path stays in use while packets still come from there, and the path still
    works after the attacker stops.

    Args:
        spread: `link.spread`.
        entropy: function that returns a number of random bytes.
        timeout_ns: time without a packet after which the vehicle considers the link lost [ns].
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
        """Proven addresses of each path, newest last, and the time of their last packet [ns]."""
        self.plan_worth = 0.0
        """Cost of losing the next plan, in units of the price of a packet."""

    def number(self, place: Place) -> int | None:
        """Number of the path that the address is proven for; None if the address is not proven."""
        return next((path for path, places in self._places.items() if place in places), None)

    def hear(self, place: Place, now_ns: int) -> int | None:
        """Note that a datagram has arrived from an address; return the path as `number` does."""
        path = self.number(place)
        if path is not None:
            self._places[path][place] = now_ns
        return path

    @property
    def places(self) -> Collection[Place]:
        """Proven addresses of all paths."""
        return [*chain.from_iterable(self._places.values())]

    def set_prices(self, prices: tuple[int, ...]) -> None:
        if prices != self.prices and len(prices) == len(self.prices):
            self.prices = prices
            self.paths.set_prices(prices)

    def prove(self, message: PathProof, place: Place, now_ns: int) -> PathProof | None:
        """Request for a proof of the address of a message; None if the address is proven."""
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
        """Request for a proof of the address `place`; the vehicle's answer names the path."""
        return PathProof(vehicle, session, path, self._proof(place), self.prices)

    def _proof(self, place: Place) -> int:
        (host, port), socket = place
        text = f"{host} {port} {socket}".encode()
        digest = hashlib.blake2s(text, key=self._secret, digest_size=8).digest()
        # The highest bit is set, so that msgpack uses nine bytes for every number.
        return int.from_bytes(digest) | 2**63

    def sealed(self, payload: bytes, line: ReplyPath, now_ns: int) -> list[Datagram]:
        kind = kind_of(payload)
        worth = EVERYWHERE if kind == CLOSE else self.plan_worth if kind in PLANS else 0.0
        among = sorted(self._places)
        chosen = self.paths.choose(worth, now_ns, among)
        return self._put(payload, line, chosen, now_ns, worth=worth)

    def watched(
        self, vehicle: int, session: int, line: ReplyPath, silence_ns: int, now_ns: int
    ) -> list[Datagram]:
        """Datagrams that are due: the newest datagram again if it was lost, and a probe on each
        path that has been unused for long.
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
        """Events for paths that have failed, or work again, since the last call."""
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
        """Datagrams to a path's newest address, and to the former one if packets come from it."""
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


class RoutesOverPaths(Routes):
    """Routes to vehicles with one or several paths.

    Args:
        entropy: function that returns a number of random bytes.
        spread: `link.spread`.
        timeout_ns: time without a packet after which a vehicle considers the link lost [ns].
    """

    def __init__(self, entropy: Callable[[int], bytes], spread: str, timeout_ns: int) -> None:
        self._entropy, self._spread, self._timeout_ns = entropy, spread, timeout_ns
        self.of: dict[int, Session] = {}
        """Live sessions with several paths, by vehicle."""
        self.at: dict[Place, Session] = {}
        """Live sessions with several paths, by the proven address of each path."""

    def of_several(self, entropy: Callable[[int], bytes], spread: str, timeout_ns: int) -> Routes:  # noqa: ARG002
        return self

    def is_copy(self, datagram: Datagram, now_ns: int) -> bool:
        place = Place(datagram.peer, datagram.socket)
        session = self.at.get(place)
        paths = session and _paths(session)
        if not paths or not paths.paths.is_copy(datagram.payload, paths.number(place)):
            return False
        paths.hear(place, now_ns)
        return True

    def is_repeat(self, session: Session, datagram: Datagram) -> bool:
        paths = _paths(session)
        return paths is not None and paths.paths.is_copy(datagram.payload, None)

    def hear(
        self, session: Session, report: Report, message: Message, datagram: Datagram, now_ns: int
    ) -> None:
        if paths := _paths(session):
            is_recent = not isinstance(message, PathProof)
            _hear(paths, report, datagram, now_ns, is_recent=is_recent)

    def observe(
        self, session: Session, report: Report, datagram: Datagram, now_ns: int, *, is_newest: bool
    ) -> PathProof | None:
        """Note the loss report that precedes an observation; return a request for a proof if the
        sender's address is new.
        """
        count, paths = len(report.arrived), _paths(session)
        if paths is None or len(paths.prices) != count:
            paths = ServerPaths((1,) * count, self._spread, self._entropy, self._timeout_ns)
            self._note(session, paths)
        if _hear(paths, report, datagram, now_ns) is None and is_newest:
            place = Place(datagram.peer, datagram.socket)
            return paths.question(session.vehicle, session.number, place)
        return None

    def take(
        self, session: Session, message: Message, datagram: Datagram, now_ns: int
    ) -> PathProof | None:
        """Note a path's address once it is proven; until then return the request for a proof."""
        paths = _paths(session)
        if paths is None or not isinstance(message, PathProof):
            raise ProtocolError(Drop.FIELD)
        paths.set_prices(message.prices)
        place = Place(datagram.peer, datagram.socket)
        question = paths.prove(message, place, now_ns)
        if question is None and place in paths.places and self.at.get(place) is not session:
            self._note(session, paths)
        return question

    def narrow(self, session: Session) -> None:
        if session.route:
            self.forget(session)

    def restart(self, session: Session) -> None:
        """Note that a client may have restarted and kept its session."""
        if paths := _paths(session):
            paths.paths.peer_may_restart = True

    def forget(self, session: Session) -> None:
        session.route = None
        if self.of.get(session.vehicle) is session:
            del self.of[session.vehicle]
            for place in [place for place, each in self.at.items() if each is session]:
                del self.at[place]

    def appraise(self, decisions: Decisions) -> None:
        """Note the cost of losing each plan.

        A trigger sends if the cost of not sending exceeds its threshold, so the threshold is the
        price of a packet.
        """
        rows, verdict = decisions.batch.rows, decisions.verdict
        if not self.of:
            return
        worths: dict[int, float] = {}
        if verdict.compares:
            with np.errstate(divide="ignore", invalid="ignore"):
                each = np.nan_to_num(verdict.figure / verdict.threshold, nan=0.0)
            worths = dict(zip(rows.tolist(), each.tolist(), strict=False))
        for session in self.of.values():
            paths = _paths(session)
            assert paths
            paths.plan_worth = worths.get(session.row, 0.0)

    def watch(
        self, put: Callable[[int, Sequence[Datagram]], None], events: Events, now_ns: int
    ) -> None:
        for session in self.of.values():
            silence_ns, paths = session.hearing.silence_ns, _paths(session)
            assert paths
            due = paths.watched(session.vehicle, session.number, session.line, silence_ns, now_ns)
            put(session.row, due)
            events += paths.turned(session.vehicle, now_ns)

    def figures(self, session: Session, now_ns: int) -> dict[str, Any]:
        paths = _paths(session)
        return {"paths": paths.paths.figures(now_ns)} if paths else {}

    def _note(self, session: Session, paths: ServerPaths) -> None:
        """Note the paths of a session and their proven addresses; they replace earlier paths."""
        self.forget(session)
        session.route = paths
        self.of[session.vehicle] = session
        self.at |= dict.fromkeys(paths.places, session)


make = RoutesOverPaths
"""Function that `server.routes.Routes.of_several` calls to make the routes."""


def _paths(session: Session) -> ServerPaths | None:
    """Paths of a session; None with a single address."""
    return session.route if isinstance(session.route, ServerPaths) else None


def _hear(
    paths: ServerPaths, report: Report, datagram: Datagram, now_ns: int, *, is_recent: bool = True
) -> int | None:
    """Note a message's loss report; return the message's path, or None without a proven address."""
    path = paths.hear(Place(datagram.peer, datagram.socket), now_ns)
    paths.paths.heard(report, datagram.payload, path, now_ns, is_recent=is_recent)
    return path
