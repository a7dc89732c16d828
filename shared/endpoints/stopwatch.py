"""Stopwatch: duration of each part of the work, on a clock passed in by the driver."""

from collections import Counter
from collections.abc import Callable


class Stopwatch:
    """Sums durations by name. With `clock_ns` None nothing is measured, as in virtual time."""

    def __init__(self, clock_ns: Callable[[], int] | None = None) -> None:
        self.runs = clock_ns is not None
        self._clock_ns = clock_ns
        self._since_ns = 0
        self.spent_ns: Counter[str] = Counter()
        self.total_ns = 0

    def start(self) -> None:
        if self._clock_ns is not None:
            self._since_ns = self._clock_ns()

    def lap(self, name: str) -> int:
        """Add the duration of the lap to this name's sum, begin a lap; return the duration [ns]."""
        if self._clock_ns is None:
            return 0
        now_ns = self._clock_ns()
        took_ns = now_ns - self._since_ns
        self.spent_ns[name] += took_ns
        self.total_ns += took_ns
        self._since_ns = now_ns
        return took_ns
