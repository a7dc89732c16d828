"""Active-set solver of the QPs of `problem` by Riccati recursions, for one vehicle or a batch.

A condensed QP  ½ Uᵀ𝓗U + gᵀU  with 𝓗 = ΓᵀWΓ + diag(ρ) is the optimal control problem

    minimise  Σ ½ xᵢ₊₁ᵀ Wᵢ xᵢ₊₁ + ½ ρᵢ uᵢ² + gᵢ uᵢ,   xᵢ₊₁ = A xᵢ + B uᵢ,   x₀ = 0

So for a fixed set of inputs at their bounds, a backward pass over 2 x 2 matrices solves it in O(H),
where a factorisation of 𝓗 takes O(H³). The forward pass gives the unconstrained input v of each
stage: a stage belongs to the set if v is beyond the bound. If a pass leaves the set unchanged, the
set is optimal. From the shifted previous plan, one or two iterations suffice. If the sets repeat in
a cycle (long steps, a tiny R, corners of the reference), each further iteration changes only the
input with the largest violation. `server.mpc.exact` solves the QPs for which this method does not
converge.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.mpc.problem import MPC, WIDTH, SimdBatch, simd_memory
from skytether.server.planning.compiled import advance, axis_at
from skytether.shared.base.kernel import B1, F1, F2, F3, F4, inline, kernel, lanes, part
from skytether.shared.law.model import Axis

NEAR = 1.0 - 1e-6
"""Share of the bound above which a guessed input, rounded to float32, counts as at its bound."""

ROUNDS_MAX = 8
"""Number of iterations in which the whole set may change; recorded flights needed five at most."""
PIVOTS_MAX = 200
"""Number of further iterations, in which one input enters or leaves the set."""

# Quantities of a stage that depend only on the active set. The cost to go from the stage is ½ c u²
# + (s x + d) u before its input u is chosen, and ½ xᵀPx + qᵀx after.
K0, K1, INVERSE, F00, F01, F10, F11 = range(7)
"""Columns of `RiccatiWorkspace.free`: k = s / c, 1 / c and F = A - B k."""


class RiccatiWorkspace(NamedTuple):
    free: F4
    """Backward passes with every input free, for FIRST and LATER weights and each axis; shape (2,
    axes, H, 7)."""
    memory: F3
    """Scratch for a single vehicle, see `problem.simd_memory`."""
    together: F3
    """Scratch for WIDTH vehicles, see `problem.simd_memory`."""


Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@part
def stage_of(model: Axis, rho: float, after: Three, free: bool) -> tuple[Nine, Three]:
    """One stage of a backward pass: s, k, 1 / c and F of the stage, and P before W is added.

    Args:
        model: eq. (4) on one axis.
        rho: weight of the input.
        after: P of the next stage, as (P00, P01, P11).
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
    # Conditional expressions instead of branches, so that several vehicles are computed with SIMD.
    p00 = p00 - s0 * k0 if free else p00
    p01 = p01 - s0 * k1 if free else p01
    p11 = p11 - s1 * k1 if free else p11
    f0, f1 = (1.0 - b0 * k0, a01 - b0 * k1), (-b1 * k0, a11 - b1 * k1)
    return (s0, s1, k0, k1, inverse, f0[0], f0[1], f1[0], f1[1]), (p00, p01, p11)


@inline
def own_input(model: Axis, q0: float, q1: float, g: float, inverse: float) -> float:
    """Unconstrained input of a stage for the state 0 [m/s]."""
    return -(model.b0 * q0 + model.b1 * q1 + g) * inverse


@lanes
def _first_set(bound: float, simd: SimdBatch) -> None:
    """Fill in the first active set from the previous plan, and the sum of the gradient."""
    near, L = NEAR * bound, len(simd.p)
    side, active, total = simd.side, simd.active, simd.total
    g, previous = simd.gradient, simd.previous
    for lane in range(L):
        active[lane], total[lane] = 0.0, 0.0
    for i in range(len(g)):
        for lane in range(L):
            before = previous[i, lane]
            at = 1.0 if before >= near else -1.0 if before <= -near else 0.0
            side[i, lane] = at
            active[lane] += abs(at)
            total[lane] += g[i, lane]


