"""Impairments that delay packets by a random distribution. Several in one direction add up.

A uniform random number becomes a delay by the distribution's quantile function. With
`correlation_s` the random number is kept for a random time (`Draws.lasting`): the autocorrelation
of the delays falls to 1/e in that time, and their distribution does not change.
"""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from math import exp, floor, inf, lgamma, log, pi, sqrt
from statistics import NormalDist
from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Time, impairment
from skytether.shared.base.units import SECOND_NS, seconds_to_ns

_NORMAL = NormalDist()
_TAIL = 2.0**-54
"""Smallest probability at which the normal quantile is evaluated: half the resolution of a uniform
number."""


class Delay(Impairment):
    kind = "delay"

    def __init__(self, correlation_s: float = 0.0) -> None:
        self._correlation_s = correlation_s

    def quantile_ns(self, share: float) -> int:
        """Quantile of the delay [ns] for a probability from 0 to 1."""
        raise NotImplementedError

    def __call__(self, fate: Fate, draws: Draws) -> None:
        correlation_s = self._correlation_s
        drawn = draws.lasting(fate, correlation_s) if correlation_s else draws.uniform(fate)
        fate.delay_ns += self.quantile_ns(drawn)


@impairment(name="constant")
class Constant(Delay):
    """Delays every packet by a constant number of seconds."""

    def __init__(self, delay_s: Time) -> None:
        super().__init__()
        self.least_s = self.mean_s = delay_s
        self._delay_ns = seconds_to_ns(delay_s)

    def __call__(self, fate: Fate, draws: Draws) -> None:  # noqa: ARG002
        fate.delay_ns += self._delay_ns

    def quantile_ns(self, share: float) -> int:  # noqa: ARG002
        return self._delay_ns


@impairment(name="paper")
class Paper(Delay):
    """Delays by minimum_s + slot_s · Poisson(slots_mean): the paper's law, as corrected (E1, E2).

    Source: eq. (17).
    """

    def __init__(
        self,
        minimum_s: Time,
        slot_s: Time,
        slots_mean: Annotated[float, Meta(ge=0, le=1e6)],
        correlation_s: Time = 0.0,
    ) -> None:
        super().__init__(correlation_s)
        self.least_s, self.mean_s = minimum_s, minimum_s + slot_s * slots_mean
        self._least_ns, self._slot_ns = seconds_to_ns(minimum_s), seconds_to_ns(slot_s)
        self._fewest, self._cumulative = _poisson(slots_mean)

    def quantile_ns(self, share: float) -> int:
        slots = self._fewest + bisect_right(self._cumulative, share)
        return self._least_ns + slots * self._slot_ns


@impairment(name="uniform")
class Uniform(Delay):
    """Delays by a uniformly distributed time from low_s to high_s."""

    def __init__(self, low_s: Time, high_s: Time, correlation_s: Time = 0.0) -> None:
        super().__init__(correlation_s)
        if high_s < low_s:
            raise ValueError(f"high_s to be at least low_s = {low_s:g}")
        self.least_s, self.mean_s = low_s, (low_s + high_s) / 2.0
        self._low_s, self._width_s = low_s, high_s - low_s

    def quantile_ns(self, share: float) -> int:
        return seconds_to_ns(self._low_s + self._width_s * share)


@impairment(name="normal")
class Normal(Delay):
    """Delays by a normally distributed time; negative values become 0."""

    def __init__(self, mean_s: Time, sd_s: Time, correlation_s: Time = 0.0) -> None:
        super().__init__(correlation_s)
        self._mean_s, self._sd_s = mean_s, sd_s
        reach = mean_s / sd_s if sd_s else inf
        density = exp(-reach * reach / 2.0) / sqrt(2.0 * pi)
        self.mean_s = mean_s * _NORMAL.cdf(reach) + sd_s * density
        self.least_s = self.quantile_ns(0.0) / SECOND_NS

    def quantile_ns(self, share: float) -> int:
        return max(0, seconds_to_ns(self._mean_s + self._sd_s * _standard(share)))


