"""Hierarchical MPC of section 4.1: trajectory generator, eq. (14), then tracker, eq. (15).

Both are the MPC of eq. (9), one after the other, each warm-started from its own previous plan. The
generator plans from its own last prediction and never uses the vehicle's state (E17); the tracker
controls the vehicle's estimated state along the generator's plan. The figures of a plan are V of
eq. (16), and the cost and the deviation of a flight with the inputs sent before.

With the exact solver all of this is one compiled pass for one or several vehicles
(`server.mpc.problem`). With any other solver there are five steps: set up and solve the generator's
QP; set up and solve the tracker's QP; compute the figures.
"""

from typing import NamedTuple

import numpy as np

from skytether.server.mpc.appraisal import (
    GENERATOR,
    TRACKER,
    Draft,
    PlanMemory,
    begin,
    conclude,
    planned_state,
)
from skytether.server.mpc.exact import ExactSolver
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
from skytether.server.mpc.riccati import RiccatiWorkspace, active_sets
from skytether.server.mpc.solver import Solver
from skytether.server.planning.desired import Desired, Window
from skytether.server.planning.scheme import FIGURES, Figures, Foresight
from skytether.shared.base.kernel import B1, F1, F3, I1, kernel, part
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.model import Flags, Indices
from skytether.shared.law.terms import COMMITTING, Terms
from skytether.shared.scenario.schema import ControlConfig


class PlanBatch(NamedTuple):
    """Arguments of the planning kernels for a block of vehicles."""

    mpc: MPC
    terminal_weight: F1
    """Terminal weight P on position and velocity; shape (2,)."""
    compares: bool
    """Whether plans are compared with the inputs sent before (known to some schemes only)."""
    memory: PlanMemory
    draft: Draft
    desired: Window
    foresight: Foresight
    figures: Figures
    together: F3
    """Scratch memory for WIDTH vehicles, see `problem.simd_memory`."""
    alone: F3
    single: I1
    """Scratch: index of one vehicle in the block; shape (1,)."""
    picked: I1
    """Scratch: indices of vehicles in the block, in the order of planning; shape (block,)."""
    settled: B1
    """Scratch: whether each plan is solved; shape (WIDTH,)."""


def make_solver(control: ControlConfig, problem: Problem) -> Solver:
    if control.solver == "exact":
        return ExactSolver(problem)
    # Imported here, because OSQP needs scipy, which takes 0.2 s and 40 MB.
    from skytether.server.mpc.osqp_solver import OsqpSolver

    return OsqpSolver(problem)