@lanes
def _round_free(mpc: MPC, axis: int, simd: SimdBatch, stages: F2) -> None:
    """One iteration with every input free; `stages` is the backward pass, shape (H, 7)."""
    model, bound, L = axis_at(mpc.model, axis), mpc.bounds[axis], len(simd.p)
    b0, b1 = model.b0, model.b1
    q0, q1, x0, x1 = simd.p, simd.v, simd.leader_p, simd.leader_v
    g, u, side, own = simd.gradient, simd.inputs, simd.side, simd.own
    changed, active = simd.changed, simd.active
    for lane in range(L):
        q0[lane], q1[lane], x0[lane], x1[lane] = 0.0, 0.0, 0.0, 0.0
        changed[lane], active[lane] = 0.0, 0.0
    for i in range(len(g) - 1, -1, -1):
        k0, k1, inverse = stages[i, K0], stages[i, K1], stages[i, INVERSE]
        f00, f01, f10, f11 = stages[i, F00], stages[i, F01], stages[i, F10], stages[i, F11]
        for lane in range(L):
            g_, p_, v_ = g[i, lane], q0[lane], q1[lane]
            own[i, lane] = own_input(model, p_, v_, g_, inverse)
            q0[lane] = f00 * p_ + f10 * v_ - k0 * g_
            q1[lane] = f01 * p_ + f11 * v_ - k1 * g_
    for i in range(len(g)):
        k0, k1 = stages[i, K0], stages[i, K1]
        f00, f01, f10, f11 = stages[i, F00], stages[i, F01], stages[i, F10], stages[i, F11]
        for lane in range(L):
            own_, p_, v_ = own[i, lane], x0[lane], x1[lane]
            chosen = own_ - (k0 * p_ + k1 * v_)
            verdict = 1.0 if chosen > bound else -1.0 if chosen < -bound else 0.0
            free = verdict == 0.0
            value = chosen if free else verdict * bound
            then_p, then_v = advance(model, p_, v_, value)
            x0[lane] = f00 * p_ + f01 * v_ + b0 * own_ if free else then_p
            x1[lane] = f10 * p_ + f11 * v_ + b1 * own_ if free else then_v
            u[i, lane], side[i, lane] = value, verdict
            changed[lane] += abs(verdict)
            active[lane] += abs(verdict)


@lanes
def _backward(mpc: MPC, axis: int, which: int, simd: SimdBatch) -> None:
    """Backward pass with each vehicle's active set.

    Matrices and vectors are computed together, so that intermediate results are not stored.
    """
    model, bound, W, L = axis_at(mpc.model, axis), mpc.bounds[axis], mpc.weights.states, len(simd.p)
    a01, a11 = model.a01, model.a11
    p00, p01, p11, q0, q1 = simd.p00, simd.p01, simd.p11, simd.p, simd.v
    g, side, own = simd.gradient, simd.side, simd.own
    k0, k1, f00, f01, f10, f11 = simd.k0, simd.k1, simd.f00, simd.f01, simd.f10, simd.f11
    H = len(g)
    for lane in range(L):
        p00[lane], p01[lane], p11[lane] = W[H - 1, 0], 0.0, W[H - 1, 1]
        q0[lane], q1[lane] = 0.0, 0.0
    for i in range(H - 1, -1, -1):
        weight = mpc.weights.inputs[which, i]
        add_p, add_v = (W[i - 1, 0], W[i - 1, 1]) if i > 0 else (0.0, 0.0)
        for lane in range(L):
            g_, p_, v_, at = g[i, lane], q0[lane], q1[lane], side[i, lane]
            matrix = (p00[lane], p01[lane], p11[lane])
            stage, after = stage_of(model, weight, matrix, at == 0.0)
            s0, s1, k0_, k1_, inverse, f00_, f01_, f10_, f11_ = stage
            own[i, lane] = own_input(model, p_, v_, g_, inverse)
            free_p = f00_ * p_ + f10_ * v_ - k0_ * g_
            free_v = f01_ * p_ + f11_ * v_ - k1_ * g_
            held_p = p_ + s0 * (at * bound)
            held_v = a01 * p_ + a11 * v_ + s1 * (at * bound)
            q0[lane] = free_p if at == 0.0 else held_p
            q1[lane] = free_v if at == 0.0 else held_v
            k0[i, lane], k1[i, lane] = k0_, k1_
            f00[i, lane], f01[i, lane], f10[i, lane], f11[i, lane] = f00_, f01_, f10_, f11_
            p00[lane], p01[lane], p11[lane] = after[0] + add_p, after[1], after[2] + add_v


