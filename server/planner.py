"""Hierarchical MPC of section 4.1: trajectory generator (14), and tracker (15) behind it.

Both are the MPC of (9) in closed succession: each starts from its own horizon of the step before.
The generator plans from its own last prediction and never looks at the UAV (E17); the tracker leads
the UAV's estimated state along the generator's plan. What the new plan is worth is found out on the
way: V of eq. (16), and the cost and the deviation of flying on with what was sent.

With the exact solver, all of that is one compiled pass over a vehicle, which touches no more memory
than a horizon takes. Another solver, or one that has to help out, takes the same moves in turn with
it: pose the generator's problem, solve; pose the tracker's, solve; conclude.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from server.exact import ExactSolver, Workspace, active_set
from server.model import advance, axis_at
from server.mpc import (
    FIRST,
    LATER,
    MPC,
    Problem,
    add_cost,
    follow,
    gradient,
    lead,
    make_mpc,
    pose,
    shifted,
)
from server.scheme import Foresight
from server.solver import OsqpSolver, Solver
from shared.config import ControlConfig, Scenario
from shared.kernel import F1, F2, F3, F4, I1, inline, kernel, part, plain, record, records
from shared.model import Indices
from shared.stopwatch import Stopwatch
from shared.terms import Terms

PAGE = 128
"""Steps of the desired trajectory in a page."""
PAGES = 256
"""Places for pages: more than a block of vehicles can need at once."""
EMPTY = -1
"""In place of the page that a place holds."""
GENERATOR, TRACKER = 0, 1
"""First index of what both MPCs have."""

FIGURES = record(
    ("step", "i8"),
    ("error", "f8"),
    ("cost_gap", "f8"),
    ("deviation_m", "f8"),
    ("fresh", "?"),
    ("solved", "?"),
)
"""What is known of a vehicle once its plan is made: k; V(k) of eq. (16); the cost of flying on with
what was sent, above that of the plan; the largest distance between that and the generator's last
plan [m]; whether it is at its first step or after a gap that no plan reached over; and whether the
plan is new and right, so that it may be sent."""
Figures = Annotated[NDArray[np.void], records(FIGURES, 1)]
"""Shape (n,)."""


class Memory(NamedTuple):
    """What both MPCs remember of every vehicle."""

    inputs: F4
    """U(k-1), the horizon computed last [m/s]; shape (2, capacity, axes, H)."""
    states: F4
    """X(k-1) of the generator, behind where it was computed from [m, m/s]; shape
    (capacity, axes, H + 1, 2)."""
    step: I1
    """Step that they were computed for, or -1; shape (capacity,)."""


class Draft(NamedTuple):
    """The plans of a block of vehicles in the making."""

    planned: F3
    """Planned state x_p(k|k-1), where the generator starts [m, m/s]; shape (block, axes, 2)."""
    gradient: F3
    """Gradient g of the problem to be solved; shape (block, axes, H)."""
    guess: F3
    """Horizon of the step before, shifted [m/s]; shape (block, axes, H)."""
    inputs: F4
    """U(k) of both MPCs [m/s]; shape (2, block, axes, H)."""
    states: F4
    """X(k) of the generator [m, m/s]; shape (block, axes, H + 1, 2)."""
    drift: F2
    """Scratch of `gradient`; shape (H, 2)."""
    distance: F1
    """Scratch: squares of distances [m²]; shape (H + 1,)."""


class Given(NamedTuple):
    """What a plan starts from, besides what was foreseen."""

    mpc: MPC
    """The problem."""
    terminal_weight: F1
    """P, on position and velocity; shape (2,)."""
    compares: bool
    """Whether what was sent before is known, so that the plan can be compared with it."""


class Desired(NamedTuple):
    """The desired trajectory, looked up in pages rather than computed each time."""

    pages: F4
    """Desired states of PAGE steps, and of H more, in each page [m, m/s]; shape
    (PAGES, axes, PAGE + H + 1, 2)."""
    held: I1
    """Which page of the trajectory each is, or EMPTY; shape (PAGES,)."""


class Reference:
    """The desired trajectory at any step."""

    def __init__(self, scenario: Scenario, terms: Terms) -> None:
        self._sample = scenario.make_reference()
        self._dt_s = terms.dt_s
        self._steps = np.arange(PAGE + terms.horizon + 1)
        self._desired = Desired(
            pages=np.zeros((PAGES, terms.axes, len(self._steps), 2)),
            held=np.full(PAGES, EMPTY, dtype=np.int64),
        )

    def open(self, rows: Indices, steps: Indices, found: Foresight) -> Desired:
        """The desired trajectory, with all pages that vehicles need at their steps k + d."""
        pages, held = self._desired
        while (page := _missing(self._desired, rows, steps, found)) != EMPTY:
            if np.count_nonzero(held == EMPTY) == 1:
                held[:] = EMPTY
            at = plain(_place)(held, page)
            states = self._sample((page * PAGE + self._steps) * self._dt_s)
            pages[at], held[at] = states.transpose(1, 0, 2), page
        return self._desired


@inline
def _place(held: I1, page: int) -> int:
    """Where a page is held, or where there is room for it; one place at least must be EMPTY."""
    at = page % PAGES
    while held[at] != page and held[at] != EMPTY:
        at = (at + 1) % PAGES
    return at


@kernel
def _missing(desired: Desired, rows: I1, steps: I1, found: Foresight) -> int:
    """A page that vehicles need and that is not held, or EMPTY."""
    for i in range(len(rows)):
        page = (steps[i] + found.ahead[i]) // PAGE
        if desired.held[_place(desired.held, page)] != page:
            return page
    return EMPTY


def make_solver(control: ControlConfig, problem: Problem) -> Solver:
    """The solver that a scenario names."""
    return ExactSolver(problem) if control.solver == "exact" else OsqpSolver(problem)


class Planner:
    """Trajectory generator and tracker of up to `capacity` vehicles, `block` of them at a time."""

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        capacity: int,
        block: int,
        stopwatch: Stopwatch,
    ) -> None:
        control, axes, H = scenario.control, terms.axes, terms.horizon
        self._reference = Reference(scenario, terms)
        mpc = make_mpc(terms, control)
        self._given = Given(mpc, np.array(control.terminal_weight), terms.commits)
        self._solvers = [
            make_solver(control, pose(terms.model, mpc, which)) for which in (FIRST, LATER)
        ]
        self._stopwatch = stopwatch
        self._memory = Memory(
            inputs=np.zeros((2, capacity, axes, H)),
            states=np.zeros((capacity, axes, H + 1, 2)),
            step=np.full(capacity, -1, dtype=np.int64),
        )
        self._draft = Draft(
            planned=np.zeros((block, axes, 2)),
            gradient=np.zeros((block, axes, H)),
            guess=np.zeros((block, axes, H)),
            inputs=np.zeros((2, block, axes, H)),
            states=np.zeros((block, axes, H + 1, 2)),
            drift=np.zeros((H, 2)),
            distance=np.zeros(H + 1),
        )
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        """What the last plans are worth; those of a block come first."""
        self.planned = self._draft.planned
        """Planned states x_p(k+d|k-1) of the last plans [m, m/s]; shape (block, axes, 2)."""
        self.inputs = self._memory.inputs[TRACKER]
        """U of the last plan of each vehicle [m/s]; shape (capacity, axes, H)."""
        self.solve_ns = -1
        """How long planning for the last block took, or -1 where nobody measures it."""

    def forget(self, row: int) -> None:
        """Make the next plan of this vehicle its first."""
        self._memory.step[row] = -1

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Plan for vehicles, eq. (14), then (15); fills in `found.horizons`, `figures`, `planned`.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is foreseen of them.
        """
        desired = self._reference.open(rows, step, found)
        batch = (self._given, self._memory, self._draft, rows, step, found)
        left = np.arange(len(rows))
        solver = self._solvers[LATER]
        if type(solver) is ExactSolver:
            undone = _plan(*batch, desired, solver.work, self.figures)
            left = np.flatnonzero(~self.figures["solved"][: len(rows)]) if undone else left[:0]
        if len(left):
            _pose_generators(*batch, desired, left, self.figures)
            self._solve(GENERATOR, left)
            _pose_trackers(*batch, left, self.figures)
            self._solve(TRACKER, left)
            _conclude_all(*batch, left, self.figures)
        took_ns = self._stopwatch.lap("plan")
        self.solve_ns = took_ns if self._stopwatch.runs else -1

    def _solve(self, which: int, left: Indices) -> None:
        """Solve the problems posed in the draft for some vehicles of the block, by index."""
        draft = self._draft
        fresh = self.figures["fresh"][left]
        for some, solver in zip((left[fresh], left[~fresh]), self._solvers, strict=True):
            if len(some):
                inputs, solved = solver.solve(draft.gradient[some], draft.guess[some])
                draft.inputs[which, some] = inputs
                self.figures["solved"][some] &= solved


