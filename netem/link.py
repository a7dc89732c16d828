"""A link: one direction of the network, a bounded queue of packets by due time, and statistics.

packet → bottleneck, where the direction has a finite rate → lost, or delayed → out
"""

from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

from skytether.netem.bottleneck import Bottleneck
from skytether.netem.fate import Fates
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS
from skytether.shared.core.endpoint import Datagram
from skytether.shared.scenario.air.draws import SLOT_NS, Fate
from skytether.shared.scenario.air.path import Path
from skytether.shared.telemetry.histogram import Histogram
from skytether.shared.telemetry.record import Recorder

QUEUE_MAX = 65536
"""Largest number of packets under way in one direction; further ones are dropped, not "lost"."""
QUEUE_BYTES_MAX = 64 * 1024 * 1024
"""Largest UDP payload under way in one direction, whatever `network.mtu` lets pass [B]: with both
directions full, and what Python takes for each packet, netem stays below 256 MiB."""

DELAY_BIN_NS = 20 * MILLISECOND_NS
"""Width of the bins in which delays are counted [ns]: the lattice of the paper's delay."""
DELAY_EDGES_MS = (20, 40, 60, 80, 100, 140, 200, 300, 400, 500, 600, 800, 1000, 2000)
"""Edges between which delays are counted for those who draw them over time [ms]."""
ERROR_BIN_NS = MILLISECOND_NS // 50
"""Width of the bins in which errors of delays are counted [ns]."""
QUEUEING_BIN_NS = MILLISECOND_NS
"""Width of the bins in which times in a queue are counted [ns]."""
SLICE_BITS = 17
"""Length of a slice of the queue as a power of two [ns]: 0.13 ms, in which 13 of 100 000 packets a
second are due."""


@dataclass(slots=True)
class Lane:
    """State of one flow in one direction."""

    flow: int
    """Number of the flow, from 0."""
    fates: Fates
    """Fates of its packets."""
    began_ns: int
    """Time at which the flow began [ns]."""
    slot: int = -1
    """Slot in which its newest packet has entered, counted from when the flow began."""
    rank: int = 0
    """Rank of that packet among those of its slot."""
    taken: int = 0
    """Number of packets so far, lost ones included."""
    newest_out: int = -1
    """Highest number of a packet that has left, or -1."""
    latest_ns: int = 0
    """Time at which the last of its packets is due."""


class Entered(NamedTuple):
    """A packet that has entered, and waits to pass a finite rate."""

    datagram: Datagram
    lane: Lane
    number: int
    """Number of the packet in its lane."""
    fate: Fate
    entered_ns: int


@dataclass(slots=True)
class Counts:
    """Statistics of one direction."""

    packets: int = 0
    """Packets that entered, whatever became of them."""
    bytes: int = 0
    """UDP payload of these [B]."""
    forwarded: int = 0
    """Packets that have left."""
    lost: int = 0
    """Packets whose fate was to be lost."""
    reordered: int = 0
    """Packets overtaken by a later one of their flow."""
    oversized: int = 0
    """Packets dropped because they were longer than `network.mtu`."""
    overflowed: int = 0
    """Packets dropped because QUEUE_MAX or QUEUE_BYTES_MAX were under way."""
    dropped: int = 0
    """Packets that the queue of a finite rate has dropped."""
    duplicated: int = 0
    """Copies of packets."""
    corrupted: int = 0
    """Packets of which a bit was flipped."""
    depth_max: int = 0
    """Largest number of packets that were under way at once."""
    delay: Histogram = field(default_factory=lambda: Histogram(DELAY_BIN_NS))
    """Delays of forwarded packets, as drawn."""
    error: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN_NS))
    """Times by which forwarded packets left later than drawn."""
    queueing: Histogram = field(default_factory=lambda: Histogram(QUEUEING_BIN_NS))
    """Times that packets took to pass a finite rate, from when they entered."""


Held = tuple[int, int, Datagram, int, Lane, int, int, bool]
"""Packet that is held: due time [ns], order of entry, packet, its size [B], lane, number in the
lane, delay [ns], and whether it is a copy. The order of entry decides between equal times, so that
no datagrams are ever compared."""


class Queue:
    """Held packets, the one that is due first in front.

    One heap of all would be deep and spread over memory: of 44 000 packets, each entry and exit
    touches a dozen of them. So packets wait unordered in slices of time, and only the first slice
    is a heap.
    """

    def __init__(self) -> None:
        self.front: list[Held] = []
        """Heap of the first packets; empty only if no packets are held."""
        self._slice = 0
        """Number of the slice in front; packets of earlier ones are in front as well."""
        self._later: dict[int, list[Held]] = {}
        """Packets of later slices."""
        self._slices: list[int] = []
        """Heap of the numbers of later slices."""
        self.size = 0
        """Number of held packets."""

    def push(self, held: Held) -> None:
        """Hold a packet."""
        self.size += 1
        number = held[0] >> SLICE_BITS
        if number <= self._slice and self.front:
            heappush(self.front, held)
        elif not self.front:
            self._slice = number
            self.front.append(held)
        elif number in self._later:
            self._later[number].append(held)
        else:
            self._later[number] = [held]
            heappush(self._slices, number)

    def take_due(self, now_ns: int) -> list[Held]:
        """Packets that are due, in their order, which are held no longer."""
        due: list[Held] = []
        front = self.front
        while front and front[0][0] <= now_ns:
            if (self._slice + 1) << SLICE_BITS <= now_ns:
                front.sort()  # the whole slice is due
                due += front
                front.clear()
            else:
                due.append(heappop(front))
            if not front and self._slices:
                self._slice = heappop(self._slices)
                front = self.front = self._later.pop(self._slice)
                heapify(front)
        self.size -= len(due)
        return due