@lanes
def _forward(mpc: MPC, axis: int, simd: SimdBatch, singly: bool) -> None:
    """Forward pass: update the active set; if `singly`, only find the input that must change."""
    model, bound, L = axis_at(mpc.model, axis), mpc.bounds[axis], len(simd.p)
    b0, b1, x0, x1 = model.b0, model.b1, simd.leader_p, simd.leader_v
    u, side, own, changed, active = simd.inputs, simd.side, simd.own, simd.changed, simd.active
    k0, k1, f00, f01, f10, f11 = simd.k0, simd.k1, simd.f00, simd.f01, simd.f10, simd.f11
    worst, worst_at = simd.worst, simd.worst_at
    for lane in range(L):
        x0[lane], x1[lane], changed[lane], active[lane] = 0.0, 0.0, 0.0, 0.0
        worst[lane], worst_at[lane] = 0.0, -1.0
    for i in range(len(u)):
        for lane in range(L):
            own_, p_, v_, at = own[i, lane], x0[lane], x1[lane], side[i, lane]
            chosen = own_ - (k0[i, lane] * p_ + k1[i, lane] * v_)
            verdict = 1.0 if chosen > bound else -1.0 if chosen < -bound else 0.0
            # An input that would leave its bound stays at the bound in this iteration.
            stays = at if at != 0.0 or singly else verdict
            value = chosen if stays == 0.0 else stays * bound
            then_p, then_v = advance(model, p_, v_, value)
            free_p = f00[i, lane] * p_ + f01[i, lane] * v_ + b0 * own_
            free_v = f10[i, lane] * p_ + f11[i, lane] * v_ + b1 * own_
            # Closed loop, x ← F x + B own: the recursion does not have to wait for `chosen`.
            x0[lane] = free_p if stays == 0.0 else then_p
            x1[lane] = free_v if stays == 0.0 else then_v
            u[i, lane] = value
            changed[lane] += 0.0 if verdict == at else 1.0
            if singly:
                wrong = abs(chosen) - bound if at == 0.0 else bound - chosen * at
                if verdict != at and wrong > worst[lane]:
                    worst[lane], worst_at[lane] = wrong, i
            else:
                side[i, lane] = verdict
                active[lane] += abs(verdict)


@lanes
def _change_worst(simd: SimdBatch) -> None:
    for lane in range(len(simd.p)):
        i = int(simd.worst_at[lane])
        if i >= 0:
            at = simd.side[i, lane]
            simd.side[i, lane] = 0.0 if at != 0.0 else np.sign(simd.inputs[i, lane])


@lanes
def _any(number: F1) -> bool:
    is_any = False
    for lane in range(len(number)):
        is_any |= number[lane] > 0.0
    return is_any


@part
def active_sets(mpc: MPC, axis: int, which: int, simd: SimdBatch, free: F4, settled: B1) -> int:
    """Fill in the optimal inputs of one axis; returns the number of iterations.

    Args:
        which: FIRST or LATER weights.
        simd: reads the gradient and the previous plan, whose active set is the first guess; writes
            the inputs [m/s].
        free: `RiccatiWorkspace.free`.
        settled: set to False for a vehicle without a solution; shape (L,).

    Source: eqs. (6), (8), (10).
    """
    changed, total, x0, x1 = simd.changed, simd.total, simd.leader_p, simd.leader_v
    _first_set(mpc.bounds[axis], simd)
    rounds = 0
    while rounds < ROUNDS_MAX + PIVOTS_MAX:
        singly = rounds >= ROUNDS_MAX
        rounds += 1
        # If no vehicle has an input at its bound, all use the same table of stages.
        if singly or _any(simd.active):
            _backward(mpc, axis, which, simd)
            _forward(mpc, axis, simd, singly)
        else:
            _round_free(mpc, axis, simd, free[which, axis])
        # The optimal set does not change.
        if not _any(changed):
            break
        if singly:
            _change_worst(simd)
    for lane in range(len(settled)):
        finite = np.isfinite(total[lane] + x0[lane] + x1[lane])
        settled[lane] = settled[lane] and changed[lane] == 0.0 and finite
    return rounds


@kernel
def _table(mpc: MPC, work: RiccatiWorkspace) -> None:
    W = mpc.weights.states
    for which in range(2):
        for axis in range(len(mpc.model)):
            model, P = axis_at(mpc.model, axis), (W[-1, 0], 0.0, W[-1, 1])
            for i in range(len(W) - 1, -1, -1):
                stage, P = stage_of(model, mpc.weights.inputs[which, i], P, True)
                if i > 0:
                    P = (P[0] + W[i - 1, 0], P[1], P[2] + W[i - 1, 1])
                for at in range(7):
                    work.free[which, axis, i, at] = stage[2 + at]


def workspace(mpc: MPC) -> RiccatiWorkspace:
    axes, H = len(mpc.model), len(mpc.weights.states)
    work = RiccatiWorkspace(np.empty((2, axes, H, 7)), simd_memory(H, 1), simd_memory(H, WIDTH))
    _table(mpc, work)
    return work
