"""Regulators aboard: the limit of eq. (9) for a horizon without end and an input without bounds.

Along a trajectory it is the linear-quadratic regulator of eq. (9) itself, which weighs changes of
the input. The cost of each step and the optimal input are

    xᵀ Q x + R u² + S (u - u(k-1))²         u = λ u(k-1) - (1 - λ) K x

so the vehicle moves from the input flown until now towards -K x, by the same share at each step.

Around a horizon of inputs there is feedback on position and velocity alone, u = -K x: which input
is told before depends on the packets that arrive. There S counts like R.

The model's gain is in K. A dead time is not: feedback is on the state in which the next input meets
the vehicle, for which there is none (`shared.law.dead_time`).
"""

from functools import lru_cache

import numpy as np

from skytether.shared.law.model import Array, Model
from skytether.shared.scenario.schema import ControlConfig, Scenario

ROUNDS = 10_000
"""Largest number of rounds of the recursion, for weights with which it hardly settles."""


def feedback_gain(scenario: Scenario) -> Array:
    """K of a scenario; 0 without feedback.

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    model, control = scenario.terms().model, scenario.control
    if not control.feedback:
        return np.zeros_like(model.B)
    return stationary_gain(model, control)


def stationary_gain(model: Model, control: ControlConfig) -> Array:
    """K for a model.

    Args:
        model: eq. (4).
        control: the weights; S counts like R.

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    weight = control.input_weight + control.change_weight
    gain = _settled(model.A.tobytes(), model.B.tobytes(), control.state_weight, weight, 0.0)
    return gain[:, :2]


def regulator(scenario: Scenario) -> Array:
    """Regulator along a trajectory.

    Returns:
        K on position [1/s] and velocity, and λ; shape (axes, 3).
    """
    model, control = scenario.terms().model, scenario.control
    Q, R, S = control.state_weight, control.input_weight, control.change_weight
    gain = _settled(model.A.tobytes(), model.B.tobytes(), Q, R, S)
    lag = -gain[:, 2:]
    return np.concatenate([gain[:, :2] / (1.0 - lag), lag], axis=1)


@lru_cache(maxsize=64)
def _settled(
    a: bytes,
    b: bytes,
    state_weight: tuple[float, float],
    input_weight: float,
    change_weight: float,
) -> Array:
    """Gain on position, velocity and the input before, shape (axes, 3), from A and B of eq. (4), Q,
    R and S; cached, for many vehicles of one scenario need it.
    """
    B = np.pad(np.frombuffer(b).reshape(-1, 2), ((0, 0), (0, 1)), constant_values=1.0)
    A = np.pad(np.frombuffer(a).reshape(-1, 2, 2), ((0, 0), (0, 1), (0, 1)))
    Q, R = np.diag([*state_weight, change_weight]), input_weight + change_weight
    cross = np.array([0.0, 0.0, -change_weight])
    """Weight of the input times the input before: half of that in S (u - u(k-1))²."""
    cost, before = np.tile(Q, (len(B), 1, 1)), np.zeros((len(B), 3, 3))
    gain = np.zeros_like(B)
    for _ in range(ROUNDS):
        # Riccati recursion until the cost matrix stands still, but for rounding.
        if (np.abs(cost - before) <= 1e-12 * np.abs(before)).all():
            break
        ahead = np.einsum("ai,aij->aj", B, cost)
        weight = R + np.einsum("aj,aj->a", ahead, B)
        gain = (np.einsum("ai,aij->aj", ahead, A) + cross) / weight[:, None]
        left = A - B[:, :, None] * gain[:, None, :]
        rolled = np.einsum("aji,ajk,akl->ail", A, cost, left)
        cost, before = Q + rolled - cross[:, None] * gain[:, None, :], cost
    # Shared by all that ask for it: nobody may write into it.
    gain.setflags(write=False)
    return gain
