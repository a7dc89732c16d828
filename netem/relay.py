"""Relay of byte streams: latency, a rate and cuts of TCP connections, which lose no byte.

A stream has no packets that could be lost. Each piece of it passes the same impairments as a packet
would; a piece that would be lost holds up its stream and is tried again every RETRY_NS, about as a
retransmission would be. Pieces never overtake each other, and are neither copied nor damaged. A
full queue takes nothing from its connections until there is room. This is no packet loss: TCP's own
answer to loss shows only where its packets pass, in a network namespace.

The ends of connection N are the peers `(CLIENT, N)` and `(SERVER, N)`; an empty piece says that an
end sends no more.
"""

from collections import deque
from dataclasses import replace
from typing import Any

from skytether.netem.fate import Fates
from skytether.netem.link import Lane, Link
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.core.endpoint import Address, Datagram, Endpoint, make_datagram
from skytether.shared.core.events import FlowOpened, Unreachable
from skytether.shared.core.line import CLIENT, PIECE_BYTES, SERVER
from skytether.shared.scenario.air.draws import SLOT_NS, Fate
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Recorder

RETRY_NS = 200 * MILLISECOND_NS
"""Time after which a piece that would have been lost is tried again [ns]: Linux's smallest
retransmission time-out."""


class Whole(Fates):
    """Fates that lose, copy and damage nothing; the relay asks for losses beforehand."""

    def at(self, slot: int, rank: int = 0) -> Fate:
        return replace(super().at(slot, rank), lost=False, copies=0, flipped=None)

    def loses(self, slot: int) -> bool:
        return super().at(slot).lost


class Stream:
    """One direction of a connection."""

    def __init__(self, lane: Lane, fates: Whole, link: Link) -> None:
        self.lane, self.fates, self.link = lane, fates, link
        self.held: deque[Datagram] = deque()
        """Pieces that have not entered the link."""
        self.retry_ns: int | None = None
        """Time at which the first held piece is tried again; None while it waits for room."""


class Relay(Endpoint):
    """Delays, slows and cuts the connections to one server.

    Args:
        server: address of the server, for events only.
        path: number of the session's path, from 0, in the record.
    """

    changeable = keys_of(InFlight.IMPAIRMENT)

    def __init__(
        self,
        scenario: Scenario,
        *,
        server: Address,
        recorder: Recorder | None = None,
        path: int = 0,
    ) -> None:
        super().__init__()
        self._scenario, self._server = scenario, server
        self.uplink = Link(UPLINK, PIECE_BYTES, recorder, number=path)
        self.downlink = Link(DOWNLINK, PIECE_BYTES, recorder, number=path)
        self._streams: dict[Address, Stream] = {}
        """Streams by their source."""
        self._holding: dict[Address, Stream] = {}
        """Streams with held pieces, in the order in which they are tried."""
        self._ended: set[Address] = set()
        """Sources whose end has left."""
        self._opened = 0
        self._retries = 0
        self._change_links(now_ns=0)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        source = side, number = datagram.peer
        if source not in self._streams:
            self._open(number, now_ns)
        onward = make_datagram((datagram.payload, (_other(side), number), datagram.socket))
        stream = self._streams[source]
        stream.held.append(onward)
        if len(stream.held) == 1:
            self._admit(source, stream, now_ns)
        self._forward(now_ns)

    def _open(self, number: int, now_ns: int) -> None:
        for side, name, link in (
            (CLIENT, "downlink", self.downlink),
            (SERVER, "uplink", self.uplink),
        ):
            fates = Whole(getattr(self._scenario, name), self._scenario.seed, name, self._opened)
            lane = Lane(self._opened, fates, now_ns)
            self._streams[side, number] = Stream(lane, fates, link)
        self._events.append(FlowOpened(flow=self._opened, host=CLIENT, port=number))
        self._opened += 1

    def _admit(self, source: Address, stream: Stream, now_ns: int) -> None:
        """Let the held pieces of a stream enter its link, up to one that must wait."""
        self._holding.pop(source, None)
        while stream.held:
            first = stream.held[0]
            if not stream.link.has_room(len(first.payload)):
                stream.retry_ns = None
            elif stream.fates.loses((now_ns - stream.lane.began_ns) // SLOT_NS):
                stream.retry_ns = now_ns + RETRY_NS
                self._retries += 1
            else:
                stream.link.accept(stream.held.popleft(), stream.lane, now_ns=now_ns)
                continue
            self._holding[source] = stream
            return

    def wake(self, *, now_ns: int) -> None:
        self._forward(now_ns)
        for source, stream in list(self._holding.items()):
            if stream.retry_ns is None or stream.retry_ns <= now_ns:
                self._admit(source, stream, now_ns)
        self._forward(now_ns)

    def _forward(self, now_ns: int) -> None:
        for link in (self.uplink, self.downlink):
            if link.is_due(now_ns):
                for piece in link.release(now_ns=now_ns):
                    self._out.append(piece)
                    if not piece.payload:
                        self._end(piece.peer)

    def _end(self, peer: Address) -> None:
        """Forget a connection once both of its ends have sent all."""
        side, number = peer
        self._ended.add((_other(side), number))
        both = (CLIENT, number), (SERVER, number)
        if self._ended.issuperset(both):
            for source in both:
                self._ended.discard(source)
                self._streams.pop(source, None)

    def next_wake_ns(self) -> int | None:
        due_ns = [self.uplink.next_due_ns(), self.downlink.next_due_ns()]
        due_ns += [stream.retry_ns for stream in self._holding.values()]
        return min((each for each in due_ns if each is not None), default=None)

    def undelivered(self, socket: int, reason: str) -> None:  # noqa: ARG002 - there is only one
        """Report a connection that the server has refused."""
        host, port = self._server
        self._events.append(Unreachable(host=host, port=port, reason=reason))

    def change(
        self,
        scenario: Scenario,
        keys: frozenset[str],  # noqa: ARG002
        *,
        now_ns: int,
    ) -> None:
        """See `Endpoint`; pieces that have entered keep their fate."""
        self._scenario = scenario
        self._change_links(now_ns=now_ns)
        for (side, _), stream in self._streams.items():
            name = "downlink" if side == CLIENT else "uplink"
            direction, flow = getattr(scenario, name), stream.lane.flow
            stream.fates = Whole(direction, scenario.seed, name, flow)
            stream.lane.fates = stream.fates
            if stream.held:
                stream.retry_ns = now_ns

    def _change_links(self, *, now_ns: int) -> None:
        for link, path in (
            (self.uplink, self._scenario.uplink),
            (self.downlink, self._scenario.downlink),
        ):
            link.change(path.for_streams(), now_ns=now_ns)

    def figures(self) -> dict[str, Any]:
        return {
            "flows": len(self._streams) // 2,
            "retries": self._retries,
            "uplink": self.uplink.figures(),
            "downlink": self.downlink.figures(),
        }


def _other(side: str) -> str:
    return SERVER if side == CLIENT else CLIENT
