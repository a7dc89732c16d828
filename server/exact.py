"""The QPs of `server.mpc`, solved exactly: an active set, and a Riccati pass for each guess of it.

A condensed QP  ½ Uᵀ𝓗U + gᵀU  with 𝓗 = ΓᵀWΓ + diag(ρ) is the optimal control problem

    minimise  Σ ½ xᵢ₊₁ᵀ Wᵢ xᵢ₊₁ + ½ ρᵢ uᵢ² + gᵢ uᵢ,   xᵢ₊₁ = A xᵢ + B uᵢ,   x₀ = 0

so that, with the set of inputs at their bound given, a backward pass over 2 x 2 matrices solves it
in O(H), where a factorisation of 𝓗 takes O(H³). The forward pass finds the input v that each stage
would choose for itself: beyond the bound it belongs into the set, within it belongs out. A set that
finds itself again is the optimum. From the shifted horizon of the step before that takes one or two
rounds. A set can wander in a circle instead (long steps, a tiny R, corners of the reference); then
only the input that is furthest on the wrong side changes it, a round for each. What even that does
not end goes to DAQP, a dual active-set method, and its answer is believed once it meets the
optimality conditions.
"""

import daqp
import numpy as np
from numba import njit

from server.mpc import MPC
from server.solver import NEAR, SolverFailed
from shared.model import Array, Flags

ROUNDS_MAX = 8
"""In which the whole set may change; five have been the most on recorded flights."""
PIVOTS_MAX = 200
"""Rounds after that, in which one input enters the set or leaves it."""
SNAP = 1e-12
RESIDUAL_MAX = 1e-7
"""Of the optimality conditions, relative to the gradient, for an answer of DAQP."""
CYCLED, NOT_FINITE = -1, -2
"""In place of a number of rounds."""


