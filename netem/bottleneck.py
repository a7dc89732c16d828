"""Bottleneck: a queue that sends the packets of all flows one after another, at a finite rate.

An idle bottleneck serves a packet at once; otherwise the packet waits in a queue of limited bytes.
Sizes include the headers of IP and UDP.

`netem.link` loads this module for a direction with a `rate` or with `deliveries`.
"""

from bisect import bisect_left
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import ceil, sqrt
from typing import Generic, TypeVar

from skytether.netem.impairments.queues import DELIVERY_BYTES, Queued
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array

QUANTUM_BYTES = 300
"""Bytes that each flow may send per turn under fair queueing [B]: a few small packets; a larger
packet needs several turns."""
TARGET_NS, INTERVAL_NS = 5 * MILLISECOND_NS, 100 * MILLISECOND_NS
"""CoDel's TARGET and INTERVAL: acceptable queueing time, and reaction time (RFC 8289) [ns]."""

T = TypeVar("T")


@dataclass(slots=True)
class Waiting(Generic[T]):
    item: T
    size: int
    """Size of the packet, headers included [B]."""
    flow: int
    entered_ns: int


@dataclass(slots=True)
class Codel:
    """Controlled delay (RFC 8289): drops packets more and more often until queueing times fall."""

    above_ns: int = 0
    """Time at which drops begin if queueing times stay long [ns]; 0 if they are short."""
    drop_ns: int = 0
    """Time of the next drop [ns]."""
    count: int = 0
    last_count: int = 0
    dropping: bool = False

    def drops(self, now_ns: int, *, is_fine: bool) -> bool:
        """Whether to drop the first packet; `is_fine`: short wait, or a nearly empty queue."""
        late = False
        if is_fine:
            self.above_ns = 0
        elif not self.above_ns:
            self.above_ns = now_ns + INTERVAL_NS
        else:
            late = now_ns >= self.above_ns
        if not late:
            self.dropping = False
            return False
        if self.dropping:
            if now_ns < self.drop_ns:
                return False
            self.count += 1
            self.drop_ns += round(INTERVAL_NS / sqrt(self.count))
            return True
        self.dropping = True
        # If the last drops were recent, the drop rate resumes near its last value (RFC 8289).
        recent = now_ns - self.drop_ns < 16 * INTERVAL_NS
        self.count = max(1, self.count - self.last_count) if recent else 1
        self.last_count = self.count
        self.drop_ns = now_ns + round(INTERVAL_NS / sqrt(self.count))
        return True


@dataclass(slots=True)
class FlowQueue(Generic[T]):
    """Queue of a direction, or of one flow under fair queueing."""

    packets: "deque[Waiting[T]]" = field(default_factory=deque)
    bytes: int = 0
    credit: int = 0
    """Number of bytes that the queue may still send in its turn [B]."""
    codel: Codel = field(default_factory=Codel)