class Planner:
    """Trajectory generator and tracker of up to `capacity` vehicles, in blocks of `block`."""

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
        self._compares = terms.scheme in COMMITTING
        self.solvers = [
            make_solver(control, pose(terms.model, mpc, which)) for which in (FIRST, LATER)
        ]
        """Solvers for a vehicle's first plan and for later plans; may be replaced."""
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
        """Figures of the latest plans, in the first rows; shape (block,)."""
        self.planned = self._draft.planned
        """Planned states x_p(k+d|k-1) of the latest plans [m, m/s]; shape (block, axes, 2)."""
        self.inputs = self._memory.inputs[TRACKER]
        """Latest planned inputs U of each vehicle [m/s]; shape (capacity, axes, H)."""
        self._batch: PlanBatch | None = None
        self.solve_ns = -1
        """Time that planning for the last block took [ns], or -1 if not measured."""

    def forget(self, row: int) -> None:
        self._memory.step[row] = -1

    def remember(self, rows: Indices, event: Flags) -> None:
        """Do nothing: the MPC continues from every plan, whether it was sent or not."""

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Plan with generator, then tracker; fills in `foresight.horizons` and `figures`.

        Source: eqs. (14), (15).
        """
        window = self._desired.window(rows, step, foresight.ahead)
        batch = self._batch
        if batch is None or batch.desired is not window or batch.foresight is not foresight:
            batch = self._batch = self._batch_of(window, foresight)
        self._plan_all(batch, rows, step)
        took_ns = self._stopwatch.lap("plan")
        self.solve_ns = took_ns if self._stopwatch.runs else -1

    def _plan_all(self, batch: PlanBatch, rows: Indices, step: Indices) -> None:
        solver, undone = self.solvers[LATER], len(rows)
        # Derived classes are excluded, because the compiled pass would not call their `solve`.
        if type(solver) is ExactSolver:
            undone = _plan(batch, rows, step, solver.work)
        if undone:
            self._plan_with_solvers(batch, rows, step, undone)

    def _batch_of(self, window: Window, foresight: Foresight) -> PlanBatch:
        return PlanBatch(
            mpc=self._mpc,
            terminal_weight=self._terminal_weight,
            compares=self._compares,
            memory=self._memory,
            draft=self._draft,
            desired=window,
            foresight=foresight,
            figures=self.figures,
            together=self._together,
            alone=self._alone,
            single=self._single,
            picked=self._picked,
            settled=self._settled,
        )

    def _plan_with_solvers(
        self, batch: PlanBatch, rows: Indices, step: Indices, undone: int
    ) -> None:
        """Plan with `solvers` for all vehicles, or for the vehicles whose QP the compiled pass has
        not solved.
        """
        left = np.arange(len(rows))
        if undone < len(rows):
            left = np.flatnonzero(~self.figures["solved"][: len(rows)])
        for tier in (GENERATOR, TRACKER):
            _pose(batch, rows, step, left, tier)
            self._solve(tier, left)
        _conclude_all(batch, left, True)

    def _solve(self, tier: int, left: Indices) -> None:
        draft = self._draft
        fresh = self.figures["fresh"][left]
        for group, solver in zip((left[fresh], left[~fresh]), self.solvers, strict=True):
            if len(group):
                inputs, solved = solver.solve(draft.gradient[group], draft.guess[group])
                draft.inputs[tier, group] = inputs
                self.figures["solved"][group] &= solved


@part
def _pose_generator(batch: PlanBatch, simd: SimdBatch, indices: I1, which: int, axis: int) -> None:
    """Set up the generator's QPs on one axis for vehicles, given by index in the block.

    Source: eq. (14).
    """
    mpc, memory, draft, desired, foresight = (
        batch.mpc,
        batch.memory,
        batch.draft,
        batch.desired,
        batch.foresight,
    )
    H = memory.inputs.shape[3]
    for lane in range(len(indices)):
        i = indices[lane]
        plan, page, first = batch.figures[i], desired.place[i], desired.first[i]
        x = (foresight.start[i, axis, 0], foresight.start[i, axis, 1])
        if not plan.fresh:
            x = planned_state(mpc, memory, plan, axis)
        draft.planned[i, axis, 0], draft.planned[i, axis, 1] = x
        # The generator uses neither the vehicle's state nor its disturbance.
        simd.p[lane], simd.v[lane], simd.w[lane] = x[0], x[1], 0.0
        set_target(desired.states[page, axis, first : first + H + 1], simd, lane)
        before = memory.inputs[GENERATOR, plan.row, axis]
        set_previous(before, plan.gap, plan.fresh, simd, lane)
    lead(mpc, axis, simd)
    gradient(mpc, axis, which, simd, simd.target_v)


@part
def _pose_tracker(batch: PlanBatch, simd: SimdBatch, indices: I1, which: int, axis: int) -> None:
    """Set up the tracker's QPs on one axis; `simd.inputs` has the generator's solutions.

    Source: eq. (15).
    """
    mpc, memory, draft, foresight = batch.mpc, batch.memory, batch.draft, batch.foresight
    for lane in range(len(indices)):
        i = indices[lane]
        plan = batch.figures[i]
        simd.p[lane], simd.v[lane] = foresight.start[i, axis, 0], foresight.start[i, axis, 1]
        planned = draft.planned[i, axis]
        simd.leader_p[lane], simd.leader_v[lane] = planned[0], planned[1]
        simd.w[lane] = foresight.disturbance[i, axis]
        before = memory.inputs[TRACKER, plan.row, axis]
        set_previous(before, plan.gap, plan.fresh, simd, lane)
    follow(mpc, axis, simd)
    gradient(mpc, axis, which, simd, simd.leader_speed)


@part
def _keep(batch: PlanBatch, simd: SimdBatch, indices: I1, tier: int, axis: int) -> None:
    """Store the generator's or tracker's solutions on one axis, rounded as sent."""
    for lane in range(len(indices)):
        i = indices[lane]
        batch.memory.bounded[batch.figures[i].row] |= simd.active[lane] > 0.0
        column(simd.inputs, lane, batch.draft.inputs[tier, i, axis])


@part
def _plan_some(
    batch: PlanBatch, memory: F3, indices: I1, which: int, work: RiccatiWorkspace
) -> int:
    """Plan together for vehicles given by index; returns the number of unsolved plans."""
    mpc, draft, figures, compares = batch.mpc, batch.draft, batch.figures, batch.compares
    simd, settled, undone = simd_batch(memory), batch.settled[: len(indices)], 0
    for lane in range(len(indices)):
        settled[lane], batch.memory.bounded[figures[indices[lane]].row] = True, False
    for axis in range(len(mpc.model)):
        _pose_generator(batch, simd, indices, which, axis)
        active_sets(mpc, axis, which, simd, work.free, settled)
        _keep(batch, simd, indices, GENERATOR, axis)
        _pose_tracker(batch, simd, indices, which, axis)
        active_sets(mpc, axis, which, simd, work.free, settled)
        _keep(batch, simd, indices, TRACKER, axis)
        if compares:
            slope(mpc, axis, which, simd)
            for lane in range(len(indices)):
                column(simd.gradient, lane, draft.gradient[indices[lane], axis])
    for lane in range(len(indices)):
        i = indices[lane]
        figures[i].solved = settled[lane]
        if settled[lane]:
            _conclude(batch, i)
        else:
            undone += 1
    return undone


@part
def _conclude(batch: PlanBatch, i: int) -> None:
    conclude(
        batch.mpc,
        batch.terminal_weight,
        batch.compares,
        batch.memory,
        batch.draft,
        batch.foresight,
        batch.figures[i],
        i,
    )


@kernel
def _plan(batch: PlanBatch, rows: I1, steps: I1, work: RiccatiWorkspace) -> int:
    """Plan with the exact solver, see `Planner.plan`; returns the number of unsolved plans.

    Data of unsolved vehicles are unchanged, except that `solved` is False in their figures.
    """
    memory, foresight, figures = batch.memory, batch.foresight, batch.figures
    picked, undone = batch.picked, 0
    # An iteration for vehicles without any input at a bound takes a third of the time. So vehicles
    # whose inputs were at a bound are grouped: they fill `picked` from the back, all others from
    # the front.
    waiting, last = 0, len(rows)
    for i in range(len(rows)):
        begin(memory, foresight.ahead[i], figures[i], rows[i], steps[i])
        if figures[i].fresh:
            # A first plan is made alone, because it has other weights (E8), and plans made together
            # need the same weights. First plans are rare.
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
    # The vehicles left are too few for a full batch. Planned alone, each gets the same plan
    # (tests/mpc/test_hierarchical.py).
    for at in range(first, waiting):
        undone += _plan_some(batch, batch.alone, picked[at : at + 1], LATER, work)
    return undone


@kernel
def _pose(batch: PlanBatch, rows: I1, steps: I1, left: I1, tier: int) -> None:
    """Set up the generator's or tracker's QPs of the vehicles `left` for `Planner.solvers`."""
    draft, simd, single = batch.draft, simd_batch(batch.alone), batch.single
    for i in left:
        plan, single[0] = batch.figures[i], i
        if tier == GENERATOR:
            begin(batch.memory, batch.foresight.ahead[i], plan, rows[i], steps[i])
        which = FIRST if plan.fresh else LATER
        for axis in range(len(batch.mpc.model)):
            if tier == GENERATOR:
                _pose_generator(batch, simd, single, which, axis)
            else:
                set_inputs(draft.inputs[GENERATOR, i, axis], simd, 0)
                _pose_tracker(batch, simd, single, which, axis)
            column(simd.gradient, 0, draft.gradient[i, axis])
            column(simd.previous, 0, draft.guess[i, axis])


def start_plans(batch: PlanBatch, rows: Indices, step: Indices) -> None:
    """Set the steps of a plug-in's plans, and `draft.guess` to the shifted previous plans."""
    _pose(batch, rows, step, np.arange(len(rows)), GENERATOR)


def conclude_given(batch: PlanBatch, n: int) -> None:
    """Compare a plug-in's plans with the inputs sent before, assuming slope 0; store the plans."""
    batch.draft.gradient[:n] = 0.0
    _conclude_all(batch, np.arange(n), False)


@kernel
def _conclude_all(batch: PlanBatch, left: I1, sloping: bool) -> None:
    """Fill in figures and store plans; `sloping`: whether `draft.gradient` has g, not the slope."""
    draft, simd = batch.draft, simd_batch(batch.alone)
    for i in left:
        which = FIRST if batch.figures[i].fresh else LATER
        for axis in range(len(batch.mpc.model)):
            if batch.compares and sloping:
                set_inputs(draft.inputs[TRACKER, i, axis], simd, 0)
                for stage in range(len(simd.gradient)):
                    simd.gradient[stage, 0] = draft.gradient[i, axis, stage]
                slope(batch.mpc, axis, which, simd)
                column(simd.gradient, 0, draft.gradient[i, axis])
        _conclude(batch, i)
