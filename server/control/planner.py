"""Hierarchical MPC of section 4.1: trajectory generator, eq. (14), then tracker, eq. (15).

Both are the MPC of eq. (9), one after the other: each starts from its own horizon of the step
before. The generator plans from its own last prediction and never looks at the UAV (E17); the
tracker leads the UAV's estimated state along the generator's plan. On the way the new plan is
compared with what was sent: V of eq. (16), and the cost and the deviation of flying on with that.

With the exact solver, all of that is one compiled pass over a vehicle, which touches no more memory
than a horizon takes, or over several side by side (`server.control.lanes`). Another solver, or one
that has to help out, takes the same moves in turn with it: pose the generator's problem, solve;
pose the tracker's, solve; conclude.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.control import lanes as side_by_side
from skytether.server.control.desired import Desired, Window
from skytether.server.control.exact import FREE, ExactSolver, Workspace, active_set
from skytether.server.control.lanes import LANES, Lanes, lanes_in, make_room
from skytether.server.control.law import advance, axis_at
from skytether.server.control.mpc import (
    FIRST,
    LATER,
    MPC,
    Inputs,
    Problem,
    add_cost,
    follow,
    gradient,
    lead,
    make_mpc,
    pose,
    shifted,
    slope,
)
from skytether.server.control.scheme import Foresight
from skytether.server.control.solver import Solver
from skytether.shared.base.kernel import (
    B1,
    F1,
    F2,
    F3,
    I1,
    S4,
    inline,
    kernel,
    lanes,
    part,
    record,
    records,
)
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.model import Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig

GENERATOR, TRACKER, CONCLUDE = 0, 1, 2
"""Moves of a plan; GENERATOR and TRACKER are also the first index of what both MPCs have."""


class PlanFigures:
    """Record: what is known of a vehicle once its plan is made; a cost is that of eq. (9)."""

    row: int
    """Row of the vehicle."""
    step: int
    """Step k."""
    start: int
    """Step k + d, where planning starts."""
    gap: int
    """Steps since planning started before."""
    state_gap: float
    """V(k) of eq. (16): square of how far x̂ is from x_p, weighted by P [cost]."""
    cost_gap: float
    """Cost of flying on with what was sent above that of the plan [cost]."""
    expected_gap: float
    """Mean of that cost where packets in flight may be lost [cost]."""
    deviation_m: float
    """Largest distance between what was sent and the generator's plan before [m]; 0 where fresh."""
    fresh: bool
    """Whether it is at its first step, or behind a gap that no plan reached over."""
    solved: bool
    """Whether the plan is new and right, so that it may be sent."""


FIGURES = record(PlanFigures)
Figures = Annotated[NDArray[np.void], records(FIGURES, 1)]
"""Shape (n,)."""


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
    """Whether an input was at its bound, of plans made side by side; shape (capacity,)."""


class Draft(NamedTuple):
    """The plans of a block of vehicles in the making."""

    planned: F3
    """Planned state x_p(k|k-1), where the generator starts [m, m/s]; shape (block, axes, 2)."""
    gradient: F3
    """Gradient g of the problem to be solved; shape (block, axes, H)."""
    guess: F3
    """Horizon of the step before, shifted [m/s]; shape (block, axes, H)."""
    answer: F1
    """Scratch: U(k) of one problem, not rounded yet [m/s]; shape (H,)."""
    inputs: S4
    """U(k) of both MPCs, rounded: planning goes on with what the vehicle will really be told
    [m/s]; shape (2, block, axes, H)."""
    states: F2
    """Scratch: X(k) of the generator on one axis [m, m/s]; shape (H + 1, 2)."""
    drift: F2
    """Scratch of `gradient`; shape (H, 2)."""
    distance: F1
    """Scratch: squares of distances [m²]; shape (H + 1,)."""