@part
def _rounded(u: F1) -> None:
    """Round inputs to float32: planning goes on with what the vehicle will really be told."""
    for i in range(len(u)):
        u[i] = np.float64(np.float32(u[i]))


@inline
def _appraise(memory: Memory, row: int, start: int, figures: Figures, i: int, k: int) -> int:
    """Steps since a vehicle was planned for last; notes whether its plan is to begin anew."""
    last = memory.step[row]
    gap = start - last
    figures[i].step, figures[i].solved = k, True
    figures[i].fresh = last < 0 or not 0 <= gap <= memory.inputs.shape[3]
    return gap


@inline
def _pose_generator(
    given: Given,
    memory: Memory,
    draft: Draft,
    found: Foresight,
    desired: Desired,
    i: int,
    at: int,
    row: int,
    axis: int,
    start: int,
    gap: int,
    fresh: bool,
) -> None:
    """Pose the generator's problem (14) on one axis of vehicle `i` of the block, at draft `at`."""
    H = memory.inputs.shape[3]
    if fresh:
        x = (found.start[i, axis, 0], found.start[i, axis, 1])
    else:
        x = (memory.states[row, axis, gap, 0], memory.states[row, axis, gap, 1])
    draft.planned[i, axis, 0], draft.planned[i, axis, 1] = x
    place, first = _place(desired.held, start // PAGE), start % PAGE
    target = desired.pages[place, axis, first : first + H + 1]
    previous, g = memory.inputs[GENERATOR, row, axis], draft.gradient[at, axis]
    # The generator plans for no vehicle in particular, and so for no disturbance.
    lead(given.mpc, axis, x, 0.0, target, draft.drift)
    which = FIRST if fresh else LATER
    gradient(given.mpc, axis, which, 0.0, target, previous, gap, fresh, draft.drift, g)


@inline
def _pose_tracker(
    given: Given,
    memory: Memory,
    draft: Draft,
    found: Foresight,
    i: int,
    at: int,
    row: int,
    axis: int,
    gap: int,
    fresh: bool,
) -> None:
    """Pose the tracker's problem (15) on one axis, behind the generator's answer in the draft."""
    u, states = draft.inputs[GENERATOR, at, axis], draft.states[at, axis]
    _rounded(u)
    x = (found.start[i, axis, 0], found.start[i, axis, 1])
    planned = (draft.planned[i, axis, 0], draft.planned[i, axis, 1])
    previous, g = memory.inputs[TRACKER, row, axis], draft.gradient[at, axis]
    follow(given.mpc, axis, x, found.disturbance[i, axis], planned, u, states, draft.drift)
    which, w = FIRST if fresh else LATER, found.disturbance[i, axis]
    gradient(given.mpc, axis, which, w, states, previous, gap, fresh, draft.drift, g)


@inline
def _conclude(
    given: Given,
    memory: Memory,
    draft: Draft,
    found: Foresight,
    i: int,
    at: int,
    row: int,
    start: int,
    gap: int,
    figures: Figures,
) -> None:
    """Appraise the plan of vehicle `i`, whose answers are in the draft, and remember it."""
    axes, H, P = len(given.mpc.model), memory.inputs.shape[3], given.terminal_weight
    error, cost, d = 0.0, 0.0, found.ahead[i]
    change, compared = draft.gradient[at, 0], H - gap if not figures[i].fresh else -1
    for axis in range(axes):
        u = draft.inputs[TRACKER, at, axis]
        _rounded(u)
        off_p = found.start[i, axis, 0] - draft.planned[i, axis, 0]
        off_v = found.start[i, axis, 1] - draft.planned[i, axis, 1]
        error += off_p * off_p * P[0] + off_v * off_v * P[1]
        if given.compares:
            for stage in range(H):
                change[stage] = found.held[i, axis, stage] - u[stage]
            cost = add_cost(given.mpc, axis, change, cost)
            x = (found.start[i, axis, 0], found.start[i, axis, 1])
            states = memory.states[row, axis]
            model, w, (p, v) = axis_at(given.mpc.model, axis), found.disturbance[i, axis], x
            for stage in range(compared + 1):
                away = p - states[stage + gap, 0]
                before = draft.distance[stage] if axis > 0 else 0.0
                draft.distance[stage] = before + away * away
                if stage < H:
                    p, v = advance(model, p, v, found.held[i, axis, stage] + w)
        for stage in range(d):
            found.horizons[i, axis, stage] = found.committed[i, axis, stage]
        for stage in range(H):
            found.horizons[i, axis, d + stage] = u[stage]
    furthest = 0.0
    for stage in range(compared + 1):
        furthest = max(furthest, draft.distance[stage])
    figures[i].error, figures[i].cost_gap = error, cost
    figures[i].deviation_m = np.sqrt(furthest)
    for axis in range(axes):
        memory.inputs[GENERATOR, row, axis] = draft.inputs[GENERATOR, at, axis]
        memory.inputs[TRACKER, row, axis] = draft.inputs[TRACKER, at, axis]
        memory.states[row, axis] = draft.states[at, axis]
    # A first plan that failed is no plan to go on from.
    memory.step[row] = start if figures[i].solved or not figures[i].fresh else -1


@kernel
def _plan(
    given: Given,
    memory: Memory,
    draft: Draft,
    rows: I1,
    steps: I1,
    found: Foresight,
    desired: Desired,
    work: Workspace,
    figures: Figures,
) -> int:
    """Plan for vehicles with the exact solver, see `Planner.plan`; how many have to be left.

    Those have no `solved` in their figures, and are as they were.
    """
    mpc, undone = given.mpc, 0
    for i in range(len(rows)):
        row, start = rows[i], steps[i] + found.ahead[i]
        gap = _appraise(memory, row, start, figures, i, steps[i])
        fresh = figures[i].fresh
        which = FIRST if fresh else LATER
        for axis in range(len(mpc.model)):
            g = draft.gradient[0, axis]
            _pose_generator(
                given, memory, draft, found, desired, i, 0, row, axis, start, gap, fresh
            )
            before, u = memory.inputs[GENERATOR, row, axis], draft.inputs[GENERATOR, 0, axis]
            if active_set(mpc, axis, which, work, g, before, gap, fresh, u) <= 0:
                figures[i].solved = False
                break
            _pose_tracker(given, memory, draft, found, i, 0, row, axis, gap, fresh)
            before, u = memory.inputs[TRACKER, row, axis], draft.inputs[TRACKER, 0, axis]
            if active_set(mpc, axis, which, work, g, before, gap, fresh, u) <= 0:
                figures[i].solved = False
                break
        if figures[i].solved:
            _conclude(given, memory, draft, found, i, 0, row, start, gap, figures)
        else:
            undone += 1
    return undone


@part
def _guess(
    memory: Memory, draft: Draft, which: int, i: int, row: int, gap: int, fresh: bool
) -> None:
    """Fill in the guess of a solver that is no part of the pass: the horizon before, shifted."""
    for axis in range(draft.guess.shape[1]):
        for stage in range(draft.guess.shape[2]):
            previous = memory.inputs[which, row, axis]
            draft.guess[i, axis, stage] = shifted(previous, gap, fresh, stage)


@kernel
def _pose_generators(
    given: Given,
    memory: Memory,
    draft: Draft,
    rows: I1,
    steps: I1,
    found: Foresight,
    desired: Desired,
    left: I1,
    figures: Figures,
) -> None:
    """Pose the generator's problems of those `left` in a block, by index."""
    for i in left:
        start = steps[i] + found.ahead[i]
        gap = _appraise(memory, rows[i], start, figures, i, steps[i])
        _guess(memory, draft, GENERATOR, i, rows[i], gap, figures[i].fresh)
        for axis in range(len(given.mpc.model)):
            _pose_generator(
                given,
                memory,
                draft,
                found,
                desired,
                i,
                i,
                rows[i],
                axis,
                start,
                gap,
                figures[i].fresh,
            )


@kernel
def _pose_trackers(
    given: Given,
    memory: Memory,
    draft: Draft,
    rows: I1,
    steps: I1,
    found: Foresight,
    left: I1,
    figures: Figures,
) -> None:
    """Pose the tracker's problems of those `left` in a block, by index."""
    for i in left:
        gap = steps[i] + found.ahead[i] - memory.step[rows[i]]
        _guess(memory, draft, TRACKER, i, rows[i], gap, figures[i].fresh)
        for axis in range(len(given.mpc.model)):
            fresh = figures[i].fresh
            _pose_tracker(given, memory, draft, found, i, i, rows[i], axis, gap, fresh)


@kernel
def _conclude_all(
    given: Given,
    memory: Memory,
    draft: Draft,
    rows: I1,
    steps: I1,
    found: Foresight,
    left: I1,
    figures: Figures,
) -> None:
    """Conclude the plans of those `left` in a block, by index."""
    for i in left:
        start = steps[i] + found.ahead[i]
        gap = start - memory.step[rows[i]]
        _conclude(given, memory, draft, found, i, i, rows[i], start, gap, figures)
