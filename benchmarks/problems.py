"""The problems of the benchmarks: recorded in flight, in the order of the flight."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np

from server import planner
from server.exact import ExactSolver
from server.mpc import MPC
from server.solver import Solver
from shared import config
from shared.config import ControlConfig, Scenario
from shared.model import Array, Flags
from sim.flight import fly


def derive(name: str, **sections: Any) -> Scenario:
    """A scenario that comes with Skytether, with some keys changed: `control={"dt": 0.02}`."""
    table = config.to_table(config.load(name))
    for key, value in sections.items():
        table[key] = {**table[key], **value} if isinstance(value, dict) else value
    return config.check(table, "a benchmark")


@dataclass(frozen=True)
class Recorded:
    """The QPs of one vehicle's flight; two a tick, the generator's and the tracker's."""

    mpc: MPC
    """MPC of the QPs; both solves have the same Hessian."""
    u_max: Array
    """Bounds of the input [m/s]; shape (axes,)."""
    gradient: Array
    """Gradients of the QPs; shape (2, ticks, axes, H)."""
    guess: Array
    """The shifted horizon of the step before [m/s]; shape (2, ticks, axes, H)."""

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return self.gradient.shape[1]

    def active(self) -> float:
        """Share of the axis problems that have an input at its bound."""
        flat = self.gradient.reshape(-1, *self.gradient.shape[2:])
        inputs, _ = ExactSolver(self.mpc, self.u_max).solve(flat, np.zeros_like(flat))
        return float((np.abs(inputs) >= self.u_max[:, None]).any(axis=2).mean())


class Listener:
    """A solver that notes what it is asked."""

    def __init__(self, solver: Solver, mpc: MPC) -> None:
        self._solver = solver
        self.mpc = mpc
        self.asked: list[tuple[Array, Array]] = []

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """Note the problem and solve it (see `Solver`)."""
        self.asked.append((gradient, guess))
        return self._solver.solve(gradient, guess)


@contextmanager
def solving(make: Callable[[MPC, Array], Solver]) -> Iterator[None]:
    """Planners made meanwhile solve by `make(mpc, u_max)`, whatever their scenario says."""

    def make_solver(control: ControlConfig, mpc: MPC, u_max: Array) -> Solver:  # noqa: ARG001
        return make(mpc, u_max)

    with patch.object(planner, "make_solver", make_solver):
        yield


@contextmanager
def listening() -> Iterator[list[Listener]]:
    """Planners made meanwhile solve exactly, and are listened to.

    Gives the generator, the generator of a first step, the tracker and that of a first step.
    """
    listeners: list[Listener] = []

    def make(mpc: MPC, u_max: Array) -> Solver:
        listeners.append(Listener(ExactSolver(mpc, u_max), mpc))
        return listeners[-1]

    with solving(make):
        yield listeners


def record(scenario: Scenario, ticks: int) -> Recorded:
    """Fly a scenario in virtual time and keep the QPs of its last ticks."""
    with listening() as listeners:
        flight = fly(scenario)
    assert flight.failure is None, flight.failure
    generator, _, tracker, _ = listeners
    asked = [listener.asked[-ticks:] for listener in (generator, tracker)]
    gradient, guess = (
        np.array([[pair[i][0] for pair in half] for half in asked]) for i in range(2)
    )
    return Recorded(generator.mpc, scenario.u_max, gradient, guess)
