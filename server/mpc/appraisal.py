"""Begin of a plan, and its appraisal once it is solved; `server.mpc.hierarchical` calls both."""

from typing import NamedTuple

import numpy as np

from skytether.server.common.compiled import advance, axis_at
from skytether.server.common.scheme import Foresight, PlanFigures
from skytether.server.mpc.problem import MPC, Inputs, add_cost
from skytether.shared.base.kernel import B1, F1, F3, I1, S4, inline, lanes

GENERATOR, TRACKER = 0, 1
"""First index of what both MPCs have."""


class PlanMemory(NamedTuple):
    """Memory of both MPCs for every vehicle."""

    # A thousand vehicles' memory is 0.8 MB like this. With float64, and with the states X(k-1) that
    # the inputs lead to, it was four times as large, and no core's own cache held it.
    inputs: S4
    """U(k-1), the horizon computed last [m/s], rounded as it is sent; shape
    (2, capacity, axes, H)."""
    start: F3
    """State that the generator's horizon begins at [m, m/s]; shape (capacity, axes, 2)."""
    step: I1
    """Step that they were computed for, or -1; shape (capacity,)."""
    bounded: B1
    """Whether an input was at its bound; shape (capacity,)."""


class Draft(NamedTuple):
    """The plans of a block of vehicles in the making."""

    planned: F3
    """Planned state x_p(k|k-1), where the generator starts [m, m/s]; shape (block, axes, 2)."""
    gradient: F3
    """Gradient g of the problem to be solved, and then the slope at its answer; shape (block, axes,
    H)."""
    guess: F3
    """Horizon of the step before, shifted [m/s]; shape (block, axes, H)."""
    inputs: S4
    """U(k) of both MPCs, rounded: planning goes on with what the vehicle will really be told
    [m/s]; shape (2, block, axes, H)."""
    distance: F1
    """Scratch: squares of distances [m²]; shape (H + 1,)."""


@inline
def begin(memory: PlanMemory, ahead: int, plan: PlanFigures, row: int, k: int) -> None:
    """Note what a plan starts from, in its record of FIGURES, and whether it begins anew."""
    last, start = memory.step[row], k + ahead
    plan.row, plan.step, plan.start, plan.gap = row, k, start, start - last
    plan.solved = True
    # Behind a gap longer than H nothing of the last plan is left to go on from (E17).
    plan.fresh = last < 0 or not 0 <= start - last <= memory.inputs.shape[3]


@inline
def planned_state(
    mpc: MPC, memory: PlanMemory, plan: PlanFigures, axis: int
) -> tuple[float, float]:
    """Planned state x_p(k|k-1) on one axis: where the generator's last plan leads at `plan.gap`.

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
    found: Foresight,
    plan: PlanFigures,
    i: int,
    axis: int,
    distance: F1,
) -> None:
    """Add the squares of how far `held` leads away from the generator's last plan on one axis.

    Args:
        distance: what is added to, stage by stage, as far as that plan goes and a new one would be
            flown [m²]; shape (H + 1,).
    """
    held, flown = found.held[i, axis], found.flown[i]
    model, w, H = axis_at(mpc.model, axis), found.disturbance[i, axis], len(held)
    planned = memory.inputs[GENERATOR, plan.row, axis]
    p, v = found.start[i, axis, 0], found.start[i, axis, 1]
    planned_p, planned_v = planned_state(mpc, memory, plan, axis)
    for stage in range(min(H - plan.gap, flown) + 1):
        away = p - planned_p
        distance[stage] += away * away
        if stage < flown:
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
    """Add to `cost` what flying on with other inputs costs above the optimum, twice, on one axis.

    Args:
        x: by how much the state at stage 0 is another then [m, m/s].
        held: the other inputs [m/s]; shape (H,).
        u: the optimal ones [m/s]; shape (H,).
        steep: `slope` there, by which the cost rises where a bound is active; shape (H,).
        change: scratch, as long as inputs are compared; shape (flown,).
    """
    for stage in range(len(change)):
        # The slope is 0 but where a bound is active, and there every change that is allowed costs
        # more: less than 0 is rounding. Without this term the gap was wrong in 68 % of the tests of
        # a flight in wind 0.3.
        change[stage] = held[stage] - u[stage]
        cost += 2.0 * max(0.0, steep[stage] * change[stage])
    return add_cost(mpc, axis, x, change, cost)


@lanes
def copy(numbers: Inputs, to: Inputs) -> None:
    """Put numbers into the beginning of an array."""
    for i in range(len(numbers)):
        to[i] = numbers[i]


@inline
def conclude(
    mpc: MPC,
    terminal_weight: F1,
    compares: bool,
    memory: PlanMemory,
    draft: Draft,
    found: Foresight,
    plan: PlanFigures,
    i: int,
) -> None:
    """Appraise the plan of vehicle `i`, with V(k) among its figures, and remember it.

    Source: eq. (16).
    """
    axes, H, P = len(mpc.model), memory.inputs.shape[3], terminal_weight
    row, d, state_gap, cost = plan.row, found.ahead[i], 0.0, 0.0
    # Beyond that a plan is never flown: what was sent would seem to end too early at every step.
    change = draft.guess[i, 0, : found.flown[i]]
    distance, furthest = draft.distance, 0.0
    sure, doubted = 1.0, 0.0
    if compares:
        for stage in range(H + 1):
            distance[stage] = 0.0
    for axis in range(axes):
        u = draft.inputs[TRACKER, i, axis]
        off_p = found.start[i, axis, 0] - draft.planned[i, axis, 0]
        off_v = found.start[i, axis, 1] - draft.planned[i, axis, 1]
        state_gap += off_p * off_p * P[0] + off_v * off_v * P[1]
        if compares:
            steep = draft.gradient[i, axis]
            x = (0.0, 0.0)
            cost = _add_gap(mpc, axis, x, found.held[i, axis], u, steep, change, cost)
            for j in range(found.doubt.shape[1]):
                share = found.doubt[i, j]
                if share > 0.0:
                    x = (
                        found.doubted_start[i, j, axis, 0] - found.start[i, axis, 0],
                        found.doubted_start[i, j, axis, 1] - found.start[i, axis, 1],
                    )
                    held = found.doubted[i, j, axis]
                    doubted += share * _add_gap(mpc, axis, x, held, u, steep, change, 0.0)
            if not plan.fresh:
                _deviate(mpc, memory, found, plan, i, axis, distance)
        copy(found.committed[i, axis, :d], found.horizons[i, axis])
        copy(u, found.horizons[i, axis, d:])
    if compares:
        for stage in range(H + 1):
            furthest = max(furthest, distance[stage])
        furthest = np.sqrt(furthest)
    for j in range(found.doubt.shape[1]):
        sure -= found.doubt[i, j]
    plan.state_gap, plan.cost_gap, plan.deviation_m = state_gap, cost, furthest
    plan.expected_gap = sure * cost + doubted
    for axis in range(axes):
        for which in (GENERATOR, TRACKER):
            copy(draft.inputs[which, i, axis], memory.inputs[which, row, axis])
        memory.start[row, axis, 0] = draft.planned[i, axis, 0]
        memory.start[row, axis, 1] = draft.planned[i, axis, 1]
    # A first plan that failed is no plan to go on from.
    memory.step[row] = plan.start if plan.solved or not plan.fresh else -1
