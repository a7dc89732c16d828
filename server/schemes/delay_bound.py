"""Delay bound d: largest number of steps from making a horizon until it comes into force.

Every acknowledged horizon gives one sample: the step at which it came into force minus the step
that it was made for. With each sample of a vehicle

    d ← max(d, sample)
    d ← d - 1 if none of the newest RECENT samples, and at most a share LATE of the newest SAMPLES,
              exceed d - 1.

So d is a high quantile of the delay and never below a recent sample. It rises at once and falls by
one step at a time. A horizon that was lost, or overtaken by a newer one, gives no sample.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.base.kernel import I1, I2, part
from skytether.shared.base.units import seconds_to_ns

SAMPLES = 128
LATE = 0.01
"""Largest share of the samples that may exceed d."""
RECENT = 16
"""Number of newest samples, none of which may exceed d. On the paper's network, d then changes
every 4 s (Δt = 0.02 s, a horizon at every step) to every 35 s (0.05 s, one step in ten), and 0.3 to
1.3 % of the horizons come later than d."""


class DelayBound(NamedTuple):
    """Delay bounds d of up to `capacity` vehicles, and the samples from which they are computed."""

    steps: I1
    """Delay bound d of each vehicle, or 0 while it is unknown; shape (capacity,)."""
    samples: I2
    """Newest samples of each vehicle [steps], in a ring; shape (capacity, SAMPLES)."""
    seen: I1
    """Number of samples so far; shape (capacity,)."""
    least: int
    most: int


def delay_bound(capacity: int, dt_s: float, most: int, fixed_s: float | None) -> DelayBound:
    """Initial delay bounds, at most `most` steps; `fixed_s`: fixed bound [s], or None."""
    least = 1
    if fixed_s is not None:
        # Rounded up, because d has to cover the whole delay.
        fixed = -(-seconds_to_ns(fixed_s) // seconds_to_ns(dt_s))
        least = most = min(max(fixed, 1), most)
    steps, seen = np.zeros((2, capacity), dtype=np.int64)
    samples = np.zeros((capacity, SAMPLES), dtype=np.int64)
    return DelayBound(steps, samples, seen, least, most)


def forget(bound: DelayBound, row: int) -> None:
    bound.steps[row] = bound.seen[row] = 0


@part
def set_first(bound: DelayBound, row: int, guess: int) -> None:
    bound.steps[row] = min(max(guess, bound.least), bound.most)


@part
def raise_to(bound: DelayBound, row: int, delay: int) -> None:
    """Raise d of a vehicle to at least a delay [steps], without a sample."""
    bound.steps[row] = max(bound.steps[row], min(delay, bound.most))


@part
def add_sample(bound: DelayBound, row: int, delay: int) -> None:
    """Update d of a vehicle with a sample [steps]; d falls by 1 at most."""
    newest = bound.seen[row] % SAMPLES
    bound.samples[row, newest] = delay
    bound.seen[row] += 1
    # d rises at once: while d is too small, horizons come into force late, and until then the
    # vehicle flies other inputs than the server assumed when it computed the horizon.
    d = max(bound.steps[row], min(delay, bound.most))
    count = min(bound.seen[row], SAMPLES)
    needed, since = 0, count  # number of samples of d or more, and of samples after the last such
    for slot in range(count):
        if bound.samples[row, slot] >= d:
            age = newest - slot if slot <= newest else newest - slot + SAMPLES
            needed, since = needed + 1, min(since, age)
    if d > bound.least and since >= RECENT and needed <= LATE * count:
        d -= 1
    bound.steps[row] = d
