"""Impairments that delay packets by a random distribution. Several delays in one direction add up.
`distributions` has further distributions.

A uniform random number becomes a delay by the distribution's quantile function. With
`correlation_s` the random number is kept for a random time (`Draws.lasting`): the autocorrelation
of the delays falls to 1/e in that time, and their distribution does not change.
"""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from math import floor, lgamma, log, sqrt
from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Time, impairment
from skytether.shared.base.units import seconds_to_ns


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
    """Delays by minimum_s + slot_s · Poisson(slots_mean): the paper's delays, corrected.

    Source: eq. (17), with the corrections E1 and E2 of docs/paper.md.
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


@lru_cache(maxsize=64)
def _poisson(mean: float) -> tuple[int, Sequence[float]]:
    """Cumulative probabilities of a Poisson distribution, except values near 0 and near 1.

    Returns:
        smallest number n, and the probabilities P(N ≤ n), P(N ≤ n + 1), …
    """
    if mean == 0.0:  # avoids log(0)
        return 0, (1.0,)
    wide = 10.0 * sqrt(mean) + 20.0
    numbers = range(max(0, floor(mean - wide)), floor(mean + wide))
    # In logarithms, because mean^m and m! overflow for large means. The paper has m for m! (E1).
    logs = [number * log(mean) - mean - lgamma(number + 1.0) for number in numbers]
    cumulative = np.cumsum(np.exp(logs))
    return numbers[0], (cumulative / cumulative[-1]).tolist()
