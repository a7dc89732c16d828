"""Models of delay and loss, as in `skytether list impairments`, fitted to a measurement.

Models are fitted by maximum likelihood, and compared by the Bayesian information criterion (BIC) k
ln n - 2 ln L: k is the number of parameters, L the likelihood, and n the effective sample size, see
`analysis.effective`. Widths of distributions, and distances of delays from a distribution's lower
bound, are at least RESOLUTION_S, so that no likelihood is infinite. Delays with a standard
deviation of at most CONSTANT_S are modelled as constant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import exp, lgamma, log, pi, sqrt

import numpy as np

from skytether.probe.analysis import highest
from skytether.shared.law.model import Array, Flags

RESOLUTION_S = 50e-6
CONSTANT_S = 0.5e-3
"""Largest standard deviation of delays that are modelled as constant [s]."""
LEASTS = 60
"""Number of candidates for a delay distribution's lower bound."""
SLOTS = 4000
"""Number of slot lengths that are tried for the paper's distribution."""
COLUMNS = 50
"""Number of columns of the table of slot lengths that are tried; a divisor of SLOTS."""
PAIRS_MIN = 20
"""Smallest number of packets for a fit."""
BURST_MIN, BURST_MAX_S = 0.1, 3600.0
"""Bounds of the mean redraw time: lower in median times between packets, upper in seconds."""


@dataclass(frozen=True, slots=True)
class FittedImpairment:
    """Impairment of a scenario, with arguments fitted to a measurement."""

    name: str
    numbers: tuple[float, ...]
    bic: float
    """Bayesian information criterion; smaller is better."""

    def text(self, correlation_s: float = 0.0) -> str:
        arguments = [f"{number:.5g}" for number in self.numbers]
        if correlation_s and self.name != "constant":
            arguments.append(f"correlation_s={correlation_s:.3g}")
        return f"{self.name}({', '.join(arguments)})"


# -- delays -------------------------------------------------------------------------------------


def fit_delays(delay_s: Array, independent: float) -> list[FittedImpairment]:
    """Fit models of delays; the best is first.

    Args:
        delay_s: delays of the received packets; shape (n,).
        independent: effective sample size.
    """
    if len(delay_s) < PAIRS_MIN:
        return []
    if float(np.std(delay_s)) <= CONSTANT_S:
        return [FittedImpairment("constant", (float(np.mean(delay_s)),), 0.0)]
    found = [_uniform(delay_s), _normal(delay_s), _paper(delay_s)]
    found += [_with_least(delay_s, "gamma"), _with_least(delay_s, "lognormal")]
    weight = min(1.0, independent / len(delay_s))
    fits = [
        FittedImpairment(
            name, numbers, parameters * log(max(independent, 2.0)) - 2.0 * weight * likelihood
        )
        for name, numbers, parameters, likelihood in filter(None, found)
    ]
    return sorted(fits, key=lambda fit: fit.bic)


Found = tuple[str, tuple[float, ...], int, float]
"""Name of a distribution, its arguments, number of parameters, and log-likelihood."""


def _normal_likelihood(left: Array, sd: float) -> float:
    return -len(left) * log(sd * sqrt(2.0 * pi)) - float(left @ left) / (2.0 * sd * sd)


def _uniform(delay_s: Array) -> Found:
    low, high = float(delay_s.min()), float(delay_s.max())
    width = max(high - low, RESOLUTION_S)
    return "uniform", (low, high), 2, -len(delay_s) * log(width)


def _normal(delay_s: Array) -> Found:
    mean, sd = float(np.mean(delay_s)), max(float(np.std(delay_s)), RESOLUTION_S)
    return "normal", (mean, sd), 2, _normal_likelihood(delay_s - mean, sd)


