"""Exact solver of the QPs of `mpc`: an active set, and a Riccati pass for each guess of it.

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

from typing import NamedTuple

import daqp
import numpy as np

from skytether.server.control.law import advance, axis_at
from skytether.server.control.mpc import MPC, Inputs, Problem, shifted
from skytether.server.control.solver import NEAR, SolverFailed
from skytether.shared.base.kernel import F1, F2, F3, F5, I2, inline, kernel, part
from skytether.shared.law.model import Array, Axis, Flags

ROUNDS_MAX = 8
"""Rounds in which the whole set may change; five have been the most on recorded flights."""
PIVOTS_MAX = 200
"""Further rounds, in which one input enters the set or leaves it."""
SNAP = 1e-12
"""Distance from its bound at which DAQP may leave an input that belongs on it [m/s]."""
RESIDUAL_MAX = 1e-7
"""Largest residual of the optimality conditions, relative to the gradient, of an answer of DAQP."""
CYCLED, NOT_FINITE = -1, -2
"""Number of rounds where the active set went in a circle, and where a number was not finite."""

# One stage of a backward pass: what depends on the active set alone. The cost to go from the stage
# is ½ c u² + (s x + d) u before its input u is chosen, and ½ xᵀPx + qᵀx after.
FREE, OWN = 0, 1
"""Sets whose stages are kept: every input free, and the set of the problem under way."""
S0, S1, K0, K1, INVERSE, F00, F01, F10, F11, P00, P01, P11 = range(12)
"""Columns of `stages`: s, k = s / c, 1 / c, F = A - B k where the input is free, and P."""


class Workspace(NamedTuple):
    """Scratch memory that a solve reuses from round to round and from problem to problem."""

    stages: F5
    """Backward passes for FIRST and LATER weights, each axis, FREE and OWN; shape
    (2, axes, 2, H, 12)."""
    side: F1
    """-1 or 1 where the input is at that bound, 0 where it is free; shape (H,)."""
    own: F1
    """Input that each stage would choose for itself at x = 0 [m/s]; shape (H,)."""


Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@part
def stage_of(model: Axis, rho: float, after: Three, free: bool) -> tuple[Nine, Three]:
    """A stage of a backward pass: its columns from S0 to F11, and P before W is added.

    Args:
        model: eq. (4) on one axis.
        rho: weight of the input.
        after: P of the stage behind, as (P00, P01, P11).
        free: whether the input is free, not at its bound.
    """
    a01, a11, b0, b1 = model.a01, model.a11, model.b0, model.b1
    p00, p01, p11 = after
    pb0, pb1 = p00 * b0 + p01 * b1, p01 * b0 + p11 * b1
    inverse = 1.0 / (rho + b0 * pb0 + b1 * pb1)
    s0, s1 = pb0, pb0 * a01 + pb1 * a11
    k0, k1 = s0 * inverse, s1 * inverse
    e01, e11 = p00 * a01 + p01 * a11, p01 * a01 + p11 * a11
    p01, p11 = e01, a01 * e01 + a11 * e11
    # Chosen, not branched to, so that stages of several vehicles are computed side by side.
    p00 = p00 - s0 * k0 if free else p00
    p01 = p01 - s0 * k1 if free else p01
    p11 = p11 - s1 * k1 if free else p11
    f0, f1 = (1.0 - b0 * k0, a01 - b0 * k1), (-b1 * k0, a11 - b1 * k1)
    return (s0, s1, k0, k1, inverse, f0[0], f0[1], f1[0], f1[1]), (p00, p01, p11)


@inline
def own_input(model: Axis, q0: float, q1: float, g: float, inverse: float) -> float:
    """Input that a stage would choose for itself at x = 0 [m/s]."""
    return -(model.b0 * q0 + model.b1 * q1 + g) * inverse


@part
def _backward(
    after: tuple[float, float, float], stages: F2, side: F1, last: int, mpc: MPC, axis: int, rho: F1
) -> None:
    """Fill in the rows of `stages` from `last` to 0, for an active set.

    Args:
        after: P of the stage after `last`, as (P00, P01, P11).
        stages: shape (H, 12).
        side: -1 or 1 where the input is at that bound, 0 where it is free; shape (H,).
        last: the last stage whose side is another than the one its row was made for.
        rho: weights of the inputs; shape (H,).
    """
    model, W, P = axis_at(mpc.model, axis), mpc.weights.states, after
    for i in range(last, -1, -1):
        found, P = stage_of(model, rho[i], P, side[i] == 0.0)
        if i > 0:
            P = (P[0] + W[i - 1, 0], P[1], P[2] + W[i - 1, 1])
        stages[i, S0], stages[i, S1] = found[0], found[1]
        stages[i, K0], stages[i, K1], stages[i, INVERSE] = found[2], found[3], found[4]
        stages[i, F00], stages[i, F01] = found[5], found[6]
        stages[i, F10], stages[i, F11] = found[7], found[8]
        stages[i, P00], stages[i, P01], stages[i, P11] = P


@part
def active_set(  # noqa: PLR0912, PLR0915 - two passes along the horizon, and what they share
    mpc: MPC,
    axis: int,
    which: int,
    work: Workspace,
    g: F1,
    previous: Inputs,
    gap: int,
    fresh: bool,
    u: F1,
) -> int:
    """Fill in the optimal inputs U(k) of one axis; rounds taken, or CYCLED or NOT_FINITE.

    Args:
        which: FIRST or LATER weights. work: of `workspace`; what it has of OWN sets is written to.
        g: gradient; shape (H,). previous, gap, fresh: see `server.control.mpc.shifted`; what that
        is at its bound is the first set. u: what is filled in [m/s]; shape (H,).

    Source: eqs. (6), (8), (10).
    """
    model, bound, W, H = axis_at(mpc.model, axis), mpc.bounds[axis], mpc.weights.states, len(g)
    a01, a11, b0, b1 = model.a01, model.a11, model.b0, model.b1
    stages, side, own = work.stages[which, axis], work.side, work.own
    rho = mpc.weights.inputs[which]
    last, changed, total = -1, -1, 0.0
    for i in range(H):
        v = shifted(previous, gap, fresh, i)
        side[i] = 1.0 if v >= NEAR * bound else -1.0 if v <= -NEAR * bound else 0.0
        if side[i] != 0.0:
            last = i
        # A sum that is finite has finite terms: one check in place of H.
        total += g[i]
    for count in range(1, ROUNDS_MAX + PIVOTS_MAX + 1):
        singly = count > ROUNDS_MAX
        # Stages behind the last change are as before: of the last round, or of the table of FREE
        # sets.
        if last >= 0:
            after = (W[H - 1, 0], 0.0, W[H - 1, 1])
            if last < H - 1:
                i, row = last + 1, OWN if last < changed else FREE
                after = (stages[row, i, P00], stages[row, i, P01], stages[row, i, P11])
            _backward(after, stages[OWN], side, last, mpc, axis, rho)
            changed = max(changed, last)
        # Backward: own is what the stage would choose for itself at x = 0.
        q0, q1 = 0.0, 0.0
        for i in range(H - 1, -1, -1):
            row = OWN if i <= changed else FREE
            own[i] = own_input(model, q0, q1, g[i], stages[row, i, INVERSE])
            if side[i] == 0.0:
                q0, q1 = (
                    stages[row, i, F00] * q0 + stages[row, i, F10] * q1 - stages[row, i, K0] * g[i],
                    stages[row, i, F01] * q0 + stages[row, i, F11] * q1 - stages[row, i, K1] * g[i],
                )
            else:
                held = side[i] * bound
                q0, q1 = (
                    q0 + stages[row, i, S0] * held,
                    a01 * q0 + a11 * q1 + stages[row, i, S1] * held,
                )
        # Forward: what each stage would choose for itself is its verdict on the set. Those
        # that must leave the box are held back, unless only the worst may change.
        x0, x1, last, most = 0.0, 0.0, -1, 0.0
        for i in range(H):
            row = OWN if i <= changed else FREE
            v = own[i] - (stages[row, i, K0] * x0 + stages[row, i, K1] * x1)
            if side[i] == 0.0 and -bound <= v <= bound:
                # Closed loop, x ← F x + B own: the chain from stage to stage does not wait for v.
                u[i] = v
                x0, x1 = (
                    stages[row, i, F00] * x0 + stages[row, i, F01] * x1 + b0 * own[i],
                    stages[row, i, F10] * x0 + stages[row, i, F11] * x1 + b1 * own[i],
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
            x0, x1 = advance(model, x0, x1, v)
        if last < 0:
            return count if np.isfinite(total + x0 + x1) else NOT_FINITE
        if singly:
            side[last] = 0.0 if side[last] != 0.0 else np.sign(u[last])
    return CYCLED if np.isfinite(total + x0 + x1) else NOT_FINITE


@kernel
def _table(mpc: MPC, work: Workspace) -> None:
    """Fill in the stages of FREE sets, with `side` as it is at first: 0."""
    W = mpc.weights.states
    end, free = (W[-1, 0], 0.0, W[-1, 1]), work.side
    for which in range(2):
        for axis in range(len(mpc.model)):
            stages, rho = work.stages[which, axis, FREE], mpc.weights.inputs[which]
            _backward(end, stages, free, len(W) - 1, mpc, axis, rho)


@kernel
def _solve(
    mpc: MPC, which: int, work: Workspace, gradient: F3, guess: F3, inputs: F3, rounds: I2
) -> None:
    """Fill in inputs (n, axes, H) and rounds (n, axes) of n vehicles, see `active_set`."""
    for vehicle in range(len(gradient)):
        for axis in range(len(mpc.model)):
            g, first = gradient[vehicle, axis], guess[vehicle, axis]
            u = inputs[vehicle, axis]
            rounds[vehicle, axis] = active_set(mpc, axis, which, work, g, first, 0, False, u)


def workspace(mpc: MPC) -> Workspace:
    """A workspace for the problems of an MPC."""
    axes, H = len(mpc.model), len(mpc.weights.states)
    work = Workspace(np.empty((2, axes, 2, H, 12)), np.zeros(H), np.empty(H))
    _table(mpc, work)
    return work


class ExactSolver:
    """See `server.control.solver.Solver`; the answer depends on the problem alone, to rounding.

    Source: eq. (10).
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.work = workspace(problem.mpc)
        self.fallbacks = 0
        """Number of problems that DAQP had to solve."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """See `Solver`."""
        inputs = np.empty_like(gradient)
        rounds = np.empty(gradient.shape[:2], dtype=np.int64)
        mpc, which = self._problem.mpc, self._problem.which
        _solve(mpc, which, self.work, gradient, guess, inputs, rounds)
        if rounds.min() > 0:
            return inputs, np.ones(len(gradient), dtype=np.bool_)
        solved: Flags = (rounds != NOT_FINITE).all(axis=1)
        for vehicle, axis in np.argwhere((rounds == CYCLED) & solved[:, None]):
            self.fallbacks += 1
            try:
                inputs[vehicle, axis] = self._dual(int(axis), gradient[vehicle, axis])
            except SolverFailed:
                solved[vehicle] = False
        inputs[~solved] = guess[~solved]
        return inputs, solved

    def _dual(self, axis: int, gradient: Array) -> Array:
        problem = self._problem
        hessian = problem.hessian[axis]
        bound = np.full(len(gradient), problem.mpc.bounds[axis])
        # Without rows here, DAQP takes the bounds as simple bounds, which cost it least.
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
