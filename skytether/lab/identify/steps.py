"""The experiment: steps of velocity on one axis after another, out and back.

    home → rest → 0 to v → v to 0 → 0 to -v → -v to 0 → home …

Everything passes the fence, as in a flight. What it cuts is no step of the size that was asked for:
it is not used, and the vehicle goes home.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from skytether.client.fence import Fence
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.scenario.fence import SLOW_STEPS, margins
from skytether.shared.scenario.schema import Scenario

ALTITUDE = 2
"""Axis of the altitude, where there is one."""
STEPS = 4
"""Steps of one repetition."""
HOMEWARD = 0.3
"""Speed towards home over distance [1/s]: slow enough for a second of dead time."""
NEAR_M, SLOW_MPS = 0.3, 0.2
"""Distance and speed on an axis at which the vehicle is home."""
HOMEWARD_S = 15.0
"""Longest time on the way home [s]: steady wind keeps a vehicle away."""
HOLD_MIN_S, HOLD_MAX_S = 3.0, 6.0
"""Shortest and longest time after a step, unless another is asked for [s]."""
STEP_MPS = 0.5
"""Size of step where the desired trajectory stands still [m/s]."""
STEP_MIN_MPS = 0.05
"""Smallest size of step [m/s]."""
FAST = 1.3
"""How much further a vehicle may go with a step than its input says."""


class ExperimentPlan(NamedTuple):
    """Experiment that is asked for."""

    speeds: tuple[float, ...]
    """Size of step on each axis [m/s]."""
    hold_s: float
    """Time after each step [s]."""
    repeats: int
    """Number of repetitions on each axis."""

    @property
    def duration_s(self) -> float:
        """About how long it takes [s]."""
        return len(self.speeds) * self.repeats * ((STEPS + 1) * self.hold_s + 2.0)


class FlownStep(NamedTuple):
    """A step that was flown."""

    axis: int
    """Axis whose input changed."""
    before: float
    """Input before [m/s]."""
    after: float
    """Input after [m/s]."""
    began_ns: int
    """Time of the change."""
    ended_ns: int
    """Time up to which the input stayed."""


def reference_speeds(scenario: Scenario) -> list[float]:
    """Largest speed of the desired trajectory on each axis [m/s]."""
    times = np.arange(scenario.steps + 1) * scenario.control.dt
    states = scenario.make_reference()(times)
    speeds: list[float] = np.abs(states[..., 1]).max(axis=0).tolist()
    return speeds


def default_speeds(scenario: Scenario) -> tuple[float, ...]:
    """Size of step on each axis that is like what will be flown [m/s].

    It is the largest speed of the desired trajectory on the axis, and at least half of that on any:
    an axis that it leaves alone is flown by the feedback.
    """
    speeds = reference_speeds(scenario)
    least = max(speeds) / 2.0 or STEP_MPS
    limit = scenario.fence.speed_mps or math.inf
    asked = zip(speeds, scenario.u_max.tolist(), strict=True)
    return tuple(round(min(max(each, least), most, limit), 2) for each, most in asked)


def default_hold_s(scenario: Scenario) -> float:
    """Time after a step in which a vehicle that is like the model settles [s]."""
    terms = scenario.terms()
    slowest = max(4.0 * t + late for t, late in zip(terms.tau_s, terms.dead_time_s, strict=True))
    return round(min(max(slowest, HOLD_MIN_S), HOLD_MAX_S), 2)


def fenced(scenario: Scenario, plan: ExperimentPlan) -> Scenario:
    """The scenario with a fence around an experiment, where it has none."""
    if scenario.fence.is_there:
        return scenario
    fastest, brake = max(plan.speeds), scenario.vehicle.brake_mps2
    slow = max(scenario.tau_s.tolist()) + SLOW_STEPS * scenario.control.dt
    room = FAST * fastest * plan.hold_s + fastest * slow + fastest**2 / (2.0 * brake)
    radius = math.ceil(room + max(margins(scenario)))
    fence = msgspec.structs.replace(scenario.fence, radius_m=float(radius))
    return msgspec.structs.replace(scenario, fence=fence)


class Experiment:
    """An experiment in flight: what the vehicle is told at each step of control.

    Args:
        scenario: the vehicle's own; it has a fence.
        plan: what is to be flown.
    """

    def __init__(self, scenario: Scenario, plan: ExperimentPlan) -> None:
        self.plan = plan
        self._fence, self._u_max = Fence(scenario), scenario.u_max.tolist()
        self._hold_ns = seconds_to_ns(plan.hold_s)
        self._has_floor = bool(scenario.fence.low_m)
        self._now_ns = 0
        self._state: Sequence[tuple[float, float]] = ()
        self._home: list[float] = []
        self._script: Iterator[list[float]] | None = None
        self._input = [0.0] * len(plan.speeds)
        self.steps: list[FlownStep] = []
        """Steps that were flown whole."""
        self.cut = [0] * len(plan.speeds)
        """Number of steps of each axis that the fence cut, or left no room for."""
        self.is_over = False
        """Whether everything was flown."""

    def choose(self, state: Sequence[tuple[float, float]], *, now_ns: int) -> list[float]:
        """Input to fly from now on, of each axis [m/s].

        Args:
            state: state in which the input will meet the vehicle, of each axis [m, m/s]; the first
                is home.
            now_ns: time now.
        """
        self._now_ns, self._state = now_ns, state
        if self._script is None:
            self._home = [p for p, _ in state]
            self._fence.limited([0.0] * len(state), state, self._u_max)  # it knows home from now on
            self._script = self._flown()
        wanted = next(self._script, None)
        if wanted is None:
            self.is_over, wanted = True, [0.0] * len(state)
        self._input = self._fence.limited(wanted, state, self._u_max)
        return self._input

    def _flown(self) -> Iterator[list[float]]:
        """What is wanted at each step of control, of each axis [m/s]."""
        for axis, speed in enumerate(self.plan.speeds):
            for _ in range(self.plan.repeats):
                yield from self._go_home()
                done = len(self.steps)
                direction = self._direction(axis)
                if direction:
                    yield from self._repetition(axis, direction * speed)
                self.cut[axis] += STEPS - (len(self.steps) - done)
        yield from self._go_home()

    def _repetition(self, axis: int, speed: float) -> Iterator[list[float]]:
        """Rest, and steps out and back, until the fence cuts one."""
        before = 0.0
        for number, after in enumerate((0.0, speed, 0.0, -speed, 0.0)):
            began_ns = self._now_ns
            while self._now_ns - began_ns < self._hold_ns:
                wanted = self._homeward()
                wanted[axis] = after
                yield wanted
                if self._fence.holds:
                    return
            if number:
                self.steps.append(FlownStep(axis, before, after, began_ns, self._now_ns))
            before = after

    def _go_home(self) -> Iterator[list[float]]:
        """Fly to where it began."""
        began_ns = self._now_ns
        while self._now_ns - began_ns < HOMEWARD_S * SECOND_NS:
            away = zip(self._state, self._home, strict=True)
            if all(abs(p - h) < NEAR_M and abs(v) < SLOW_MPS for (p, v), h in away):
                return
            yield self._homeward()

    def _homeward(self) -> list[float]:
        """Input that leads home, of each axis [m/s]."""
        axes = zip(self._state, self._home, self._u_max, strict=True)
        return [min(max(HOMEWARD * (h - p), -most), most) for (p, _), h, most in axes]

    def _direction(self, axis: int) -> float:
        """Direction in which there is room for a step; 0 where there is none.

        Up is tried first, and down only where the fence says how deep it may go.
        """
        speed = self.plan.speeds[axis]
        ways = (1.0, -1.0) if axis != ALTITUDE or self._has_floor else (1.0,)
        for way in ways:
            ended, wanted = list(self._state), [0.0] * len(self._state)
            ended[axis] = (self._state[axis][0] + way * speed * self.plan.hold_s, way * speed)
            wanted[axis] = way * speed
            self._fence.limited(wanted, ended, self._u_max)
            if not self._fence.holds:
                return way
        return 0.0
