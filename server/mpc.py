"""The optimal control problem (5)-(9) as algebra: problem → QP → plan.

Eliminating the states of (4), X = Φ x + Γ U, leaves a box-constrained QP in the H inputs of each
axis,

    minimise  ½ Uᵀ 𝓗 U + gᵀ U   subject to  |U| ≤ u_max,

whose Hessian 𝓗 = ΓᵀWΓ + R + S is the same at every step; only the gradient g follows the state, the
target and the horizon before. W holds Q at the stages 1 … H-1 and P at H.

What is done at every step is done in O(H), by recursion along the horizon. It is compiled when this
module is imported, and kept on disk where that is possible. Each vehicle gets the same bits alone
as in a batch, which a product with Γ by BLAS does not promise.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from shared.config import ControlConfig
from shared.model import Array, Indices, Model

ROUNDS = 10_000
"""Most of the Riccati recursion, for weights with which it hardly settles."""


@dataclass(frozen=True, slots=True)
class MPC:
    """One horizon of (9) in condensed form; n vehicles in one call."""

    model: Model
    """A and B of eq. (4)."""
    weights: Array
    """W, diagonal; shape (H, 2)."""
    input_weights: Array
    """R + S, of all that weighs the input itself; shape (H,)."""
    input_weight: float
    """R."""
    target_weight: float
    """R where the input has a target of its own (E7), else 0."""
    change_weights: Array
    """S of the stages 0 … H-2, and 0 of the last; shape (H,)."""
    hessian: Array
    """𝓗; shape (axes, H, H)."""

    def gradient(self, x: Array, target: Array, previous: Array, disturbance: Array) -> Array:
        """g of the QP.

        Args:
            x: state at stage 0 [m, m/s]; shape (n, axes, 2).
            target: desired states at the stages 0 … H [m, m/s]; shape (n, axes, H + 1, 2).
            previous: u(k+i|k-1) of the S-term [m/s]; shape (n, axes, H).
            disturbance: what is added to every input on its way [m/s]; R weighs the sum; shape
                (n, axes).

        Returns:
            shape (n, axes, H).
        """
        gradient: Array = _gradient(
            *(self.model.A, self.model.B, self.weights, self.input_weight, self.target_weight),
            *(self.change_weights, x, target, previous, disturbance),
        )
        return gradient

    def predict(self, x: Array, u: Array, disturbance: Array, states: Array, rows: Indices) -> None:
        """x, then X(k) of eq. (7): the states at the stages 0 … H.

        Args:
            x: state at stage 0 [m, m/s]; shape (n, axes, 2).
            u: inputs [m/s]; shape (n, axes, H).
            disturbance: see `gradient`.
            states: where to put them; shape (some, axes, H + 1, 2).
            rows: of each vehicle in there; shape (n,).
        """
        _roll_out(self.model.A, self.model.B, x, u, disturbance, states, rows)

    def cost(self, change: Array) -> Array:
        """ΔUᵀ 𝓗 ΔU: by how much, doubled, a change of the optimal inputs costs more.

        Args:
            change: ΔU of each axis [m/s]; shape (n, axes, H).

        Returns:
            of all axes; shape (n,).
        """
        cost: Array = _cost(self.model.A, self.model.B, self.weights, self.input_weights, change)
        return cost


def condense(model: Model, control: ControlConfig, *, change_weight: float) -> MPC:
    """The QP of (9) for a model and weights.

    Args:
        change_weight: S; zero at the first step of a flight, where no horizon came before (E8).
    """
    axes, H = len(model.B), control.horizon
    forced = np.zeros((axes, H, 2, H))
    """Γ: what the inputs add to the states 1 … H."""
    response = model.B
    for stage in range(H):
        for later in range(stage, H):
            forced[:, later, :, later - stage] = response
        response = np.einsum("aij,aj->ai", model.A, response)
    weights = np.tile(np.array(control.state_weight), (H, 1))
    weights[-1] = control.terminal_weight
    change_weights = np.full(H, change_weight)
    change_weights[-1] = 0.0
    hessian = np.einsum("aipk,ip,aipl->akl", forced, weights, forced)
    input_weights = control.input_weight + change_weights
    hessian += np.diag(input_weights)
    target_weight = control.input_weight if control.input_reference else 0.0
    return MPC(
        *(model, weights, input_weights, control.input_weight, target_weight),
        *(change_weights, hessian),
    )


def stationary_gain(model: Model, control: ControlConfig) -> Array:
    """K of the linear-quadratic regulator u = -K x: what (9) comes to without end and bounds.

    Returns:
        on position [1/s] and velocity; shape (axes, 2).
    """
    A, B, Q = model.A, model.B, np.diag(control.state_weight)
    cost, before = np.tile(Q, (len(B), 1, 1)), np.zeros((len(B), 2, 2))
    gain = np.zeros_like(B)
    for _ in range(ROUNDS):
        if np.allclose(cost, before, rtol=1e-12, atol=0.0):
            break
        ahead = np.einsum("ai,aij->aj", B, cost)
        weight = control.input_weight + control.change_weight + np.einsum("aj,aj->a", ahead, B)
        gain = np.einsum("ai,aij->aj", ahead, A) / weight[:, None]
        left = A - B[:, :, None] * gain[:, None, :]
        cost, before = Q + np.einsum("aji,ajk,akl->ail", A, cost, left), cost
    return gain


@njit("f8[:,:,::1](f8[:,:,::1], i8[:])", cache=True)
def _shift(inputs, steps):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    n, axes, H = inputs.shape
    shifted = np.empty((n, axes, H))
    for vehicle in range(n):
        for axis in range(axes):
            for i in range(H):
                shifted[vehicle, axis, i] = inputs[vehicle, axis, min(i + steps[vehicle], H - 1)]
    return shifted


def shift(inputs: Array, steps: Indices) -> Array:
    """A horizon as seen `steps` later, its last input repeated at the end (11).

    Args:
        inputs: shape (n, axes, H).
        steps: none negative; shape (n,).
    """
    shifted: Array = _shift(inputs, steps)
    return shifted


@njit(
    "(f8[:,:,::1], f8[:,::1], f8[:,:,:], f8[:,:,::1], f8[:,:], f8[:,:,:,::1], i8[:])",
    cache=True,
    error_model="numpy",
)
def _roll_out(A, B, x, u, w, states, rows):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """Eq. (4) along a horizon, see `MPC.predict`."""
    n, axes, H = u.shape
    for vehicle in range(n):
        for axis in range(axes):
            p, v = x[vehicle, axis, 0], x[vehicle, axis, 1]
            along = states[rows[vehicle], axis]
            along[0, 0], along[0, 1] = p, v
            for i in range(H):
                command = u[vehicle, axis, i] + w[vehicle, axis]
                p, v = (
                    A[axis, 0, 0] * p + A[axis, 0, 1] * v + B[axis, 0] * command,
                    A[axis, 1, 0] * p + A[axis, 1, 1] * v + B[axis, 1] * command,
                )
                along[i + 1, 0], along[i + 1, 1] = p, v


@njit(
    "f8[:,:,::1](f8[:,:,::1], f8[:,::1], f8[:,::1], f8, f8, f8[::1], f8[:,:,:], f8[:,:,:,:],"
    "f8[:,:,::1], f8[:,:])",
    cache=True,
    error_model="numpy",
)
def _gradient(A, B, W, R, T, S, x, target, previous, w):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """ΓᵀW (Φ x - target) by the adjoint of (4), from stage H back to 0, less R and S terms.

    Args:
        A, B: shape (axes, 2, 2) and (axes, 2).
        W: shape (H, 2).
        R, T: weights of the input, and of its own target.
        S: shape (H,).
        x, target, previous, w: see `MPC.gradient`.
    """
    n, axes, H = previous.shape
    gradient, drift = np.empty((n, axes, H)), np.empty((H, 2))
    for vehicle in range(n):
        for axis in range(axes):
            a00, a01, a10, a11 = A[axis, 0, 0], A[axis, 0, 1], A[axis, 1, 0], A[axis, 1, 1]
            b0, b1 = B[axis, 0], B[axis, 1]
            p, v, added = x[vehicle, axis, 0], x[vehicle, axis, 1], w[vehicle, axis]
            for i in range(H):
                p, v = a00 * p + a01 * v + b0 * added, a10 * p + a11 * v + b1 * added
                drift[i, 0] = W[i, 0] * (p - target[vehicle, axis, i + 1, 0])
                drift[i, 1] = W[i, 1] * (v - target[vehicle, axis, i + 1, 1])
            l0, l1 = 0.0, 0.0
            for i in range(H - 1, -1, -1):
                l0, l1 = a00 * l0 + a10 * l1 + drift[i, 0], a01 * l0 + a11 * l1 + drift[i, 1]
                toward = S[i] * previous[vehicle, axis, i] + T * target[vehicle, axis, i, 1]
                toward -= R * added
                gradient[vehicle, axis, i] = b0 * l0 + b1 * l1 - toward
    return gradient


@njit(
    "f8[::1](f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1])",
    cache=True,
    error_model="numpy",
)
def _cost(A, B, W, rho, change):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """See `MPC.cost`: what the change does to the states, rolled out from none."""
    n, axes, H = change.shape
    cost = np.zeros(n)
    for vehicle in range(n):
        for axis in range(axes):
            p, v = 0.0, 0.0
            for i in range(H):
                u = change[vehicle, axis, i]
                p, v = (
                    A[axis, 0, 0] * p + A[axis, 0, 1] * v + B[axis, 0] * u,
                    A[axis, 1, 0] * p + A[axis, 1, 1] * v + B[axis, 1] * u,
                )
                cost[vehicle] += W[i, 0] * p * p + W[i, 1] * v * v + rho[i] * u * u
    return cost
