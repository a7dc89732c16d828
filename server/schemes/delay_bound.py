"""The delay bound d: how many steps after it was made a horizon is in force at the latest.

Every acknowledged horizon gives one sample: the step at which it came into force less the step that
it was made for. With each sample of a vehicle

    d ← max(d, sample)
    d ← d - 1 where of its newest RECENT none, and of its newest SAMPLES a share of at most LATE,
              would have been later than d - 1.

So d is a high quantile that is never below what was seen recently; it rises at once, and falls by a
step at a time. A horizon that was lost or overtaken by a newer one was never in force: no sample.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.base.kernel import I1, I2, part
from skytether.shared.base.units import seconds_to_ns

SAMPLES = 128
"""Newest samples that count."""
LATE = 0.01
"""Largest share of them that may be later than d."""
RECENT = 16
"""Newest samples of which none may be later than d. On the paper's network d then changes every 4 s
(Δt = 0.02 s, every step sent) to every 35 s (0.05 s, one step in ten); of the horizons in force 0.3
to 1.3 % came later than d."""


class DelayBound(NamedTuple):
    """Delay bounds d of up to `capacity` vehicles, and the samples that it comes from."""

    steps: I1
    """Delay bound d of each vehicle, or 0 while nothing is known; shape (capacity,)."""
    samples: I2
    """Newest samples of each [steps], a ring; shape (capacity, SAMPLES)."""
    seen: I1
    """Number of samples seen so far; shape (capacity,)."""
    least: int
    """Smallest d."""
    most: int
    """Largest d."""


def delay_bound(capacity: int, dt_s: float, most: int, fixed_s: float | None) -> DelayBound:
    """The delay bounds of vehicles of which nothing is known yet.

    Args:
        dt_s: length of a step [s].
        most: the largest d, what a horizon has room for.
        fixed_s: a bound that is known [s]; None to estimate it.
    """
    least = 1
    if fixed_s is not None:
        # Rounded up, for d has to cover the whole delay.
        fixed = -(-seconds_to_ns(fixed_s) // seconds_to_ns(dt_s))
        least = most = min(max(fixed, 1), most)
    steps, seen = np.zeros((2, capacity), dtype=np.int64)
    samples = np.zeros((capacity, SAMPLES), dtype=np.int64)
    return DelayBound(steps, samples, seen, least, most)


def forget(bound: DelayBound, row: int) -> None:
    """Begin anew with a vehicle, or with a new life of it."""
    bound.steps[row] = bound.seen[row] = 0


@part
def begin(bound: DelayBound, row: int, guess: int) -> None:
    """Set a first d [steps] of a vehicle without a sample."""
    bound.steps[row] = min(max(guess, bound.least), bound.most)


@part
def at_least(bound: DelayBound, row: int, delay: int) -> None:
    """Raise d of a vehicle to what every packet takes just now [steps], acknowledged or not."""
    bound.steps[row] = max(bound.steps[row], min(delay, bound.most))


@part
def acknowledge(bound: DelayBound, row: int, delay: int) -> None:
    """Take a sample [steps] of a vehicle into its d, which falls by one at most."""
    newest = bound.seen[row] % SAMPLES
    bound.samples[row, newest] = delay
    bound.seen[row] += 1
    # Up at once: with too small a d every horizon enters after inputs that it did not reckon with.
    d = max(bound.steps[row], min(delay, bound.most))
    known = min(bound.seen[row], SAMPLES)
    needed, since = 0, known  # samples that need d, and how many came after the last of these
    for slot in range(known):
        if bound.samples[row, slot] >= d:
            age = newest - slot if slot <= newest else newest - slot + SAMPLES
            needed, since = needed + 1, min(since, age)
    if d > bound.least and since >= RECENT and needed <= LATE * known:
        d -= 1
    bound.steps[row] = d
