"""The QPs of `server.mpc`, solved exactly: an active set, and a Riccati pass for each guess of it.

A condensed QP  ½ Uᵀ𝓗U + gᵀU  with 𝓗 = ΓᵀWΓ + diag(ρ) is the optimal control problem

    minimise  Σ ½ xᵢ₊₁ᵀ Wᵢ xᵢ₊₁ + ½ ρᵢ uᵢ² + gᵢ uᵢ,   xᵢ₊₁ = A xᵢ + B uᵢ,   x₀ = 0

so that, with the set of inputs at their bound given, a backward pass over 2 x 2 matrices solves it
in O(H), where a factorisation of 𝓗 takes O(H³). The forward pass finds the input v that each stage
would choose for itself: beyond the bound it belongs into the set, within it belongs out. A set that
finds itself again is the optimum. From the shifted horizon of the step before that takes one or two
rounds. A set can wander in a circle instead (rarely: long steps, a tiny R); such a problem goes to
DAQP, a dual active-set method, and its answer is believed once it meets the optimality conditions.
"""

import daqp
import numpy as np
from numba import njit

from server.mpc import MPC
from server.solver import NEAR, SolverFailed
from shared.model import Array, Flags

ROUNDS_MAX = 30
"""Of the active set; seven have been the most on recorded flights."""
RESIDUAL_MAX = 1e-7
"""Of the optimality conditions, relative to the gradient, for an answer of DAQP."""
CYCLED = -1