class Batch(NamedTuple):
    """A block of vehicles, and all that their plans are made of."""

    mpc: MPC
    """The problem."""
    terminal_weight: F1
    """P, on position and velocity; shape (2,)."""
    compares: bool
    """Whether what was sent before is known, so that a plan can be compared with it."""
    memory: PlanMemory
    """Memory of all vehicles."""
    draft: Draft
    """The plans in the making."""
    desired: Window
    """The desired trajectory, as far as plans go."""
    found: Foresight
    """Predicted states of the vehicles."""
    figures: Figures
    """Costs of their plans."""
    room: F3
    """Scratch of vehicles side by side, see `lanes.make_room`."""
    picked: I1
    """Scratch: vehicles by their places in the block, in the order in which they are planned for;
    shape (block,)."""
    settled: B1
    """Scratch: whether the plan of each lane is found; shape (LANES,)."""


def make_solver(control: ControlConfig, problem: Problem) -> Solver:
    """The solver that a scenario names."""
    if control.solver == "exact":
        return ExactSolver(problem)
    # OSQP brings scipy, which takes 0.2 s and 40 MB.
    from skytether.server.control.osqp_solver import OsqpSolver

    return OsqpSolver(problem)


class Planner:
    """Trajectory generator and tracker of up to `capacity` vehicles, `block` of them at a time."""

    def __init__(
        self,
        control: ControlConfig,
        terms: Terms,
        desired: Desired,
        capacity: int,
        block: int,
        stopwatch: Stopwatch,
    ) -> None:
        axes, H = terms.axes, terms.horizon
        self._desired = desired
        mpc = make_mpc(terms, control)
        self._mpc = mpc
        self._terminal_weight = np.array(control.terminal_weight)
        self._compares = terms.commits
        self.solvers = [
            make_solver(control, pose(terms.model, mpc, which)) for which in (FIRST, LATER)
        ]
        """Solvers of a vehicle's first plan, and of later ones; others may take their places."""
        self._stopwatch = stopwatch
        self._memory = PlanMemory(
            inputs=np.zeros((2, capacity, axes, H), dtype=np.float32),
            start=np.zeros((capacity, axes, 2)),
            step=np.full(capacity, -1, dtype=np.int64),
            bounded=np.zeros(capacity, dtype=np.bool_),
        )
        self._draft = Draft(
            planned=np.zeros((block, axes, 2)),
            gradient=np.zeros((block, axes, H)),
            guess=np.zeros((block, axes, H)),
            answer=np.zeros(H),
            inputs=np.zeros((2, block, axes, H), dtype=np.float32),
            states=np.zeros((H + 1, 2)),
            drift=np.zeros((H, 2)),
            distance=np.zeros(H + 1),
        )
        self._room = make_room(H)
        self._picked = np.zeros(block, dtype=np.int64)
        self._settled = np.zeros(LANES, dtype=np.bool_)
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        """Costs of the last plans; those of a block come first."""
        self.planned = self._draft.planned
        """Planned states x_p(k+d|k-1) of the last plans [m, m/s]; shape (block, axes, 2)."""
        self.inputs = self._memory.inputs[TRACKER]
        """U of the last plan of each vehicle [m/s]; shape (capacity, axes, H)."""
        self._batch: Batch | None = None
        """Batch of the last plans."""
        self.solve_ns = -1
        """Time that planning for the last block took [ns], or -1 where nobody measures it."""

    def forget(self, row: int) -> None:
        """Make the next plan of this vehicle its first."""
        self._memory.step[row] = -1

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Plan for vehicles: generator, then tracker; `found.horizons` and `figures` are filled in.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is foreseen of them.

        Source: eqs. (14), (15).
        """
        window = self._desired.window(rows, step, found.ahead)
        batch = self._batch
        if batch is None or batch.desired is not window or batch.found is not found:
            batch = self._batch = self._batch_of(window, found)
        solver, undone = self.solvers[LATER], len(rows)
        # No isinstance: a solver derived from it may solve otherwise, and the compiled pass would
        # not ask it.
        if type(solver) is ExactSolver:
            undone = _plan(batch, rows, step, solver.work)
        if undone:
            self._plan_by_moves(batch, rows, step, undone)
        took_ns = self._stopwatch.lap("plan")
        self.solve_ns = took_ns if self._stopwatch.runs else -1

    def _batch_of(self, window: Window, found: Foresight) -> Batch:
        """Batch of these arrays, which are the same ones from step to step."""
        return Batch(
            mpc=self._mpc,
            terminal_weight=self._terminal_weight,
            compares=self._compares,
            memory=self._memory,
            draft=self._draft,
            desired=window,
            found=found,
            figures=self.figures,
            room=self._room,
            picked=self._picked,
            settled=self._settled,
        )

    def _plan_by_moves(self, batch: Batch, rows: Indices, step: Indices, undone: int) -> None:
        """Plan move by move for all vehicles, or for those `undone` that the pass has left."""
        left = np.arange(len(rows))
        if undone < len(rows):
            left = np.flatnonzero(~self.figures["solved"][: len(rows)])
        for which in (GENERATOR, TRACKER):
            _move(batch, rows, step, left, which)
            self._solve(which, left)
        _move(batch, rows, step, left, CONCLUDE)

    def _solve(self, which: int, left: Indices) -> None:
        """Solve the problems posed in the draft for some vehicles of the block, by index."""
        draft = self._draft
        fresh = self.figures["fresh"][left]
        for some, solver in zip((left[fresh], left[~fresh]), self.solvers, strict=True):
            if len(some):
                inputs, solved = solver.solve(draft.gradient[some], draft.guess[some])
                draft.inputs[which, some] = inputs
                self.figures["solved"][some] &= solved


@inline
def _begin(memory: PlanMemory, ahead: int, plan: PlanFigures, row: int, k: int) -> None:
    """Note what a plan starts from, in its record of FIGURES, and whether it begins anew."""
    last, start = memory.step[row], k + ahead
    plan.row, plan.step, plan.start, plan.gap = row, k, start, start - last
    plan.solved = True
    # Behind a gap longer than H nothing of the last plan is left to go on from (E17).
    plan.fresh = last < 0 or not 0 <= start - last <= memory.inputs.shape[3]


@inline
def _planned(mpc: MPC, memory: PlanMemory, plan: PlanFigures, axis: int) -> tuple[float, float]:
    """Planned state x_p(k|k-1) on one axis: where the generator's last plan leads at `plan.gap`.

    Source: eq. (14).
    """
    model, u = axis_at(mpc.model, axis), memory.inputs[GENERATOR, plan.row, axis]
    p, v = memory.start[plan.row, axis, 0], memory.start[plan.row, axis, 1]
    for stage in range(plan.gap):
        p, v = advance(model, p, v, u[stage])
    return p, v


@inline
def _pose_generator(
    mpc: MPC,
    memory: PlanMemory,
    draft: Draft,
    desired: Window,
    found: Foresight,
    plan: PlanFigures,
    i: int,
    at: int,
    axis: int,
) -> None:
    """Pose the generator's problem on one axis of vehicle `i` of the block, at draft `at`.

    Source: eq. (14).
    """
    row, gap, fresh, H = plan.row, plan.gap, plan.fresh, memory.inputs.shape[3]
    if fresh:
        x = (found.start[i, axis, 0], found.start[i, axis, 1])
    else:
        x = _planned(mpc, memory, plan, axis)
    draft.planned[i, axis, 0], draft.planned[i, axis, 1] = x
    place, first = desired.place[i], desired.first[i]
    target = desired.states[place, axis, first : first + H + 1]
    previous, g = memory.inputs[GENERATOR, row, axis], draft.gradient[at, axis]
    # The generator plans for no vehicle in particular, and so for no disturbance.
    lead(mpc, axis, x, 0.0, target, draft.drift)
    which = FIRST if fresh else LATER
    gradient(mpc, axis, which, 0.0, target, previous, gap, fresh, draft.drift, g)


@inline
def _pose_tracker(
    mpc: MPC,
    memory: PlanMemory,
    draft: Draft,
    found: Foresight,
    plan: PlanFigures,
    i: int,
    at: int,
    axis: int,
) -> None:
    """Pose the tracker's problem on one axis, behind the generator's answer in the draft.

    Source: eq. (15).
    """
    u, states = draft.inputs[GENERATOR, at, axis], draft.states
    x = (found.start[i, axis, 0], found.start[i, axis, 1])
    planned = (draft.planned[i, axis, 0], draft.planned[i, axis, 1])
    previous, g = memory.inputs[TRACKER, plan.row, axis], draft.gradient[at, axis]
    which, w, gap = FIRST if plan.fresh else LATER, found.disturbance[i, axis], plan.gap
    follow(mpc, axis, x, w, planned, u, states, draft.drift)
    gradient(mpc, axis, which, w, states, previous, gap, plan.fresh, draft.drift, g)


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
    planned_p, planned_v = _planned(mpc, memory, plan, axis)
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


@inline
def _finish(mpc: MPC, draft: Draft, plan: PlanFigures, compares: bool, at: int, axis: int) -> None:
    """Find the slope at the tracker's answer on one axis, where plans are compared."""
    if compares:
        u, which = draft.inputs[TRACKER, at, axis], FIRST if plan.fresh else LATER
        slope(mpc, axis, which, u, draft.gradient[at, axis], draft.drift)


