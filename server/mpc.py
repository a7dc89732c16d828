"""The optimal control problem (5)-(9) as algebra: problem → QP → plan.

Eliminating the states of (4), X = Φ x + Γ U, leaves a box-constrained QP in the H inputs of each
axis,

    minimise  ½ Uᵀ 𝓗 U + gᵀ U   subject to  |U| ≤ u_max,

whose Hessian 𝓗 = ΓᵀWΓ + R + S is the same at every step; only the gradient g follows the state, the
target and the horizon before. W holds Q at the stages 1 … H-1 and P at H.
"""

from dataclasses import dataclass

import numpy as np

from shared.config import ControlConfig
from shared.model import Array, Indices, Model


@dataclass(frozen=True, slots=True)
class MPC:
    """One horizon of (9) in condensed form; n vehicles in one call."""

    model: Model
    """A and B of eq. (4)."""
    free: Array
    """Φ: states without any input; shape (axes, H, 2, 2)."""
    forced: Array
    """Γ: what the inputs add; shape (axes, H, 2, H)."""
    weights: Array
    """W, diagonal; shape (H, 2)."""
    input_weights: Array
    """R + S, of all that weighs the input itself; shape (H,)."""
    target_weight: float
    """R where the input has a target of its own (E7), else 0."""
    change_weights: Array
    """S of the stages 0 … H-2, and 0 of the last; shape (H,)."""
    hessian: Array
    """𝓗; shape (axes, H, H)."""

    def gradient(self, x: Array, target: Array, previous: Array) -> Array:
        """g of the QP.

        Args:
            x: state at stage 0 [m, m/s]; shape (n, axes, 2).
            target: desired states at the stages 0 … H [m, m/s]; shape (n, axes, H + 1, 2).
            previous: u(k+i|k-1) of the S-term [m/s]; shape (n, axes, H).

        Returns:
            shape (n, axes, H).
        """
        deviation = np.einsum("aipq,naq->naip", self.free, x) - target[:, :, 1:]
        pulled = np.einsum("aipk,ip,naip->nak", self.forced, self.weights, deviation)
        toward = self.change_weights * previous + self.target_weight * target[:, :, :-1, 1]
        return pulled - toward

    def predict(self, x: Array, u: Array) -> Array:
        """X(k) of eq. (7): the states at the stages 1 … H; shape (n, axes, H, 2)."""
        return np.einsum("aipq,naq->naip", self.free, x) + np.einsum(
            "aipk,nak->naip", self.forced, u
        )


def condense(model: Model, control: ControlConfig, *, change_weight: float) -> MPC:
    """The QP of (9) for a model and weights.

    Args:
        change_weight: S; zero at the first step of a flight, where no horizon came before (E8).
    """
    axes, H = len(model.B), control.horizon
    free = np.empty((axes, H, 2, 2))
    forced = np.zeros((axes, H, 2, H))
    power, response = model.A, model.B
    for stage in range(H):
        free[:, stage] = power
        for later in range(stage, H):
            forced[:, later, :, later - stage] = response
        power, response = model.A @ power, np.einsum("aij,aj->ai", model.A, response)
    weights = np.tile(np.array(control.state_weight), (H, 1))
    weights[-1] = control.terminal_weight
    change_weights = np.full(H, change_weight)
    change_weights[-1] = 0.0
    hessian = np.einsum("aipk,ip,aipl->akl", forced, weights, forced)
    input_weights = control.input_weight + change_weights
    hessian += np.diag(input_weights)
    target_weight = control.input_weight if control.input_reference else 0.0
    return MPC(model, free, forced, weights, input_weights, target_weight, change_weights, hessian)


def shift(inputs: Array, steps: Indices) -> Array:
    """A horizon as seen `steps` later, its last input repeated at the end (11).

    Args:
        inputs: shape (n, axes, H).
        steps: shape (n,).
    """
    H = inputs.shape[2]
    stages = np.minimum(np.arange(H) + steps[:, None], H - 1)
    return np.take_along_axis(inputs, stages[:, None, :], axis=2)
