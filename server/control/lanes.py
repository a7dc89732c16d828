"""Vehicles side by side: the passes of `mpc` and `exact` over several problems at once.

Each pass is a chain in which every stage waits for the one before, about ten cycles a stage,
while the processor could do many times as much. So the innermost loop goes over `LANES` vehicles on
the same axis, which the compiler turns into vector instructions. Lanes do not mix, and each does
the very operations of the pass for one vehicle in the same order: a vehicle gets the same bits in a
lane as alone (`tests/server/test_planner.py`).

A lane whose active set does not settle within `ROUNDS_MAX` rounds is left to `exact`.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control.exact import (
    F00,
    F01,
    F10,
    F11,
    INVERSE,
    K0,
    K1,
    ROUNDS_MAX,
    own_input,
    stage_of,
)
from skytether.server.control.law import advance, axis_at
from skytether.server.control.mpc import LATER, MPC, adjoint, pulled
from skytether.server.control.solver import NEAR
from skytether.shared.base.kernel import B1, F1, F2, F3, inline, lanes
from skytether.shared.law.model import Array

LANES = 16
"""Number of vehicles side by side: LLVM makes no vectors of loops known to be shorter than 16."""


class Lanes(NamedTuple):
    """Scratch of `LANES` problems on one axis; the last axis of each array is the lane."""

    p: F1
    """Position, or costate of it, at the stage under way; shape (LANES,)."""
    v: F1
    """Velocity, or costate of it; shape (LANES,)."""
    led_p: F1
    """Position of the vehicle that is followed [m]; shape (LANES,)."""
    led_v: F1
    """Velocity of that [m/s]; shape (LANES,)."""
    w: F1
    """Disturbance ŵ [m/s]; shape (LANES,)."""
    p00: F1
    """Entry for position of the matrix P of the backward pass; shape (LANES,)."""
    p01: F1
    """Entry for position and velocity; shape (LANES,)."""
    p11: F1
    """Entry for velocity; shape (LANES,)."""
    total: F1
    """Sum of a gradient, which is not finite where one of its numbers is not; shape (LANES,)."""
    changed: F1
    """Number of inputs that entered or left the active set in the last round; shape (LANES,)."""
    held: F1
    """Number of inputs in the active set; shape (LANES,)."""
    target_p: F2
    """Desired positions at the stages 0 … H [m]; shape (H + 1, LANES)."""
    target_v: F2
    """Desired velocities [m/s]; shape (H + 1, LANES)."""
    states_v: F2
    """Velocities of the generator's plan [m/s]; shape (H + 1, LANES)."""
    drift_p: F2
    """See `mpc.lead`, on position; shape (H, LANES)."""
    drift_v: F2
    """The drift on velocity; shape (H, LANES)."""
    previous: F2
    """Horizon of the step before, shifted [m/s]; shape (H, LANES)."""
    gradient: F2
    """Gradient g; shape (H, LANES)."""
    inputs: F2
    """Optimal inputs, not rounded yet [m/s]; shape (H, LANES)."""
    side: F2
    """-1 or 1 where the input is at that bound, 0 where it is free; shape (H, LANES)."""
    own: F2
    """See `exact.Workspace.own`; shape (H, LANES)."""
    k0: F2
    """Backward pass for the active sets under way, column K0 of `exact`; shape (H, LANES)."""
    k1: F2
    """Column K1."""
    f00: F2
    """Column F00."""
    f01: F2
    """Column F01."""
    f10: F2
    """Column F10."""
    f11: F2
    """Column F11."""


def make_room(H: int) -> Array:
    """Memory of `Lanes` for problems of H inputs: one array, since each costs time in a call."""
    return np.zeros((len(Lanes._fields), H + 1, LANES))


@inline
def lanes_in(room: F3) -> Lanes:
    """The parts of what `make_room` made."""
    H = room.shape[1] - 1
    return Lanes(
        p=room[0, 0],
        v=room[1, 0],
        led_p=room[2, 0],
        led_v=room[3, 0],
        w=room[4, 0],
        p00=room[5, 0],
        p01=room[6, 0],
        p11=room[7, 0],
        total=room[8, 0],
        changed=room[9, 0],
        held=room[10, 0],
        target_p=room[11],
        target_v=room[12],
        states_v=room[13],
        drift_p=room[14, :H],
        drift_v=room[15, :H],
        previous=room[16, :H],
        gradient=room[17, :H],
        inputs=room[18, :H],
        side=room[19, :H],
        own=room[20, :H],
        k0=room[21, :H],
        k1=room[22, :H],
        f00=room[23, :H],
        f01=room[24, :H],
        f10=room[25, :H],
        f11=room[26, :H],
    )


