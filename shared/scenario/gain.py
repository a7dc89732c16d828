"""Gain of the regulator aboard: eq. (9) with infinite horizon and unbounded input.

Along a trajectory the regulator is the linear-quadratic regulator of eq. (9), which weighs changes
of the input. The cost of each step and the optimal input are

    xᵀ Q x + R u² + S (u - u(k-1))²         u = λ u(k-1) - (1 - λ) K x

so at each step the input moves from the previous one towards -K x by the share 1 - λ.

K accounts for the model's gain, but not for a dead time: the feedback uses the state predicted for
the time when the next input takes effect (`shared.law.dead_time`).
"""

from functools import lru_cache

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario

ROUNDS = 10_000
"""Largest number of iterations of the Riccati recursion. It converges slowly for some weights."""


def regulator(scenario: Scenario) -> Array:
    """Gain of the regulator along a trajectory; shape (axes, 3). Columns: K on position [1/s], K on
    velocity, and λ.
    """
    model, control = scenario.terms().model, scenario.control
    Q, R, S = control.state_weight, control.input_weight, control.change_weight
    gain = converged_gain(model.A.tobytes(), model.B.tobytes(), Q, R, S)
    lag = -gain[:, 2:]
    return np.concatenate([gain[:, :2] / (1.0 - lag), lag], axis=1)


@lru_cache(maxsize=64)
def converged_gain(
    a: bytes,
    b: bytes,
    state_weight: tuple[float, float],
    input_weight: float,
    change_weight: float,
) -> Array:
    """Gain on position, velocity and previous input, computed from A and B of eq. (4), Q, R and S;
    shape (axes, 3).

    The result is cached, because all vehicles of a scenario have the same gain.
    """
    B = np.pad(np.frombuffer(b).reshape(-1, 2), ((0, 0), (0, 1)), constant_values=1.0)
    A = np.pad(np.frombuffer(a).reshape(-1, 2, 2), ((0, 0), (0, 1), (0, 1)))
    Q, R = np.diag([*state_weight, change_weight]), input_weight + change_weight
    # Half the weight of the product u u(k-1) in S (u - u(k-1))².
    cross = np.array([0.0, 0.0, -change_weight])
    cost, before = np.tile(Q, (len(B), 1, 1)), np.zeros((len(B), 3, 3))
    gain = np.zeros_like(B)
    for _ in range(ROUNDS):
        # Riccati recursion, until the cost matrix changes only by rounding errors.
        if (np.abs(cost - before) <= 1e-12 * np.abs(before)).all():
            break
        ahead = np.einsum("ai,aij->aj", B, cost)
        weight = R + np.einsum("aj,aj->a", ahead, B)
        gain = (np.einsum("ai,aij->aj", ahead, A) + cross) / weight[:, None]
        closed_loop = A - B[:, :, None] * gain[:, None, :]
        rolled = np.einsum("aji,ajk,akl->ail", A, cost, closed_loop)
        cost, before = Q + rolled - cross[:, None] * gain[:, None, :], cost
    # Read-only, because all callers share the cached array.
    gain.setflags(write=False)
    return gain
