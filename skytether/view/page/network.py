"""Last minute of a network, in bins of 0.25 s, from netem's rows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.shared.telemetry.record import Rows as Table

SPAN_S = 60.0
"""Length of the stored history [s]."""
BIN_NS = 250 * MILLISECOND_NS
BINS = int(SPAN_S * SECOND_NS) // BIN_NS
DELAY_BIN_NS = 20 * MILLISECOND_NS
DELAY_BINS = 100
"""Number of bins of the delay histogram; the last bin contains all longer delays."""
DIRECTIONS = {UPLINK: "up", DOWNLINK: "down"}
"""Names of the directions: up to the vehicle, down from the vehicle."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Statistics of one direction of the network over the last seconds."""

    packets_per_s: float
    bytes_per_s: float
    loss: float
    """Share of packets that were lost; NaN without packets."""
    delay_ms_p50: float
    delay_ms_p99: float


class Network:
    """Last minute of the network, in bins of 0.25 s.

    Args:
        horizon_bytes: smallest size of an uplink packet that carries a horizon [B].
    """

    def __init__(self, horizon_bytes: int) -> None:
        self._horizon_bytes = horizon_bytes
        shape = (BINS, len(DIRECTIONS))
        self._bin = np.full(BINS, -1, np.int64)
        self._packets = np.zeros(shape, np.int64)
        self._bytes = np.zeros(shape, np.int64)
        self._lost = np.zeros(shape, np.int64)
        self._delay_ns = np.zeros(shape, np.int64)
        """Sum of the delays of packets that arrived [ns]."""
        self._delays = np.zeros((*shape, DELAY_BINS), np.int64)
        self._waiting = np.zeros(shape)
        """Number of packets in netem at the end of each bin."""
        self._horizons = np.zeros((BINS, 2), np.int64)
        """Uplink packets that carry a horizon: their number, and their bytes."""
        self.heard_ns: dict[int, int] = {}
        """Arrival time of the newest packet, by direction [ns]."""

    def take(self, rows: Table, *, time_ns: int) -> None:
        at = self._at(time_ns)
        if at is None:
            return
        direction, lost, size = rows["direction"], rows["lost"], rows["bytes"].astype(np.int64)
        np.add.at(self._packets[at], direction, 1)
        np.add.at(self._bytes[at], direction, size)
        np.add.at(self._lost[at], direction, lost)
        through = ~lost
        directions, delay_ns = direction[through], rows["delay_ns"][through]
        np.add.at(self._delay_ns[at], directions, delay_ns)
        bins = np.minimum(delay_ns // DELAY_BIN_NS, DELAY_BINS - 1)
        np.add.at(self._delays[at], (directions, bins), 1)
        planned = (direction == UPLINK) & (size >= self._horizon_bytes)
        self._horizons[at] += (int(planned.sum()), int(size[planned].sum()))
        for each in np.unique(directions):
            self.heard_ns[int(each)] = time_ns

    def wait(self, waiting: Array, *, time_ns: int) -> None:
        at = self._at(time_ns)
        if at is not None:
            self._waiting[at] = waiting

    def _at(self, time_ns: int) -> int | None:
        """Index of the bin of a time, cleared if it is new; None for a time that is too old."""
        number = time_ns // BIN_NS
        at = number % BINS
        if self._bin[at] > number:
            return None
        if self._bin[at] != number:
            self._bin[at] = number
            for counts in (self._packets, self._bytes, self._lost, self._delay_ns, self._delays):
                counts[at] = 0
            self._waiting[at] = self._horizons[at] = 0
        return int(at)

    def _since(self, seconds: float, now_ns: int) -> NDArray[np.bool_]:
        """Mask of the bins of the last seconds, without the unfinished bin."""
        last = now_ns // BIN_NS
        recent: NDArray[np.bool_] = (self._bin < last) & (
            self._bin >= last - round(seconds * SECOND_NS / BIN_NS)
        )
        return recent & (self._bin >= 0)

    def traffic(self, direction: int, seconds: float, now_ns: int) -> Traffic:
        recent = self._since(seconds, now_ns)
        packets = int(self._packets[recent, direction].sum())
        lost = int(self._lost[recent, direction].sum())
        return Traffic(
            packets_per_s=packets / seconds,
            bytes_per_s=float(self._bytes[recent, direction].sum()) / seconds,
            loss=lost / packets if packets else np.nan,
            delay_ms_p50=self._quantile_ms(recent, direction, 0.5),
            delay_ms_p99=self._quantile_ms(recent, direction, 0.99),
        )

    def _quantile_ms(self, recent: NDArray[np.bool_], direction: int, share: float) -> float:
        counts = self._delays[recent, direction].sum(axis=0).cumsum()
        if not len(counts) or not counts[-1]:
            return np.nan
        index = int(np.searchsorted(counts, share * counts[-1]))
        return (index + 0.5) * DELAY_BIN_NS / MILLISECOND_NS

    def histogram(self, direction: int, now_ns: int) -> Array:
        """Number of packets of the last minute by delay; shape (DELAY_BINS,)."""
        recent = self._since(SPAN_S, now_ns)
        return self._delays[recent, direction].sum(axis=0).astype(np.float64)

    def rates(self, direction: int, now_ns: int) -> Array:
        """Packets in each of the last SPAN_S seconds, oldest first; shape (SPAN_S,)."""
        return self._by_second(self._packets[:, direction], now_ns)

    def loads(self, direction: int, now_ns: int) -> Array:
        """Payload in each of the last SPAN_S seconds, oldest first [B]; shape (SPAN_S,)."""
        return self._by_second(self._bytes[:, direction], now_ns)

    def losses(self, direction: int, now_ns: int) -> Array:
        """Share of packets lost in each of the last SPAN_S seconds, NaN without packets; shape
        (SPAN_S,).
        """
        packets = self._by_second(self._packets[:, direction], now_ns)
        lost = self._by_second(self._lost[:, direction], now_ns)
        return np.where(packets > 0, lost / np.maximum(packets, 1), np.nan)

    def waiting(self, direction: int, now_ns: int) -> Array:
        """Packets in netem in each of the last SPAN_S seconds, oldest first; shape (SPAN_S,)."""
        return self._by_second(self._waiting[:, direction], now_ns)

    def delays_s(self, direction: int, now_ns: int) -> Array:
        """Mean delay in each of the last SPAN_S seconds [s], NaN if no packet; shape (SPAN_S,)."""
        through = self._packets[:, direction] - self._lost[:, direction]
        total_ns = self._by_second(self._delay_ns[:, direction], now_ns)
        count = self._by_second(through, now_ns)
        return np.where(count > 0, total_ns / np.maximum(count, 1), np.nan) / SECOND_NS

    def bins(self, direction: int, now_ns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of packets and of lost packets in each bin, oldest first; shape (BINS,)."""
        numbers = now_ns // BIN_NS - np.arange(BINS)[::-1]
        is_kept = self._bin[numbers % BINS] == numbers
        packets, lost = (
            np.where(is_kept, counts[numbers % BINS, direction], 0)
            for counts in (self._packets, self._lost)
        )
        return packets, lost

    def _by_second(self, counts: NDArray[np.int64] | Array, now_ns: int) -> Array:
        """Sums of counts by second, oldest first."""
        recent = self._since(SPAN_S, now_ns)
        per_second = SECOND_NS // BIN_NS
        old = (now_ns // BIN_NS - 1 - self._bin[recent]) // per_second
        sums = np.zeros(int(SPAN_S))
        np.add.at(sums, len(sums) - 1 - old, counts[recent])
        return sums

    def horizon_bytes(self, now_ns: int) -> float:
        """Mean size of the last minute's packets that carry a horizon [B]; NaN if none does."""
        count, size = self._horizons[self._since(SPAN_S, now_ns)].sum(axis=0)
        return float(size / count) if count else np.nan