def _with_least(delay_s: Array, name: str) -> Found:
    """Fit a gamma or lognormal distribution above a least delay, from a grid of least delays."""
    first, span = float(delay_s.min()), float(np.mean(delay_s) - delay_s.min())
    law = _gamma if name == "gamma" else _lognormal
    below = np.minimum(np.geomspace(RESOLUTION_S, 30.0 * span, LEASTS), first)
    tried = [law(delay_s, first - each)[0] for each in below.tolist()]
    best = int(np.argmax(tried))
    low, high = below[max(best - 1, 0)], below[min(best + 1, LEASTS - 1)]
    at = highest(lambda each: law(delay_s, first - each)[0], float(low), float(high), 25)
    likelihood, mean, sd = law(delay_s, first - at)
    return name, (max(first - at, 0.0), mean, sd), 3, likelihood


def _lognormal(delay_s: Array, least_s: float) -> tuple[float, float, float]:
    """Log-likelihood, mean and standard deviation of the best lognormal above `least_s`."""
    over = np.maximum(delay_s - least_s, RESOLUTION_S)
    logs = np.log(over)
    mu, sigma = float(np.mean(logs)), max(float(np.std(logs)), 1e-6)
    mean = exp(min(mu + sigma * sigma / 2.0, 50.0))
    sd = mean * sqrt(exp(min(sigma * sigma, 50.0)) - 1.0)
    return _normal_likelihood(logs - mu, sigma) - float(logs.sum()), least_s + mean, sd


def _gamma(delay_s: Array, least_s: float) -> tuple[float, float, float]:
    """Log-likelihood, mean and standard deviation of the best gamma law above `least_s`."""
    over = np.maximum(delay_s - least_s, RESOLUTION_S)
    count, mean, mean_log = len(over), float(np.mean(over)), float(np.mean(np.log(over)))

    def likelihood(log_shape: float) -> float:
        shape = exp(log_shape)
        rate = shape / mean
        return count * (shape * log(rate) - lgamma(shape) + (shape - 1.0) * mean_log - shape)

    log_shape = highest(likelihood, log(0.1), log(1e4), 60)
    return likelihood(log_shape), least_s + mean, mean / sqrt(exp(log_shape))


