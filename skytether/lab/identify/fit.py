"""First-order model with dead time, fitted to a vehicle's responses to steps of velocity.

    v(t) = g Σ Δu (1 - exp(-(t - t_u - θ) / τ)) + w       over the changes Δu at times t_u < t - θ

Gain g, time constant τ and dead time θ are the least-squares solution over all steps of an axis.
The offset w, constant within a step, is due to wind or sensor error; subtracting each step's mean
from both sides removes it. Residuals are correlated within a step, so the intervals treat steps as
clusters (the sandwich estimator; Liang and Zeger, Biometrika 73, 1986). The intervals are never
narrower than those for white noise.
"""

import math
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy import optimize

from skytether.lab.engine.intervals import students
from skytether.shared.law.model import Array

STEPS_MIN = 2
DEAD_MAX_S = 2.0
TAU_MIN_S = 1e-3
GAIN_MIN = 1e-3
"""Smallest gain that a scenario allows."""
GRID_S = 0.08
"""Spacing of the grid of dead times from which fits start [s]."""
BEGINNINGS = 2
BIN_S = 0.05
"""Time over which the residuals of steps are averaged [s]."""
GOOD = 0.1
"""Largest accepted difference between measured and predicted step, as a share of the height."""
SURE = 4.0
"""Number of standard errors above `GOOD` at which a model is rejected."""


class StepResponse(NamedTuple):
    before: float
    after: float
    changes: Array
    """Changes of the input that affect the response: time relative to the step [s], and amount
    [m/s]; shape (n, 2)."""
    times: Array
    """Times of the measurements relative to the step [s], negative before the step; shape (m,)."""
    velocity: Array
    """Measured velocity [m/s]; shape (m,)."""

    @property
    def height(self) -> float:
        return self.after - self.before

    @property
    def starts(self) -> bool:
        """Whether the step starts a motion; otherwise the step ends a motion."""
        return abs(self.after) > abs(self.before)


class Numbers(NamedTuple):
    """Gain, time constant and dead time of a model, or half-widths of their intervals."""

    gain: float
    tau_s: float
    dead_time_s: float


class Misfit(NamedTuple):
    """Residual of a model, as shares of the predicted height of steps."""

    rms: float
    largest: float
    """Largest residual, averaged over all starting steps or over all ending steps."""
    at_s: float
    """Time of the largest residual, relative to the step [s]."""
    certain: float
    """Lower confidence bound of the largest residual, from the scatter between steps."""


class Fit(NamedTuple):
    numbers: Numbers
    within: Numbers
    """Half-widths of the 95 % intervals of `numbers`; infinite if the steps do not suffice."""
    misfit: Misfit


def fit(responses: Sequence[StepResponse]) -> Fit | None:
    """Fit a model to the responses of an axis; None if there are too few responses."""
    if len(responses) < STEPS_MIN:
        return None
    numbers = _best(responses)
    return Fit(numbers, _within(responses, numbers), misfit(responses, numbers))


def unit_response(times: Array, numbers: Numbers) -> Array:
    """Velocity after a unit step of the input, divided by the gain, at `times` [s]; same shape."""
    return -np.expm1(-np.maximum(times - numbers.dead_time_s, 0.0) / numbers.tau_s)


def predicted(response: StepResponse, numbers: Numbers) -> Array:
    """Velocity that a model predicts at the measurements of a step [m/s]; shape (m,)."""
    since = response.times[:, None] - response.changes[:, 0]
    first = response.before - response.changes[response.changes[:, 0] < 0.0, 1].sum()
    predicted_input = first + unit_response(since, numbers) @ response.changes[:, 1]
    velocity: Array = numbers.gain * predicted_input
    return velocity


def remainder(response: StepResponse, numbers: Numbers) -> Array:
    """Residual of a model for a step, without its mean [m/s]; shape (m,)."""
    return _centred(response.velocity - predicted(response, numbers))


def _centred(values: Array) -> Array:
    centred: Array = values - values.mean(axis=0)
    return centred


