"""Navigation: the estimate of the vehicle's state, from measurements and a filter.

With a dead time, feedback and observations use not the present state but the predicted state in
which the next input will take effect (`shared.law.dead_time`). A sensor that measures the exact
state at every step needs no filter. A filter is used all the same if the disturbance has to be
estimated, to predict over a dead time or to follow a spline.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from skytether.client.filter import Kalman
from skytether.client.vehicle import Measurement
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.leap import (
    NOISE_M,
    NOISE_MPS,
    displacement,
    most_m,
    position_leaps,
    velocity_leaps,
)
from skytether.shared.law.model import Array
from skytether.shared.scenario import rooms
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import FLOAT_MAX

CARRIED_NS = SECOND_NS // 2
"""Longest time over which a measurement is extrapolated [ns], even if the measurement is older."""
SIGMAS = 10.0
"""Number of standard deviations of sensor noise by which two measurements may differ without a
leap."""


class Sensing(NamedTuple):
    delay: int
    """Delay of a measurement, D [steps]."""
    every_ns: tuple[int, int]
    """Interval between positions, and between velocities [ns]; 0: never measured."""
    prompt: bool
    """Whether the sensor measures the whole state at every step without delay."""
    exact: bool
    """Whether the sensor is `prompt` and has neither noise nor bias."""


def sensing(scenario: Scenario) -> Sensing:
    sensor, dt_ns = scenario.sensor, scenario.dt_ns
    # Rounded up: a measurement is used at the first step at which it is available.
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
    terms = scenario.terms()
    needs_disturbance = any(terms.dead_time_s) or terms.splines
    return scenario.sensor.filter == "kalman" and (needs_disturbance or not sensing(scenario).exact)


class Navigation:
    """Estimate of a vehicle's state, updated at every step."""

    def __init__(self, scenario: Scenario) -> None:
        sensor, axes = sensing(scenario), scenario.model.axes
        self._scenario, terms = scenario, scenario.terms()
        self.filter: Any = (
            Kalman(scenario, sensor.delay)
            if filters(scenario)
            else load("skytether.client.unfiltered", "sensor.filter").Newest(axes)
        )
        self._inputs: Any = None
        """Inputs that do not act yet (`PendingInputs`); None if the model has no dead time."""
        if any(terms.dead_time_s):
            late = rooms.dead_time()
            self._inputs = late.PendingInputs(terms.model.axes(), late.dead_times(terms))
        self._delay_ns = sensor.delay * scenario.dt_ns
        """Delay of measurements that the filter compensates [ns]."""
        self._tau_s, self._gain = np.array(terms.tau_s), np.array(terms.gain)
        self._begun = False
        self.leaps = Leaps(scenario)
        self.leapt = False
        """Whether a measurement since the last step differs from the previous one by more than any
        vehicle could have moved."""
        self._nothing = np.full((2, axes), math.nan)
        self.measured: Array = np.full((axes, 2), math.nan)
        """Measurements since the last step, position [m] and velocity [m/s] of each axis, NaN if
        missing; shape (axes, 2)."""
        self.estimate = self.measured
        """Estimated present state, position [m] and velocity [m/s] of each axis; shape (axes,
        2)."""
        self.predicted = self.estimate
        """State in which the next input will take effect, used by feedback and in observations;
        equal to the estimate without a dead time."""
        self.is_known = False
        """Whether the predicted state is finite, also as float32."""

    def advance(self, measurements: Sequence[Measurement], command: Array, *, now_ns: int) -> None:
        """Advance to a step; the filter starts at the first position, with a vehicle at rest.

        Args:
            measurements: measurements that became available since the previous step.
            command: input flown since the previous step [m/s]; shape (axes,).
            now_ns: start of the step [ns; the client's clock].
        """
        due, swing = command, None
        if self._inputs is not None:
            due, swing = self._inputs.issue(command)
        if self._begun:
            self.filter.advance(due, swing)
        self.leapt, newest = False, self._nothing
        for measured in measurements if self._begun else _newest(measurements):
            numbers = measured.numbers()
            self.leapt |= self.leaps.leaps(measured, numbers)
            newest = (
                numbers if newest is self._nothing else np.where(np.isnan(numbers), newest, numbers)
            )
            if self._begun:
                carried = self._carried(measured, now_ns - self._delay_ns, due)
                if carried is not measured:
                    numbers = carried.numbers()
                self.filter.take(carried, numbers)
            else:
                self.filter.begin(measured, numbers)
                self._begun = True
        self.measured = newest.T
        if self._begun:
            self.estimate = self.predicted = self.filter.estimate()
            if self._inputs is not None:
                self.predicted = self._inputs.predict(self.estimate, self.filter.disturbance())
            # Observations carry float32, in which a larger number would be infinite.
            self.is_known = all_within(self.predicted, FLOAT_MAX)

    def begin_anew(self) -> None:
        """Start again from the next measurement, because frame and position have changed."""
        self._begun, self.leaps = False, Leaps(self._scenario)

    @property
    def disturbance(self) -> Array:
        return self.filter.disturbance()

    def _carried(self, measured: Measurement, to_ns: int, due: Array) -> Measurement:
        """Measurement extrapolated by the model to a later time; unchanged if the time is earlier.

        A real vehicle measures between steps. The extrapolation assumes the input `due`. If another
        input acted for part of the time, the filter corrects the error.

        Args:
            measured: the measurement.
            to_ns: time to extrapolate to [ns; the client's clock].
            due: input that acted during the last step, of each axis [m/s].

        Source: eq. (1).
        """
        age = min(to_ns - measured.stamp_ns, CARRIED_NS) / SECOND_NS
        if age <= 0.0:
            return measured
        _, position, velocity = measured
        velocity_now = self.filter.estimate()[:, 1] if velocity is None else np.array(velocity)
        # Eq. (1) in closed form: the input is constant over this time.
        decay, steady = np.exp(-age / self._tau_s), self._gain * due + self.filter.disturbance()
        if position is not None:
            bridged = steady * age + (velocity_now - steady) * self._tau_s * (1.0 - decay)
            position = (position + bridged).tolist()
        if velocity is not None:
            velocity = (steady + (velocity_now - steady) * decay).tolist()
        return Measurement(to_ns, position, velocity)


