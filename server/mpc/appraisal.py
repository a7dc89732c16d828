"""Appraisal of plans: values set before a plan's QP is solved, and the plan's costs afterwards."""

from typing import NamedTuple

import numpy as np

from skytether.server.mpc.problem import MPC, Inputs, add_cost
from skytether.server.planning.compiled import advance, axis_at
from skytether.server.planning.scheme import Foresight, PlanFigures
from skytether.shared.base.kernel import B1, F1, F3, I1, S4, inline, lanes

GENERATOR, TRACKER = 0, 1
"""Indices of the two MPCs, trajectory generator and tracker, in arrays."""


class PlanMemory(NamedTuple):
    """Latest plans of both MPCs for every vehicle."""

    # The plans of a thousand vehicles take 0.8 MB, because inputs are float32 and states are not
    # stored. With float64 and stored states they took four times as much: more than a core's cache.
    inputs: S4
    """Latest inputs U(k-1) [m/s], rounded as sent; shape (2, capacity, axes, H)."""
    start: F3
    """Initial state of the generator's plan [m, m/s]; shape (capacity, axes, 2)."""
    step: I1
    """Step of the latest plans, or -1; shape (capacity,)."""
    bounded: B1
    """Whether an input of the latest plan was at its bound; shape (capacity,)."""


class Draft(NamedTuple):
    """Plans being computed for a block of vehicles."""

    planned: F3
    """Planned state x_p(k|k-1), initial state of the generator [m, m/s]; shape (block, axes, 2)."""
    gradient: F3
    """Gradient g of the QP, later the slope at its solution; shape (block, axes, H)."""
    guess: F3
    """Shifted plan of the previous step [m/s]; shape (block, axes, H)."""
    inputs: S4
    """Inputs U(k) of both MPCs [m/s], rounded as sent, because planning continues from the inputs
    sent; shape (2, block, axes, H)."""
    distance: F1
    """Scratch: squared distances at each stage [m²]; shape (H + 1,)."""


@inline
def begin(memory: PlanMemory, ahead: int, plan: PlanFigures, row: int, k: int) -> None:
    """Set a plan's steps, and `fresh`: whether the vehicle has no usable previous plan."""
    last, start = memory.step[row], k + ahead
    plan.row, plan.step, plan.start, plan.gap = row, k, start, start - last
    plan.solved = True
    # After a gap longer than H no input of the previous plan is left (E17).
    plan.fresh = last < 0 or not 0 <= start - last <= memory.inputs.shape[3]


@inline
def planned_state(
    mpc: MPC, memory: PlanMemory, plan: PlanFigures, axis: int
) -> tuple[float, float]:
    """Planned state x_p(k|k-1) on one axis, by the generator's previous plan [m, m/s].

    Source: eq. (14).
    """
    model, u = axis_at(mpc.model, axis), memory.inputs[GENERATOR, plan.row, axis]
    p, v = memory.start[plan.row, axis, 0], memory.start[plan.row, axis, 1]
    for stage in range(plan.gap):
        p, v = advance(model, p, v, u[stage])
    return p, v


@inline
def _deviate(
    mpc: MPC,
    memory: PlanMemory,
    foresight: Foresight,
    plan: PlanFigures,
    i: int,
    axis: int,
    distance: F1,
) -> None:
    """Add one axis to the squared distances between the previous plan's path and the path of the
    inputs already sent (`held`).

    Args:
        i: index of the vehicle in the block.
        distance: input and output: sum over the axes so far, at each stage [m²]; shape (H + 1,).
    """
    held, usable = foresight.held[i, axis], foresight.usable[i]
    model, w, H = axis_at(mpc.model, axis), foresight.disturbance[i, axis], len(held)
    planned = memory.inputs[GENERATOR, plan.row, axis]
    p, v = foresight.start[i, axis, 0], foresight.start[i, axis, 1]
    planned_p, planned_v = planned_state(mpc, memory, plan, axis)
    for stage in range(min(H - plan.gap, usable) + 1):
        away = p - planned_p
        distance[stage] += away * away
        if stage < usable:
            p, v = advance(model, p, v, held[stage] + w)
        if stage + plan.gap < H:
            u = planned[stage + plan.gap]
            planned_p, planned_v = advance(model, planned_p, planned_v, u)


