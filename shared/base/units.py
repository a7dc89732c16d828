"""Units of time: whole nanoseconds at every interface; seconds as floats are for formulas only."""

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000
MICROSECOND_NS = 1_000
HEADER_BYTES = 28
"""Size of the headers of IPv4 and UDP of each packet [B]."""


def seconds_to_ns(seconds: float) -> int:
    return round(seconds * SECOND_NS)


JUMP_NS = 60 * SECOND_NS
"""A clock has jumped if it advances by more than this after both the previous reading and the due
time of the endpoint's next wake [ns]; see `shared.endpoints.steady`."""
