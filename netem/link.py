"""Link: one direction of the network, with statistics and a bounded queue ordered by due time.

packet → bottleneck, if the direction has a finite rate → lost, or delayed → out
"""

from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING, Any, NamedTuple

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.impairments.draws import SLOT_NS, Fate
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.scenario.registry import load
from skytether.shared.telemetry.histogram import Histogram
from skytether.shared.telemetry.record import Recorder

if TYPE_CHECKING:
    from skytether.netem.bottleneck import Bottleneck

QUEUE_MAX = 65536
"""Largest number of packets queued in one direction; further packets count as `overflowed`."""
QUEUE_BYTES_MAX = 64 * 1024 * 1024
"""Largest UDP payload queued in one direction [B], whatever `network.mtu` is. If both directions
are full, netem uses less than 256 MiB, Python's overhead included."""

DELAY_BIN_NS = 20 * MILLISECOND_NS
"""Bin width of the histogram of delays [ns]: the resolution of the paper's delays."""
DELAY_EDGES_MS = (20, 40, 60, 80, 100, 140, 200, 300, 400, 500, 600, 800, 1000, 2000)
"""Bin edges of the coarse histogram of delays for plots over time [ms]."""
ERROR_BIN_NS = MILLISECOND_NS // 50
"""Bin width of the histogram of delay errors [ns]."""
QUEUEING_BIN_NS = MILLISECOND_NS
"""Bin width of the histogram of queueing times [ns]."""
SLICE_BITS = 17
"""Binary logarithm of the length of a slice of the queue in ns. At 100 000 packets a second a
slice, 0.13 ms long, has 13 packets."""


@dataclass(slots=True)
class Lane:
    """State of one flow in one direction."""

    flow: int
    fates: Fates
    began_ns: int
    slot: int = -1
    """Time slot of the newest packet, counted from `began_ns`."""
    rank: int = 0
    """Number of earlier packets in the newest packet's slot; with `by_number`, in the flow."""
    taken: int = 0
    """Number of packets so far, lost packets included."""
    newest_out: int = -1
    """Largest number in the flow of a packet that has left, or -1."""
    latest_ns: int = 0
    """Latest due time of a packet so far [ns]; only used if packets stay in order."""


class Entered(NamedTuple):
    """Packet that waits at the bottleneck."""

    datagram: Datagram
    lane: Lane
    number: int
    fate: Fate
    entered_ns: int


@dataclass(slots=True)
class Counts:
    packets: int = 0
    """Packets that entered."""
    bytes: int = 0
    """UDP payload of the packets that entered [B]."""
    forwarded: int = 0
    """Packets that have left."""
    undelivered: int = 0
    """Packets that could not be sent on, or that the receiver refused; not counted as forwarded."""
    lost: int = 0
    """Packets lost by impairments."""
    reordered: int = 0
    """Packets overtaken by a later packet of their flow."""
    oversized: int = 0
    """Packets dropped because they were longer than `network.mtu`."""
    overflowed: int = 0
    """Packets dropped because QUEUE_MAX or QUEUE_BYTES_MAX was reached."""
    dropped: int = 0
    """Packets dropped by the bottleneck's queue."""
    duplicated: int = 0
    """Copies of packets made by impairments."""
    corrupted: int = 0
    """Packets with a flipped bit."""
    depth_max: int = 0
    """Largest number of packets queued at once."""
    delay: Histogram = field(default_factory=lambda: Histogram(DELAY_BIN_NS))
    """Delays drawn for the forwarded packets."""
    error: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN_NS))
    """Time from a packet's due time until it was forwarded."""
    queueing: Histogram = field(default_factory=lambda: Histogram(QUEUEING_BIN_NS))
    """Time that each packet spent in the bottleneck, from its entry until it was sent."""


QueuedPacket = tuple[int, int, Datagram, int, Lane, int, int, bool]
"""Queued packet: due time [ns], order of entry, packet, its size [B], lane, number in the lane,
delay [ns], and whether it is a copy. The order of entry breaks ties, so that datagrams are never
compared."""


