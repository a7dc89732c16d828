"""Time at every boundary is whole nanoseconds; float seconds are for formulas alone."""

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
MICROSECOND_NS = 1_000


def seconds_to_ns(seconds: float) -> int:
    """Whole nanoseconds nearest to a duration [s]."""
    return round(seconds * SECOND_NS)