class Link:
    """Holds packets until they are due.

    Args:
        direction: UPLINK or DOWNLINK, for the record.
        mtu: longest UDP payload that passes [B].
        recorder: takes one row a packet, where there is one.
        path: order and finite rate of the direction.
    """

    def __init__(
        self, direction: int, mtu: int, recorder: Recorder | None, path: Path | None = None
    ) -> None:
        self._direction = direction
        self._mtu = mtu
        self._recorder = recorder
        self._queue = Queue()
        self._bytes = 0
        """UDP payload in the queue [B]."""
        self._entered = 0
        self._path = path or Path()
        self._is_ordered = self._path.is_ordered
        self._bottleneck = _bottleneck(self._path)
        self.counts = Counts()

    def change(self, path: Path, *, now_ns: int) -> None:
        """Take another order and rate; packets that wait for a rate are queued anew if they fit."""
        self._pass(now_ns)
        was, self._path, self._is_ordered = self._path, path, path.is_ordered
        if path.queue is was.queue:
            return
        before, self._bottleneck = self._bottleneck, _bottleneck(path)
        for waiting in before.drain() if before else ():
            self._wait(waiting.item, now_ns)

    def take(self, datagram: Datagram, lane: Lane, *, now_ns: int) -> bool:
        """Take a packet that enters, addressed to where it is to come out.

        Returns:
            whether something may be due because of it: most packets are delayed.
        """
        counts, number, size = self.counts, lane.taken, len(datagram.payload)
        slot = (now_ns - lane.began_ns) // SLOT_NS
        # Packets of one slot have a rank, for else they would all meet one fate.
        lane.rank = lane.rank + 1 if slot == lane.slot else 0
        lane.slot = slot
        fate = lane.fates.at(slot, lane.rank)
        lane.taken += 1
        counts.packets += 1
        counts.bytes += size
        if size > self._mtu:
            counts.oversized += 1
            return False
        if self._bottleneck is None:
            self._delay(datagram, lane, number, fate, now_ns, now_ns)
            return fate.delay_ns <= 0
        self._pass(now_ns)
        self._wait(Entered(datagram, lane, number, fate, now_ns), now_ns)
        return True

    def _wait(self, entered: Entered, now_ns: int) -> None:
        """Put a packet into the bottleneck, or delay it at once where there is none."""
        bottleneck, size = self._bottleneck, len(entered.datagram.payload)
        if bottleneck is None:
            self._delay(*entered, now_ns)
        elif self._is_full(size):
            self.counts.overflowed += 1
        else:
            flow = entered.lane.flow
            bottleneck.take(entered, size + HEADER_BYTES, flow, now_ns=now_ns)
            self._count_dropped(bottleneck)

    def _pass(self, now_ns: int) -> None:
        """Take on what has passed the bottleneck by now."""
        bottleneck = self._bottleneck
        if bottleneck is None:
            return
        for entered, passed_ns in bottleneck.give(now_ns=now_ns):
            self.counts.queueing.add(passed_ns - entered.entered_ns)
            self._delay(*entered, passed_ns)
        self._count_dropped(bottleneck)

    def _count_dropped(self, bottleneck: Bottleneck[Entered]) -> None:
        for datagram, lane, number, fate, entered_ns in bottleneck.dropped:
            self.counts.dropped += 1
            self._record_lost(lane, number, len(datagram.payload), entered_ns, fate.delay_ns)
        bottleneck.dropped.clear()

    def _delay(
        self,
        datagram: Datagram,
        lane: Lane,
        number: int,
        fate: Fate,
        entered_ns: int,
        now_ns: int,
    ) -> None:
        """Lose a packet, or hold it until it is due; it has passed a finite rate now, if any."""
        counts, due_ns, size = self.counts, now_ns + fate.delay_ns, len(datagram.payload)
        # Behind the bottleneck: a packet that is lost on the way has used the rate all the same.
        if fate.lost:
            counts.lost += 1
            self._record_lost(lane, number, size, entered_ns, due_ns - entered_ns)
            return
        if self._is_ordered:
            # In order: what would overtake waits for the packet before it.
            due_ns = lane.latest_ns = max(due_ns, lane.latest_ns)
        if fate.flipped is not None and size:
            counts.corrupted += 1
            datagram = datagram._replace(payload=_flipped(datagram.payload, fate.flipped))
        queue, left, is_copy = self._queue, fate.copies, False
        counts.duplicated += left
        while left >= 0:
            left -= 1
            if self._is_full(size):
                counts.overflowed += 1
                continue
            self._bytes += size
            self._entered += 1
            delay_ns = due_ns - entered_ns
            queue.push((due_ns, self._entered, datagram, size, lane, number, delay_ns, is_copy))
            if queue.size > counts.depth_max:  # noqa: PLR1730
                counts.depth_max = queue.size
            is_copy = True

    def _is_full(self, size: int) -> bool:
        """Whether there is no room for another packet of this size."""
        if self._bottleneck is None:
            return self._queue.size >= QUEUE_MAX or self._bytes + size > QUEUE_BYTES_MAX
        return self.depth() >= QUEUE_MAX or self.depth_bytes() + size > QUEUE_BYTES_MAX

    def _record_lost(
        self, lane: Lane, number: int, size: int, entered_ns: int, delay_ns: int
    ) -> None:
        if self._recorder is not None:
            self._recorder.append_row(
                self._direction, lane.flow, number, size, entered_ns, delay_ns, True, False
            )

    def give(self, *, now_ns: int) -> list[Datagram]:
        """Remove the packets that are due, and return them."""
        self._pass(now_ns)
        queue, counts, recorder = self._queue, self.counts, self._recorder
        out: list[Datagram] = []
        delays_ns: list[int] = []
        errors_ns: list[int] = []
        rows: list[bytes] = []
        way, pack = self._direction, recorder.pack if recorder else None
        for held in queue.take_due(now_ns):
            due_ns, _, datagram, size, lane, number, delay_ns, is_copy = held
            self._bytes -= size
            overtaken = number < lane.newest_out
            if overtaken:
                counts.reordered += 1
            else:
                lane.newest_out = number
            delays_ns.append(delay_ns)
            errors_ns.append(now_ns - due_ns)
            if pack is not None and not is_copy:
                flow, entered_ns = lane.flow, due_ns - delay_ns
                rows.append(pack(way, flow, number, size, entered_ns, delay_ns, False, overtaken))
            out.append(datagram)
        # Together: a call for each packet would take longer than what it does.
        counts.forwarded += len(out)
        counts.delay.add_all(delays_ns)
        counts.error.add_all(errors_ns)
        if recorder is not None and rows:
            recorder.append_packed(rows)
        return out

    def is_due(self, now_ns: int) -> bool:
        """Whether a packet is due, or has passed the bottleneck."""
        due_ns = self.next_due_ns()
        return due_ns is not None and due_ns <= now_ns

    def next_due_ns(self) -> int | None:
        """Time at which the next packet is due, or has passed the bottleneck, or None."""
        front = self._queue.front
        due_ns = front[0][0] if front else None
        if self._bottleneck is None:
            return due_ns
        passed_ns = self._bottleneck.next_due_ns()
        if due_ns is None or (passed_ns is not None and passed_ns < due_ns):
            return passed_ns
        return due_ns

    def depth(self) -> int:
        """Number of packets under way, but for the one that a finite rate is serving."""
        waiting = self._bottleneck.waiting if self._bottleneck else 0
        return self._queue.size + waiting

    def depth_bytes(self) -> int:
        """UDP payload under way, of packets that wait with their headers [B]."""
        return self._bytes + (self._bottleneck.waiting_bytes if self._bottleneck else 0)

    def figures(self) -> dict[str, Any]:
        """Statistics by name, as in `Endpoint.figures`."""
        counts = self.counts
        return {
            "packets": counts.packets,
            "bytes": counts.bytes,
            "forwarded": counts.forwarded,
            "lost": counts.lost,
            "reordered": counts.reordered,
            "oversized": counts.oversized,
            "overflowed": counts.overflowed,
            "dropped": counts.dropped,
            "duplicated": counts.duplicated,
            "corrupted": counts.corrupted,
            "queue": self.depth(),
            "queue_max": counts.depth_max,
            "delay_ms_p50": counts.delay.quantile_ms(0.5),
            "delay_ms_p99": counts.delay.quantile_ms(0.99),
            "delays_ms": counts.delay.by_bin(),
            "delays_within_ms": counts.delay.within(DELAY_EDGES_MS),
            "error_ms_p50": counts.error.quantile_ms(0.5),
            "error_ms_p99": counts.error.quantile_ms(0.99),
            "error_ms_max": counts.error.largest_ns / MILLISECOND_NS,
            "queueing_ms_p50": counts.queueing.quantile_ms(0.5),
            "queueing_ms_p99": counts.queueing.quantile_ms(0.99),
        }


def _bottleneck(path: Path) -> Bottleneck[Entered] | None:
    return Bottleneck(path.queue) if path.queue is not None else None


def _flipped(payload: bytes, place: float) -> bytes:
    """A payload with one bit flipped, at a share of its length below 1."""
    bit = int(place * 8 * len(payload))
    changed = bytearray(payload)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