@lanes
def lead(mpc: MPC, axis: int, to: Lanes) -> None:
    """Fill in the drift from p, v, w and the target: `mpc.lead`."""
    model, W = axis_at(mpc.model, axis), mpc.weights.states
    p, v, w = to.p, to.v, to.w
    target_p, target_v = to.target_p, to.target_v
    drift_p, drift_v = to.drift_p, to.drift_v
    for i in range(len(drift_p)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(LANES):
            p_, v_ = advance(model, p[lane], v[lane], w[lane])
            p[lane], v[lane] = p_, v_
            drift_p[i, lane] = weight_p * (p_ - target_p[i + 1, lane])
            drift_v[i, lane] = weight_v * (v_ - target_v[i + 1, lane])


@inline
def rounded(u: float) -> float:
    """The input as it is sent, in float32, see `planner`."""
    return np.float64(np.float32(u))


@lanes
def follow(mpc: MPC, axis: int, to: Lanes) -> None:
    """Fill in the drift and the velocities from p, v, w, led_p, led_v and inputs: `mpc.follow`.

    Source: eq. (7).
    """
    model, W = axis_at(mpc.model, axis), mpc.weights.states
    p, v, led_p, led_v, w = to.p, to.v, to.led_p, to.led_v, to.w
    states_v, u = to.states_v, to.inputs
    drift_p, drift_v = to.drift_p, to.drift_v
    for lane in range(LANES):
        states_v[0, lane] = led_v[lane]
    for i in range(len(u)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(LANES):
            led_p_, led_v_ = advance(model, led_p[lane], led_v[lane], rounded(u[i, lane]))
            led_p[lane], led_v[lane] = led_p_, led_v_
            states_v[i + 1, lane] = led_v_
            p_, v_ = advance(model, p[lane], v[lane], w[lane])
            p[lane], v[lane] = p_, v_
            drift_p[i, lane] = weight_p * (p_ - led_p_)
            drift_v[i, lane] = weight_v * (v_ - led_v_)


@lanes
def gradient(mpc: MPC, axis: int, to: Lanes, target_v: F2) -> None:
    """Fill in the gradient from drift, w, horizon before, desired velocities: `mpc.gradient`.

    The first active set, which is that of the horizon before, is filled in by the way.

    Source: eqs. (5), (9).
    """
    model, weights, near = axis_at(mpc.model, axis), mpc.weights, NEAR * mpc.bounds[axis]
    R, T = weights.input, weights.target[axis]
    side, held, total = to.side, to.held, to.total
    p, v, w, g, previous = to.p, to.v, to.w, to.gradient, to.previous
    drift_p, drift_v = to.drift_p, to.drift_v
    for lane in range(LANES):
        p[lane], v[lane], held[lane], total[lane] = 0.0, 0.0, 0.0, 0.0
    for i in range(len(g) - 1, -1, -1):
        S = weights.changes[LATER, i]
        for lane in range(LANES):
            co = adjoint(model, (p[lane], v[lane]), drift_p[i, lane], drift_v[i, lane])
            p[lane], v[lane] = co
            before = previous[i, lane]
            toward = pulled(S, before, T, target_v[i, lane], R, w[lane])
            slant = model.b0 * co[0] + model.b1 * co[1] - toward
            at = 1.0 if before >= near else -1.0 if before <= -near else 0.0
            g[i, lane], side[i, lane] = slant, at
            held[lane] += abs(at)
            total[lane] += slant


@lanes
def slope(mpc: MPC, axis: int, to: Lanes) -> None:
    """Turn the gradient into 𝓗 U + g: `mpc.slope`."""
    model, W, rho = axis_at(mpc.model, axis), mpc.weights.states, mpc.weights.inputs[LATER]
    p, v, u, g = to.p, to.v, to.inputs, to.gradient
    drift_p, drift_v = to.drift_p, to.drift_v
    for lane in range(LANES):
        p[lane], v[lane] = 0.0, 0.0
    for i in range(len(u)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(LANES):
            p_, v_ = advance(model, p[lane], v[lane], rounded(u[i, lane]))
            p[lane], v[lane] = p_, v_
            drift_p[i, lane], drift_v[i, lane] = weight_p * p_, weight_v * v_
    for lane in range(LANES):
        p[lane], v[lane] = 0.0, 0.0
    for i in range(len(u) - 1, -1, -1):
        weight = rho[i]
        for lane in range(LANES):
            co = adjoint(model, (p[lane], v[lane]), drift_p[i, lane], drift_v[i, lane])
            p[lane], v[lane] = co
            g[i, lane] += model.b0 * co[0] + model.b1 * co[1] + weight * rounded(u[i, lane])


@lanes
def _round_free(mpc: MPC, axis: int, to: Lanes, stages: F2) -> None:
    """Make a round of `exact.active_set` in which every input of every lane is free.

    Args:
        stages: those of the FREE set; shape (H, 12).
    """
    model, bound = axis_at(mpc.model, axis), mpc.bounds[axis]
    b0, b1 = model.b0, model.b1
    q0, q1, x0, x1 = to.p, to.v, to.led_p, to.led_v
    g, u, side, own = to.gradient, to.inputs, to.side, to.own
    changed, held = to.changed, to.held
    for lane in range(LANES):
        q0[lane], q1[lane], x0[lane], x1[lane] = 0.0, 0.0, 0.0, 0.0
        changed[lane], held[lane] = 0.0, 0.0
    for i in range(len(g) - 1, -1, -1):
        k0, k1, inverse = stages[i, K0], stages[i, K1], stages[i, INVERSE]
        f00, f01, f10, f11 = stages[i, F00], stages[i, F01], stages[i, F10], stages[i, F11]
        for lane in range(LANES):
            g_, p_, v_ = g[i, lane], q0[lane], q1[lane]
            own[i, lane] = own_input(model, p_, v_, g_, inverse)
            q0[lane] = f00 * p_ + f10 * v_ - k0 * g_
            q1[lane] = f01 * p_ + f11 * v_ - k1 * g_
    for i in range(len(g)):
        k0, k1 = stages[i, K0], stages[i, K1]
        f00, f01, f10, f11 = stages[i, F00], stages[i, F01], stages[i, F10], stages[i, F11]
        for lane in range(LANES):
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
            held[lane] += abs(verdict)


@lanes
def _round(mpc: MPC, axis: int, to: Lanes) -> None:
    """Make a round of `exact.active_set` with an active set in each lane."""
    model, bound = axis_at(mpc.model, axis), mpc.bounds[axis]
    W, rho = mpc.weights.states, mpc.weights.inputs[LATER]
    a01, a11, b0, b1 = model.a01, model.a11, model.b0, model.b1
    p00, p01, p11, q0, q1, x0, x1 = to.p00, to.p01, to.p11, to.p, to.v, to.led_p, to.led_v
    g, u, side, own = to.gradient, to.inputs, to.side, to.own
    changed, held = to.changed, to.held
    k0, k1, f00, f01, f10, f11 = to.k0, to.k1, to.f00, to.f01, to.f10, to.f11
    H = len(g)
    for lane in range(LANES):
        p00[lane], p01[lane], p11[lane] = W[H - 1, 0], 0.0, W[H - 1, 1]
        q0[lane], q1[lane], x0[lane], x1[lane] = 0.0, 0.0, 0.0, 0.0
        changed[lane], held[lane] = 0.0, 0.0
    # The pass for the matrices and the one for the vectors go backward together: what only the
    # latter needs of a stage is then never stored.
    for i in range(H - 1, -1, -1):
        weight = rho[i]
        add_p, add_v = (W[i - 1, 0], W[i - 1, 1]) if i > 0 else (0.0, 0.0)
        for lane in range(LANES):
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
    for i in range(H):
        for lane in range(LANES):
            own_, p_, v_, at = own[i, lane], x0[lane], x1[lane], side[i, lane]
            chosen = own_ - (k0[i, lane] * p_ + k1[i, lane] * v_)
            verdict = 1.0 if chosen > bound else -1.0 if chosen < -bound else 0.0
            # An input that would leave its bound stays at it for this round.
            stays = at if at != 0.0 else verdict
            value = chosen if stays == 0.0 else stays * bound
            then_p, then_v = advance(model, p_, v_, value)
            free_p = f00[i, lane] * p_ + f01[i, lane] * v_ + b0 * own_
            free_v = f10[i, lane] * p_ + f11[i, lane] * v_ + b1 * own_
            x0[lane] = free_p if stays == 0.0 else then_p
            x1[lane] = free_v if stays == 0.0 else then_v
            u[i, lane], side[i, lane] = value, verdict
            changed[lane] += 0.0 if verdict == at else 1.0
            held[lane] += abs(verdict)


@lanes
def _any(number: F1) -> bool:
    """Whether a number is above 0 in any lane."""
    found = False
    for lane in range(LANES):
        found |= number[lane] > 0.0
    return found


@lanes
def active_sets(mpc: MPC, axis: int, to: Lanes, stages: F2, settled: B1) -> None:
    """Fill in the optimal inputs of one axis: `exact.active_set` with LATER weights.

    Args:
        mpc, axis: the problem.
        to: gradient and first active set, as `gradient` fills them in; the inputs are filled in
            [m/s].
        stages: those of the FREE set; shape (H, 12).
        settled: set to False where a lane has no answer; shape (LANES,).

    Source: eqs. (6), (8), (10).
    """
    total, changed, held, x0, x1 = to.total, to.changed, to.held, to.led_p, to.led_v
    for _ in range(ROUNDS_MAX):
        # Where no lane has an input at its bound, one table of FREE stages serves all of them.
        if _any(held):
            _round(mpc, axis, to)
        else:
            _round_free(mpc, axis, to, stages)
        # A lane that has settled finds the same again, to the last bit.
        if not _any(changed):
            break
    for lane in range(LANES):
        finite = np.isfinite(total[lane] + x0[lane] + x1[lane])
        settled[lane] = settled[lane] and changed[lane] == 0.0 and finite
