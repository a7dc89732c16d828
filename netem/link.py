"""A link: one direction of the network, a bounded heap of packets by due time, and statistics."""

from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

from skytether.netem.fate import SLOT_NS, Fates
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.core.endpoint import Datagram
from skytether.shared.telemetry.histogram import Histogram
from skytether.shared.telemetry.record import Recorder

QUEUE_MAX = 65536
"""Most packets under way in one direction; more are dropped, and counted apart from losses."""
QUEUE_BYTES_MAX = 64 * 1024 * 1024
"""Most UDP payload under way in one direction, whatever `network.mtu` lets pass [B]: with both
directions full, and what Python takes for each packet, netem stays below 256 MiB."""

DELAY_BIN_NS = 20 * MILLISECOND_NS
"""Width of the bins in which delays are counted [ns]: the lattice of the paper's delay."""
DELAY_EDGES_MS = (20, 40, 60, 80, 100, 140, 200, 300, 400, 500, 600, 800, 1000, 2000)
"""Edges between which delays are counted for those who draw them over time [ms]."""
ERROR_BIN_NS = MILLISECOND_NS // 50
"""Width of the bins in which errors of delays are counted [ns]."""


@dataclass(slots=True)
class Lane:
    """One flow in one direction."""

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
    depth_max: int = 0
    """Most packets that were under way at once."""
    delay: Histogram = field(default_factory=lambda: Histogram(DELAY_BIN_NS))
    """Delays of forwarded packets, as drawn."""
    error: Histogram = field(default_factory=lambda: Histogram(ERROR_BIN_NS))
    """Times by which forwarded packets left later than drawn."""


class Link:
    """Holds packets until they are due.

    Args:
        direction: UPLINK or DOWNLINK, for the record.
        mtu: longest UDP payload that passes [B].
        recorder: takes one row a packet, where there is one.
    """

    def __init__(self, direction: int, mtu: int, recorder: Recorder | None) -> None:
        self._direction = direction
        self._mtu = mtu
        self._recorder = recorder
        self._heap: list[tuple[int, int, Datagram, Lane, int, int]] = []
        """Heap of due time [ns], order of entry, packet, lane, number in the lane, delay [ns]."""
        self._bytes = 0
        """UDP payload under way [B]."""
        self._entered = 0
        self.counts = Counts()

    def take(self, datagram: Datagram, lane: Lane, *, now_ns: int) -> None:
        """Take a packet that enters, addressed to where it is to come out."""
        counts, number, size = self.counts, lane.taken, len(datagram.payload)
        slot = (now_ns - lane.began_ns) // SLOT_NS
        lane.rank = lane.rank + 1 if slot == lane.slot else 0
        lane.slot = slot
        delay_ns, lost = lane.fates.at(slot, lane.rank)
        lane.taken += 1
        counts.packets += 1
        counts.bytes += size
        depth = len(self._heap)
        if size > self._mtu:
            counts.oversized += 1
        elif lost:
            counts.lost += 1
            if self._recorder is not None:
                self._recorder.append_row(
                    self._direction, lane.flow, number, size, now_ns, delay_ns, True, False
                )
        elif depth >= QUEUE_MAX or self._bytes + size > QUEUE_BYTES_MAX:
            counts.overflowed += 1
        else:
            self._bytes += size
            self._entered += 1
            due_ns = now_ns + delay_ns
            heappush(self._heap, (due_ns, self._entered, datagram, lane, number, delay_ns))
            if depth >= counts.depth_max:
                counts.depth_max = depth + 1

    def give(self, *, now_ns: int) -> list[Datagram]:
        """Packets that are due, which so leave."""
        heap, counts, out = self._heap, self.counts, []
        while heap and heap[0][0] <= now_ns:
            due_ns, _, datagram, lane, number, delay_ns = heappop(heap)
            self._bytes -= len(datagram.payload)
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
        """Time at which the next packet is due, or None."""
        return self._heap[0][0] if self._heap else None

    def depth(self) -> int:
        """Number of packets under way."""
        return len(self._heap)

    def depth_bytes(self) -> int:
        """UDP payload under way [B]."""
        return self._bytes

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
            "queue": self.depth(),
            "queue_max": counts.depth_max,
            "delays_ms": counts.delay.by_bin(),
            "delays_within_ms": counts.delay.within(DELAY_EDGES_MS),
            "error_ms_p50": counts.error.quantile_ms(0.5),
            "error_ms_p99": counts.error.quantile_ms(0.99),
            "error_ms_max": counts.error.largest_ns / MILLISECOND_NS,
        }
