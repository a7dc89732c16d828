"""The optimal control problem, eq. (5)-(9), as algebra: problem → QP → plan.

Eliminating the states of eq. (4), X = Φ x + Γ U, leaves a box-constrained QP in the H inputs of
each axis,

    minimise  ½ Uᵀ 𝓗 U + gᵀ U   subject to  |U| ≤ u_max,

whose Hessian 𝓗 = ΓᵀWΓ + R + S is the same at every step; only the gradient g depends on the state,
the target and the previous plan. W holds Q at the stages 1 … H-1 and P at H.

The work of a step is done in O(H), by recursion along the horizon, on one axis, for several
vehicles at once. In a recursion every stage waits about ten cycles for the previous one, and most
of the processor is idle. So the innermost loop runs over vehicles, and the compiler turns it into
vector instructions. A single vehicle is a batch of size 1. A vehicle's plan is the same to the last
bit alone and in a batch; a BLAS product with Γ would not guarantee this.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.server.planning.compiled import Axes, advance, axes_of, axis_at
from skytether.shared.base.kernel import F1, F2, F3, S1, inline, lanes, part, shared
from skytether.shared.law.model import Array, Axis, Model
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig

Inputs = F1 | S1
"""Inputs of a horizon, in float64 or in float32 as sent [m/s]; shape (H,)."""


class Weights(NamedTuple):
    """Weights of eq. (9), for the first step of a flight and for all later steps.

    Without a previous plan there is no S-term (E8): the first of the two rows omits it.
    """

    states: F2
    """Diagonal of W, the weights of the states; shape (H, 2)."""
    inputs: F2
    """R + S, all weights of the input itself; shape (2, H)."""
    changes: F2
    """Weights S of the stages 0 … H-2, and 0 for the last stage; shape (2, H)."""
    input: float
    """Weight R of the input."""
    target: F1
    """Weight of the desired velocity: R / g if the input has its own target (E7), because velocity
    v needs the input v / g; otherwise 0; shape (axes,)."""


FIRST, LATER = 0, 1


class MPC(NamedTuple):
    """Constant part of the problem of eq. (9), without state, target and previous plan."""

    model: Axes
    """Model, eq. (4); shape (axes,)."""
    bounds: F1
    """Bound u_max of the input [m/s]; shape (axes,)."""
    weights: Weights


def make_mpc(terms: Terms, control: ControlConfig) -> MPC:
    """Constant part of a scenario's problem.

    Source: eqs. (5), (6), (9).
    """
    H = terms.horizon
    # Stages 1 … H: no input changes the state at stage 0, so its Q of eq. (5) is left out.
    states = np.tile(np.array(control.state_weight), (H, 1))
    states[-1] = control.terminal_weight
    changes = np.zeros((2, H))
    # Eq. (9) sums S only up to H - 2: the last input has no counterpart in the previous plan.
    changes[LATER, :-1] = control.change_weight
    weights = Weights(
        states=states,
        inputs=control.input_weight + changes,
        changes=changes,
        input=control.input_weight,
        target=control.input_weight * control.input_reference / np.array(terms.gain),
    )
    return MPC(axes_of(terms.model), np.array(terms.u_max), weights)


@dataclass(frozen=True, slots=True)
class Problem:
    """Data shared by all QPs with the same Hessian."""

    model: Model
    mpc: MPC
    which: int
    """Weights in use: FIRST or LATER."""
    hessian: Array
    """𝓗 of each axis; shape (axes, H, H)."""


def pose(model: Model, mpc: MPC, which: int) -> Problem:
    """QPs for the FIRST step or for LATER steps.

    Source: eqs. (5), (9).
    """
    axes, H = len(model.b0), len(mpc.weights.states)
    forced = np.zeros((axes, H, 2, H))
    """Γ: effect of the inputs on the states 1 … H."""
    response = model.B
    for stage in range(H):
        for later in range(stage, H):
            # Γ is a Toeplitz matrix: the response depends on the distance of the two stages alone.
            forced[:, later, :, later - stage] = response
        response = model.step(response, 0.0)
    # A full matrix, because it is computed only twice per flight; each step takes O(H), see below.
    hessian = np.einsum("aipk,ip,aipl->akl", forced, mpc.weights.states, forced)
    return Problem(model, mpc, which, hessian + np.diag(mpc.weights.inputs[which]))


# -- recursions along the horizon, for several vehicles at once -----------------------------------

WIDTH = 16
"""Number of vehicles planned for at once: LLVM does not vectorise shorter loops."""


class SimdBatch(NamedTuple):
    """Scratch for the problems of several vehicles on one axis; L = WIDTH or 1 vehicles."""

    p: F1
    """Position, or its costate, at the current stage; shape (L,)."""
    v: F1
    """Velocity, or its costate; shape (L,)."""
    leader_p: F1
    """Position of the plan that is tracked [m]; shape (L,)."""
    leader_v: F1
    """Velocity of the plan that is tracked [m/s]; shape (L,)."""
    w: F1
    """Disturbance ŵ [m/s]; shape (L,)."""
    p00: F1
    """Matrix P of the backward pass, entry of position; shape (L,)."""
    p01: F1
    """Matrix P, mixed entry; shape (L,)."""
    p11: F1
    """Matrix P, entry of velocity; shape (L,)."""
    total: F1
    """Sum of the gradient's entries, which is finite only if every entry is; shape (L,)."""
    changed: F1
    """Number of inputs that entered or left the active set in the last iteration; shape (L,)."""
    active: F1
    """Number of inputs in the active set; shape (L,)."""
    worst: F1
    """Largest distance of a free input beyond its bound or, for an input held at its bound, of its
    unconstrained value from this bound towards the inside [m/s]; 0 if the active set is right;
    shape (L,)."""
    worst_at: F1
    """Stage of the input with the distance `worst`; -1 if the active set is right; shape (L,)."""
    target_p: F2
    """Desired positions at the stages 0 … H [m]; shape (H + 1, L)."""
    target_v: F2
    """Desired velocities at the stages 0 … H [m/s]; shape (H + 1, L)."""
    leader_speed: F2
    """Velocities of the plan that is tracked [m/s]; shape (H + 1, L)."""
    drift_p: F2
    """Weighted position error if all inputs are 0, see `lead`; shape (H, L)."""
    drift_v: F2
    """Weighted velocity error if all inputs are 0; shape (H, L)."""
    previous: F2
    """Previous plan, shifted to the start of the new plan [m/s]; shape (H, L)."""
    gradient: F2
    """Gradient g; shape (H, L)."""
    inputs: F2
    """Optimal inputs, not yet rounded [m/s]; shape (H, L)."""
    side: F2
    """-1 or 1 if the input is at its lower or upper bound, 0 if it is free; shape (H, L)."""
    own: F2
    """Unconstrained input of each stage for the state 0 [m/s]; shape (H, L)."""
    k0: F2
    """Column K0 of the backward pass, see `riccati`; shape (H, L)."""
    k1: F2
    """Column K1 of the backward pass; shape (H, L)."""
    f00: F2
    f01: F2
    f10: F2
    f11: F2