@lanes
def _copy(numbers: Inputs, to: Inputs) -> None:
    """Put numbers into the beginning of an array."""
    for i in range(len(numbers)):
        to[i] = numbers[i]


@inline
def _conclude(
    mpc: MPC,
    terminal_weight: F1,
    compares: bool,
    memory: PlanMemory,
    draft: Draft,
    found: Foresight,
    plan: PlanFigures,
    i: int,
    at: int,
) -> None:
    """Appraise the plan of vehicle `i`, with V(k) among its figures, and remember it.

    Source: eq. (16).
    """
    axes, H, P = len(mpc.model), memory.inputs.shape[3], terminal_weight
    row, d, state_gap, cost = plan.row, found.ahead[i], 0.0, 0.0
    # Beyond that a plan is never flown: what was sent would seem to end too early at every step.
    change = draft.guess[at, 0, : found.flown[i]]
    distance, furthest = draft.distance, 0.0
    sure, doubted = 1.0, 0.0
    if compares:
        for stage in range(H + 1):
            distance[stage] = 0.0
    for axis in range(axes):
        u = draft.inputs[TRACKER, at, axis]
        off_p = found.start[i, axis, 0] - draft.planned[i, axis, 0]
        off_v = found.start[i, axis, 1] - draft.planned[i, axis, 1]
        state_gap += off_p * off_p * P[0] + off_v * off_v * P[1]
        if compares:
            steep = draft.gradient[at, axis]
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
        _copy(found.committed[i, axis, :d], found.horizons[i, axis])
        _copy(u, found.horizons[i, axis, d:])
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
            _copy(draft.inputs[which, at, axis], memory.inputs[which, row, axis])
        memory.start[row, axis, 0] = draft.planned[i, axis, 0]
        memory.start[row, axis, 1] = draft.planned[i, axis, 1]
    # A first plan that failed is no plan to go on from.
    memory.step[row] = plan.start if plan.solved or not plan.fresh else -1


