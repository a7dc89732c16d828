"""First order with dead time, fitted to what a vehicle answered to steps of velocity.

    v(t) = g Σ Δu (1 - exp(-(t - t_u - θ) / τ)) + w       over the changes Δu at times t_u < t - θ

Gain g, time constant τ and dead time θ are those of the least squares over all steps of an axis; w
is what wind or a sensor's error adds, for each step its own, and is gone where each step's mean is
taken off both sides. Errors of a fit belong together within a step, for what is left over is no
white noise: intervals are those of the steps as clusters (the sandwich estimator; Liang and Zeger,
Biometrika 73, 1986), and no narrower than those of white noise.
"""

import math
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from skytether.shared.law.model import Array

STEPS_MIN = 2
"""Fewest steps that a fit, and its intervals, can be made of."""
CONFIDENCE = 0.95
"""Share of intervals that hold the true number."""
DEAD_MAX_S = 2.0
"""Longest dead time that both ends can reckon with [s]."""
TAU_MIN_S = 1e-3
"""Shortest time constant that they can [s]."""
GAIN_MIN = 1e-3
"""Smallest gain that they can."""
GRID_S = 0.08
"""Distance of the dead times from which a fit is begun [s]."""
BEGINNINGS = 2
"""Number of places where a fit is begun."""
BIN_S = 0.05
"""Time over which what steps have left over is averaged [s]."""
GOOD = 0.1
"""Largest difference between measured and predicted step that will do, as share of its height."""
SURE = 4.0
"""Standard errors by which a difference has to be larger than `GOOD` for a model to be refused."""


class StepResponse(NamedTuple):
    """What an axis answered to one step of its input."""

    before: float
    """Input before the step [m/s]."""
    after: float
    """Input after it [m/s]."""
    changes: Array
    """Changes of the input, as far back as they matter: time from the step [s], and by how much
    [m/s]; shape (n, 2)."""
    times: Array
    """Times of the measurements, from a while before the step on [s]; shape (m,)."""
    velocity: Array
    """Velocity measured then [m/s]; shape (m,)."""

    @property
    def height(self) -> float:
        """Height of the step, with its sign [m/s]."""
        return self.after - self.before

    @property
    def starts(self) -> bool:
        """Whether the vehicle sets out with the step; else it stops."""
        return abs(self.after) > abs(self.before)


class Numbers(NamedTuple):
    """Numbers of a model of first order with dead time, or half-widths of their intervals."""

    gain: float
    """Gain."""
    tau_s: float
    """Time constant [s]."""
    dead_time_s: float
    """Dead time [s]."""


class Misfit(NamedTuple):
    """What a model leaves over of measured steps, as shares of their predicted height."""

    rms: float
    """Root of the mean square over all measurements."""
    largest: float
    """Largest difference at any time, of the mean of the steps that set out, or that stop."""
    at_s: float
    """Time from the step at which it is [s]."""
    certain: float
    """How large it is at least, for noise and wind make the steps differ among themselves."""


class Fit(NamedTuple):
    """A model of first order with dead time, fitted to steps."""

    numbers: Numbers
    """Numbers of the model."""
    within: Numbers
    """Half-widths of their 95 % intervals; infinite where the steps do not tell."""
    misfit: Misfit
    """What is left over."""


def fit(responses: Sequence[StepResponse]) -> Fit | None:
    """The model that fits responses of an axis best; None where there are too few to tell."""
    if len(responses) < STEPS_MIN:
        return None
    numbers = _best(responses)
    return Fit(numbers, _within(responses, numbers), misfit(responses, numbers))


def unit_response(times: Array, numbers: Numbers) -> Array:
    """Velocity after a unit step of the input, over the gain; shape of the times [s]."""
    return -np.expm1(-np.maximum(times - numbers.dead_time_s, 0.0) / numbers.tau_s)


def predicted(response: StepResponse, numbers: Numbers) -> Array:
    """Velocity that a model predicts for the measurements of a step [m/s]; shape (m,)."""
    since = response.times[:, None] - response.changes[:, 0]
    first = response.before - response.changes[response.changes[:, 0] < 0.0, 1].sum()
    told = first + unit_response(since, numbers) @ response.changes[:, 1]
    velocity: Array = numbers.gain * told
    return velocity