def simd_memory(H: int, width: int) -> Array:
    """Memory for a `SimdBatch`: one array, because every array argument makes a call slower."""
    return np.zeros((len(SimdBatch._fields), H + 1, width))


@shared
def simd_batch(memory: F3) -> SimdBatch:
    H = memory.shape[1] - 1
    return SimdBatch(
        p=memory[0, 0],
        v=memory[1, 0],
        leader_p=memory[2, 0],
        leader_v=memory[3, 0],
        w=memory[4, 0],
        p00=memory[5, 0],
        p01=memory[6, 0],
        p11=memory[7, 0],
        total=memory[8, 0],
        changed=memory[9, 0],
        active=memory[10, 0],
        worst=memory[11, 0],
        worst_at=memory[12, 0],
        target_p=memory[13],
        target_v=memory[14],
        leader_speed=memory[15],
        drift_p=memory[16, :H],
        drift_v=memory[17, :H],
        previous=memory[18, :H],
        gradient=memory[19, :H],
        inputs=memory[20, :H],
        side=memory[21, :H],
        own=memory[22, :H],
        k0=memory[23, :H],
        k1=memory[24, :H],
        f00=memory[25, :H],
        f01=memory[26, :H],
        f10=memory[27, :H],
        f11=memory[28, :H],
    )