@inline
def _solve_exactly(
    mpc: MPC,
    memory: PlanMemory,
    draft: Draft,
    plan: PlanFigures,
    which: int,
    axis: int,
    work: Workspace,
) -> bool:
    """Solve a problem posed at draft 0; whether that came to an end."""
    previous, u = memory.inputs[which, plan.row, axis], draft.answer
    weights, gap, fresh = FIRST if plan.fresh else LATER, plan.gap, plan.fresh
    g = draft.gradient[0, axis]
    solved = active_set(mpc, axis, weights, work, g, previous, gap, fresh, u) > 0
    _copy(u, draft.inputs[which, 0, axis])
    return solved


@part
def _plan_one(batch: Batch, i: int, work: Workspace) -> bool:
    """Plan for vehicle `i` of the block, which has begun; whether it is solved."""
    mpc, terminal_weight, compares, memory = batch[:4]
    draft, desired, found, figures = batch[4:8]
    plan = figures[i]
    plan.solved = True
    for axis in range(len(mpc.model)):
        _pose_generator(mpc, memory, draft, desired, found, plan, i, 0, axis)
        if not _solve_exactly(mpc, memory, draft, plan, GENERATOR, axis, work):
            plan.solved = False
            break
        _pose_tracker(mpc, memory, draft, found, plan, i, 0, axis)
        if not _solve_exactly(mpc, memory, draft, plan, TRACKER, axis, work):
            plan.solved = False
            break
        _finish(mpc, draft, plan, compares, 0, axis)
    if plan.solved:
        _conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, 0)
    return plan.solved