def remainder(response: StepResponse, numbers: Numbers) -> Array:
    """What a model leaves over of a step, but for what is the same all along [m/s]; shape (m,)."""
    return _centred(response.velocity - predicted(response, numbers))


def _centred(values: Array) -> Array:
    centred: Array = values - values.mean(axis=0)
    return centred


def _slopes(response: StepResponse, numbers: Numbers) -> Array:
    """Derivatives of the remainder by gain, time constant and dead time; shape (m, 3)."""
    gain, tau, late = numbers
    late_s = response.times[:, None] - response.changes[:, 0] - late
    left = np.where(late_s > 0.0, np.exp(-np.maximum(late_s, 0.0) / tau), 0.0)
    change = response.changes[:, 1]
    by_tau = gain * (left * late_s / tau**2) @ change
    by_late = gain * (left / tau) @ change
    by_gain = -predicted(response, numbers) / gain
    return _centred(np.stack([by_gain, by_tau, by_late], axis=1))


def _best(responses: Sequence[StepResponse]) -> Numbers:
    """Numbers of least squares: the best of a grid, each with its best gain, and from there on.

    What is left over has a kink wherever a dead time ends at a measurement, and local minima there:
    the search compares values alone, and begins at several places.
    """
    longest_s = max(float(each.times[-1]) for each in responses)
    dead_max_s = min(DEAD_MAX_S, longest_s / 2.0)
    projected = _projection(responses)

    def left_over(x: Array) -> float:
        return projected(math.exp(x[0]), x[1])[0]

    taus = np.log(np.geomspace(0.03, longest_s, 9))
    grid = [(tau, late) for tau in taus for late in np.arange(0.0, dead_max_s, GRID_S)]
    grid.sort(key=lambda each: left_over(np.array(each)))
    bounds = [(math.log(TAU_MIN_S), math.log(10.0 * longest_s)), (0.0, dead_max_s)]
    found = []
    for tau, late in grid[:BEGINNINGS]:
        simplex = [(tau, late), (tau + 0.2, late), (tau, late + GRID_S / 2.0)]
        options = {"initial_simplex": simplex, "xatol": 1e-6, "fatol": 0.0, "maxfev": 200}
        found.append(
            optimize.minimize(
                left_over, simplex[0], method="Nelder-Mead", bounds=bounds, options=options
            )
        )
    log_tau, late = min(found, key=lambda each: float(each.fun)).x.tolist()
    tau = math.exp(log_tau)
    return Numbers(projected(tau, late)[1], tau, late)


def _projection(responses: Sequence[StepResponse]) -> Callable[[float, float], tuple[float, float]]:
    """What gives, for a time constant and a dead time, the sum of squares that is left over, and
    the gain with which it is least; all responses at once, for it is asked a thousand times.
    """
    lengths = [len(each.times) for each in responses]
    edges = np.cumsum([0, *lengths[:-1]])
    count = max(len(each.changes) for each in responses)
    since, change = np.zeros((2, sum(lengths), count))
    for each, edge, length in zip(responses, edges, lengths, strict=True):
        rows, columns = slice(edge, edge + length), slice(len(each.changes))
        since[rows, columns] = each.times[:, None] - each.changes[:, 0]
        change[rows, columns] = each.changes[:, 1]

    def centred(values: Array) -> Array:
        means = np.add.reduceat(values, edges) / lengths
        return values - np.repeat(means, lengths)

    velocity = centred(np.concatenate([each.velocity for each in responses]))

    def projected(tau: float, late: float) -> tuple[float, float]:
        unit = unit_response(since, Numbers(1.0, tau, late))
        told = centred(np.einsum("ij,ij->i", unit, change))
        gain = max(float(told @ velocity) / max(float(told @ told), 1e-12), GAIN_MIN)
        return float(np.sum((velocity - gain * told) ** 2)), gain

    return projected


