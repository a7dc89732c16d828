"""One direction of the network: a bounded heap of (due_ns, number, packet), and its statistics."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from netem.fate import Fate
from shared.endpoint import MILLISECOND_NS, Datagram
from shared.record import Recorder

QUEUE_MAX = 65536
"""Packets under way in one direction; more are dropped, and counted apart from losses."""

DELAY_BIN_NS = 20 * MILLISECOND_NS
ERROR_BIN_NS = MILLISECOND_NS // 50
BINS = 500


class Histogram:
    """Counts of durations in bins of equal width; the last bin takes all that is longer."""

    def __init__(self, bin_ns: int) -> None:
        self.bin_ns = bin_ns
        self.counts = [0] * BINS
        self.largest_ns = 0

    def add(self, value_ns: int) -> None:
        """Count one."""
        # Once a packet: comparisons cost half of what min() and max() do.
        index = value_ns // self.bin_ns
        self.counts[index if index < BINS else -1] += 1
        if value_ns > self.largest_ns:  # noqa: PLR1730
            self.largest_ns = value_ns

    def quantile_ms(self, share: float) -> float:
        """Upper edge of the bin in which this share of all lies below [ms]; 0 without any."""
        wanted, seen = share * sum(self.counts), 0
        for index, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted and index < BINS - 1:
                return min((index + 1) * self.bin_ns, self.largest_ns) / MILLISECOND_NS
        return self.largest_ns / MILLISECOND_NS

    def __str__(self) -> str:
        bins = [
            f"{index * self.bin_ns / MILLISECOND_NS:g} ms: {count}"
            for index, count in enumerate(self.counts)
            if count
        ]
        return ", ".join(bins) or "empty"


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
        self._heap: list[tuple[int, int, Datagram, Lane, int, Fate]] = []
        self._entered = 0
        self.counts = Counts()

    def take(self, datagram: Datagram, lane: Lane, *, now_ns: int) -> None:
        """A packet enters, addressed to where it is to come out."""
        counts, number, fate = self.counts, lane.taken, next(lane.fates)
        lane.taken += 1
        counts.packets += 1
        counts.bytes += len(datagram.payload)
        if fate.lost:
            counts.lost += 1
            self._record(datagram, lane, number, fate, now_ns, overtaken=False)
        elif len(self._heap) >= QUEUE_MAX:
            counts.overflowed += 1
        else:
            self._entered += 1
            due_ns = now_ns + fate.delay_ns
            heappush(self._heap, (due_ns, self._entered, datagram, lane, number, fate))
            counts.depth_max = max(counts.depth_max, len(self._heap))

    def give(self, *, now_ns: int) -> list[Datagram]:
        """The packets that are due."""
        heap, counts, out = self._heap, self.counts, []
        while heap and heap[0][0] <= now_ns:
            due_ns, _, datagram, lane, number, fate = heappop(heap)
            overtaken = number < lane.newest_out
            if overtaken:
                counts.reordered += 1
            else:
                lane.newest_out = number
            counts.forwarded += 1
            counts.delay.add(fate.delay_ns)
            counts.error.add(now_ns - due_ns)
            self._record(datagram, lane, number, fate, due_ns - fate.delay_ns, overtaken=overtaken)
            out.append(datagram)
        return out

    def next_due_ns(self) -> int | None:
        """When the next packet is due."""
        return self._heap[0][0] if self._heap else None

    def depth(self) -> int:
        """Packets under way."""
        return len(self._heap)

    def _record(
        self,
        datagram: Datagram,
        lane: Lane,
        number: int,
        fate: Fate,
        arrived_ns: int,
        *,
        overtaken: bool,
    ) -> None:
        if self._recorder is None:
            return
        self._recorder.append(
            1,
            direction=self._direction,
            flow=lane.flow,
            number=number,
            bytes=len(datagram.payload),
            arrived_ns=arrived_ns,
            delay_ns=fate.delay_ns,
            lost=fate.lost,
            overtaken=overtaken,
        )
