"""State of a vehicle as it knows it: its measurements, and its filter's estimate.

What is known is what the vehicle flies by and reports: with a dead time not its state now, but the
one in which its next input will meet it (`shared.law.dead_time`). With a sensor that measures the
whole state as it is, at every step, nothing is filtered, unless the filter's disturbance is needed:
to predict over a dead time, and to fly along a spline.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

from skytether.client.filter import Kalman
from skytether.client.vehicle import Measurement
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.dead_time import OnTheirWay
from skytether.shared.law.leap import (
    NOISE_M,
    NOISE_MPS,
    displacement,
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
        self._motions = list(zip(terms.tau_s, terms.gain, strict=True))
        self._begun = False
        self.leaps = Leaps(scenario)
        """Check of each measurement against the one before."""
        self.is_simple = known.prompt and self._inputs is None
        """Whether the whole state is measured at each step, and each input acts at once."""
        self.leapt = False
        """Whether what was measured since the last step is what no vehicle can have come to."""
        self._nothing = [math.nan] * axes
        self.measured = [(math.nan, math.nan)] * axes
        """Measurements that came since the last step, position [m] and velocity [m/s] of each
        axis; NaN where nothing is."""
        self.estimate = self.measured
        """State now, position [m] and velocity [m/s] of each axis."""
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
        position = velocity = self._nothing
        due: list[float] = command.tolist()
        swing: Sequence[float] = ()
        if self._inputs is not None:
            due, swing = self._inputs.issue(due)
        if self._begun:
            self.filter.advance(due, swing)
        self.leapt = False
        for measured in measurements if self._begun else _newest(measurements):
            self.leapt |= self.leaps.leaps(measured)
            if self._begun:
                self.filter.take(self._carried(measured, now_ns - self._delay_ns, due))
            else:
                self.filter.begin(measured)
                self._begun = True
            position, velocity = measured.position or position, measured.velocity or velocity
        self.measured = list(zip(position, velocity, strict=True))
        if self._begun:
            self.estimate = self.predicted = self.filter.estimate()
            if self._inputs is not None:
                self.predicted = self._inputs.predict(self.estimate, self.filter.disturbance())
            numbers = chain.from_iterable(self.predicted)
            # Told as float32, a larger number would reach the server as infinity.
            self.is_known = all(-FLOAT_MAX <= number <= FLOAT_MAX for number in numbers)

    def begin_anew(self) -> None:
        """Begin with the next measurement: the frame has changed, and with it the position."""
        self._begun, self.leaps = False, Leaps(self._scenario)

    def note(self, estimate: list[tuple[float, float]]) -> None:
        """Note the finite estimate of a step that was computed elsewhere, without a leap.

        Filter, leaps and `measured` are left as they were.
        """
        self.leapt = False
        self.estimate = self.predicted = estimate

    @property
    def disturbance(self) -> Sequence[float]:
        """Disturbance ŵ that the filter has found on each axis [m/s]; 0 without a filter."""
        return self.filter.disturbance()

    def _carried(self, measured: Measurement, to_ns: int, due: list[float]) -> Measurement:
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
        known = measured.velocity or [v for _, v in self.filter.estimate()]
        acting = zip(self._motions, due, self.filter.disturbance(), strict=True)
        position, velocity = list(measured.position or ()), []
        for i, ((tau, gain), u, w) in enumerate(acting):
            # Eq. (1) in closed form: the input is constant over the time that is bridged.
            left, steady = math.exp(-age / tau), gain * u + w
            velocity.append(steady + (known[i] - steady) * left)
            if position:
                position[i] += steady * age + (known[i] - steady) * tau * (1.0 - left)
        return Measurement(to_ns, position or None, velocity if measured.velocity else None)


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
        self.noise_m = NOISE_M + SIGMAS * sensor.position_noise_m
        self.noise_mps = NOISE_MPS + SIGMAS * sensor.velocity_noise_mps
        self._position: tuple[int, list[float]] | None = None
        """Newest position [m] of each axis, and its stamp."""
        self._velocity: tuple[int, list[float]] | None = None
        """Newest velocity [m/s] of each axis, and its stamp."""

    def leaps(self, measured: Measurement) -> bool:
        """Remember a measurement; whether no vehicle can have come so far since the last one."""
        stamp_ns, position, velocity = measured
        before, found = self._velocity, False
        if velocity is not None:
            if before is not None:
                time, noise = (stamp_ns - before[0]) / SECOND_NS, self.noise_mps
                for v, after_v in zip(before[1], velocity, strict=True):
                    found |= velocity_leaps(v, after_v, time, noise)
            # Also after a leap: else whatever is measured after it would be one, too.
            self._velocity = stamp_ns, velocity
        self.off_m = []
        if position is not None:
            if self._position is not None and before is not None:
                since_ns, elsewhere = self._position
                time, noise = (stamp_ns - since_ns) / SECOND_NS, self.noise_m
                moves = list(
                    zip(elsewhere, before[1], position, velocity or before[1], strict=True)
                )
                if any(position_leaps(*each, time, noise) for each in moves):
                    found = True
                    self.off_m = [displacement(*each, time) for each in moves]
            self._position = stamp_ns, position
        return found

    def took(self, measured: Measurement) -> None:
        """Note a whole state that has not leapt."""
        stamp_ns, position, velocity = measured
        assert position is not None
        assert velocity is not None
        self._position, self._velocity = (stamp_ns, position), (stamp_ns, velocity)


class Newest:
    """Stand-in for a filter: each number as it was measured last."""

    def __init__(self, axes: int) -> None:
        self._nothing = [0.0] * axes
        self._position: list[float] = []
        self._velocity: list[float] = []

    def begin(self, measured: Measurement) -> None:
        """Take the first measurement."""
        self.take(measured)

    def advance(self, due: list[float], swing: Sequence[float] = ()) -> None:
        """Advance by a step, in which no number changes by itself."""

    def disturbance(self) -> list[float]:
        """Disturbance of each axis, of which nothing is known: 0 [m/s]."""
        return self._nothing

    def take(self, measured: Measurement) -> None:
        """Keep a measurement, in place of the one before."""
        self._position = measured.position or self._position
        self._velocity = measured.velocity or self._velocity

    def estimate(self) -> list[tuple[float, float]]:
        """Position [m] and velocity [m/s] of each axis."""
        return list(zip(self._position, self._velocity, strict=True))
