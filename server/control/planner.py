"""Hierarchical MPC of section 4.1: trajectory generator, eq. (14), then tracker, eq. (15).

Both are the MPC of eq. (9), one after the other: each starts from its own horizon of the step
before. The generator plans from its own last prediction and never looks at the UAV (E17); the
tracker leads the UAV's estimated state along the generator's plan. On the way the new plan is
compared with what was sent: V of eq. (16), and the cost and the deviation of flying on with that.

With the exact solver, all of that is one compiled pass over a vehicle, which touches no more memory
than a horizon takes, or over several side by side (`server.control.lanes`). Another solver, or one
that has to help out, takes the same moves (`server.control.moves`) in turn with it: pose the
generator's problem, solve; pose the tracker's, solve; conclude.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.control import lanes as side_by_side
from skytether.server.control.desired import Desired, Window
from skytether.server.control.exact import FREE, ExactSolver, Workspace, active_set
from skytether.server.control.lanes import LANES, Lanes, lanes_in, make_room
from skytether.server.control.moves import (
    CONCLUDE,
    GENERATOR,
    TRACKER,
    Draft,
    PlanMemory,
    begin,
    conclude,
    copy,
    finish,
    planned_state,
    pose_generator,
    pose_tracker,
)
from skytether.server.control.mpc import FIRST, LATER, MPC, Inputs, Problem, make_mpc, pose, shifted
from skytether.server.control.scheme import FIGURES, Figures, Foresight, PlanFigures
from skytether.server.control.solver import Solver
from skytether.shared.base.kernel import B1, F1, F2, F3, I1, inline, kernel, part
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.model import Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig


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
    copy(u, draft.inputs[which, 0, axis])
    return solved


@part
def _plan_one(batch: Batch, i: int, work: Workspace) -> bool:
    """Plan for vehicle `i` of the block, which has begun; whether it is solved."""
    mpc, terminal_weight, compares, memory = batch[:4]
    draft, desired, found, figures = batch[4:8]
    plan = figures[i]
    plan.solved = True
    for axis in range(len(mpc.model)):
        pose_generator(mpc, memory, draft, desired, found, plan, i, 0, axis)
        if not _solve_exactly(mpc, memory, draft, plan, GENERATOR, axis, work):
            plan.solved = False
            break
        pose_tracker(mpc, memory, draft, found, plan, i, 0, axis)
        if not _solve_exactly(mpc, memory, draft, plan, TRACKER, axis, work):
            plan.solved = False
            break
        finish(mpc, draft, plan, compares, 0, axis)
    if plan.solved:
        conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, 0)
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
            x = planned_state(mpc, memory, plan, axis)
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
            conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, i)


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
        begin(memory, found.ahead[i], figures[i], rows[i], steps[i])
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
                finish(mpc, draft, plan, compares, i, axis)
            conclude(mpc, terminal_weight, compares, memory, draft, found, plan, i, i)
            continue
        if move == GENERATOR:
            begin(memory, found.ahead[i], plan, rows[i], steps[i])
        _guess(memory, plan, move, draft.guess[i])
        for axis in range(len(mpc.model)):
            if move == GENERATOR:
                pose_generator(mpc, memory, draft, desired, found, plan, i, i, axis)
            else:
                pose_tracker(mpc, memory, draft, found, plan, i, i, axis)
