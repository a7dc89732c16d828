"""One direction of the network: a bounded heap of (due_ns, number, packet), and its statistics."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from netem.fate import Fate
from shared.endpoint import MILLISECOND_NS, Datagram
from shared.histogram import Histogram
from shared.record import Recorder

QUEUE_MAX = 65536
"""Packets under way in one direction; more are dropped, and counted apart from losses."""

DELAY_BIN_NS = 20 * MILLISECOND_NS
ERROR_BIN_NS = MILLISECOND_NS // 50


@dataclass(slots=True)
class Lane:
    """One flow in one direction."""

    flow: int
    fates: Iterator[Fate]
    taken: int = 0
    """Packets so far, lost ones with them."""
    newest_out: int = -1
    """Highest number that has left."""


@dataclass(slots=True)
class Counts:
    """What happened in one direction."""

    packets: int = 0
    bytes: int = 0
    forwarded: int = 0
    lost: int = 0
    reordered: int = 0
    """Overtaken by a later packet of their flow."""
    overflowed: int = 0
    depth_max: int = 0
    delay: Histogram = field(default_factory=lambda: Histogram(DELAY_BIN_NS))
    """As drawn, of forwarded packets."""
    error: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN_NS))
    """How much later than that they left."""


class Link:
    """Holds packets until they are due.

    Args:
        direction: UPLINK or DOWNLINK, for the record.
        recorder: takes one row a packet, where there is one.
    """

    def __init__(self, direction: int, recorder: Recorder | None) -> None:
        self._direction = direction
        self._recorder = recorder
        self._heap: list[tuple[int, int, Datagram, Lane, int, int]] = []
        """Due time and order of entry, then packet, lane, number in it, and delay."""
        self._entered = 0
        self.counts = Counts()

    def take(self, datagram: Datagram, lane: Lane, *, now_ns: int) -> None:
        """A packet enters, addressed to where it is to come out."""
        counts, number, size = self.counts, lane.taken, len(datagram.payload)
        delay_ns, lost = next(lane.fates)
        lane.taken += 1
        counts.packets += 1
        counts.bytes += size
        depth = len(self._heap)
        if lost:
            counts.lost += 1
            if self._recorder is not None:
                self._recorder.append_row(
                    self._direction, lane.flow, number, size, now_ns, delay_ns, True, False
                )
        elif depth >= QUEUE_MAX:
            counts.overflowed += 1
        else:
            self._entered += 1
            due_ns = now_ns + delay_ns
            heappush(self._heap, (due_ns, self._entered, datagram, lane, number, delay_ns))
            if depth >= counts.depth_max:
                counts.depth_max = depth + 1

    def give(self, *, now_ns: int) -> list[Datagram]:
        """The packets that are due."""
        heap, counts, out = self._heap, self.counts, []
        while heap and heap[0][0] <= now_ns:
            due_ns, _, datagram, lane, number, delay_ns = heappop(heap)
            overtaken = number < lane.newest_out
            if overtaken:
                counts.reordered += 1
            else:
                lane.newest_out = number
            counts.forwarded += 1
            counts.delay.add(delay_ns)
            counts.error.add(now_ns - due_ns)
            if self._recorder is not None:
                size, arrived_ns = len(datagram.payload), due_ns - delay_ns
                self._recorder.append_row(
                    self._direction, lane.flow, number, size, arrived_ns, delay_ns, False, overtaken
                )
            out.append(datagram)
        return out

    def next_due_ns(self) -> int | None:
        """When the next packet is due."""
        return self._heap[0][0] if self._heap else None

    def depth(self) -> int:
        """Packets under way."""
        return len(self._heap)