def _within(responses: Sequence[StepResponse], numbers: Numbers) -> Numbers:
    """Half-widths of the intervals of numbers that fit responses best."""
    slopes = [_slopes(each, numbers) for each in responses]
    left = [remainder(each, numbers) for each in responses]
    count, samples = len(responses), sum(map(len, left))
    curvature = sum(each.T @ each for each in slopes)
    if not np.linalg.cond(curvature) < 1e12:
        return Numbers(math.inf, math.inf, math.inf)
    inverse = np.linalg.inv(curvature)
    scores = [slope.T @ rest for slope, rest in zip(slopes, left, strict=True)]
    clustered = inverse @ sum(np.outer(each, each) for each in scores) @ inverse
    clustered *= count / (count - 1.0)
    freedom = max(1, samples - count - len(numbers))
    white = inverse * (sum(float(each @ each) for each in left) / freedom)
    variance = np.maximum(np.diag(clustered), np.diag(white))
    half = stats.t.ppf(0.5 + CONFIDENCE / 2.0, count - 1) * np.sqrt(variance)
    return Numbers(*half.tolist())


def differences(response: StepResponse, numbers: Numbers) -> Array:
    """What a model leaves over of a step, as share of its predicted height; shape (m,)."""
    return remainder(response, numbers) / (numbers.gain * response.height)


def misfit(responses: Sequence[StepResponse], numbers: Numbers) -> Misfit:
    """What a model leaves over of responses, which need not be those that it was fitted to."""
    shares = [differences(each, numbers) for each in responses]
    rms = float(np.sqrt(np.mean(np.concatenate(shares) ** 2)))
    worst = Misfit(rms, 0.0, 0.0, 0.0)
    ordered = sorted(zip(responses, shares, strict=True), key=lambda each: each[0].starts)
    for _, group in groupby(ordered, key=lambda each: each[0].starts):
        times, mean, error = binned([(each.times, share) for each, share in group])
        if not len(times):
            continue
        at = int(np.abs(mean).argmax())
        certain = max(worst.certain, float((np.abs(mean) - SURE * error).max()))
        worst = worst._replace(certain=certain)
        if abs(mean[at]) > worst.largest:
            worst = worst._replace(largest=float(abs(mean[at])), at_s=float(times[at]))
    return worst


def binned(curves: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Mean of curves over time, and its standard error, where at least half of them have a value.

    Args:
        curves: times from the step [s] and values of each.

    Returns:
        times [s], means, and standard errors, which are infinite where there is one curve.
    """
    count = max((int(times[-1] / BIN_S) + 2 for times, _ in curves), default=0)
    table = np.full((len(curves), count), np.nan)
    for row, (times, values) in zip(table, curves, strict=True):
        after = times >= 0.0
        which = (times[after] / BIN_S + 1e-6).astype(int)  # at a border, what comes after it
        number = np.bincount(which, minlength=count)
        with np.errstate(invalid="ignore"):
            row[:] = np.bincount(which, values[after], minlength=count) / number
    having = np.isfinite(table).sum(axis=0)
    told = having >= max(1, (len(curves) + 1) // 2)
    table, having = table[:, told], having[told]
    mean = np.nansum(table, axis=0) / having
    variance = np.nansum((table - mean) ** 2, axis=0) / np.maximum(having - 1, 1)
    several = having > 1
    pooled = variance[several].mean() if several.any() else np.inf  # of two curves one tells little
    error = np.sqrt(np.maximum(variance, pooled) / having)
    return BIN_S * (np.flatnonzero(told).astype(np.float64) + 0.5), mean, error


def verdict(found: Fit) -> str:
    """Whether first order with dead time will do, in words."""
    off = found.misfit
    where = f"{off.largest:.0%} of the step's height {off.at_s:.2f} s after it"
    if off.largest <= GOOD:
        return f"first order with dead time will do: it is off by at most {where}"
    if off.certain > GOOD:
        return f"first order with dead time will not do: it is off by {where}"
    said = "for the steps differ among themselves: fly in calm air, or more --repeats"
    return f"whether first order with dead time will do cannot be told ({where}), {said}"