def _paper(delay_s: Array) -> Found | None:
    """Fit least delay, Poisson number of slots and normal error; None if no slots are found."""
    first, span = float(delay_s.min()), float(delay_s.max() - delay_s.min())
    if span < 20.0 * RESOLUTION_S:
        return None
    shift = delay_s - first
    sample = shift[:: max(1, len(shift) // 2000)]

    def concentration(slot_s: float) -> float:
        return abs(complex(np.mean(np.exp(2j * pi * sample / slot_s))))

    # Slot lengths are tried on a uniform grid of 1/slot, on which all peaks are 1/span wide.
    inverse = np.linspace(1.0 / span, min(SLOTS / (4.0 * span), 1e3), SLOTS)
    # Computes concentration(1 / inverse). Each exponential is the product of an exponential for its
    # row and one for its column, so that a thirtieth of the exponentials suffices.
    rows, columns = inverse[::COLUMNS], inverse[:COLUMNS] - inverse[0]
    waves = [np.exp(2j * pi * np.outer(each, sample)) for each in (rows, columns)]
    scores = np.abs(waves[0] @ waves[1].T).ravel() / len(sample)
    good = np.flatnonzero(scores > max(0.9 * float(scores.max()), 0.8))
    if not len(good):
        return None
    # Half or a third of the true slot length scores as high: the longest of the best is taken.
    run = good[: int(np.argmax(np.diff(good, append=10**9) > 1)) + 1]
    peak = inverse[run[np.argmax(scores[run])]]
    step = inverse[1] - inverse[0]
    slot = 1.0 / highest(lambda each: concentration(1.0 / each), peak - step, peak + step, 60)
    phase = float(np.angle(np.mean(np.exp(2j * pi * shift / slot)))) * slot / (2.0 * pi)
    places = np.rint((shift - phase) / slot)
    slot, begin = (float(each) for each in np.polyfit(places, delay_s, 1))
    residuals = delay_s - begin - slot * places
    error = max(float(np.std(residuals)), RESOLUTION_S)
    places -= places.min()
    begin = float(np.mean(delay_s - slot * places))

    def likelihood(before: int) -> float:
        """Log-likelihood of a Poisson law with `before` empty slots below the least delay."""
        counts, times = np.unique(places + before, return_counts=True)
        mean = float(np.mean(places)) + before
        logs = [count * log(mean) - mean - lgamma(count + 1.0) for count in counts.tolist()]
        return float(np.array(logs) @ times)

    befores = range(max(0, int(begin / slot)) + 1) if float(np.mean(places)) > 0.0 else range(0)
    if not befores:
        return None
    before = max(befores[:200], key=likelihood)
    numbers = max(begin - before * slot, 0.0), slot, float(np.mean(places)) + before
    return "paper", numbers, 4, likelihood(before) + _normal_likelihood(residuals, error)


# -- losses -------------------------------------------------------------------------------------


def fit_losses(time_s: Array, lost: Flags) -> list[FittedImpairment]:
    """Fit models of losses; the best is first. Empty if no packet or every packet was lost.

    In `gilbert_elliott`, the channel is redrawn at random times: it is bad with probability
    `share`, and loses every packet while it is bad. With probability exp(-Δt / cell) it is not
    redrawn between two packets that are Δt apart; `cell` is the mean time from one redraw to the
    next [s]. A bad period lasts cell / (1 - share) on average.

    Args:
        time_s: times of sending, in the order of sending; shape (n,).
        lost: whether each packet was lost; shape (n,).
    """
    count, lost_count = len(lost), int(np.sum(lost))
    if count < PAIRS_MIN or lost_count in (0, count):
        return []
    share = lost_count / count
    bernoulli = lost_count * log(share) + (count - lost_count) * log(1.0 - share)
    fits = [FittedImpairment("loss", (share,), log(count) - 2.0 * bernoulli)]
    between = np.maximum(np.diff(time_s), 0.0)
    before, after = lost[:-1].astype(bool), lost[1:].astype(bool)
    groups = [between[(before == one) & (after == other)] for one, other in _TURNS]
    likelihood = partial(_gilbert, groups)
    spacing = max(float(np.median(between)), 1e-6)
    low, high = log(BURST_MIN * spacing), log(BURST_MAX_S)
    best_share = share
    cell = spacing
    for _ in range(20):  # alternate between both parameters, which hardly depend on each other
        cell = exp(highest(partial(_at_share, likelihood, best_share), low, high, 40))
        best_share = highest(partial(_at_cell, likelihood, cell), 1e-6, 1.0 - 1e-6, 50)
    first = log(best_share if lost[0] else 1.0 - best_share)
    numbers = best_share, cell / (1.0 - best_share)
    if numbers[1] <= BURST_MAX_S:
        bic = 2.0 * log(count) - 2.0 * (likelihood(best_share, cell) + first)
        fits.append(FittedImpairment("gilbert_elliott", numbers, bic))
    return sorted(fits, key=lambda fit: fit.bic)


def _at_share(likelihood: Callable[[float, float], float], share: float, cell: float) -> float:
    """Log-likelihood of a redraw time at a given share; `cell` is the time's logarithm."""
    return likelihood(share, exp(cell))


def _at_cell(likelihood: Callable[[float, float], float], cell_s: float, share: float) -> float:
    """Log-likelihood of a share at a given redraw time `cell_s` [s]."""
    return likelihood(share, cell_s)


_TURNS = ((True, True), (True, False), (False, True), (False, False))
"""Four cases: whether a packet was lost, and whether the packet after it was lost."""


def _gilbert(groups: list[Array], share: float, cell_s: float) -> float:
    """Log-likelihood of the packets' losses, each given whether the previous packet was lost.

    Args:
        groups: times between successive packets [s], for each of the four cases in `_TURNS`.
    """
    total = 0.0
    for (before, after), between in zip(_TURNS, groups, strict=True):
        same = np.exp(-between / cell_s)
        to_bad = share * (1.0 - same) + (same if before else 0.0)
        chance = to_bad if after else 1.0 - to_bad
        total += float(np.log(np.maximum(chance, 1e-12)).sum())
    return total
