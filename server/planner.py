"""Hierarchical MPC of section 4.1: trajectory generator (14), and tracker (15) behind it.

Both are the MPC of (9) in closed succession: each starts from its own horizon of the step before.
The generator plans from its own last prediction and never looks at the UAV (E17); the tracker leads
the UAV's estimated state along the generator's plan.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from server.exact import ExactSolver
from server.mpc import MPC, condense, shift
from server.solver import OsqpSolver, Solver
from shared.config import ControlConfig, Scenario
from shared.model import Array, Flags, Indices, Model
from shared.reference import Reference
from shared.stopwatch import Stopwatch

WINDOW = 4096
"""Steps of the reference that are held at a time."""


def make_solver(control: ControlConfig, mpc: MPC, u_max: Array) -> Solver:
    """The solver that a scenario names, for the QPs of one MPC."""
    if control.solver == "exact":
        return ExactSolver(mpc, u_max)
    return OsqpSolver(mpc.hessian, u_max)


class Successive:
    """One MPC solved at every step, for up to `capacity` vehicles."""

    def __init__(
        self, scenario: Scenario, model: Model, capacity: int, stopwatch: Stopwatch
    ) -> None:
        control, axes, H = scenario.control, len(model.B), scenario.control.horizon
        self._stopwatch = stopwatch
        self.mpc = condense(model, control, change_weight=control.change_weight)
        self._solver = make_solver(control, self.mpc, scenario.u_max)
        # Without a horizon before there is no S-term (E8), which is another Hessian.
        self._first = condense(model, control, change_weight=0.0)
        self._first_solver = make_solver(control, self._first, scenario.u_max)
        self.inputs = np.zeros((capacity, axes, H))
        """U(k-1), the horizon computed last."""
        self.states = np.zeros((capacity, axes, H + 1, 2))
        """Where it was computed from, and X(k-1), the states predicted with it."""
        self.solve_ns = 0
        """How long solving took last, where the stopwatch runs."""

    def solve(  # noqa: PLR0917 - all that a plan starts from
        self,
        rows: Indices,
        gap: Indices,
        fresh: Flags,
        x: Array,
        target: Array,
        disturbance: Array,
    ) -> Flags:
        """{X(k), U(k)} ← MPC, eq. (10), into `states` and `inputs`.

        Args:
            rows: the vehicles; shape (n,).
            gap: steps since each was solved last, of no matter where it starts anew; shape (n,).
            fresh: which of them start anew; shape (n,).
            x: state at stage 0; shape (n, axes, 2).
            target: desired states at the stages 0 … H; shape (n, axes, H + 1, 2).
            disturbance: see `MPC.gradient`; shape (n, axes).

        Returns:
            which were solved; the others go on with their horizon of before, shifted.
        """
        previous = shift(self.inputs[rows], gap)
        anew = fresh.any()
        if anew:
            previous[fresh] = 0.0
        gradient = self.mpc.gradient(x, target, previous, disturbance)
        self._stopwatch.lap("plan")
        inputs, solved = self._solver.solve(gradient, previous)
        if anew:
            gradient = self._first.gradient(
                x[fresh], target[fresh], previous[fresh], disturbance[fresh]
            )
            inputs[fresh], solved[fresh] = self._first_solver.solve(gradient, previous[fresh])
        self.solve_ns = self._stopwatch.lap("solve")
        # What is sent is float32: planning goes on with what the vehicle will really be told.
        self.inputs[rows] = inputs = inputs.astype(np.float32).astype(np.float64)
        self.mpc.predict(x, inputs, disturbance, self.states, rows)
        return solved


class Desired:
    """The reference at the stages 0 … H of any step, looked up rather than computed each time."""

    def __init__(self, reference: Reference, dt_s: float, H: int) -> None:
        self._reference = reference
        self._dt_s = dt_s
        self._stages = np.arange(H + 1)
        self._steps = np.arange(WINDOW + H)
        self._first = 0
        self._fill(0)

    def __call__(self, step: Indices) -> Array:
        """x_d(k|k) … x_d(k+H|k) for each of these k; shape (n, axes, H + 1, 2)."""
        low, high = int(step.min()), int(step.max())
        if high - low >= WINDOW:  # vehicles that fly hours apart share no table
            times = (step[:, None] + self._stages) * self._dt_s
            return self._reference(times).transpose(0, 2, 1, 3)
        if not self._first <= low <= high < self._first + WINDOW:
            self._fill(low)
        return self._windows[:, step - self._first].transpose(1, 0, 2, 3)

    def _fill(self, first: int) -> None:
        states = self._reference((first + self._steps) * self._dt_s).transpose(1, 0, 2)
        windows = sliding_window_view(np.ascontiguousarray(states), len(self._stages), axis=1)
        self._first, self._windows = first, windows.swapaxes(2, 3)


@dataclass(frozen=True, slots=True)
class Plan:
    """What the planner has to say about n vehicles at one step."""

    inputs: Array
    """U(k) of (15) [m/s]; shape (n, axes, H)."""
    solved: Flags
    """Whether U(k) is new and right, so that it may be sent; shape (n,)."""
    solve_ns: int
    """How long it took to solve both problems of all n; -1 where nobody measured."""


class Planner:
    """Trajectory generator and tracker of up to `capacity` vehicles."""

    def __init__(
        self, scenario: Scenario, model: Model, capacity: int, stopwatch: Stopwatch
    ) -> None:
        control = scenario.control
        self._H = control.horizon
        self._desired = Desired(scenario.make_reference(), control.dt, control.horizon)
        self._generator = Successive(scenario, model, capacity, stopwatch)
        self._tracker = Successive(scenario, model, capacity, stopwatch)
        self._stopwatch = stopwatch
        self._step = np.full(capacity, -1, dtype=np.int64)

    def forget(self, row: int) -> None:
        """The next plan of this vehicle is its first."""
        self._step[row] = -1

    def planned(self, rows: Indices, step: Indices, estimate: Array) -> tuple[Array, Flags]:
        """x_p(k|k-1) ∈ X_p(k-1), and which vehicles start anew, from their estimate.

        A vehicle starts anew at its first step, and after a gap that its plan does not reach over.

        Returns:
            shape (n, axes, 2) and (n,).
        """
        last = self._step[rows]
        gap = step - last
        fresh = (last < 0) | (gap > self._H)
        planned = self._generator.states[rows, :, np.minimum(gap, self._H)]
        planned[fresh] = estimate[fresh]
        return planned, fresh

    def plan(  # noqa: PLR0917 - all that a plan starts from
        self,
        rows: Indices,
        step: Indices,
        estimate: Array,
        planned: Array,
        fresh: Flags,
        disturbance: Array,
    ) -> Plan:
        """Eq. (14), then (15).

        Args:
            rows: the vehicles; shape (n,).
            step: where each plan starts, later than the last one, or there; shape (n,).
            estimate: x̂ at that step; shape (n, axes, 2).
            planned: x_p there, and `fresh`: from `planned`.
            disturbance: see `MPC.gradient`; shape (n, axes).
        """
        gap = step - self._step[rows]
        calm = np.zeros_like(disturbance)  # the generator plans for no vehicle in particular
        led = self._generator.solve(rows, gap, fresh, planned, self._desired(step), calm)
        trajectory = self._generator.states[rows]
        solved = led & self._tracker.solve(rows, gap, fresh, estimate, trajectory, disturbance)
        self._step[rows] = step
        if not solved.all():  # a first plan that failed is no plan to go on from
            self._step[rows[fresh & ~solved]] = -1
        solve_ns = self._generator.solve_ns + self._tracker.solve_ns
        return Plan(self._tracker.inputs[rows], solved, solve_ns if self._stopwatch.runs else -1)

    def cost_gap(self, rows: Indices, held: Array) -> Array:
        """(U_old - U)ᵀ 𝓗 (U_old - U): what it costs to fly `held` instead of the plan just made.

        Args:
            rows: the vehicles; shape (n,).
            held: U_old; shape (n, axes, H).

        Returns:
            shape (n,).
        """
        return self._tracker.mpc.cost(held - self._tracker.inputs[rows])

    def deviation_m(
        self, rows: Indices, step: Indices, estimate: Array, held: Array, disturbance: Array
    ) -> Array:
        """How far `held` leads away from the generator's last plan, at most, as far as that goes.

        Args:
            rows, step, estimate, disturbance: see `plan`.
            held: inputs from `step` on; shape (n, axes, H).

        Returns:
            distance [m]; shape (n,).
        """
        n, axes, H = held.shape
        states = np.empty((n, axes, H + 1, 2))
        self._tracker.mpc.predict(estimate, held, disturbance, states, np.arange(n))
        gap = step - self._step[rows]
        stage = np.arange(H + 1) + gap[:, None]
        plan = self._generator.states[rows[:, None], :, np.minimum(stage, H), 0].transpose(0, 2, 1)
        distance = np.linalg.norm(states[..., 0] - plan, axis=1)
        largest: Array = np.where(stage <= H, distance, 0.0).max(axis=1)
        return largest