class Bottleneck(Generic[T]):
    def __init__(self, queue: Queued) -> None:
        self._queue = queue
        self._is_fair = queue.serve == "fair"
        self._lines: OrderedDict[int, FlowQueue[T]] = OrderedDict()
        """Queues with waiting packets, in the order in which they are served."""
        self._served: Waiting[T] | None = None
        self._done_ns = 0
        self._largest = 0
        self.waiting = 0
        """Number of waiting packets, without the packet being served."""
        self.waiting_bytes = 0
        """Size of the waiting packets, headers included [B]."""
        self.dropped: list[T] = []
        """Dropped packets; the caller counts them and empties the list."""
        self._pace: _Rate | _Deliveries = (
            _Rate(queue.bytes_per_s) if queue.times_s is None else _Deliveries(queue.times_s)
        )

    def accept(self, item: T, size: int, flow: int, *, now_ns: int) -> None:
        """Add a packet of `size` bytes, headers included; call `release` first."""
        packet = Waiting(item, size, flow, now_ns)
        self._largest = max(self._largest, size)
        if self._served is None:
            self._serve(packet, now_ns)
            return
        key = flow if self._is_fair else 0
        queue = self._lines.get(key)
        if queue is None:
            queue = self._lines[key] = FlowQueue(credit=QUANTUM_BYTES)
        queue.packets.append(packet)
        self._count(key, packet, 1)
        while self.waiting_bytes > self._queue.room_bytes and not self._queue.keeps_all:
            # Only the flow with the longest queue loses packets, its newest first.
            longest = max(self._lines, key=lambda flow_key: self._lines[flow_key].bytes)
            last = self._lines[longest].packets.pop()
            self._count(longest, last, -1)
            self.dropped.append(last.item)

    def has_room(self, size: int) -> bool:
        return self._served is None or self.waiting_bytes + size <= self._queue.room_bytes

    def release(self, *, now_ns: int) -> Iterator[tuple[T, int]]:
        """Packets that have passed by now, each with the time at which it passed [ns]."""
        while self._served is not None and self._done_ns <= now_ns:
            item, at_ns = self._served.item, self._done_ns
            self._served = None
            packet = self._next(at_ns)
            if packet is not None:
                self._serve(packet, at_ns)
            yield item, at_ns

    def next_due_ns(self) -> int | None:
        return None if self._served is None else self._done_ns

    def drain(self) -> Iterator[Waiting[T]]:
        """Remove and return all packets, in order of entry."""
        lines = [packet for queue in self._lines.values() for packet in queue.packets]
        served = [] if self._served is None else [self._served]
        self._lines.clear()
        self._served, self.waiting, self.waiting_bytes = None, 0, 0
        yield from sorted(served + lines, key=lambda packet: packet.entered_ns)

    def _serve(self, packet: Waiting[T], now_ns: int) -> None:
        self._served = packet
        self._done_ns = self._pace.done_ns(now_ns, packet.size)

    def _next(self, now_ns: int) -> Waiting[T] | None:
        while self.waiting:
            key, queue = next(iter(self._lines.items()))
            # Deficit round robin: a queue without credit gets a new quantum and goes to the end.
            if self._is_fair and queue.credit <= 0:
                queue.credit += QUANTUM_BYTES
                self._lines.move_to_end(key)
                continue
            packet = queue.packets.popleft()
            queue.credit -= packet.size
            self._count(key, packet, -1)
            if self._queue.drop == "tail" or not self._is_late(queue, packet, now_ns):
                return packet
            self.dropped.append(packet.item)
        return None

    def _is_late(self, queue: FlowQueue[T], packet: Waiting[T], now_ns: int) -> bool:
        waited_ns = now_ns - packet.entered_ns
        # At a low rate, sending one packet takes over 5 ms. Such a wait is no reason for a drop.
        target_ns = max(TARGET_NS, round(self._largest / self._queue.bytes_per_s * SECOND_NS))
        # With at most one more packet waiting, a drop would leave the bottleneck idle.
        is_fine = waited_ns < target_ns or queue.bytes <= self._largest
        return queue.codel.drops(now_ns, is_fine=is_fine)

    def _count(self, key: int, packet: Waiting[T], one: int) -> None:
        """Count a packet that entered (1) or left (-1) a queue."""
        queue = self._lines[key]
        queue.bytes += one * packet.size
        self.waiting_bytes += one * packet.size
        self.waiting += one
        # The credit of an empty queue is lost, so that a silent flow cannot save up turns.
        if self._is_fair and not queue.packets:
            del self._lines[key]


class _Rate:
    def __init__(self, bytes_per_s: float) -> None:
        self._bytes_per_s = bytes_per_s

    def done_ns(self, now_ns: int, size: int) -> int:
        """Time at which service of a packet of this size ends if it starts now."""
        return now_ns + round(size / self._bytes_per_s * SECOND_NS)


class _Deliveries:
    """Rate by the times in a mahimahi file, counted from the first packet; the file is repeated.

    Packets share the bytes of a delivery opportunity; unused bytes are lost.
    """

    def __init__(self, times_s: Array) -> None:
        self._times_ns: list[int] = [round(time_s * SECOND_NS) for time_s in times_s]
        self._began_ns: int | None = None
        self._used_bytes = 0
        """Number of bytes in past delivery opportunities, used or lost [B]."""

    def done_ns(self, now_ns: int, size: int) -> int:
        if self._began_ns is None:
            self._began_ns = now_ns
        times_ns = self._times_ns
        rounds, at_ns = divmod(now_ns - self._began_ns, times_ns[-1])
        before = rounds * len(times_ns) + bisect_left(times_ns, at_ns)
        # Delivery opportunities that passed while nothing waited are lost, as in mahimahi.
        self._used_bytes = max(self._used_bytes, before * DELIVERY_BYTES) + size
        rounds, last = divmod(ceil(self._used_bytes / DELIVERY_BYTES) - 1, len(times_ns))
        return max(now_ns, self._began_ns + rounds * times_ns[-1] + times_ns[last])
