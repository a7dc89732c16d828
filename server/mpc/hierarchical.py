"""Hierarchical MPC of section 4.1: trajectory generator, eq. (14), then tracker, eq. (15).

Both are the MPC of eq. (9), one after the other: each starts from its own horizon of the step
before. The generator plans from its own last prediction and never looks at the UAV (E17); the
tracker leads the UAV's estimated state along the generator's plan. On the way the new plan is
compared with what was sent: V of eq. (16), and the cost and the deviation of flying on with that.

With the exact solver, all of that is one compiled pass over several vehicles side by side, or over
one (`server.mpc.problem`). Another solver, or one that has to help out, is asked in between: pose
the generator's problem, solve; pose the tracker's, solve; conclude.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.common.desired import Desired, Window
from skytether.server.common.scheme import FIGURES, Figures, Foresight
from skytether.server.mpc.appraisal import (
    GENERATOR,
    TRACKER,
    Draft,
    PlanMemory,
    begin,
    conclude,
    planned_state,
)
from skytether.server.mpc.exact import ExactSolver, Workspace, active_sets
from skytether.server.mpc.problem import (
    FIRST,
    LATER,
    MPC,
    WIDTH,
    Problem,
    SimdBatch,
    column,
    follow,
    gradient,
    lead,
    make_mpc,
    pose,
    set_inputs,
    set_previous,
    set_target,
    simd_batch,
    simd_memory,
    slope,
)
from skytether.server.mpc.solver import Solver
from skytether.shared.base.kernel import B1, F1, F3, I1, kernel, part
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
    together: F3
    """Scratch of WIDTH vehicles side by side, see `mpc.simd_memory`."""
    alone: F3
    """Scratch of one vehicle."""
    single: I1
    """Scratch: one vehicle by its place in the block; shape (1,)."""
    picked: I1
    """Scratch: vehicles by their places in the block, in the order in which they are planned for;
    shape (block,)."""
    settled: B1
    """Scratch: whether the plan of each is found; shape (WIDTH,)."""


def make_solver(control: ControlConfig, problem: Problem) -> Solver:
    """The solver that a scenario names."""
    if control.solver == "exact":
        return ExactSolver(problem)
    # OSQP brings scipy, which takes 0.2 s and 40 MB.
    from skytether.server.mpc.osqp_solver import OsqpSolver

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
            inputs=np.zeros((2, block, axes, H), dtype=np.float32),
            distance=np.zeros(H + 1),
        )
        self._together, self._alone = simd_memory(H, WIDTH), simd_memory(H, 1)
        self._single = np.zeros(1, dtype=np.int64)
        self._picked = np.zeros(block, dtype=np.int64)
        self._settled = np.zeros(WIDTH, dtype=np.bool_)
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
            self._plan_with_solvers(batch, rows, step, undone)
        took_ns = self._stopwatch.lap("plan")
        self.solve_ns = took_ns if self._stopwatch.runs else -1

    def _batch_of(self, window: Window, found: Foresight) -> Batch:
        """Arguments of the planning kernels in one tuple, of the same arrays at every step."""
        return Batch(
            mpc=self._mpc,
            terminal_weight=self._terminal_weight,
            compares=self._compares,
            memory=self._memory,
            draft=self._draft,
            desired=window,
            found=found,
            figures=self.figures,
            together=self._together,
            alone=self._alone,
            single=self._single,
            picked=self._picked,
            settled=self._settled,
        )

    def _plan_with_solvers(self, batch: Batch, rows: Indices, step: Indices, undone: int) -> None:
        """Plan with the solvers for all vehicles, or for those `undone` that the pass has left."""
        left = np.arange(len(rows))
        if undone < len(rows):
            left = np.flatnonzero(~self.figures["solved"][: len(rows)])
        for tier in (GENERATOR, TRACKER):
            _pose(batch, rows, step, left, tier)
            self._solve(tier, left)
        _conclude_all(batch, left)

    def _solve(self, tier: int, left: Indices) -> None:
        """Solve the problems posed in the draft for some vehicles of the block, by index."""
        draft = self._draft
        fresh = self.figures["fresh"][left]
        for some, solver in zip((left[fresh], left[~fresh]), self.solvers, strict=True):
            if len(some):
                inputs, solved = solver.solve(draft.gradient[some], draft.guess[some])
                draft.inputs[tier, some] = inputs
                self.figures["solved"][some] &= solved


@part
def _pose_generator(batch: Batch, simd: SimdBatch, some: I1, which: int, axis: int) -> None:
    """Pose the generator's problem on one axis for some vehicles, by their places in the block.

    Source: eq. (14).
    """
    mpc, memory, draft, desired, found = (
        batch.mpc,
        batch.memory,
        batch.draft,
        batch.desired,
        batch.found,
    )
    H = memory.inputs.shape[3]
    for lane in range(len(some)):
        i = some[lane]
        plan, page, first = batch.figures[i], desired.place[i], desired.first[i]
        x = (found.start[i, axis, 0], found.start[i, axis, 1])
        if not plan.fresh:
            x = planned_state(mpc, memory, plan, axis)
        draft.planned[i, axis, 0], draft.planned[i, axis, 1] = x
        # The generator plans for no vehicle in particular, and so for no disturbance.
        simd.p[lane], simd.v[lane], simd.w[lane] = x[0], x[1], 0.0
        set_target(desired.states[page, axis, first : first + H + 1], simd, lane)
        before = memory.inputs[GENERATOR, plan.row, axis]
        set_previous(before, plan.gap, plan.fresh, simd, lane)
    lead(mpc, axis, simd)
    gradient(mpc, axis, which, simd, simd.target_v)


@part
def _pose_tracker(batch: Batch, simd: SimdBatch, some: I1, which: int, axis: int) -> None:
    """Pose the tracker's problem on one axis, with the generator's answer in `simd.inputs`.

    Source: eq. (15).
    """
    mpc, memory, draft, found = batch.mpc, batch.memory, batch.draft, batch.found
    for lane in range(len(some)):
        i = some[lane]
        plan = batch.figures[i]
        simd.p[lane], simd.v[lane] = found.start[i, axis, 0], found.start[i, axis, 1]
        planned = draft.planned[i, axis]
        simd.leader_p[lane], simd.leader_v[lane] = planned[0], planned[1]
        simd.w[lane] = found.disturbance[i, axis]
        before = memory.inputs[TRACKER, plan.row, axis]
        set_previous(before, plan.gap, plan.fresh, simd, lane)
    follow(mpc, axis, simd)
    gradient(mpc, axis, which, simd, simd.leader_speed)


@part
def _keep(batch: Batch, simd: SimdBatch, some: I1, tier: int, axis: int) -> None:
    """Keep the answers of generator or tracker on one axis, as they are sent."""
    for lane in range(len(some)):
        i = some[lane]
        batch.memory.bounded[batch.figures[i].row] |= simd.held[lane] > 0.0
        column(simd.inputs, lane, batch.draft.inputs[tier, i, axis])


@part
def _plan_some(batch: Batch, memory: F3, some: I1, which: int, work: Workspace) -> int:
    """Plan for some vehicles, side by side, which have begun; how many are not solved.

    Args:
        batch: the block.
        memory: of a `SimdBatch` of as many vehicles.
        some: the vehicles, by their places in the block; shape (L,).
        which: weights of all of them, FIRST or LATER.
        work: of the exact solver.
    """
    mpc, draft, figures, compares = batch.mpc, batch.draft, batch.figures, batch.compares
    simd, settled, undone = simd_batch(memory), batch.settled[: len(some)], 0
    for lane in range(len(some)):
        settled[lane], batch.memory.bounded[figures[some[lane]].row] = True, False
    for axis in range(len(mpc.model)):
        _pose_generator(batch, simd, some, which, axis)
        active_sets(mpc, axis, which, simd, work.free, settled)
        _keep(batch, simd, some, GENERATOR, axis)
        _pose_tracker(batch, simd, some, which, axis)
        active_sets(mpc, axis, which, simd, work.free, settled)
        _keep(batch, simd, some, TRACKER, axis)
        if compares:
            slope(mpc, axis, which, simd)
            for lane in range(len(some)):
                column(simd.gradient, lane, draft.gradient[some[lane], axis])
    for lane in range(len(some)):
        i = some[lane]
        figures[i].solved = settled[lane]
        if settled[lane]:
            _conclude(batch, i)
        else:
            undone += 1
    return undone


@part
def _conclude(batch: Batch, i: int) -> None:
    """Appraise the plan of a vehicle, and remember it."""
    conclude(
        batch.mpc,
        batch.terminal_weight,
        batch.compares,
        batch.memory,
        batch.draft,
        batch.found,
        batch.figures[i],
        i,
    )


@kernel
def _plan(batch: Batch, rows: I1, steps: I1, work: Workspace) -> int:
    """Plan for vehicles with the exact solver, see `Planner.plan`; how many have to be left.

    Those have no `solved` in their figures, and are as they were.
    """
    memory, found, figures = batch.memory, batch.found, batch.figures
    picked, undone = batch.picked, 0
    # A round without a bound takes a third of the time of one with a bound for any vehicle, so
    # those that were at a bound share theirs: the others are picked from the front, these from the
    # back.
    waiting, last = 0, len(rows)
    for i in range(len(rows)):
        begin(memory, found.ahead[i], figures[i], rows[i], steps[i])
        if figures[i].fresh:
            # All in a batch have the same weights; a first plan has others (E8), and is rare.
            batch.single[0] = i
            undone += _plan_some(batch, batch.alone, batch.single, FIRST, work)
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
    while waiting - first >= WIDTH:
        undone += _plan_some(batch, batch.together, picked[first : first + WIDTH], LATER, work)
        first += WIDTH
    # Too few are left for a whole batch; alone each gets the same bits
    # (tests/mpc/test_hierarchical.py).
    for at in range(first, waiting):
        undone += _plan_some(batch, batch.alone, picked[at : at + 1], LATER, work)
    return undone


@kernel
def _pose(batch: Batch, rows: I1, steps: I1, left: I1, tier: int) -> None:
    """Pose the generator's or the tracker's problems of those `left` for another solver."""
    draft, simd, single = batch.draft, simd_batch(batch.alone), batch.single
    for i in left:
        plan, single[0] = batch.figures[i], i
        if tier == GENERATOR:
            begin(batch.memory, batch.found.ahead[i], plan, rows[i], steps[i])
        which = FIRST if plan.fresh else LATER
        for axis in range(len(batch.mpc.model)):
            if tier == GENERATOR:
                _pose_generator(batch, simd, single, which, axis)
            else:
                set_inputs(draft.inputs[GENERATOR, i, axis], simd, 0)
                _pose_tracker(batch, simd, single, which, axis)
            column(simd.gradient, 0, draft.gradient[i, axis])
            column(simd.previous, 0, draft.guess[i, axis])


@kernel
def _conclude_all(batch: Batch, left: I1) -> None:
    """Appraise and remember the plans of those `left`, which another solver has solved."""
    draft, simd = batch.draft, simd_batch(batch.alone)
    for i in left:
        which = FIRST if batch.figures[i].fresh else LATER
        for axis in range(len(batch.mpc.model)):
            if batch.compares:
                set_inputs(draft.inputs[TRACKER, i, axis], simd, 0)
                for stage in range(len(simd.gradient)):
                    simd.gradient[stage, 0] = draft.gradient[i, axis, stage]
                slope(batch.mpc, axis, which, simd)
                column(simd.gradient, 0, draft.gradient[i, axis])
        _conclude(batch, i)