def _slopes(response: StepResponse, numbers: Numbers) -> Array:
    """Derivatives of the residual by gain, time constant and dead time; shape (m, 3)."""
    gain, tau, late = numbers
    late_s = response.times[:, None] - response.changes[:, 0] - late
    left = np.where(late_s > 0.0, np.exp(-np.maximum(late_s, 0.0) / tau), 0.0)
    change = response.changes[:, 1]
    by_tau = gain * (left * late_s / tau**2) @ change
    by_late = gain * (left / tau) @ change
    by_gain = -predicted(response, numbers) / gain
    return _centred(np.stack([by_gain, by_tau, by_late], axis=1))


def _best(responses: Sequence[StepResponse]) -> Numbers:
    """Least-squares parameters: a grid search, each point with its best gain, then a local search.

    The sum of squares has kinks and local minima where a dead time coincides with a measurement. So
    the local search uses no derivatives, and starts at several points.
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
    """Function of time constant and dead time that returns the sum of squares and the best gain.

    Called a thousand times, so it evaluates all responses at once.
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
        unit_velocity = centred(np.einsum("ij,ij->i", unit, change))
        gain = max(
            float(unit_velocity @ velocity) / max(float(unit_velocity @ unit_velocity), 1e-12),
            GAIN_MIN,
        )
        return float(np.sum((velocity - gain * unit_velocity) ** 2)), gain

    return projected


def _within(responses: Sequence[StepResponse], numbers: Numbers) -> Numbers:
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
    half = students(count - 1) * np.sqrt(variance)
    return Numbers(*half.tolist())


def differences(response: StepResponse, numbers: Numbers) -> Array:
    """Residual of a model for a step, as a share of its predicted height; shape (m,)."""
    return remainder(response, numbers) / (numbers.gain * response.height)


def misfit(responses: Sequence[StepResponse], numbers: Numbers) -> Misfit:
    """Residual of a model for responses; the model may have been fitted to other responses."""
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
    """Mean of curves over time, and its standard error, at times at which at least half of the
    curves have values.

    Args:
        curves: times from the step [s] and values of each curve.

    Returns:
        times [s], means, and standard errors, which are infinite for a single curve.
    """
    count = max((int(times[-1] / BIN_S) + 2 for times, _ in curves), default=0)
    table = np.full((len(curves), count), np.nan)
    for row, (times, values) in zip(table, curves, strict=True):
        after = times >= 0.0
        # A time on a bin's border counts for the later bin.
        which = (times[after] / BIN_S + 1e-6).astype(int)
        number = np.bincount(which, minlength=count)
        with np.errstate(invalid="ignore"):
            row[:] = np.bincount(which, values[after], minlength=count) / number
    having = np.isfinite(table).sum(axis=0)
    is_shown = having >= max(1, (len(curves) + 1) // 2)
    table, having = table[:, is_shown], having[is_shown]
    mean = np.nansum(table, axis=0) / having
    variance = np.nansum((table - mean) ** 2, axis=0) / np.maximum(having - 1, 1)
    several = having > 1
    # The variance of two curves is too uncertain, so all times have at least the mean variance.
    pooled = variance[several].mean() if several.any() else np.inf
    error = np.sqrt(np.maximum(variance, pooled) / having)
    return BIN_S * (np.flatnonzero(is_shown).astype(np.float64) + 0.5), mean, error


def verdict(found: Fit) -> str:
    """Sentence that says whether a first-order model with dead time is adequate."""
    off = found.misfit
    where = f"{off.largest:.0%} of the step's height {off.at_s:.2f} s after it"
    if off.largest <= GOOD:
        return f"first order with dead time will do: it is off by at most {where}"
    if off.certain > GOOD:
        return f"first order with dead time will not do: it is off by {where}"
    advice = "because the steps differ too much: fly in calm air, or with more --repeats"
    return f"it is unclear whether first order with dead time will do ({where}), {advice}"
