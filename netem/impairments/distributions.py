"""Further distributions of delays, see `delays`."""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from math import exp, inf, lgamma, log, pi, sqrt
from statistics import NormalDist

import numpy as np

from skytether.netem.impairments.delays import Delay
from skytether.netem.impairments.impairment import Time, impairment
from skytether.shared.base.units import SECOND_NS, seconds_to_ns

_NORMAL = NormalDist()
_TAIL = 2.0**-54
"""Smallest probability at which the normal quantile is evaluated, because the quantile of 0 is
infinite: half the resolution of a uniform random number."""


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
    """Delays by least_s plus a lognormal time; mean_s and sd_s are those of the sum."""

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
    """Delays by least_s plus a gamma-distributed time; mean_s and sd_s are those of the sum."""

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
def _gamma(shape: float) -> tuple[Sequence[float], Sequence[float]]:
    """Cumulative probabilities P(X ≤ x) of a gamma distribution of scale 1, and the values x.

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