@part
def _put_in(
    memory: PlanMemory, to: Lanes, plan: PlanFigures, which: int, axis: int, lane: int
) -> None:
    """Put the horizon of the step before into a lane."""
    previous, gap = memory.inputs[which, plan.row, axis], plan.gap
    # As `shifted` does, without asking at each stage where the horizon ends.
    H = len(previous)
    for stage in range(H - gap):
        to.previous[stage, lane] = previous[stage + gap]
    for stage in range(H - gap, H):
        to.previous[stage, lane] = previous[H - 1]


@part
def _take_out(numbers: F2, lane: int, to: Inputs) -> None:
    """Take one number for each stage out of a lane."""
    for stage in range(len(to)):
        to[stage] = numbers[stage, lane]


@part
def _plan_lanes(batch: Batch, picked: I1, work: Workspace) -> None:
    """Plan for as many vehicles as there are lanes, none of them at its first plan.

    Args:
        batch: the block; `settled` is filled in.
        picked: vehicle in each lane, by its place in the block; shape (LANES,).
        work: of the exact solver.
    """
    mpc, terminal_weight, compares, memory = batch[:4]
    draft, desired, found, figures, room, _, settled = batch[4:]
    to, H = lanes_in(room), memory.inputs.shape[3]
    for lane in range(LANES):
        settled[lane], memory.bounded[figures[picked[lane]].row] = True, False
    for axis in range(len(mpc.model)):
        free = work.stages[LATER, axis, FREE]
        for lane in range(LANES):
            i = picked[lane]
            plan, place, first = figures[i], desired.place[i], desired.first[i]
            x = _planned(mpc, memory, plan, axis)
            draft.planned[i, axis, 0], draft.planned[i, axis, 1] = x[0], x[1]
            to.p[lane], to.v[lane], to.w[lane] = x[0], x[1], 0.0
            for stage in range(H + 1):
                to.target_p[stage, lane] = desired.states[place, axis, first + stage, 0]
                to.target_v[stage, lane] = desired.states[place, axis, first + stage, 1]
            _put_in(memory, to, plan, GENERATOR, axis, lane)
        side_by_side.lead(mpc, axis, to)
        side_by_side.gradient(mpc, axis, to, to.target_v)
        side_by_side.active_sets(mpc, axis, to, free, settled)
        for lane in range(LANES):
            i = picked[lane]
            to.p[lane], to.v[lane] = found.start[i, axis, 0], found.start[i, axis, 1]
            planned = draft.planned[i, axis]
            to.led_p[lane], to.led_v[lane] = planned[0], planned[1]
            to.w[lane] = found.disturbance[i, axis]
            memory.bounded[figures[i].row] |= to.held[lane] > 0.0
            _take_out(to.inputs, lane, draft.inputs[GENERATOR, i, axis])
            _put_in(memory, to, figures[i], TRACKER, axis, lane)
        side_by_side.follow(mpc, axis, to)
        side_by_side.gradient(mpc, axis, to, to.states_v)
        side_by_side.active_sets(mpc, axis, to, free, settled)
        if compares:
            side_by_side.slope(mpc, axis, to)
        for lane in range(LANES):
            i = picked[lane]
            memory.bounded[figures[i].row] |= to.held[lane] > 0.0
            _take_out(to.inputs, lane, draft.inputs[TRACKER, i, axis])
            if compares:
                _take_out(to.gradient, lane, draft.gradient[i, axis])
    for lane in range(LANES):
        i = picked[lane]
        if settled[lane]:
            plan = figures[i]
            _conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, i)