@lanes
def set_previous(inputs: Inputs, gap: int, fresh: bool, simd: SimdBatch, lane: int) -> None:
    """Fill in the previous plan shifted by `gap` steps, its last input repeated; 0 if `fresh`."""
    H = len(inputs)
    for stage in range(H):
        simd.previous[stage, lane] = 0.0 if fresh else inputs[min(stage + gap, H - 1)]


@lanes
def set_target(states: F2, simd: SimdBatch, lane: int) -> None:
    """Fill in the desired states at the stages 0 … H [m, m/s]; shape (H + 1, 2)."""
    for stage in range(len(states)):
        simd.target_p[stage, lane] = states[stage, 0]
        simd.target_v[stage, lane] = states[stage, 1]


@lanes
def set_inputs(inputs: Inputs, simd: SimdBatch, lane: int) -> None:
    for stage in range(len(inputs)):
        simd.inputs[stage, lane] = inputs[stage]


@lanes
def column(numbers: F2, lane: int, to: Inputs) -> None:
    for stage in range(len(to)):
        to[stage] = numbers[stage, lane]


@lanes
def lead(mpc: MPC, axis: int, simd: SimdBatch) -> None:
    """Fill in W (Φ x - target): the weighted error without any input.

    Reads p and v at stage 0, the disturbance w that adds to every input, and the target.
    """
    model, W, L = axis_at(mpc.model, axis), mpc.weights.states, len(simd.p)
    p, v, w = simd.p, simd.v, simd.w
    target_p, target_v = simd.target_p, simd.target_v
    drift_p, drift_v = simd.drift_p, simd.drift_v
    for i in range(len(drift_p)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(L):
            p_, v_ = advance(model, p[lane], v[lane], w[lane])
            p[lane], v[lane] = p_, v_
            drift_p[i, lane] = weight_p * (p_ - target_p[i + 1, lane])
            drift_v[i, lane] = weight_v * (v_ - target_v[i + 1, lane])


@inline
def rounded(u: float) -> float:
    """Input rounded to float32, as it is sent."""
    return np.float64(np.float32(u))


@lanes
def follow(mpc: MPC, axis: int, simd: SimdBatch) -> None:
    """Fill in the tracked plan from its inputs, and W (Φ x - plan) of the vehicle that tracks it.

    Reads p, v and w of the vehicle; leader_p, leader_v and inputs of the plan.

    Source: eq. (7).
    """
    model, W, L = axis_at(mpc.model, axis), mpc.weights.states, len(simd.p)
    p, v, leader_p, leader_v, w = simd.p, simd.v, simd.leader_p, simd.leader_v, simd.w
    leader_speed, u = simd.leader_speed, simd.inputs
    drift_p, drift_v = simd.drift_p, simd.drift_v
    for lane in range(L):
        leader_speed[0, lane] = leader_v[lane]
    for i in range(len(u)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(L):
            q_, s_ = advance(model, leader_p[lane], leader_v[lane], rounded(u[i, lane]))
            leader_p[lane], leader_v[lane] = q_, s_
            leader_speed[i + 1, lane] = s_
            p_, v_ = advance(model, p[lane], v[lane], w[lane])
            p[lane], v[lane] = p_, v_
            drift_p[i, lane] = weight_p * (p_ - q_)
            drift_v[i, lane] = weight_v * (v_ - s_)


@inline
def adjoint(
    model: Axis, co: tuple[float, float], drift_p: float, drift_v: float
) -> tuple[float, float]:
    """Costate λ of eq. (4) one stage earlier: λ(i) = Aᵀ λ(i+1) + drift(i). Bᵀ λ is the derivative
    of the cost by an input.

    Args:
        co: λ of the next stage, on position and velocity; 0 after the last.
        drift_p, drift_v: derivative of the cost by the state at the next stage.
    """
    return co[0] + drift_p, model.a01 * co[0] + model.a11 * co[1] + drift_v


@inline
def pulled(S: float, previous: float, T: float, target_v: float, R: float, w: float) -> float:
    """Negative S- and R-terms of the gradient of one input.

    Args:
        S, T, R: weights of change, desired velocity and input, see `Weights`.
        previous: this input in the previous plan [m/s].
        w: disturbance that adds to the input [m/s].
    """
    return S * previous + T * target_v - R * w


@lanes
def gradient(mpc: MPC, axis: int, which: int, simd: SimdBatch, target_v: F2) -> None:
    """Fill in g of the QP of one axis: Γᵀ drift by the adjoint of eq. (4), minus R and S terms.

    Args:
        which: FIRST or LATER weights.
        simd: reads drift, previous and w.
        target_v: desired velocities [m/s]; shape (H + 1, L).

    Source: eqs. (5), (9).
    """
    model, weights, L = axis_at(mpc.model, axis), mpc.weights, len(simd.p)
    R, T = weights.input, weights.target[axis]
    p, v, w, g, previous = simd.p, simd.v, simd.w, simd.gradient, simd.previous
    drift_p, drift_v = simd.drift_p, simd.drift_v
    for lane in range(L):
        p[lane], v[lane] = 0.0, 0.0
    for i in range(len(g) - 1, -1, -1):
        S = weights.changes[which, i]
        for lane in range(L):
            co = adjoint(model, (p[lane], v[lane]), drift_p[i, lane], drift_v[i, lane])
            p[lane], v[lane] = co
            toward = pulled(S, previous[i, lane], T, target_v[i, lane], R, w[lane])
            g[i, lane] = model.b0 * co[0] + model.b1 * co[1] - toward


@lanes
def slope(mpc: MPC, axis: int, which: int, simd: SimdBatch) -> None:
    """Replace g by 𝓗 U + g, with U as sent: 0 where U is optimal and within its bounds."""
    model, W, L = axis_at(mpc.model, axis), mpc.weights.states, len(simd.p)
    p, v, u, g = simd.p, simd.v, simd.inputs, simd.gradient
    drift_p, drift_v = simd.drift_p, simd.drift_v
    for lane in range(L):
        p[lane], v[lane] = 0.0, 0.0
    for i in range(len(u)):
        weight_p, weight_v = W[i, 0], W[i, 1]
        for lane in range(L):
            p_, v_ = advance(model, p[lane], v[lane], rounded(u[i, lane]))
            p[lane], v[lane] = p_, v_
            drift_p[i, lane], drift_v[i, lane] = weight_p * p_, weight_v * v_
    for lane in range(L):
        p[lane], v[lane] = 0.0, 0.0
    for i in range(len(u) - 1, -1, -1):
        weight = mpc.weights.inputs[which, i]
        for lane in range(L):
            co = adjoint(model, (p[lane], v[lane]), drift_p[i, lane], drift_v[i, lane])
            p[lane], v[lane] = co
            g[i, lane] += model.b0 * co[0] + model.b1 * co[1] + weight * rounded(u[i, lane])


@part
def add_cost(mpc: MPC, axis: int, x: tuple[float, float], change: F1, cost: float) -> float:
    """Add to `cost` twice the quadratic cost of a change of the state and the inputs.

    Args:
        x: change of position [m] and velocity [m/s] at stage 0; if 0, the sum is ΔUᵀ 𝓗 ΔU.
        change: ΔU [m/s]; shape (H,).
        cost: the sum so far.
    """
    model, W, rho = axis_at(mpc.model, axis), mpc.weights.states, mpc.weights.inputs
    p, v = x
    for i in range(len(change)):
        u = change[i]
        p, v = advance(model, p, v, u)
        cost += W[i, 0] * p * p + W[i, 1] * v * v + rho[LATER, i] * u * u
    return cost