class ExactSolver:
    """See `server.solver.Solver`; the answer depends on the problem alone, to rounding.

    Args:
        mpc: whose QPs.
        u_max: bound of every input [m/s]; shape (axes,).
    """

    def __init__(self, mpc: MPC, u_max: Array) -> None:
        self._mpc = mpc
        self._u_max = np.asarray(u_max, dtype=np.float64)
        self.fallbacks = 0
        """Problems that DAQP had to solve."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """See `Solver`."""
        mpc, model = self._mpc, self._mpc.model
        inputs, rounds = _riccati_active_set(
            *(model.A, model.B, mpc.weights, mpc.input_weights, self._u_max),
            *(np.ascontiguousarray(gradient), np.ascontiguousarray(guess), NEAR, ROUNDS_MAX),
        )
        solved: Flags = np.asarray(np.isfinite(inputs + gradient).all(axis=(1, 2)))
        for vehicle, axis in np.argwhere((rounds == CYCLED) & solved[:, None]):
            self.fallbacks += 1
            try:
                inputs[vehicle, axis] = self._dual(int(axis), gradient[vehicle, axis])
            except SolverFailed:
                solved[vehicle] = False
        inputs[~solved] = guess[~solved]
        return inputs, solved

    def _dual(self, axis: int, gradient: Array) -> Array:
        hessian, bound = self._mpc.hessian[axis], np.full(len(gradient), self._u_max[axis])
        nothing = np.zeros((0, len(gradient)))
        answer, _, status, info = daqp.solve(
            hessian, gradient, nothing, bound, -bound, primal_tol=1e-12, dual_tol=1e-12
        )
        inputs: Array = np.clip(answer, -bound, bound)
        slope = hessian @ inputs + gradient
        # Optimal: no slope inside, and none back inside at a bound.
        slope = np.where(np.abs(inputs) >= bound, np.maximum(np.sign(inputs) * slope, 0.0), slope)
        if not np.abs(slope).max() <= RESIDUAL_MAX * (1.0 + np.abs(gradient).max()):
            raise SolverFailed(f"DAQP status {status}", info["iterations"])
        return inputs


@njit(
    "Tuple((f8[:,:,::1], i8[:,::1]))(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1],"
    "f8[:,:,::1], f8[:,:,::1], f8, i8)",
    cache=True,
    error_model="numpy",
)
def _riccati_active_set(  # type: ignore[no-untyped-def]  # noqa: ANN202, PLR0917 - compiled
    A: Array,
    B: Array,
    W: Array,
    rho: Array,
    u_max: Array,
    gradient: Array,
    guess: Array,
    near: float,
    rounds_max: int,
):
    """Inputs (n, axes, H) and rounds taken (n, axes), CYCLED where the set was not found.

    Args:
        A, B: shape (axes, 2, 2) and (axes, 2).
        W: weights of the states 1 … H; shape (H, 2).
        rho: weights of the inputs; shape (H,).
        u_max: shape (axes,).
        gradient: shape (n, axes, H).
        guess: inputs whose bounds are the first set; shape (n, axes, H).
        near: how much of the bound they must reach for that (an argument: numba would not notice
            that a constant of another module has changed).
        rounds_max: after so many the set is given up.
    """
    n, axes, H = gradient.shape
    inputs = np.empty((n, axes, H))
    rounds = np.full((n, axes), CYCLED)
    side = np.empty(H)
    """-1 or 1: at that bound; 0: free."""
    curvature, slope_0, slope_1, offset = np.empty(H), np.empty(H), np.empty(H), np.empty(H)
    for vehicle in range(n):
        for axis in range(axes):
            a00, a01, a10, a11 = A[axis, 0, 0], A[axis, 0, 1], A[axis, 1, 0], A[axis, 1, 1]
            b0, b1, bound = B[axis, 0], B[axis, 1], u_max[axis]
            for i in range(H):
                u = guess[vehicle, axis, i]
                side[i] = 1.0 if u >= near * bound else -1.0 if u <= -near * bound else 0.0
            for count in range(1, rounds_max + 1):
                # Backward: the cost to go from stage i + 1 is ½ xᵀPx + qᵀx.
                p00, p01, p11, q0, q1 = W[H - 1, 0], 0.0, W[H - 1, 1], 0.0, 0.0
                for i in range(H - 1, -1, -1):
                    pb0, pb1 = p00 * b0 + p01 * b1, p01 * b0 + p11 * b1
                    # The stage's own cost: ½ curvature u² + (slope x + offset) u.
                    c = rho[i] + b0 * pb0 + b1 * pb1
                    s0, s1 = pb0 * a00 + pb1 * a10, pb0 * a01 + pb1 * a11
                    d = b0 * q0 + b1 * q1 + gradient[vehicle, axis, i]
                    curvature[i], slope_0[i], slope_1[i], offset[i] = c, s0, s1, d
                    if i == 0:
                        break
                    e00, e01 = p00 * a00 + p01 * a10, p00 * a01 + p01 * a11
                    e10, e11 = p01 * a00 + p11 * a10, p01 * a01 + p11 * a11
                    p00, p01 = a00 * e00 + a10 * e10, a00 * e01 + a10 * e11
                    p11 = a01 * e01 + a11 * e11
                    q0, q1 = a00 * q0 + a10 * q1, a01 * q0 + a11 * q1
                    if side[i] == 0.0:
                        p00, p01, p11 = p00 - s0 * s0 / c, p01 - s0 * s1 / c, p11 - s1 * s1 / c
                        q0, q1 = q0 - s0 * d / c, q1 - s1 * d / c
                    else:
                        q0, q1 = q0 + s0 * side[i] * bound, q1 + s1 * side[i] * bound
                    p00, p11 = p00 + W[i - 1, 0], p11 + W[i - 1, 1]
                # Forward: what each stage would choose for itself is its verdict on the set.
                x0, x1, unchanged = 0.0, 0.0, True
                for i in range(H):
                    u = -(slope_0[i] * x0 + slope_1[i] * x1 + offset[i]) / curvature[i]
                    verdict = 1.0 if u > bound else -1.0 if u < -bound else 0.0
                    if side[i] != 0.0:
                        u = side[i] * bound
                    elif verdict != 0.0:
                        u = verdict * bound
                    unchanged = unchanged and verdict == side[i]
                    side[i] = verdict
                    inputs[vehicle, axis, i] = u
                    x0, x1 = a00 * x0 + a01 * x1 + b0 * u, a10 * x0 + a11 * x1 + b1 * u
                if unchanged:
                    rounds[vehicle, axis] = count
                    break
    return inputs, rounds
