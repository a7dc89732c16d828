"""The delay bound d: how many steps after it was made a horizon is in force at the latest.

Every acknowledged horizon gives one sample: the step at which it came into force less the step that
it was made for. With each sample of a vehicle

    d ← max(d, sample)
    d ← d - 1 where of its newest RECENT none, and of its newest SAMPLES a share of at most LATE,
              would have been later than d - 1.

So d is a high quantile that is never below what was seen recently; it rises at once, and falls by a
step at a time. A horizon that was lost or overtaken by a newer one was never in force: no sample.
"""

import numpy as np
from numba import njit

from shared.endpoint import seconds_to_ns
from shared.model import Indices

SAMPLES = 128
LATE = 0.01
RECENT = 16
"""On the paper's network d then changes every 4 s (Δt = 0.02 s, every step sent) to every 35 s
(0.05 s, one step in ten); of the horizons in force 0.3 to 1.3 % came later than d."""


class DelayBound:
    """d of up to `capacity` vehicles.

    Args:
        dt_s: length of a step [s].
        most: the largest d, what a horizon has room for.
        fixed_s: a bound that is known [s]; None to estimate it.
    """

    def __init__(self, capacity: int, dt_s: float, most: int, fixed_s: float | None) -> None:
        if fixed_s is None:
            self._least, self._most = 1, most
        else:
            fixed = -(-seconds_to_ns(fixed_s) // seconds_to_ns(dt_s))
            self._least = self._most = min(max(fixed, 1), most)
        self._steps = np.full(capacity, self._least, dtype=np.int64)
        self._samples = np.zeros((capacity, SAMPLES), dtype=np.int64)
        """A ring; shape (capacity, SAMPLES)."""
        self._counts = np.zeros(capacity, dtype=np.int64)
        """Of the samples there were."""

    def forget(self, row: int) -> None:
        """A new vehicle in this row, or a new life of it."""
        self._steps[row] = self._least
        self._counts[row] = 0

    def begin(self, rows: Indices, guess: Indices) -> None:
        """A first d [steps], for vehicles without a sample; shape (n,)."""
        self._steps[rows] = guess.clip(self._least, self._most)

    def acknowledged(self, rows: Indices, delays: Indices) -> None:
        """Samples [steps] of vehicles that have a new one; once a tick: d falls by one a call.

        Args:
            rows: each at most once; shape (n,).
            delays: shape (n,).
        """
        _acknowledged(
            *(self._samples, self._counts, self._steps, rows, delays),
            *(self._least, self._most, RECENT, LATE),
        )

    def steps(self, rows: Indices) -> Indices:
        """d, 1 <= d <= most; shape (n,)."""
        return self._steps[rows]


@njit(
    "(i8[:,::1], i8[::1], i8[::1], i8[:], i8[:], i8, i8, i8, f8)",
    cache=True,
    error_model="numpy",
)
def _acknowledged(samples, counts, bounds, rows, delays, least, most, recent, late):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    size = samples.shape[1]
    for i in range(len(rows)):
        row = rows[i]
        newest = counts[row] % size
        samples[row, newest] = delays[i]
        counts[row] += 1
        d = max(bounds[row], min(delays[i], most))
        known = min(counts[row], size)
        needed, since = 0, known  # samples that need d, and how many came after the last of these
        for slot in range(known):
            if samples[row, slot] >= d:
                age = newest - slot if slot <= newest else newest - slot + size
                needed, since = needed + 1, min(since, age)
        if d > least and since >= recent and needed <= late * known:
            d -= 1
        bounds[row] = d
