"""Units of time: whole nanoseconds at every interface; seconds as floats are for formulas only."""

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
MICROSECOND_NS = 1_000
HEADER_BYTES = 28
"""Headers of IPv4 and UDP on each packet."""


def seconds_to_ns(seconds: float) -> int:
    return round(seconds * SECOND_NS)
