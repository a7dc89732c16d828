"""Time of day as learned by an endpoint, and its error."""

from typing import NamedTuple

from skytether.shared.base.units import SECOND_NS

FRESH_NS = 10 * SECOND_NS
"""Time for which a learned time of day is valid [ns]."""
DRIFT = 1000
"""Inverse of the largest relative drift of two clocks: 0.1 %, for two hosts whose clocks are slewed
by 500 ppm each."""


class TimeOfDay(NamedTuple):
    """Offset from an endpoint's own clock to the time of day, and its error."""

    ahead_ns: int
    """Time since 1970 minus the time on the endpoint's own clock [ns]."""
    error_ns: int
    """Largest error of `ahead_ns` at the time `learned_ns` [ns]."""
    learned_ns: int
    """Time on the endpoint's own clock when the offset was learned [ns]."""

    def error_at(self, now_ns: int) -> int | None:
        """Largest error at a time of the endpoint's clock [ns]; None if the offset is too old."""
        age_ns = now_ns - self.learned_ns
        return self.error_ns + age_ns // DRIFT + 1 if 0 <= age_ns <= FRESH_NS else None