class Queue:
    """Queued packets, earliest due time first.

    In a single heap of 44 000 packets, each entry and exit would touch a dozen packets, spread over
    memory. So packets are stored unordered in slices of time, and only the first slice is a heap.
    """

    def __init__(self) -> None:
        self.front: list[QueuedPacket] = []
        """Heap of the packets due first; empty only if the queue is empty."""
        self._slice = 0
        """Number of the slice in `front`; earlier packets are in `front`, too."""
        self._later: dict[int, list[QueuedPacket]] = {}
        self._slices: list[int] = []
        self.size = 0

    def push(self, queued: QueuedPacket) -> None:
        self.size += 1
        number = queued[0] >> SLICE_BITS
        if number <= self._slice and self.front:
            heappush(self.front, queued)
        elif not self.front:
            self._slice = number
            self.front.append(queued)
        elif number in self._later:
            self._later[number].append(queued)
        else:
            self._later[number] = [queued]
            heappush(self._slices, number)

    def take_due(self, now_ns: int) -> list[QueuedPacket]:
        due: list[QueuedPacket] = []
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
    """Delays, loses and reorders packets of one direction; drops UDP payloads above `mtu` [B].

    Args:
        number: number of the session's path, from 0, in the record.
        header_bytes: size of the headers that precede the payload [B]; 0 for packets of IP.
    """

    def __init__(
        self,
        direction: int,
        mtu: int,
        recorder: Recorder | None,
        impairments: Impairments | None = None,
        number: int = 0,
        *,
        header_bytes: int = HEADER_BYTES,
    ) -> None:
        self._direction = direction
        self._header_bytes = header_bytes
        self._number = number
        self._mtu = mtu
        self._recorder = recorder
        self._queue = Queue()
        self._bytes = 0
        """UDP payload in the queue [B]."""
        self._entered = 0
        self.impairments = impairments or Impairments()
        self._is_ordered = self.impairments.is_ordered
        self._bottleneck = _bottleneck(self.impairments)
        self.counts = Counts()

    def change(self, impairments: Impairments, *, now_ns: int) -> None:
        """Use other impairments. If the queue changes, waiting packets enter the new queue."""
        self._pass(now_ns)
        previous, self.impairments = self.impairments, impairments
        self._is_ordered = impairments.is_ordered
        if impairments.queue is previous.queue:
            return
        before, self._bottleneck = self._bottleneck, _bottleneck(impairments)
        for waiting in before.drain() if before else ():
            self._wait(waiting.item, now_ns)

    def accept(self, datagram: Datagram, lane: Lane, *, now_ns: int) -> bool:
        """Accept a packet whose peer is its destination; True if a packet may be due now."""
        counts, number, size = self.counts, lane.taken, len(datagram.payload)
        slot = (now_ns - lane.began_ns) // SLOT_NS
        # Without ranks, all packets in a slot would have the same fate.
        if lane.fates.by_number:
            lane.rank = number
        else:
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
        bottleneck, size = self._bottleneck, len(entered.datagram.payload)
        if bottleneck is None:
            self._delay(*entered, now_ns)
        elif self._is_full(size):
            self.counts.overflowed += 1
        else:
            flow = entered.lane.flow
            bottleneck.accept(entered, size + self._header_bytes, flow, now_ns=now_ns)
            self._count_dropped(bottleneck)

    def _pass(self, now_ns: int) -> None:
        bottleneck = self._bottleneck
        if bottleneck is None:
            return
        for entered, passed_ns in bottleneck.release(now_ns=now_ns):
            self.counts.queueing.add(passed_ns - entered.entered_ns)
            self._delay(*entered, passed_ns)
        self._count_dropped(bottleneck)

    def _count_dropped(self, bottleneck: "Bottleneck[Entered]") -> None:
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
        """Lose a packet that has passed the bottleneck, or queue it until it is due."""
        counts, due_ns, size = self.counts, now_ns + fate.delay_ns, len(datagram.payload)
        # A packet is lost only after the bottleneck, because lost packets use its rate, too.
        if fate.lost:
            counts.lost += 1
            self._record_lost(lane, number, size, entered_ns, due_ns - entered_ns)
            return
        if self._is_ordered:
            # To keep the order, a packet waits for all earlier packets.
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
        if self._bottleneck is None:
            return self._queue.size >= QUEUE_MAX or self._bytes + size > QUEUE_BYTES_MAX
        return self.depth() >= QUEUE_MAX or self.depth_bytes() + size > QUEUE_BYTES_MAX

    def _record_lost(
        self, lane: Lane, number: int, size: int, entered_ns: int, delay_ns: int
    ) -> None:
        if self._recorder is not None:
            at = self._direction, self._number, lane.flow
            self._recorder.append_row(*at, number, size, entered_ns, delay_ns, True, False)

    def release(self, *, now_ns: int) -> list[Datagram]:
        self._pass(now_ns)
        queue, counts, recorder = self._queue, self.counts, self._recorder
        out: list[Datagram] = []
        delays_ns: list[int] = []
        errors_ns: list[int] = []
        rows: list[bytes] = []
        direction, path = self._direction, self._number
        pack = recorder.pack if recorder else None
        for queued in queue.take_due(now_ns):
            due_ns, _, datagram, size, lane, number, delay_ns, is_copy = queued
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
                at = direction, path, flow
                rows.append(pack(*at, number, size, entered_ns, delay_ns, False, overtaken))
            out.append(datagram)
        # One call for all packets: a call for each would take longer than the work itself.
        counts.forwarded += len(out)
        counts.delay.add_all(delays_ns)
        counts.error.add_all(errors_ns)
        if recorder is not None and rows:
            recorder.append_packed(rows)
        return out

    def next_due_ns(self) -> int | None:
        """Time at which a packet is next due, or passes the bottleneck; None without packets."""
        front = self._queue.front
        due_ns = front[0][0] if front else None
        if self._bottleneck is None:
            return due_ns
        passed_ns = self._bottleneck.next_due_ns()
        if due_ns is None or (passed_ns is not None and passed_ns < due_ns):
            return passed_ns
        return due_ns

    def has_room(self, size: int) -> bool:
        """Whether the queues have space for a packet of this size [B]."""
        bottleneck = self._bottleneck
        return not self._is_full(size) and (bottleneck is None or bottleneck.has_room(size))

    def depth(self) -> int:
        """Number of packets in queue and bottleneck, except the packet being served."""
        waiting = self._bottleneck.waiting if self._bottleneck else 0
        return self._queue.size + waiting

    def depth_bytes(self) -> int:
        """UDP payload in queue and bottleneck, plus headers in the bottleneck [B]."""
        return self._bytes + (self._bottleneck.waiting_bytes if self._bottleneck else 0)

    def figures(self) -> dict[str, Any]:
        counts = self.counts
        return {
            "packets": counts.packets,
            "bytes": counts.bytes,
            "forwarded": counts.forwarded,
            "undelivered": counts.undelivered,
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


def _bottleneck(impairments: Impairments) -> "Bottleneck[Entered] | None":
    if impairments.queue is None:
        return None
    made: Bottleneck[Entered] = load("skytether.netem.bottleneck", "rate").Bottleneck(
        impairments.queue
    )
    return made


def _flipped(payload: bytes, place: float) -> bytes:
    """Payload with one bit flipped, at the share `place` of its length."""
    bit = int(place * 8 * len(payload))
    changed = bytearray(payload)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
