"""Relay of byte streams: adds latency, a rate limit and cuts to TCP connections; no byte is lost.

A stream has no packets that could be lost. Each piece of a stream passes the same impairments as a
packet; a piece that would be lost holds up its stream and is tried again every RETRY_NS, similar to
a retransmission. Pieces never overtake each other, and are neither copied nor damaged. While a
queue is full, nothing is read from its connections. So no TCP connection sees a packet loss here;
`netem.tunnel` emulates the packets of TCP, and shows its reaction to losses.

The ends of connection N are the peers `(CLIENT, N)` and `(SERVER, N)`. An empty piece means that
its sender has closed its side.
"""

from collections import deque
from collections.abc import Iterable
from copy import copy
from dataclasses import replace
from typing import Any

from skytether.netem.emulator import Direction, Emulator
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.impairments.draws import SLOT_NS, Fate
from skytether.netem.link import Lane, Link
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, make_datagram
from skytether.shared.endpoints.line import CLIENT, PIECE_BYTES, SERVER
from skytether.shared.endpoints.other_directions import KEYS, RELAY
from skytether.shared.events.flight import FlowOpened, Unreachable
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder

TRY = 1 << 32
"""Number added to a piece's number at each new try, so that each try has a new random loss."""
RETRY_NS = 200 * MILLISECOND_NS
"""Time after which a piece that a link would have lost is sent again [ns]: the smallest
retransmission time-out of Linux."""


class LosslessFates(Fates):
    """Fates of the pieces of a stream: pieces are delayed, but not lost, copied or damaged."""

    def at(self, slot: int, rank: int = 0) -> Fate:
        return replace(super().at(slot, rank), lost=False, copies=0, flipped=None)


class HalfConnection:
    """One direction of a connection: pieces held before its link, and its lane in the link."""

    def __init__(self, lane: Lane, link: Link) -> None:
        self.lane, self.link = lane, link
        self.held: deque[Datagram] = deque()
        """Held pieces: pieces that have not entered the link, the oldest first."""
        self.tries = 0
        """Number of tries at which the first held piece would have been lost."""
        self.retry_ns: int | None = None
        """Time at which the first held piece is tried again [ns]; None while it waits for space."""

    def loses(self, now_ns: int) -> bool:
        """Whether the first held piece would be lost now if it were a packet."""
        slot = (now_ns - self.lane.began_ns) // SLOT_NS
        number = self.lane.taken + TRY * self.tries
        return Fates.at(self.lane.fates, slot, number).lost  # `LosslessFates` would never lose it


