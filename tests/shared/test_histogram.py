"""`shared.telemetry.histogram`: durations in bins, and quantiles that are never too small."""

from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.telemetry.histogram import BINS, Histogram


def filled(*values_ns: int) -> Histogram:
    histogram = Histogram(10)
    for value_ns in values_ns:
        histogram.add(value_ns)
    return histogram


def test_a_histogram_counts_by_bins_of_equal_width() -> None:
    counts = filled(0, 9, 10, 19, 20, 10 * BINS - 1, 10**9).counts
    assert counts[:4] == [2, 2, 1, 0]
    assert (counts[-1], sum(counts)) == (2, 7)


def test_a_quantile_is_never_below_the_true_one_and_at_most_a_bin_above() -> None:
    histogram = filled(*range(100, 200))
    for share, true_ns in ((0.01, 100), (0.5, 149), (0.99, 198), (1.0, 199)):
        assert true_ns <= histogram.quantile_ms(share) * MILLISECOND_NS <= true_ns + 10


def test_a_quantile_of_nothing_is_zero() -> None:
    """A report before the first packet needs a number."""
    assert filled().quantile_ms(0.99) == 0.0


def test_a_quantile_beyond_the_last_bin_is_not_understated() -> None:
    """A netem that is 50 ms late must not report the last bin's edge of 10 ms."""
    histogram = Histogram(MILLISECOND_NS // 50)
    histogram.add(50 * MILLISECOND_NS)
    assert histogram.quantile_ms(0.99) == 50.0


def test_bins_without_any_are_left_out() -> None:
    assert filled(0, 1, 20).by_bin() == {"0": 2, "2e-05": 1}
    assert filled().by_bin() == {}


def test_durations_below_edges_are_counted() -> None:
    histogram = Histogram(MILLISECOND_NS)
    for value_ms in (0.0, 0.9, 1.0, 2.5, 499.0, 10_000.0):
        histogram.add(round(value_ms * MILLISECOND_NS))
    assert histogram.within((1, 2.5, 3, 499, 600)) == {
        "1": 2,
        "2.5": 3,
        "3": 4,
        "499": 4,
        "600": 4,
        "inf": 6,
    }
