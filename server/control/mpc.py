"""The optimal control problem, eq. (5)-(9), as algebra: problem → QP → plan.

Eliminating the states of eq. (4), X = Φ x + Γ U, leaves a box-constrained QP in the H inputs of
each axis,

    minimise  ½ Uᵀ 𝓗 U + gᵀ U   subject to  |U| ≤ u_max,

whose Hessian 𝓗 = ΓᵀWΓ + R + S is the same at every step; only the gradient g follows the state, the
target and the horizon before. W holds Q at the stages 1 … H-1 and P at H.

What is done at every step is done in O(H), by recursion along the horizon, on one axis of one
vehicle. A vehicle gets the same bits alone as in a batch, which BLAS, multiplying by Γ, does not
promise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.server.control.law import Axes, advance, axes_of, axis_at
from skytether.shared.base.kernel import F1, F2, S1, inline, part
from skytether.shared.law.model import Array, Axis, Model
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig

Inputs = F1 | S1
"""Inputs of a horizon, as they are computed or as they are sent [m/s]; shape (H,)."""


class Weights(NamedTuple):
    """The weights of eq. (9), for the first step of a flight and for all later ones.

    Without a horizon before there is no S-term (E8): the first of two rows leaves it out.
    """

    states: F2
    """W, diagonal; shape (H, 2)."""
    inputs: F2
    """R + S, of all that weighs the input itself; shape (2, H)."""
    changes: F2
    """S of the stages 0 … H-2, and 0 of the last; shape (2, H)."""
    input: float
    """R."""
    target: F1
    """Weight of the desired velocity: R / g where the input has a target of its own (E7), for it
    takes the input v / g to fly at v, else 0; shape (axes,)."""


FIRST, LATER = 0, 1
"""Rows of `Weights`: at the first step of a flight, and afterwards."""


class MPC(NamedTuple):
    """The problem of eq. (9), but for what changes: state, target and horizon before."""

    model: Axes
    """Model, eq. (4); shape (axes,)."""
    bounds: F1
    """Bound u_max of the input [m/s]; shape (axes,)."""
    weights: Weights
    """Q, P, R and S."""


def make_mpc(terms: Terms, control: ControlConfig) -> MPC:
    """The problem of a scenario.

    Source: eqs. (5), (6), (9).
    """
    H = terms.horizon
    # Stages 1 … H: no input changes the state at stage 0, so its Q of eq. (5) is left out.
    states = np.tile(np.array(control.state_weight), (H, 1))
    states[-1] = control.terminal_weight
    changes = np.zeros((2, H))
    # Eq. (9) sums S up to H - 2 only: the last input has no counterpart in the horizon before.
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
    """Solver set-up that all QPs with one Hessian share."""

    model: Model
    """Model, eq. (4)."""
    mpc: MPC
    """Weights, bounds and model of the QPs."""
    which: int
    """FIRST or LATER weights."""
    hessian: Array
    """𝓗 of each axis; shape (axes, H, H)."""


def pose(model: Model, mpc: MPC, which: int) -> Problem:
    """The QPs for the FIRST step or for LATER ones.

    Source: eqs. (5), (9).
    """
    axes, H = len(model.b0), len(mpc.weights.states)
    forced = np.zeros((axes, H, 2, H))
    """Γ: what the inputs add to the states 1 … H."""
    response = model.B
    for stage in range(H):
        for later in range(stage, H):
            # Γ is a Toeplitz matrix: the response depends on the distance of the two stages alone.
            forced[:, later, :, later - stage] = response
        response = model.step(response, 0.0)
    # In full, for it is made twice a flight; what every step needs is done in O(H) below.
    hessian = np.einsum("aipk,ip,aipl->akl", forced, mpc.weights.states, forced)
    return Problem(model, mpc, which, hessian + np.diag(mpc.weights.inputs[which]))


@inline
def shifted(inputs: Inputs, gap: int, fresh: bool, i: int) -> float:
    """Input `i` of a horizon as seen `gap` steps later, its last repeated; 0 if it is fresh."""
    return 0.0 if fresh else inputs[min(i + gap, len(inputs) - 1)]


@part
def lead(mpc: MPC, axis: int, x: tuple[float, float], w: float, target: F2, drift: F2) -> None:
    """Fill in W (Φ x - target) of one axis: how far off the vehicle would come without any input.

    Args:
        x: position [m] and velocity [m/s] at stage 0.
        w: what is added to every input on its way [m/s].
        target: desired states at the stages 0 … H [m, m/s]; shape (H + 1, 2).
        drift: what is filled in, of the stages 1 … H; shape (H, 2).
    """
    model, W, (p, v) = axis_at(mpc.model, axis), mpc.weights.states, x
    for i in range(len(drift)):
        p, v = advance(model, p, v, w)
        drift[i, 0] = W[i, 0] * (p - target[i + 1, 0])
        drift[i, 1] = W[i, 1] * (v - target[i + 1, 1])


@part
def follow(
    mpc: MPC,
    axis: int,
    x: tuple[float, float],
    w: float,
    led: tuple[float, float],
    u: Inputs,
    states: F2,
    drift: F2,
) -> None:
    """Fill in X(k) of one vehicle, and `lead` another toward it, in one go.

    Args:
        x, w, drift: see `lead`, of the vehicle that follows.
        led: position [m] and velocity [m/s] at stage 0 of the one that is followed.
        u: its inputs [m/s]; shape (H,).
        states: what is filled in: its states at the stages 0 … H [m, m/s]; shape (H + 1, 2).

    Source: eq. (7).
    """
    model, W = axis_at(mpc.model, axis), mpc.weights.states
    (p, v), (led_p, led_v) = x, led
    states[0, 0], states[0, 1] = led_p, led_v
    for i in range(len(u)):
        led_p, led_v = advance(model, led_p, led_v, u[i])
        states[i + 1, 0], states[i + 1, 1] = led_p, led_v
        p, v = advance(model, p, v, w)
        drift[i, 0], drift[i, 1] = W[i, 0] * (p - led_p), W[i, 1] * (v - led_v)


@inline
def adjoint(
    model: Axis, co: tuple[float, float], drift_p: float, drift_v: float
) -> tuple[float, float]:
    """Costate λ of eq. (4) a stage earlier, λ(i) = Aᵀ λ(i+1) + drift(i); Bᵀ λ is an input's effect.

    Args:
        model: eq. (4) on one axis.
        co: λ of the stage behind, on position and velocity; 0 behind the last.
        drift_p, drift_v: derivative of the cost by the state that the stage leads to.
    """
    return co[0] + drift_p, model.a01 * co[0] + model.a11 * co[1] + drift_v


@inline
def pulled(S: float, previous: float, T: float, target_v: float, R: float, w: float) -> float:
    """S- and R-terms of the gradient of one input, with its sign turned.

    Args:
        S, T, R: weights of change, desired velocity and input, see `Weights`.
        previous: this input in the horizon before [m/s].
        target_v: desired velocity [m/s].
        w: what is added to the input on its way [m/s].
    """
    return S * previous + T * target_v - R * w


@part
def gradient(
    mpc: MPC,
    axis: int,
    which: int,
    w: float,
    target: F2,
    previous: Inputs,
    gap: int,
    fresh: bool,
    drift: F2,
    g: F1,
) -> None:
    """Fill in g of the QP of one axis: Γᵀ drift by the adjoint of eq. (4), less R and S terms.

    Args:
        which: FIRST or LATER.
        w: what is added to every input on its way [m/s]; R weighs the sum.
        target: desired states at the stages 0 … H [m, m/s]; shape (H + 1, 2).
        previous, gap, fresh: see `shifted`; the horizon before makes the S-term [m/s]; shape (H,).
        drift: see `lead`.
        g: what is filled in; shape (H,).

    Source: eqs. (5), (9).
    """
    model, weights = axis_at(mpc.model, axis), mpc.weights
    S, R, T = weights.changes[which], weights.input, weights.target[axis]
    co = (0.0, 0.0)
    for i in range(len(g) - 1, -1, -1):
        co = adjoint(model, co, drift[i, 0], drift[i, 1])
        toward = pulled(S[i], shifted(previous, gap, fresh, i), T, target[i, 1], R, w)
        g[i] = model.b0 * co[0] + model.b1 * co[1] - toward


@part
def slope(mpc: MPC, axis: int, which: int, u: Inputs, g: F1, drift: F2) -> None:
    """Turn g into 𝓗 U + g of one axis: 0 where U is optimal and within its bounds.

    Args:
        which: FIRST or LATER.
        u: U [m/s]; shape (H,).
        g: gradient of the QP, and what is filled in; shape (H,).
        drift: scratch; shape (H, 2).
    """
    model, W, rho = axis_at(mpc.model, axis), mpc.weights.states, mpc.weights.inputs[which]
    p, v = 0.0, 0.0
    for i in range(len(u)):
        p, v = advance(model, p, v, u[i])
        drift[i, 0], drift[i, 1] = W[i, 0] * p, W[i, 1] * v
    co = (0.0, 0.0)
    for i in range(len(u) - 1, -1, -1):
        co = adjoint(model, co, drift[i, 0], drift[i, 1])
        g[i] += model.b0 * co[0] + model.b1 * co[1] + rho[i] * u[i]


@part
def add_cost(mpc: MPC, axis: int, x: tuple[float, float], change: F1, cost: float) -> float:
    """Add to `cost` twice the quadratic part of the cost of a change of state and inputs.

    Args:
        x: by how much position [m] and velocity [m/s] are others at stage 0; with 0 what is added
            is ΔUᵀ 𝓗 ΔU.
        change: ΔU [m/s]; shape (H,).
    """
    model, W, rho = axis_at(mpc.model, axis), mpc.weights.states, mpc.weights.inputs
    p, v = x
    for i in range(len(change)):
        u = change[i]
        p, v = advance(model, p, v, u)
        cost += W[i, 0] * p * p + W[i, 1] * v * v + rho[LATER, i] * u * u
    return cost
