"""Time is whole nanoseconds at every boundary; float seconds are for formulas only."""

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
MICROSECOND_NS = 1_000
HEADER_BYTES = 28
"""Headers of IPv4 and UDP on each packet [B]."""


def seconds_to_ns(seconds: float) -> int:
    """Whole nanoseconds nearest to a duration [s]."""
    return round(seconds * SECOND_NS)
