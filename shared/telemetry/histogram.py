"""Histograms of durations, of constant memory."""

from collections.abc import Iterable, Sequence

from skytether.shared.base.units import MILLISECOND_NS

BINS = 500


class Histogram:
    """Counts of durations in bins of equal width; the last bin has all longer durations."""

    def __init__(self, bin_ns: int) -> None:
        self.bin_ns = bin_ns
        self.counts = [0] * BINS
        self.largest_ns = 0

    def add(self, value_ns: int) -> None:
        # Called once per packet or step: comparisons are twice as fast as min() and max().
        index = value_ns // self.bin_ns
        self.counts[index if index < BINS else -1] += 1
        if value_ns > self.largest_ns:  # noqa: PLR1730
            self.largest_ns = value_ns

    def add_all(self, values_ns: Iterable[int]) -> None:
        counts, bin_ns, largest_ns = self.counts, self.bin_ns, self.largest_ns
        for value_ns in values_ns:
            index = value_ns // bin_ns
            counts[index if index < BINS else -1] += 1
            if value_ns > largest_ns:  # noqa: PLR1730
                largest_ns = value_ns
        self.largest_ns = largest_ns

    def quantile_ms(self, share: float) -> float:
        """Upper edge of the bin that contains a quantile [ms]; 0 if there are no durations."""
        wanted, seen = share * sum(self.counts), 0
        for index, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted and index < BINS - 1:
                return min((index + 1) * self.bin_ns, self.largest_ns) / MILLISECOND_NS
        return self.largest_ns / MILLISECOND_NS

    def within(self, edges_ms: Sequence[float]) -> dict[str, int]:
        """Number of durations below each edge, by the edge as text [ms]; "inf": all durations.

        Edges must ascend. A bin that contains an edge counts as above the edge.
        """
        counts_below, seen, index = {}, 0, 0
        for edge_ms in edges_ms:
            end = min(round(edge_ms * MILLISECOND_NS) // self.bin_ns, BINS - 1)
            seen += sum(self.counts[index:end])
            counts_below[f"{edge_ms:g}"], index = seen, end
        return {**counts_below, "inf": seen + sum(self.counts[index:])}

    def by_bin(self) -> dict[str, int]:
        """Counts of the bins that are not empty, by lower edge as text [ms], such as "20"."""
        return {
            f"{index * self.bin_ns / MILLISECOND_NS:g}": count
            for index, count in enumerate(self.counts)
            if count
        }