class ExactSolver:
    """See `server.solver.Solver`; the answer depends on the problem alone, to rounding.

    Args:
        mpc: whose QPs.
        u_max: bound of every input [m/s]; shape (axes,).
    """

    def __init__(self, mpc: MPC, u_max: Array) -> None:
        model, u_max = mpc.model, np.asarray(u_max, dtype=np.float64)
        self._hessian = mpc.hessian
        self._u_max = u_max
        axes, H = mpc.hessian.shape[:2]
        self._stages = np.empty((axes, 2, H, 12))
        """Of each axis: with every input free, and for the sets of the problem under way."""
        end = (mpc.weights[-1, 0], 0.0, mpc.weights[-1, 1])
        for axis in range(axes):
            of_axis = (model.A[axis], model.B[axis], mpc.weights, mpc.input_weights)
            _backward(end, self._stages[axis, FREE], np.zeros(H), H - 1, *of_axis)
        self._problem = (model.A, model.B, mpc.weights, mpc.input_weights, u_max, self._stages)
        self.fallbacks = 0
        """Problems that DAQP had to solve."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """See `Solver`."""
        inputs, rounds, worst = _riccati_active_set(
            *self._problem, gradient, guess, NEAR, ROUNDS_MAX, PIVOTS_MAX
        )
        solved = np.ones(len(gradient), dtype=np.bool_)
        if worst > 0:
            return inputs, solved
        solved &= (rounds != NOT_FINITE).all(axis=1)
        for vehicle, axis in np.argwhere((rounds == CYCLED) & solved[:, None]):
            self.fallbacks += 1
            try:
                inputs[vehicle, axis] = self._dual(int(axis), gradient[vehicle, axis])
            except SolverFailed:
                solved[vehicle] = False
        inputs[~solved] = guess[~solved]
        return inputs, solved

    def _dual(self, axis: int, gradient: Array) -> Array:
        hessian, bound = self._hessian[axis], np.full(len(gradient), self._u_max[axis])
        nothing = np.zeros((0, len(gradient)))
        answer, _, status, info = daqp.solve(
            hessian, gradient, nothing, bound, -bound, primal_tol=1e-12, dual_tol=1e-12
        )
        # It may leave an input that is at its bound a rounding error inside.
        answer = np.where(np.abs(answer) > bound - SNAP, np.copysign(bound, answer), answer)
        inputs: Array = np.clip(answer, -bound, bound)
        slope = hessian @ inputs + gradient
        # Optimal: no slope inside, and none back inside at a bound.
        slope = np.where(np.abs(inputs) >= bound, np.maximum(np.sign(inputs) * slope, 0.0), slope)
        if not np.abs(slope).max() <= RESIDUAL_MAX * (1.0 + np.abs(gradient).max()):
            raise SolverFailed(f"DAQP status {status}", info["iterations"])
        return inputs


# One stage of a backward pass: what depends on the active set alone. The cost to go from the stage
# is ½ c u² + (s x + d) u before its input u is chosen, and ½ xᵀPx + qᵀx after.
FREE, OWN = 0, 1
S0, S1, K0, K1, INVERSE, F00, F01, F10, F11, P00, P01, P11 = range(12)
"""s, k = s / c, 1 / c, F = A - B k where the input is free, and P: the columns of `stages`."""


@njit(
    "(UniTuple(f8, 3), f8[:,::1], f8[::1], i8, f8[:,::1], f8[::1], f8[:,::1], f8[::1])",
    cache=True,
    error_model="numpy",
)
def _backward(after, stages, side, last, A, B, W, rho):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """The rows of `stages` from `last` to 0, for an active set.

    Args:
        after: P of the stage after `last`, as (P00, P01, P11).
        stages: shape (H, 12).
        side: -1 or 1 where the input is at that bound, 0 where it is free; shape (H,).
        last: the last stage whose side is another than the one its row was made for.
        A, B: of one axis; shape (2, 2) and (2,).
        W, rho: weights of the states 1 … H and of the inputs; shape (H, 2) and (H,).
    """
    a00, a01, a10, a11, b0, b1 = A[0, 0], A[0, 1], A[1, 0], A[1, 1], B[0], B[1]
    p00, p01, p11 = after
    for i in range(last, -1, -1):
        pb0, pb1 = p00 * b0 + p01 * b1, p01 * b0 + p11 * b1
        inverse = 1.0 / (rho[i] + b0 * pb0 + b1 * pb1)
        s0, s1 = pb0 * a00 + pb1 * a10, pb0 * a01 + pb1 * a11
        k0, k1 = s0 * inverse, s1 * inverse
        e00, e01 = p00 * a00 + p01 * a10, p00 * a01 + p01 * a11
        e10, e11 = p01 * a00 + p11 * a10, p01 * a01 + p11 * a11
        p00, p01, p11 = a00 * e00 + a10 * e10, a00 * e01 + a10 * e11, a01 * e01 + a11 * e11
        if side[i] == 0.0:
            p00, p01, p11 = p00 - s0 * k0, p01 - s0 * k1, p11 - s1 * k1
        if i > 0:
            p00, p11 = p00 + W[i - 1, 0], p11 + W[i - 1, 1]
        stages[i, S0], stages[i, S1], stages[i, K0], stages[i, K1], stages[i, INVERSE] = (
            s0,
            s1,
            k0,
            k1,
            inverse,
        )
        stages[i, F00], stages[i, F01] = a00 - b0 * k0, a01 - b0 * k1
        stages[i, F10], stages[i, F11] = a10 - b1 * k0, a11 - b1 * k1
        stages[i, P00], stages[i, P01], stages[i, P11] = p00, p01, p11


@njit(
    "Tuple((f8[:,:,::1], i8[:,::1], i8))(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1],"
    "f8[:,:,:,::1], f8[:,:,::1], f8[:,:,::1], f8, i8, i8)",
    cache=True,
    error_model="numpy",
)
def _riccati_active_set(  # type: ignore[no-untyped-def]  # noqa: ANN202, PLR0912, PLR0915, PLR0917 - compiled
    A: Array,
    B: Array,
    W: Array,
    rho: Array,
    u_max: Array,
    stages: Array,
    gradient: Array,
    guess: Array,
    near: float,
    rounds_max: int,
    pivots_max: int,
):
    """Inputs (n, axes, H), rounds taken (n, axes), and the worst of these (CYCLED, NOT_FINITE).

    Args:
        A, B: shape (axes, 2, 2) and (axes, 2).
        W: weights of the states 1 … H; shape (H, 2).
        rho: weights of the inputs; shape (H,).
        u_max: shape (axes,).
        stages: of `_backward`, FREE and OWN; the second is written to; shape (axes, 2, H, 12).
        gradient: shape (n, axes, H).
        guess: inputs whose bounds are the first set; shape (n, axes, H).
        near: how much of the bound they must reach for that (an argument: numba would not notice
            that a constant of another module has changed).
        rounds_max: after so many only one input at a time enters the set or leaves it.
        pivots_max: after so many of those the set is given up.
    """
    n, axes, H = gradient.shape
    inputs = np.empty((n, axes, H))
    rounds = np.full((n, axes), CYCLED)
    worst = rounds_max + pivots_max
    side, own = np.empty(H), np.empty(H)
    for vehicle in range(n):
        for axis in range(axes):
            a00, a01, a10, a11 = A[axis, 0, 0], A[axis, 0, 1], A[axis, 1, 0], A[axis, 1, 1]
            b0, b1, bound = B[axis, 0], B[axis, 1], u_max[axis]
            g, u = gradient[vehicle, axis], inputs[vehicle, axis]
            last, changed, total = -1, -1, 0.0
            for i in range(H):
                v = guess[vehicle, axis, i]
                side[i] = 1.0 if v >= near * bound else -1.0 if v <= -near * bound else 0.0
                if side[i] != 0.0:
                    last = i
                total += g[i]
            for count in range(1, rounds_max + pivots_max + 1):
                singly = count > rounds_max
                if last >= 0:
                    after = (W[H - 1, 0], 0.0, W[H - 1, 1])
                    if last < H - 1:
                        i, which = last + 1, OWN if last < changed else FREE
                        after = (
                            stages[axis, which, i, P00],
                            stages[axis, which, i, P01],
                            stages[axis, which, i, P11],
                        )
                    _backward(after, stages[axis, OWN], side, last, A[axis], B[axis], W, rho)
                    changed = max(changed, last)
                # Backward: own is what the stage would choose for itself at x = 0.
                q0, q1 = 0.0, 0.0
                for i in range(H - 1, -1, -1):
                    which = OWN if i <= changed else FREE
                    own[i] = -(b0 * q0 + b1 * q1 + g[i]) * stages[axis, which, i, INVERSE]
                    if side[i] == 0.0:
                        q0, q1 = (
                            stages[axis, which, i, F00] * q0
                            + stages[axis, which, i, F10] * q1
                            - stages[axis, which, i, K0] * g[i],
                            stages[axis, which, i, F01] * q0
                            + stages[axis, which, i, F11] * q1
                            - stages[axis, which, i, K1] * g[i],
                        )
                    else:
                        held = side[i] * bound
                        q0, q1 = (
                            a00 * q0 + a10 * q1 + stages[axis, which, i, S0] * held,
                            a01 * q0 + a11 * q1 + stages[axis, which, i, S1] * held,
                        )
                # Forward: what each stage would choose for itself is its verdict on the set. Those
                # that must leave the box are held back, unless only the worst may change.
                x0, x1, last, most = 0.0, 0.0, -1, 0.0
                for i in range(H):
                    which = OWN if i <= changed else FREE
                    v = own[i] - (stages[axis, which, i, K0] * x0 + stages[axis, which, i, K1] * x1)
                    if side[i] == 0.0 and -bound <= v <= bound:
                        u[i] = v
                        x0, x1 = (
                            stages[axis, which, i, F00] * x0
                            + stages[axis, which, i, F01] * x1
                            + b0 * own[i],
                            stages[axis, which, i, F10] * x0
                            + stages[axis, which, i, F11] * x1
                            + b1 * own[i],
                        )
                        continue
                    verdict = 1.0 if v > bound else -1.0 if v < -bound else 0.0
                    held = side[i]
                    if verdict != side[i]:
                        if singly:
                            wrong = abs(v) - bound if held == 0.0 else bound - v * held
                            if wrong > most:
                                most, last = wrong, i
                        else:
                            last, side[i] = i, verdict
                            held = held if held != 0.0 else verdict
                    if held != 0.0:
                        v = held * bound
                    u[i] = v
                    x0, x1 = a00 * x0 + a01 * x1 + b0 * v, a10 * x0 + a11 * x1 + b1 * v
                if last < 0:
                    rounds[vehicle, axis] = count
                    break
                if singly:
                    side[last] = 0.0 if side[last] != 0.0 else np.sign(u[last])
            if not np.isfinite(total + x0 + x1):
                rounds[vehicle, axis] = NOT_FINITE
            worst = min(worst, rounds[vehicle, axis])
    return inputs, rounds, worst