@kernel
def _plan(batch: Batch, rows: I1, steps: I1, work: Workspace) -> int:
    """Plan for vehicles with the exact solver, see `Planner.plan`; how many have to be left.

    Those have no `solved` in their figures, and are as they were.
    """
    memory, found, figures = batch.memory, batch.found, batch.figures
    picked, settled, undone = batch.picked, batch.settled, 0
    # A round of lanes without a bound takes a third of the time of one with a bound in any lane, so
    # those that were at a bound share theirs: the others are picked from the front, these from the
    # back.
    waiting, last = 0, len(rows)
    for i in range(len(rows)):
        _begin(memory, found.ahead[i], figures[i], rows[i], steps[i])
        if figures[i].fresh:
            # Lanes have the LATER weights in common; a first plan has others (E8), and is rare.
            undone += not _plan_one(batch, i, work)
        elif memory.bounded[rows[i]]:
            last -= 1
            picked[last] = i
        else:
            picked[waiting] = i
            waiting += 1
    for at in range(last, len(rows)):
        picked[waiting] = picked[at]
        waiting += 1
    first = 0
    while waiting - first >= LANES:
        group = picked[first : first + LANES]
        _plan_lanes(batch, group, work)
        for lane in range(LANES):
            if not settled[lane]:
                undone += not _plan_one(batch, group[lane], work)
        first += LANES
    # Too few are left for a group of lanes; alone each gets the same bits
    # (tests/server/test_planner.py).
    for at in range(first, waiting):
        undone += not _plan_one(batch, picked[at], work)
    return undone


@part
def _guess(memory: PlanMemory, plan: PlanFigures, which: int, guess: F2) -> None:
    """Fill in the guess of a solver that is no part of the pass: the horizon before, shifted."""
    for axis in range(len(guess)):
        previous = memory.inputs[which, plan.row, axis]
        for stage in range(guess.shape[1]):
            guess[axis, stage] = shifted(previous, plan.gap, plan.fresh, stage)


@kernel
def _move(batch: Batch, rows: I1, steps: I1, left: I1, move: int) -> None:
    """Make one move for those `left` in a block, by index: pose for an MPC, or CONCLUDE."""
    mpc, terminal_weight, compares, memory = batch[:4]
    draft, desired, found, figures = batch[4:8]
    for i in left:
        plan = figures[i]
        if move == CONCLUDE:
            for axis in range(len(mpc.model)):
                _finish(mpc, draft, plan, compares, i, axis)
            _conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, i)
            continue
        if move == GENERATOR:
            _begin(memory, found.ahead[i], plan, rows[i], steps[i])
        _guess(memory, plan, move, draft.guess[i])
        for axis in range(len(mpc.model)):
            if move == GENERATOR:
                _pose_generator(mpc, memory, draft, desired, found, plan, i, i, axis)
            else:
                _pose_tracker(mpc, memory, draft, found, plan, i, i, axis)
