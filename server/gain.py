"""Gain of feedback aboard: K of u = -K x, for a vehicle whose inputs act after a dead time.

It is the K on position and velocity, the same at every step, that makes the mean of the cost

    xᵀ Q x + (R + S) u²                     at every step, in flight for ever without bounds

smallest where white acceleration jolts the velocity. Without a dead time that is the linear-
quadratic regulator. With one, the inputs on their way belong to the state, z = [x, u(k-1) …
u(k-N)], but K sees x alone. A regulator for a vehicle without dead time is too hasty then: with
weights that make it firm, it swings wider and wider.

The smallest cost is found as Anderson and Moore do: from a K that is stable, to that which the
covariance X and the cost to go V of the present one make best, and half as far until it is better.

    X = F X Fᵀ + W        V = Fᵀ V F + Q + Kᵀ (R + S) K        F = A - B K, all of them of z

Noise of the measurements changes nothing without dead time: with a Kalman filter between, the best
K is the same. With one it is another, by up to 26 % in what was tried, but that is worth no more
than 3.3 % of the cost, and is left out.
"""

import math

import numpy as np

from shared.config import ControlConfig, Scenario
from shared.model import Array, Model, discretise

ROUNDS = 10_000
"""Largest number of rounds of a search, for weights with which it hardly settles."""
ON_THEIR_WAY_MAX = 40
"""Most inputs on their way that are reckoned with; where there are more, the steps are longer."""
HALVINGS = 40
"""How often a gain, or a step to another, is halved before it is given up."""
LEAST = 1e-6
"""Least weight of the position as a share of that of the velocity, where there is dead time."""
SETTLED = 1e-12
"""Share of the cost below which nothing is gained by another round."""
DOUBLINGS, TINY = 50, 1e-16
"""How often the terms of a sum are doubled, and the share of it below which they are left out."""


def feedback_gain(scenario: Scenario) -> Array:
    """K of a scenario, for the dead time of its model; 0 without feedback.

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    model, control = scenario.terms().model, scenario.control
    if not control.feedback:
        return np.zeros_like(model.B)
    return stationary_gain(model, control, scenario.model.dead_time_s)


def stationary_gain(model: Model, control: ControlConfig, dead_time_s: float = 0.0) -> Array:
    """K for the model (4) whose inputs act after a dead time.

    Args:
        model: eq. (4).
        control: the weights; S counts like R.
        dead_time_s: time from an input to its effect [s].

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    Q, R = np.diag(control.state_weight), control.input_weight + control.change_weight
    if dead_time_s == 0.0:
        return regulator(model, Q, R)
    # What is not weighed at all would have no stationary variance.
    Q[0, 0] = max(Q[0, 0], LEAST * Q[1, 1])
    gains = {
        axis: _best(DeadTime(axis.a01 / axis.b1, axis.a01 + axis.b0, dead_time_s), Q, R, plain)
        for axis, plain in dict(zip(model.axes(), regulator(model, Q, R), strict=True)).items()
    }
    return np.array([gains[axis] for axis in model.axes()])


def regulator(model: Model, Q: Array, R: float) -> Array:
    """K of the linear-quadratic regulator: what (9) comes to without end and bounds.

    Args:
        model: eq. (4).
        Q, R: weights of the state, shape (2, 2), and of the input.

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    A, B = model.A, model.B
    cost, before = np.tile(Q, (len(B), 1, 1)), np.zeros((len(B), 2, 2))
    gain = np.zeros_like(B)
    for _ in range(ROUNDS):
        if np.allclose(cost, before, rtol=1e-12, atol=0.0):
            break
        ahead = np.einsum("ai,aij->aj", B, cost)
        weight = R + np.einsum("aj,aj->a", ahead, B)
        gain = np.einsum("ai,aij->aj", ahead, A) / weight[:, None]
        left = A - B[:, :, None] * gain[:, None, :]
        cost, before = Q + np.einsum("aji,ajk,akl->ail", A, cost, left), cost
    return gain


class DeadTime:
    """One axis, with the inputs on their way: z(k+1) = A z(k) + B u(k).

    Args:
        tau_s: time constant [s].
        dt_s: length of a step [s].
        dead_time_s: time from an input to its effect [s].
    """

    def __init__(self, tau_s: float, dt_s: float, dead_time_s: float) -> None:
        dt_s *= max(1, math.ceil(dead_time_s / dt_s / ON_THEIR_WAY_MAX))
        whole = int(dead_time_s / dt_s + 1e-9)
        rest_s = max(0.0, dead_time_s - whole * dt_s)
        model = discretise([tau_s], dt_s)
        # The input that is due acts for the rest of the step, and before it the one before.
        due = discretise([tau_s], dt_s - rest_s).B[0]
        n = 2 + whole + 1
        inputs = np.zeros((2, n - 1))
        """Column i: how the input of i steps ago acts."""
        inputs[:, whole], inputs[:, whole + 1] = due, model.B[0] - due
        self.A = np.zeros((n, n))
        self.A[:2, :2], self.A[:2, 2:] = model.A[0], inputs[:, 1:]
        self.A[3:, 2:-1] = np.eye(n - 3)
        self.B = np.zeros(n)
        self.B[:2], self.B[2] = inputs[:, 0], 1.0

    def closed(self, gain: Array) -> Array:
        """F = A - B K, for K of shape (2,)."""
        left = self.A.copy()
        left[:, :2] -= np.outer(self.B, gain)
        return left

    def radius(self, gain: Array) -> float:
        """Spectral radius of F."""
        return float(np.abs(np.linalg.eigvals(self.closed(gain))).max())

    def holds(self, gain: Array) -> bool:
        """Whether feedback with this K is stable."""
        return self.radius(gain) < 1.0


def _best(axis: DeadTime, Q: Array, R: float, plain: Array) -> Array:
    """K of one axis, sought from that of the regulator without dead time; shape (2,)."""
    jolts = np.zeros_like(axis.A)
    jolts[1, 1] = 1.0

    def spread(gain: Array) -> Array:
        """Covariance X that a gain leaves."""
        return _summed(axis.closed(gain), jolts)

    def cost(gain: Array, X: Array) -> float:
        """Mean cost of a step."""
        return float((Q * X[:2, :2]).sum() + R * (gain @ X[:2, :2] @ gain))

    gain = next((K for K in plain * 0.5 ** np.arange(HALVINGS)[:, None] if axis.holds(K)), None)
    if gain is None:
        return plain
    X = spread(gain)
    for _ in range(ROUNDS):
        weights = np.zeros_like(axis.A)
        weights[:2, :2] = Q + R * np.outer(gain, gain)
        ahead = axis.B @ _summed(axis.closed(gain).T, weights)
        best = np.linalg.solve(X[:2, :2], ahead @ axis.A @ X[:, :2]) / (R + ahead @ axis.B)
        now = cost(gain, X)
        for share in 0.5 ** np.arange(HALVINGS):
            tried = gain + share * (best - gain)
            if axis.holds(tried) and cost(tried, left := spread(tried)) < now:
                gain, X = tried, left
                break
        if cost(gain, X) >= (1.0 - SETTLED) * now:
            break
    return gain


def _summed(F: Array, W: Array) -> Array:
    """Solution of X = F X Fᵀ + W, for F of a spectral radius below 1: Σ Fⁱ W Fⁱᵀ."""
    X = W
    for _ in range(DOUBLINGS):
        more = F @ X @ F.T
        X, F = X + more, F @ F
        if np.abs(more).max() <= TINY * np.abs(X).max():
            break
    return X
