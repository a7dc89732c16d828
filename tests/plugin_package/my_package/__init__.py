"""A planner, a trigger, a reference, a vehicle and an impairment in a package of their own."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from skytether.plugin import (
    Draws,
    Fate,
    Impairment,
    Measurement,
    Problem,
    Reference,
    Scenario,
    Situation,
    Vehicle,
    Verdict,
    above,
    impairment,
    planner,
    reference,
    trigger,
    vehicle,
)


@trigger
def slip(now: Situation, mps: Annotated[float, Meta(ge=0)] = 0.3) -> Verdict:
    """Sends if the velocity differs from its plan by more than so many m/s."""
    off = now.estimate[:, :, 1] - now.planned[:, :, 1]
    return above(now, np.linalg.norm(off, axis=1), mps)


@planner(name="idle")
class Idle:
    """Plans to stay."""

    def __init__(self, problem: Problem) -> None:
        self._inputs = np.zeros((problem.axes, problem.horizon))

    def plan(self, *_: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._inputs


@reference
def slope(scenario: Scenario, mps: Annotated[float, Meta(ge=-1, le=1)]) -> Reference:
    """Straight line along x, at so many m/s."""

    def at(t: NDArray[np.float64]) -> NDArray[np.float64]:
        state = np.zeros((*np.shape(t), scenario.model.axes, 2))
        state[..., 0, 0], state[..., 0, 1] = mps * np.clip(t, 0.0, 1000.0), mps
        return state

    return at


@vehicle
class Rail(Vehicle):
    """Vehicle that reaches any velocity at once, and measures its state every 30 ms."""

    def __init__(self, scenario: Scenario, _: int) -> None:
        start = scenario.make_reference()(np.zeros(()))
        self._position, self._velocity = start[:, 0], np.zeros(scenario.model.axes)
        self._measured_ns: int | None = None

    def fly(self, velocity: NDArray[np.float64]) -> None:
        """Fly with this velocity from the next measurement on [m/s]."""
        self._velocity = velocity

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        """States at all measurement times that are due by now."""
        told = []
        while self._measured_ns is None or self._measured_ns + 30_000_000 <= now_ns:
            if self._measured_ns is not None:
                self._position = self._position + 0.03 * self._velocity
            self._measured_ns = (self._measured_ns or now_ns - 30_000_000) + 30_000_000
            state = self._position.tolist(), self._velocity.tolist()
            told.append(Measurement(self._measured_ns, *state))
        return told


@impairment(name="dark")
class Dark(Impairment):
    """Loses what is sent in every other span of so many seconds."""

    def __init__(self, every_s: Annotated[float, Meta(ge=1)]) -> None:
        self._every_s, self.loss = every_s, 0.5

    def __call__(self, fate: Fate, draws: Draws) -> None:  # noqa: ARG002
        fate.lost |= fate.time_s // self._every_s % 2 == 1
