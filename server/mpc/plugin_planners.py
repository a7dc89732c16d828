"""Planners from plug-ins, one per vehicle, which replace the MPC (`shared.scenario.planners`).

A planner that raises, takes too long, or returns an infeasible plan makes no plan for its vehicle
at that step: the vehicle flies its present plan to the end, and then its failsafe acts. The caller
of planners (`server.planning.scheme.Planning`) limits their time, because a scheme reads no clock.

The server does not know which cost a planner optimises. So the planner's plan counts as optimal:
the inputs already sent, which differ from the plan by ΔU, cost ΔUᵀ 𝓗 ΔU more, with 𝓗 of eq. (9).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from queue import Full
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.server.mpc.appraisal import GENERATOR, TRACKER
from skytether.server.mpc.hierarchical import PlanBatch, Planner, conclude_given, start_plans
from skytether.server.planning.plugin_errors import NO_PLAN, PluginErrors
from skytether.server.planning.scheme import Fleet
from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.scenario.planners import Problem
from skytether.shared.scenario.registry import PLANNERS
from skytether.shared.wire.protocol import FLOAT_MAX

ERRORS, LATE, NOT_CALLED = "planner_errors", "planner_late", "planner_not_called"
"""Names of the counts of steps whose planner failed, answered too late, or was not called."""
EXPECTED = {TimeoutError: LATE, Full: NOT_CALLED}
"""Name of the count for each exception that comes in place of a planner's answer."""


@dataclass(slots=True)
class VehiclePlanner:
    """Planner of one vehicle, and its last plan."""

    number: int
    """Number of the planner, unique within its `PluginPlanners`."""
    planner: Any
    """The planner, or None if the first call for a plan has to make the planner."""
    inputs: Array
    """Inputs of the last plan [m/s]; shape (axes, H)."""
    start: int = -1
    """Step at which the last plan starts, or -1 before the first plan."""


class PluginPlanners:
    """Planners of up to `capacity` vehicles.

    Args:
        states: whether a planner may return states instead of inputs.

    Raises:
        ConfigError: a planner cannot be made.
    """

    def __init__(self, fleet: Fleet, *, states: bool) -> None:
        self._text = text = fleet.scenario.control.planner
        self._scenario, self._named = fleet.scenario, PLANNERS.one(text)
        self._problem = Problem.of(fleet.scenario)
        self._states, self._planning = states, fleet.planning or in_turn
        self._errors = PluginErrors(f"the planner {text}", NO_PLAN, ERRORS, fleet.tell)
        self._numbers = count()
        self._own: dict[int, VehiclePlanner] = {}
        """Planner of each vehicle, by row."""
        try:
            self._spare = self._make()
            self._spare.plan  # noqa: B018 - a planner has it
        except Exception as error:
            wrong = f"a planner that can be made ({type(error).__name__}: {error})"
            raise ConfigError(f"control.planner: got {text!r}, expected {wrong}") from error

    def _make(self) -> Any:
        return PLANNERS.make(self._named, (), Problem.of(self._scenario))

    def forget(self, row: int) -> None:
        self._own.pop(row, None)

    def plan(
        self, rows: Indices, starts: Indices, state: Array, reference: Array
    ) -> list[Array | None]:
        """Plan for n vehicles.

        Args:
            rows: rows of the vehicles; shape (n,).
            starts: step at which each plan starts; shape (n,).
            state: state at the start of each plan [m, m/s]; shape (n, axes, 2).
            reference: desired states from the start on [m, m/s]; shape (n, axes, H + 1, 2).

        Returns:
            for each vehicle one of: inputs within ±u_max [m/s], shape (axes, H); states [m, m/s],
            shape (H + 1, axes, 2); None without a plan.
        """
        owns = [self._of(row) for row in rows.tolist()]
        calls = [
            (own.number, partial(self._plan, own, start, x.copy(), desired.swapaxes(0, 1).copy()))
            for own, start, x, desired in zip(owns, starts.tolist(), state, reference, strict=True)
        ]
        answers = self._planning(calls)
        return [
            self._checked(own, start, answer)
            for own, start, answer in zip(owns, starts.tolist(), answers, strict=True)
        ]

    def _of(self, row: int) -> VehiclePlanner:
        if row not in self._own:
            inputs = np.zeros((self._problem.axes, self._problem.horizon))
            self._own[row] = VehiclePlanner(next(self._numbers), self._spare, inputs)
            self._spare = None
        return self._own[row]

    def _plan(self, own: VehiclePlanner, start: int, state: Array, reference: Array) -> Any:
        gap, H = start - own.start, self._problem.horizon
        previous = np.zeros_like(own.inputs)
        if own.start >= 0 and 0 <= gap <= H:
            previous = own.inputs[:, np.minimum(np.arange(H) + gap, H - 1)]
        try:
            if own.planner is None:
                own.planner = self._make()
            return own.planner.plan(state, reference, previous)
        except SystemExit as error:  # a planner must not end the flights of other vehicles
            raise RuntimeError(f"got SystemExit: {error}") from error

    def _checked(self, own: VehiclePlanner, start: int, answer: Any) -> Array | None:
        if isinstance(answer, Exception):
            self._errors.note(answer, EXPECTED.get(type(answer), ""))
            return None
        problem = self._problem
        shapes: list[tuple[int, ...]] = [(problem.axes, problem.horizon)]
        if self._states:
            shapes.append((problem.horizon + 1, problem.axes, 2))
        with self._errors:
            plan = np.array(answer, dtype=np.float64)
            if plan.shape not in shapes:
                expected = " or ".join(map(str, shapes))
                raise ValueError(f"got a plan of shape {plan.shape}, expected {expected}")
            if not (np.abs(plan) <= FLOAT_MAX).all():  # NaN fails too
                raise ValueError("expected a plan of finite numbers")
            if plan.ndim == len(shapes[0]):
                bounds = problem.u_max[:, None]
                own.inputs, own.start = np.clip(plan, -bounds, bounds), start
                return own.inputs
            return plan
        return None