@impairment(name="lognormal")
class Lognormal(Delay):
    """Delays by least_s plus a lognormal time; mean_s and sd_s are those of the total."""

    def __init__(self, least_s: Time, mean_s: Time, sd_s: Time, correlation_s: Time = 0.0) -> None:
        super().__init__(correlation_s)
        over_s = _over(least_s, mean_s)
        self._least_s, self.mean_s = least_s, mean_s
        variance = log(1.0 + (sd_s / over_s) ** 2) if over_s else 0.0
        self._sigma = sqrt(variance)
        self._scale_s = over_s * exp(-variance / 2.0)
        self.least_s = self.quantile_ns(0.0) / SECOND_NS

    def quantile_ns(self, share: float) -> int:
        return seconds_to_ns(self._least_s + self._scale_s * exp(self._sigma * _standard(share)))


@impairment(name="gamma")
class Gamma(Delay):
    """Delays by least_s plus a gamma-distributed time; mean_s and sd_s are those of the total."""

    def __init__(self, least_s: Time, mean_s: Time, sd_s: Time, correlation_s: Time = 0.0) -> None:
        super().__init__(correlation_s)
        over_s = _over(least_s, mean_s)
        self.mean_s = mean_s
        if sd_s and not 0.1 <= (over_s / sd_s) ** 2 <= 1e4:
            raise ValueError("sd_s of 0, or of a hundredth to three times mean_s - least_s")
        shape = (over_s / sd_s) ** 2 if sd_s else 0.0
        self._scale_s = over_s / shape if shape else 0.0
        self._shares, self._multiples = _gamma(shape) if shape else ((0.0,), (0.0,))
        self._constant_s = least_s if shape else mean_s
        self.least_s = self.quantile_ns(0.0) / SECOND_NS

    def quantile_ns(self, share: float) -> int:
        multiple = interpolated(share, self._shares, self._multiples)
        return seconds_to_ns(self._constant_s + self._scale_s * multiple)


def interpolated(at: float, places: Sequence[float], values: Sequence[float]) -> float:
    """Linear interpolation between ascending `places`; beyond the ends, the first or last value."""
    after = bisect_right(places, at)
    if after == 0 or after == len(places):
        return values[0 if after == 0 else -1]
    before = after - 1
    part = (at - places[before]) / (places[after] - places[before])
    return values[before] + part * (values[after] - values[before])


def _standard(share: float) -> float:
    return _NORMAL.inv_cdf(min(max(share, _TAIL), 1.0 - 2.0**-53))


def _over(least_s: float, mean_s: float) -> float:
    """Mean minus smallest delay [s]; raises ValueError if it is negative."""
    if mean_s < least_s:
        raise ValueError(f"mean_s to be at least least_s = {least_s:g}")
    return mean_s - least_s


@lru_cache(maxsize=64)
def _poisson(mean: float) -> tuple[int, Sequence[float]]:
    """Cumulative probabilities of a Poisson distribution, without those near 0 and near 1.

    Returns:
        number that the first probability belongs to, and the probabilities P(N ≤ number), P(N ≤
            number + 1), …
    """
    if mean == 0.0:  # log(0) would fail
        return 0, (1.0,)
    wide = 10.0 * sqrt(mean) + 20.0
    numbers = range(max(0, floor(mean - wide)), floor(mean + wide))
    # In logarithms, as mean^m and m! overflow for large means. The paper prints m for m! (E1).
    logs = [number * log(mean) - mean - lgamma(number + 1.0) for number in numbers]
    cumulative = np.cumsum(np.exp(logs))
    return numbers[0], (cumulative / cumulative[-1]).tolist()


@lru_cache(maxsize=64)
def _gamma(shape: float) -> tuple[Sequence[float], Sequence[float]]:
    """Cumulative probabilities of a gamma distribution of scale 1, and their values.

    The density is integrated over x^shape if shape < 1, where it is unbounded in x, and over x
    otherwise.
    """
    power = min(shape, 1.0)
    low = max(0.0, shape - 9.0 * sqrt(shape)) ** power
    high = (shape + 9.0 * sqrt(shape) + 40.0) ** power
    y = np.linspace(low, high, 20_001)
    middle = (y[1:] + y[:-1]) / 2.0
    x = middle ** (1.0 / power)
    density = np.exp((shape - power) * np.log(x) - x - (lgamma(shape) + log(power)))
    cumulative = np.concatenate([[0.0], np.cumsum(density * np.diff(y))])
    rising = np.flatnonzero(np.diff(cumulative, prepend=-1.0) > 0.0)
    return (cumulative / cumulative[-1])[rising].tolist(), (y ** (1.0 / power))[rising].tolist()
