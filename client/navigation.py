"""State of a vehicle as it knows it: its measurements, and its filter's estimate.

What is known is what the vehicle flies by and reports: with a dead time not its state now, but the
one in which its next input will meet it (`shared.law.dead_time`). With a sensor that measures the
whole state as it is, at every step, nothing is filtered, unless the filter's disturbance is needed:
to predict over a dead time, and to fly along a spline.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.client.filter import Kalman
from skytether.client.vehicle import Measurement
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.dead_time import OnTheirWay
from skytether.shared.law.leap import (
    NOISE_M,
    NOISE_MPS,
    displacement,
    most_m,
    position_leaps,
    velocity_leaps,
)
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import FLOAT_MAX

CARRIED_NS = SECOND_NS // 2
"""Longest time for which a measurement is carried on [ns]; an older one is as if from then."""
SIGMAS = 10.0
"""Standard deviations of its sensor's noise by which a change may be off."""


class Sensing(NamedTuple):
    """Properties of a scenario's sensor."""

    delay: int
    """Time from measuring to having the measurement, D [steps]."""
    every_ns: tuple[int, int]
    """Time from one position, and one velocity, to the next [ns]; 0: never."""
    prompt: bool
    """Whether it measures the whole state at every step, and tells it at once."""
    exact: bool
    """Whether it measures the whole state as it is, at every step."""