class InputPlanner(Planner):
    """Planners from plug-ins for a scheme that sends inputs; computes the same figures as the MPC.

    A planner's result replaces the plan of the MPC's generator, which assumes no disturbance. The
    plan sent is this result minus the disturbance, in place of the tracker's. Unlike the generator,
    a planner starts from the vehicle's state. So triggers compare its plan with the last sent one.
    """

    def __init__(self, fleet: Fleet) -> None:
        control, terms = fleet.scenario.control, fleet.terms
        desired, capacity, block = fleet.desired, fleet.capacity, fleet.block
        super().__init__(control, terms, desired, capacity, block, fleet.stopwatch)
        self._planners = PluginPlanners(fleet, states=False)
        self._bounds = np.array(terms.u_max)[:, None]
        self._sent: list[NDArray[Any]] = []
        """Inputs, start and step of the plans last sent to the vehicles of this block."""

    def forget(self, row: int) -> None:
        super().forget(row)
        self._planners.forget(row)

    def _plan_all(self, batch: PlanBatch, rows: Indices, step: Indices) -> None:
        n, draft, foresight = len(rows), self._draft, batch.foresight
        memory = self._memory
        self._sent = [memory.inputs[GENERATOR, rows], memory.start[rows], memory.step[rows]]
        start_plans(batch, rows, step)
        state, begins = foresight.start[:n], step + foresight.ahead[:n]
        reference = self._desired.states(rows, step, foresight.ahead)
        plans = self._planners.plan(rows, begins, state, reference)
        for i, plan in enumerate(plans):
            inputs = draft.guess[i] if plan is None else plan
            disturbance = foresight.disturbance[i][:, None]
            draft.inputs[GENERATOR, i] = inputs
            draft.inputs[TRACKER, i] = np.clip(inputs - disturbance, -self._bounds, self._bounds)
        self.figures["solved"][:n] = [plan is not None for plan in plans]
        conclude_given(batch, n)
        memory.start[rows] = state

    def remember(self, rows: Indices, event: Flags) -> None:
        memory, kept = self._memory, ~event
        inputs, start, step = (each[kept] for each in self._sent)
        memory.inputs[GENERATOR, rows[kept]] = inputs
        memory.start[rows[kept]], memory.step[rows[kept]] = start, step


def in_turn(calls: Sequence[tuple[int, Callable[[], Any]]]) -> list[Any]:
    """Results or errors of planners, called one after the other without a time limit."""
    answers = []
    for _, call in calls:
        try:
            answers.append(call())
        except Exception as error:
            answers.append(error)
    return answers
