"""QPs for the benchmarks, recorded in flight and in order."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any
from unittest.mock import patch

import numba
import numpy as np

from skytether.server.mpc import hierarchical as planner
from skytether.server.mpc.appraisal import GENERATOR, TRACKER
from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.problem import (
    FIRST,
    Problem,
    gradient,
    lead,
    set_previous,
    set_target,
    simd_batch,
    simd_memory,
)
from skytether.server.mpc.solver import Solver
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.whole import Scenario
from skytether.sim.flight import fly


def derive(name: str, **sections: Any) -> Scenario:
    """Built-in scenario with some keys changed, as in `control={"dt": 0.02}`."""
    table = reading.to_table(reading.load(name))
    for key, value in sections.items():
        table[key] = {**table[key], **value} if isinstance(value, dict) else value
    return reading.check(table, "a benchmark")


@cache
def from_python(part: Any) -> Any:
    """Part of kernels as a function that Python can call; it is compiled at the first call."""
    return numba.njit(error_model="numpy")(part.py_func)


_set_target, _set_previous = from_python(set_target), from_python(set_previous)
_lead, _gradient = from_python(lead), from_python(gradient)


def gradients(
    problem: Problem, x: Array, target: Array, previous: Array, disturbance: Array
) -> Array:
    """Gradient g of the QPs of n vehicles; shape (n, axes, H).

    Args:
        problem: problem with the common matrices.
        x: state at stage 0 [m, m/s]; shape (n, axes, 2).
        target: desired states at the stages 0 … H [m, m/s]; shape (n, axes, H + 1, 2).
        previous: previous horizon, shifted to the present [m/s]; shape (n, axes, H).
        disturbance: disturbance that is added to every input [m/s]; shape (n, axes).
    """
    mpc, which, result = problem.mpc, problem.which, np.empty(previous.shape)
    simd = simd_batch(simd_memory(previous.shape[2], 1))
    for at in np.ndindex(*previous.shape[:2]):
        (simd.p[0], simd.v[0]), simd.w[0], axis = x[at], disturbance[at], at[1]
        _set_target(target[at], simd, 0)
        _set_previous(previous[at], 0, which == FIRST, simd, 0)
        _lead(mpc, axis, simd)
        _gradient(mpc, axis, which, simd, simd.target_v)
        result[at] = simd.gradient[:, 0]
    return result


def saturated(inputs: Array, problem: Problem) -> float:
    """Share of the axis problems that have an input at its bound, in inputs (..., axes, H)."""
    return float((np.abs(inputs) >= problem.mpc.bounds[:, None]).any(axis=-1).mean())


@dataclass(frozen=True)
class RecordedProblems:
    """QPs of one vehicle's flight; two per tick, the generator's and the tracker's."""

    problem: Problem
    gradient: Array
    """Gradients of the QPs; shape (2, ticks, axes, H)."""
    guess: Array
    """Shifted horizon of the previous step [m/s]; shape (2, ticks, axes, H)."""

    def active(self) -> float:
        flat = self.gradient.reshape(-1, *self.gradient.shape[2:])
        inputs, _ = ExactSolver(self.problem).solve(flat, np.zeros_like(flat))
        return saturated(inputs, self.problem)


class ProblemRecorder:
    """Exact solver that records the problems of generator and tracker in turn."""

    def __init__(self, problem: Problem) -> None:
        self._solver = ExactSolver(problem)
        self.problem = problem
        self._asked: list[tuple[Array, Array]] = []

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        self._asked.append((gradient, guess))
        return self._solver.solve(gradient, guess)

    def recorded(self, turns: int = 0) -> tuple[Array, Array]:
        """Recorded gradients and guesses of the last `turns` ticks, or of all; each of shape (2,
        problems, axes, H), the generator's problems first.
        """
        asked = self._asked[-2 * turns :]
        halves = [asked[half::2] for half in (GENERATOR, TRACKER)]
        gradient, guess = (
            np.array([np.concatenate([pair[i] for pair in half]) for half in halves])
            for i in range(2)
        )
        return gradient, guess

    def forget(self) -> None:
        self._asked.clear()


class ByTurns:
    """Two solvers in turn, for the generator and for the tracker, each with a warm start."""

    def __init__(self, make: Callable[[Problem], Solver], problem: Problem) -> None:
        self._next, self._other = make(problem), make(problem)

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        solver = self._next
        self._next, self._other = self._other, solver
        return solver.solve(gradient, guess)


@contextmanager
def solving(make: Callable[[Problem], Solver]) -> Iterator[None]:
    """Within the block, new planners use the solver `make(problem)`, not the scenario's."""

    def make_solver(control: ControlConfig, problem: Problem) -> Solver:  # noqa: ARG001
        return make(problem)

    with patch.object(planner, "make_solver", make_solver):
        yield


@contextmanager
def listening() -> Iterator[list[ProblemRecorder]]:
    """Within the block, new planners solve exactly; yields recorders of first and later steps."""
    listeners: list[ProblemRecorder] = []

    def make(problem: Problem) -> Solver:
        listeners.append(ProblemRecorder(problem))
        return listeners[-1]

    with solving(make):
        yield listeners


def record(scenario: Scenario, ticks: int) -> RecordedProblems:
    """Fly a scenario in virtual time and return the QPs of its last ticks."""
    with listening() as listeners:
        flight = fly(scenario)
    assert len(flight.client), flight.failure
    _, later = listeners
    return RecordedProblems(later.problem, *later.recorded(ticks))
