"""Experiment: steps of velocity on one axis after another, out and back.

    home → rest → 0 to v → v to 0 → 0 to -v → -v to 0 → home …

The fence limits all inputs, as in a flight. A step that the fence shortens is not used, and the
vehicle flies home.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from skytether.client.fence import Fence
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.fence.margins import SLOW_STEPS, margins
from skytether.shared.scenario.whole import Scenario

ALTITUDE = 2
STEPS = 4
HOMEWARD = 0.3
"""Gain from distance to speed on the way home [1/s]; stable with dead times up to a second."""
NEAR_M, SLOW_MPS = 0.3, 0.2
"""Distance [m] and speed [m/s] on an axis below which the vehicle counts as home."""
HOMEWARD_S = 15.0
"""Longest time for the way home [s]; steady wind may keep a vehicle away."""
HOLD_MIN_S, HOLD_MAX_S = 3.0, 6.0
STEP_MPS = 0.5
"""Size of the velocity steps if the reference is at rest [m/s]."""
STEP_MIN_MPS = 0.05
FAST = 1.3
"""Safety factor on the predicted distance of a step."""


class ExperimentPlan(NamedTuple):
    speeds: tuple[float, ...]
    hold_s: float
    repeats: int

    @property
    def duration_s(self) -> float:
        return len(self.speeds) * self.repeats * ((STEPS + 1) * self.hold_s + 2.0)


class FlownStep(NamedTuple):
    axis: int
    before: float
    after: float
    began_ns: int
    ended_ns: int
    """Time at which the input changed again, or the fence shortened the step [ns]."""


def reference_speeds(scenario: Scenario) -> list[float]:
    times = np.arange(scenario.steps + 1) * scenario.control.dt
    states = scenario.make_reference()(times)
    speeds: list[float] = np.abs(states[..., 1]).max(axis=0).tolist()
    return speeds


def default_speeds(scenario: Scenario) -> tuple[float, ...]:
    """Default size of the velocity steps on each axis [m/s], similar to speeds of later flights.

    The size is the reference's largest speed on the axis, but at least half of its largest speed on
    any axis: on an axis without motion, feedback still causes inputs.
    """
    speeds = reference_speeds(scenario)
    least = max(speeds) / 2.0 or STEP_MPS
    limit = scenario.fence.speed_mps or math.inf
    asked = zip(speeds, scenario.u_max.tolist(), strict=True)
    return tuple(round(min(max(each, least), most, limit), 2) for each, most in asked)


def default_hold_s(scenario: Scenario) -> float:
    """Default time for which a step is held [s]; a vehicle similar to the model settles in it."""
    terms = scenario.terms()
    slowest = max(4.0 * t + late for t, late in zip(terms.tau_s, terms.dead_time_s, strict=True))
    return round(min(max(slowest, HOLD_MIN_S), HOLD_MAX_S), 2)


def fenced(scenario: Scenario, plan: ExperimentPlan) -> Scenario:
    """Scenario with a fence around the experiment, if the scenario has none."""
    if scenario.fence.is_there:
        return scenario
    fastest, brake = max(plan.speeds), scenario.vehicle.brake_mps2
    slow = max(scenario.tau_s.tolist()) + SLOW_STEPS * scenario.control.dt
    reach_m = FAST * fastest * plan.hold_s + fastest * slow + fastest**2 / (2.0 * brake)
    radius = math.ceil(reach_m + max(margins(scenario)))
    fence = msgspec.structs.replace(scenario.fence, radius_m=float(radius))
    return msgspec.structs.replace(scenario, fence=fence)


class Experiment:
    """Generator of the experiment's input at each control step.

    The scenario needs a fence.
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
        self.cut = [0] * len(plan.speeds)
        """Number of steps of each axis that the fence shortened or left no space for."""
        self.is_over = False

    def choose(self, state: Sequence[tuple[float, float]], *, now_ns: int) -> list[float]:
        """Input to fly from now on, for each axis [m/s].

        Args:
            state: state of each axis when the input takes effect [m, m/s]; the first position is
                home.
        """
        self._now_ns, self._state = now_ns, state
        if self._script is None:
            self._home = [p for p, _ in state]
            # The fence takes the position of its first call as home.
            self._fence.limited([0.0] * len(state), state, self._u_max)
            self._script = self._flown()
        wanted = next(self._script, None)
        if wanted is None:
            self.is_over, wanted = True, [0.0] * len(state)
        self._input = self._fence.limited(wanted, state, self._u_max)
        return self._input

    def _flown(self) -> Iterator[list[float]]:
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
        """One repetition: rest, then steps out and back, until the fence shortens a step."""
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
        began_ns = self._now_ns
        while self._now_ns - began_ns < HOMEWARD_S * SECOND_NS:
            away = zip(self._state, self._home, strict=True)
            if all(abs(p - h) < NEAR_M and abs(v) < SLOW_MPS for (p, v), h in away):
                return
            yield self._homeward()

    def _homeward(self) -> list[float]:
        axes = zip(self._state, self._home, self._u_max, strict=True)
        return [min(max(HOMEWARD * (h - p), -most), most) for (p, _), h, most in axes]

    def _direction(self, axis: int) -> float:
        """Direction in which the fence leaves space for a step: 1 or -1; 0 without such space.

        On the vertical axis -1 is tried only if the fence has a lower bound.
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