class Relay(Emulator):
    """Delays, slows and cuts the connections to one server.

    Args:
        server: address of the server, for events only.
        recorder, path: see `Emulator`.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        server: Address,
        recorder: Recorder | None = None,
        path: int = 0,
    ) -> None:
        super().__init__(scenario, mtu=PIECE_BYTES, directions=RELAY, recorder=recorder, path=path)
        self._server = server
        self._streams: dict[Address, HalfConnection] = {}
        """One direction of each connection, by the peer that sends it."""
        self._holding: dict[Address, HalfConnection] = {}
        """Streams with held pieces, in the order in which they are tried."""
        self._ended: set[Address] = set()
        """Sources of streams whose end (an empty piece) has left the link."""
        self._retries = 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        source = side, number = datagram.peer
        if source not in self._streams:
            self._open(number, now_ns)
        stream = self._streams[source]
        onward = (datagram.payload, (_other(side), number), datagram.socket)
        stream.held.append(make_datagram(onward))
        if len(stream.held) == 1:
            self._admit(source, stream, now_ns)
        self._report(stream.lane.fates.fault)
        self._forward(now_ns)

    def _open(self, number: int, now_ns: int) -> None:
        up, down = self._open_lanes(now_ns)
        self._streams[SERVER, number] = HalfConnection(up, self.uplink)
        self._streams[CLIENT, number] = HalfConnection(down, self.downlink)
        self._events.append(FlowOpened(flow=up.flow, host=CLIENT, port=number))

    def _admit(self, source: Address, stream: HalfConnection, now_ns: int) -> None:
        """Let held pieces of a stream enter its link, until a piece has to wait."""
        self._holding.pop(source, None)
        while stream.held:
            if not stream.link.has_room(len(stream.held[0].payload)):
                stream.retry_ns = None
            elif stream.loses(now_ns):
                stream.retry_ns = now_ns + RETRY_NS
                stream.tries += 1
                self._retries += 1
            else:
                stream.link.accept(stream.held.popleft(), stream.lane, now_ns=now_ns)
                stream.tries = 0
                continue
            self._holding[source] = stream
            return

    def wake(self, *, now_ns: int) -> None:
        self._forward(now_ns)
        for source, stream in list(self._holding.items()):
            if stream.retry_ns is None or stream.retry_ns <= now_ns:
                self._admit(source, stream, now_ns)
        self._forward(now_ns)

    def next_wake_ns(self) -> int | None:
        retries_ns = [stream.retry_ns for stream in self._holding.values()]
        due_ns = (each for each in (super().next_wake_ns(), *retries_ns) if each is not None)
        return min(due_ns, default=None)

    def _leave(self, datagrams: list[Datagram]) -> None:
        super()._leave(datagrams)
        for payload, (side, number), _ in datagrams:
            if not payload:
                self._end(_other(side), number)

    def _end(self, side: str, number: int) -> None:
        """Forget a connection once both sides have closed it."""
        self._ended.add((side, number))
        both = (CLIENT, number), (SERVER, number)
        if self._ended.issuperset(both):
            self._ended.difference_update(both)
            for source in both:
                del self._streams[source]

    def undelivered(self, socket: int, reason: str) -> None:  # noqa: ARG002 - there is only one
        """Report a connection that the server has refused."""
        host, port = self._server
        self._events.append(Unreachable(host=host, port=port, reason=reason))

    def lanes(self) -> Iterable[tuple[Lane, Lane]]:
        for (side, number), stream in self._streams.items():
            if side == SERVER:
                yield stream.lane, self._streams[CLIENT, number].lane

    def impairments(self, name: Direction) -> Impairments:
        return _for_streams(super().impairments(name))

    def fates(self, name: Direction, flow: int) -> Fates:
        at = self._scenario.seed, name, flow
        return LosslessFates(self.link(name).impairments, *at, by_number=True)

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        return objection(scenario)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """See `Endpoint`; held pieces of streams are tried again at once."""
        super().change(scenario, keys, now_ns=now_ns)
        for stream in self._holding.values():
            stream.retry_ns = now_ns

    def figures(self) -> dict[str, Any]:
        flows = {"flows": len(self._streams) // 2, "retries": self._retries}
        return flows | super().figures()


def objection(scenario: Scenario) -> str:
    """Reason why byte streams cannot pass the network of a scenario; empty if they can."""
    for key, of in zip(KEYS, (scenario.uplink, scenario.downlink), strict=True):
        if names := _only_packets(of):
            expected = "impairments that streams can have, because TCP is relayed as a stream"
            what = f"{key}: got {' and '.join(names)}, expected {expected}"
            return f"{what}; `skytether netem run` passes packets of TCP"
    return ""


def _other(side: str) -> str:
    return SERVER if side == CLIENT else CLIENT


def _only_packets(of: Impairments) -> list[str]:
    """Names of the impairments that cannot apply to byte streams."""
    names = [name for name, each in of.parts if each.only_packets]
    return [*names, "drop=codel"] if of.queue and of.queue.drop == "codel" else names


def _for_streams(of: Impairments) -> Impairments:
    """Impairments for pieces of byte streams: pieces stay in order, and a queue drops none."""
    same = copy(of)
    same.is_ordered = True
    if same.queue:
        same.queue = copy(same.queue)
        same.queue.drop, same.queue.keeps_all = "tail", True
    return same
