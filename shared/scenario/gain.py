"""Gain of feedback aboard: K of u = -K x, the linear-quadratic regulator.

It is the K on position and velocity, the same at every step, that makes the cost

    xᵀ Q x + (R + S) u²                     at every step, in flight for ever without bounds

smallest: the limit of eq. (9) for a horizon without end and an input without bounds. The model's
gain is in K. A dead time is not: feedback is on the state in which the next input meets the
vehicle, for which there is none (`shared.law.dead_time`).
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
    return _settled(model.A.tobytes(), model.B.tobytes(), control.state_weight, weight)


@lru_cache(maxsize=64)
def _settled(a: bytes, b: bytes, state_weight: tuple[float, float], input_weight: float) -> Array:
    """K from A and B of eq. (4), Q and R + S; cached, for many vehicles of one scenario need it."""
    Q, R = np.diag(state_weight), input_weight
    B = np.frombuffer(b).reshape(-1, 2)
    A = np.frombuffer(a).reshape(-1, 2, 2)
    cost, before = np.tile(Q, (len(B), 1, 1)), np.zeros((len(B), 2, 2))
    gain = np.zeros_like(B)
    for _ in range(ROUNDS):
        # Riccati recursion until the cost matrix stands still, but for rounding.
        if (np.abs(cost - before) <= 1e-12 * np.abs(before)).all():
            break
        ahead = np.einsum("ai,aij->aj", B, cost)
        weight = R + np.einsum("aj,aj->a", ahead, B)
        gain = np.einsum("ai,aij->aj", ahead, A) / weight[:, None]
        left = A - B[:, :, None] * gain[:, None, :]
        cost, before = Q + np.einsum("aji,ajk,akl->ail", A, cost, left), cost
    # Shared by all that ask for it: nobody may write into it.
    gain.setflags(write=False)
    return gain