def sensing(scenario: Scenario) -> Sensing:
    """Properties of a scenario's sensor."""
    sensor, dt_ns = scenario.sensor, scenario.dt_ns
    # Rounded up: a measurement is taken at the first step at which it is there.
    delay = -(-seconds_to_ns(sensor.delay_s) // dt_ns)
    position_ns, velocity_ns = (
        0 if every_s == "never" else max(seconds_to_ns(every_s), dt_ns)
        for every_s in (sensor.position_every_s, sensor.velocity_every_s)
    )
    noise = sensor.position_noise_m, sensor.velocity_noise_mps
    wrong = any((*noise, *sensor.position_bias_m, *sensor.velocity_bias_mps))
    prompt = delay == 0 and (position_ns, velocity_ns) == (dt_ns, dt_ns)
    return Sensing(delay, (position_ns, velocity_ns), prompt, prompt and not wrong)


def filters(scenario: Scenario) -> bool:
    """Whether a scenario's vehicle has a Kalman filter."""
    terms = scenario.terms()
    needs_disturbance = any(terms.dead_time_s) or terms.splines
    return scenario.sensor.filter == "kalman" and (needs_disturbance or not sensing(scenario).exact)


class Navigation:
    """Filter that a scenario's vehicle has for its measurements."""

    def __init__(self, scenario: Scenario) -> None:
        known, axes = sensing(scenario), scenario.model.axes
        self._scenario, terms = scenario, scenario.terms()
        self.filter = Kalman(scenario, known.delay) if filters(scenario) else Newest(axes)
        """Filter that makes an estimate of the measurements."""
        late = any(terms.dead_time_s)
        self._inputs = OnTheirWay(terms.model.axes(), terms.dead_times) if late else None
        """Inputs on their way; None where the model has each act at once."""
        self._delay_ns = known.delay * scenario.dt_ns
        """Time from measuring to having it that the filter itself reckons with [ns]."""
        self._tau_s, self._gain = np.array(terms.tau_s), np.array(terms.gain)
        self._begun = False
        self.leaps = Leaps(scenario)
        """Check of each measurement against the one before."""
        self.leapt = False
        """Whether what was measured since the last step is what no vehicle can have come to."""
        self._nothing = np.full((2, axes), math.nan)
        self.measured: Array = np.full((axes, 2), math.nan)
        """Measurements that came since the last step, position [m] and velocity [m/s] of each
        axis; NaN where nothing is. Shape (axes, 2)."""
        self.estimate = self.measured
        """State now, position [m] and velocity [m/s] of each axis; shape (axes, 2)."""
        self.predicted = self.estimate
        """State in which the next input will meet the vehicle, which is flown by and reported;
        without a dead time the estimate."""
        self.is_known = False
        """Whether the estimate is finite, also when it is told, and can be flown by."""

    def advance(self, measurements: Sequence[Measurement], command: Array, *, now_ns: int) -> None:
        """Advance to a step; before the first the vehicle stands still.

        Args:
            measurements: what has been measured and is had since the step before.
            command: the input flown since then [m/s]; shape (axes,).
            now_ns: begin of the step [ns; the client's clock].
        """
        due, swing = command, None
        if self._inputs is not None:
            due, swing = self._inputs.issue(command)
        if self._begun:
            self.filter.advance(due, swing)
        self.leapt, told = False, self._nothing
        for measured in measurements if self._begun else _newest(measurements):
            numbers = measured.numbers()
            self.leapt |= self.leaps.leaps(measured, numbers)
            told = numbers if told is self._nothing else np.where(np.isnan(numbers), told, numbers)
            if self._begun:
                carried = self._carried(measured, now_ns - self._delay_ns, due)
                if carried is not measured:
                    numbers = carried.numbers()
                self.filter.take(carried, numbers)
            else:
                self.filter.begin(measured, numbers)
                self._begun = True
        self.measured = told.T
        if self._begun:
            self.estimate = self.predicted = self.filter.estimate()
            if self._inputs is not None:
                self.predicted = self._inputs.predict(self.estimate, self.filter.disturbance())
            # Told as float32, a larger number would reach the server as infinity.
            self.is_known = all_within(self.predicted, FLOAT_MAX)

    def begin_anew(self) -> None:
        """Begin with the next measurement: the frame has changed, and with it the position."""
        self._begun, self.leaps = False, Leaps(self._scenario)

    @property
    def disturbance(self) -> Array:
        """Disturbance ŵ that the filter has found on each axis [m/s]; 0 without a filter."""
        return self.filter.disturbance()

    def _carried(self, measured: Measurement, to_ns: int, due: Array) -> Measurement:
        """A measurement carried to a later time by the model; an earlier time changes nothing.

        A real vehicle measures when it likes. For a time in which an input acted that is another
        than that of the last step, the difference is left to the filter.

        Args:
            measured: what was measured.
            to_ns: the time [ns; the client's clock].
            due: the input that has acted in the last step, of each axis [m/s].

        Source: eq. (1).
        """
        age = min(to_ns - measured.stamp_ns, CARRIED_NS) / SECOND_NS
        if age <= 0.0:
            return measured
        _, position, velocity = measured
        known = self.filter.estimate()[:, 1] if velocity is None else np.array(velocity)
        # Eq. (1) in closed form: the input is constant over the time that is bridged.
        left, steady = np.exp(-age / self._tau_s), self._gain * due + self.filter.disturbance()
        if position is not None:
            bridged = steady * age + (known - steady) * self._tau_s * (1.0 - left)
            position = (position + bridged).tolist()
        if velocity is not None:
            velocity = (steady + (known - steady) * left).tolist()
        return Measurement(to_ns, position, velocity)


def _newest(measurements: Sequence[Measurement]) -> Sequence[Measurement]:
    """Measurements from the newest position on: a vehicle is known from there.

    What was measured before the first step is of a vehicle that others flew: in its climb, the
    autopilot. With the inputs that we know, the filter would make a disturbance of that.
    """
    placed = [i for i, each in enumerate(measurements) if each.position is not None]
    return measurements[placed[-1] :] if placed else ()


class Leaps:
    """Watch over what is measured: each is held against what was measured before."""

    def __init__(self, scenario: Scenario) -> None:
        sensor = scenario.sensor
        self.off_m: list[float] = []
        """Displacement of the newest position from where the vehicle can have come to, on each axis
        [m]; empty unless it has leapt."""
        self._noise_m = NOISE_M + SIGMAS * sensor.position_noise_m
        self._noise_mps = NOISE_MPS + SIGMAS * sensor.velocity_noise_mps
        self._position = self._velocity = np.full(scenario.model.axes, math.nan)
        """Newest position [m] and velocity [m/s] of each axis; NaN before any."""
        self._position_ns = self._velocity_ns = 0
        """Their stamps."""

    def leaps(self, measured: Measurement, numbers: Array) -> bool:
        """Remember a measurement; whether no vehicle can have come so far since the last one.

        Args:
            measured: the measurement.
            numbers: its positions and velocities, NaN for what is not measured; shape (2, axes).
        """
        stamp_ns, position, velocity = measured
        p, v = self._position, self._velocity
        time_p, time_v = (
            (stamp_ns - each) / SECOND_NS for each in (self._position_ns, self._velocity_ns)
        )
        leaps = has_leapt(p, v, numbers, time_p, time_v, self._noise_m, self._noise_mps)
        self.off_m = []
        if leaps and position is not None:
            moves = zip(p.tolist(), v.tolist(), position, velocity or v.tolist(), strict=True)
            off_m = [displacement(*each, time_p) for each in moves]
            if any(abs(off) > most_m(time_p, self._noise_m) for off in off_m):
                self.off_m = off_m
        # Also after a leap: else whatever is measured after it would be one, too.
        if position is not None:
            self._position, self._position_ns = numbers[0], stamp_ns
        if velocity is not None:
            self._velocity, self._velocity_ns = numbers[1], stamp_ns
        return leaps


@compilable
def all_within(table: Table, most: float) -> bool:
    """Whether all numbers have at most this magnitude; a NaN has not."""
    within = True
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            within &= abs(table[row, column]) <= most
    return within


@compilable
def has_leapt(
    position: Numbers,
    velocity: Numbers,
    measured: Table,
    time_p: float,
    time_v: float,
    noise_m: float,
    noise_mps: float,
) -> bool:
    """Whether a measurement has jumped further than any vehicle could have moved; NaN has not
    jumped.

    Args:
        position, velocity: of each axis, as they were measured last [m], [m/s].
        measured: positions and velocities now; shape (2, axes).
        time_p, time_v: times since then [s].
        noise_m, noise_mps: what noise may add to a change [m], [m/s].
    """
    leaps = False
    for i in range(len(position)):
        p, v, after_p, after_v = position[i], velocity[i], measured[0, i], measured[1, i]
        leaps |= velocity_leaps(v, after_v, time_v, noise_mps)
        if math.isnan(after_v):
            after_v = v
        leaps |= position_leaps(p, v, after_p, after_v, time_p, noise_m)
    return leaps


class Newest:
    """Stand-in for a filter: each number as it was measured last."""

    def __init__(self, axes: int) -> None:
        self._zero = np.zeros(axes)
        self._state = np.full((axes, 2), math.nan)

    def begin(self, measured: Measurement, numbers: Array) -> None:
        """Take the first measurement."""
        self.take(measured, numbers)

    def advance(self, due: Array, swing: Array | None = None) -> None:
        """Advance by a step, in which no number changes by itself."""

    def disturbance(self) -> Array:
        """Disturbance of each axis, of which nothing is known: 0 [m/s]."""
        return self._zero

    def take(self, measured: Measurement, numbers: Array) -> None:
        """Keep a measurement, in place of the one before."""
        if measured.position is not None:
            self._state[:, 0] = numbers[0]
        if measured.velocity is not None:
            self._state[:, 1] = numbers[1]

    def estimate(self) -> Array:
        """Position [m] and velocity [m/s] of each axis; shape (axes, 2)."""
        return self._state.copy()
