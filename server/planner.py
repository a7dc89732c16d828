"""Hierarchical MPC of section 4.1: trajectory generator (14), and tracker (15) behind it.

Both are the MPC of (9) in closed succession: each starts from its own horizon of the step before.
The generator plans from its own last prediction and never looks at the UAV (E17); the tracker leads
the UAV's estimated state along the generator's plan.
"""

from dataclasses import dataclass

import numpy as np

from server.exact import ExactSolver
from server.mpc import MPC, condense, shift
from server.solver import OsqpSolver, Solver
from shared.config import ControlConfig, Scenario
from shared.model import Array, Flags, Indices, Model


def make_solver(control: ControlConfig, mpc: MPC, u_max: Array) -> Solver:
    """The solver that a scenario names, for the QPs of one MPC."""
    if control.solver == "exact":
        return ExactSolver(mpc, u_max)
    return OsqpSolver(mpc.hessian, u_max)


class Successive:
    """One MPC solved at every step, for up to `capacity` vehicles."""

    def __init__(
        self, mpc: MPC, first: MPC, control: ControlConfig, u_max: Array, capacity: int
    ) -> None:
        axes, H = mpc.hessian.shape[:2]
        self._mpc = mpc
        self._solver = make_solver(control, mpc, u_max)
        # Without a horizon before there is no S-term (E8), which is another Hessian.
        self._first = first
        self._first_solver = make_solver(control, first, u_max)
        self.inputs = np.zeros((capacity, axes, H))
        """U(k-1), the horizon computed last."""
        self.states = np.zeros((capacity, axes, H, 2))
        """X(k-1), the states predicted with it."""

    def solve(self, rows: Indices, gap: Indices, fresh: Flags, x: Array, target: Array) -> Flags:
        """{X(k), U(k)} ← MPC, eq. (10), into `states` and `inputs`.

        Args:
            rows: the vehicles; shape (n,).
            gap: steps since each was solved last; shape (n,).
            fresh: which of them start anew; shape (n,).
            x: state at stage 0; shape (n, axes, 2).
            target: desired states at the stages 0 … H; shape (n, axes, H + 1, 2).

        Returns:
            which were solved; the others go on with their horizon of before, shifted.
        """
        previous = shift(self.inputs[rows], gap)
        previous[fresh] = 0.0
        inputs, solved = self._solver.solve(self._mpc.gradient(x, target, previous), previous)
        if fresh.any():
            gradient = self._first.gradient(x[fresh], target[fresh], previous[fresh])
            inputs[fresh], solved[fresh] = self._first_solver.solve(gradient, previous[fresh])
        # What is sent is float32: planning goes on with what the vehicle will really be told.
        inputs = inputs.astype(np.float32).astype(np.float64)
        self.inputs[rows] = inputs
        self.states[rows] = self._mpc.predict(x, inputs)
        return solved


@dataclass(frozen=True, slots=True)
class Plan:
    """What the planner has to say about n vehicles at one step."""

    inputs: Array
    """U(k) of (15) [m/s]; shape (n, axes, H)."""
    solved: Flags
    """Whether U(k) is new and right, so that it may be sent; shape (n,)."""


class Planner:
    """Trajectory generator and tracker of up to `capacity` vehicles."""

    def __init__(self, scenario: Scenario, model: Model, capacity: int) -> None:
        control = scenario.control
        mpc = condense(model, control, change_weight=control.change_weight)
        first = condense(model, control, change_weight=0.0)
        self._dt = control.dt
        self._H = control.horizon
        self._reference = scenario.make_reference()
        self._generator = Successive(mpc, first, control, scenario.u_max, capacity)
        self._tracker = Successive(mpc, first, control, scenario.u_max, capacity)
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
        gap = step - self._step[rows]
        fresh = (self._step[rows] < 0) | (gap > self._H)
        stage = np.where(fresh, 1, gap) - 1
        planned = self._generator.states[rows, :, stage]
        return np.where(fresh[:, None, None], estimate, planned), fresh

    def plan(
        self, rows: Indices, step: Indices, estimate: Array, planned: Array, fresh: Flags
    ) -> Plan:
        """Eq. (14), then (15).

        Args:
            rows: the vehicles; shape (n,).
            step: k of each, later than at its last plan; shape (n,).
            estimate: x̂(k); shape (n, axes, 2).
            planned: x_p(k|k-1), and `fresh`: from `planned`.
        """
        gap = np.where(fresh, 0, step - self._step[rows])
        stages = np.arange(self._H + 1)
        desired = self._reference((step[:, None] + stages) * self._dt).transpose(0, 2, 1, 3)
        led = self._generator.solve(rows, gap, fresh, planned, desired)
        trajectory = np.concatenate([planned[:, :, None], self._generator.states[rows]], axis=2)
        tracked = self._tracker.solve(rows, gap, fresh, estimate, trajectory)
        solved = led & tracked
        # A first plan that failed is no plan to go on from.
        self._step[rows] = np.where(fresh & ~solved, -1, step)
        return Plan(self._tracker.inputs[rows], solved)