@inline
def _add_gap(
    mpc: MPC,
    axis: int,
    x: tuple[float, float],
    held: F1,
    u: Inputs,
    steep: F1,
    change: F1,
    cost: float,
) -> float:
    """Sum of `cost` and twice the excess cost of other inputs over optimal inputs on one axis.

    Args:
        x: state at stage 0 with the other inputs minus that with the optimal ones [m, m/s].
        held: the other inputs [m/s]; shape (H,).
        u: the optimal inputs [m/s]; shape (H,).
        steep: `slope` at the optimum, nonzero where a bound is active; shape (H,).
        change: scratch, one entry per compared input; shape (flown,).
        cost: the sum so far.
    """
    for stage in range(len(change)):
        # The slope is nonzero only at an active bound, where every allowed change increases the
        # cost, so a negative product is a rounding error. Without the slope the cost gap was wrong
        # at 68 % of the steps of a flight in wind 0.3.
        change[stage] = held[stage] - u[stage]
        cost += 2.0 * max(0.0, steep[stage] * change[stage])
    return add_cost(mpc, axis, x, change, cost)


@lanes
def copy(numbers: Inputs, to: Inputs) -> None:
    for i in range(len(numbers)):
        to[i] = numbers[i]


@inline
def conclude(
    mpc: MPC,
    terminal_weight: F1,
    compares: bool,
    memory: PlanMemory,
    draft: Draft,
    foresight: Foresight,
    plan: PlanFigures,
    i: int,
) -> None:
    """Fill in the figures of vehicle `i`'s plan, such as V(k), and store the plan.

    Source: eq. (16).
    """
    axes, H, P = len(mpc.model), memory.inputs.shape[3], terminal_weight
    row, d, state_gap, cost = plan.row, foresight.ahead[i], 0.0, 0.0
    # Only usable inputs are compared: later inputs are never flown.
    change = draft.guess[i, 0, : foresight.usable[i]]
    distance, furthest = draft.distance, 0.0
    sure, doubted = 1.0, 0.0
    if compares:
        for stage in range(H + 1):
            distance[stage] = 0.0
    for axis in range(axes):
        u = draft.inputs[TRACKER, i, axis]
        off_p = foresight.start[i, axis, 0] - draft.planned[i, axis, 0]
        off_v = foresight.start[i, axis, 1] - draft.planned[i, axis, 1]
        state_gap += off_p * off_p * P[0] + off_v * off_v * P[1]
        if compares:
            steep = draft.gradient[i, axis]
            x = (0.0, 0.0)
            cost = _add_gap(mpc, axis, x, foresight.held[i, axis], u, steep, change, cost)
            for j in range(foresight.loss_probability.shape[1]):
                share = foresight.loss_probability[i, j]
                if share > 0.0:
                    x = (
                        foresight.start_if_lost[i, j, axis, 0] - foresight.start[i, axis, 0],
                        foresight.start_if_lost[i, j, axis, 1] - foresight.start[i, axis, 1],
                    )
                    held = foresight.inputs_if_lost[i, j, axis]
                    doubted += share * _add_gap(mpc, axis, x, held, u, steep, change, 0.0)
            if not plan.fresh:
                _deviate(mpc, memory, foresight, plan, i, axis, distance)
        copy(foresight.committed[i, axis, :d], foresight.horizons[i, axis])
        copy(u, foresight.horizons[i, axis, d:])
    if compares:
        for stage in range(H + 1):
            furthest = max(furthest, distance[stage])
        furthest = np.sqrt(furthest)
    for j in range(foresight.loss_probability.shape[1]):
        sure -= foresight.loss_probability[i, j]
    plan.state_gap, plan.cost_gap, plan.deviation_m = state_gap, cost, furthest
    plan.expected_gap = sure * cost + doubted
    for axis in range(axes):
        for which in (GENERATOR, TRACKER):
            copy(draft.inputs[which, i, axis], memory.inputs[which, row, axis])
        memory.start[row, axis, 0] = draft.planned[i, axis, 0]
        memory.start[row, axis, 1] = draft.planned[i, axis, 1]
    # If the first QP is not solved, there is no previous plan at the next step.
    memory.step[row] = plan.start if plan.solved or not plan.fresh else -1