def _newest(measurements: Sequence[Measurement]) -> Sequence[Measurement]:
    """Newest measurement with a position, and all later measurements; the filter starts from them.

    Before the first step somebody else flew the vehicle, such as the autopilot during its climb.
    The filter, which knows only the client's inputs, would see that motion as a disturbance.
    """
    placed = [i for i, measurement in enumerate(measurements) if measurement.position is not None]
    return measurements[placed[-1] :] if placed else ()


class Leaps:
    """Leap detection: each measurement is compared with the previous one."""

    def __init__(self, scenario: Scenario) -> None:
        sensor = scenario.sensor
        self.off_m: list[float] = []
        """Distance of the newest position from the position that the velocities predict, on each
        axis [m]; empty unless the position has leapt."""
        self._noise_m = NOISE_M + SIGMAS * sensor.position_noise_m
        self._noise_mps = NOISE_MPS + SIGMAS * sensor.velocity_noise_mps
        self._position = self._velocity = np.full(scenario.model.axes, math.nan)
        """Newest position [m] and velocity [m/s] of each axis; NaN before the first."""
        self._position_ns = self._velocity_ns = 0

    def leaps(self, measured: Measurement, numbers: Array) -> bool:
        """Store a measurement; return whether it is too far from the last one for any vehicle.

        Args:
            measured: the measurement.
            numbers: its positions [m] and velocities [m/s], NaN if missing; shape (2, axes).
        """
        stamp_ns, position, velocity = measured
        p, v = self._position, self._velocity
        time_p = (stamp_ns - self._position_ns) / SECOND_NS
        time_v = (stamp_ns - self._velocity_ns) / SECOND_NS
        leaps = has_leapt(p, v, numbers, time_p, time_v, self._noise_m, self._noise_mps)
        self.off_m = []
        if leaps and position is not None:
            moves = zip(p.tolist(), v.tolist(), position, velocity or v.tolist(), strict=True)
            off_m = [displacement(*last_ns, time_p) for last_ns in moves]
            if any(abs(off) > most_m(time_p, self._noise_m) for off in off_m):
                self.off_m = off_m
        # Also stored after a leap: otherwise all later measurements would count as leaps, too.
        if position is not None:
            self._position, self._position_ns = numbers[0], stamp_ns
        if velocity is not None:
            self._velocity, self._velocity_ns = numbers[1], stamp_ns
        return leaps


@compilable
def all_within(table: Table, most: float) -> bool:
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
    """Whether a measurement is farther from the last one than a vehicle can move; False for NaN.

    Args:
        position, velocity: previous measurement of each axis [m], [m/s].
        measured: new positions [m] and velocities [m/s]; shape (2, axes).
        time_p, time_v: time since the previous position and velocity [s].
        noise_m, noise_mps: change that noise alone may cause [m], [m/s].
    """
    leaps = False
    for i in range(len(position)):
        p, v, after_p, after_v = position[i], velocity[i], measured[0, i], measured[1, i]
        leaps |= velocity_leaps(v, after_v, time_v, noise_mps)
        if math.isnan(after_v):
            after_v = v
        leaps |= position_leaps(p, v, after_p, after_v, time_p, noise_m)
    return leaps
