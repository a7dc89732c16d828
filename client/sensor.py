"""What a vehicle measures of itself: its position and its velocity, now and then, late and wrong.

    z(k) = x(k - D) + b + σ n          D: delay [steps]   b: bias   σ n: noise, drawn anew each time

A measurement is made at the begin of a step, and had at the begin of another: of the first that is
no earlier than it is due, and than its delay allows. At step 0 everything is due that is measured
at all. Until then the vehicle has stood where it starts.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from shared.config import Scenario
from shared.endpoint import seconds_to_ns
from shared.model import Array


class Measured(NamedTuple):
    """What is measured and had at a step, of each axis; None where there is nothing new."""

    position: list[float] | None
    """Position [m]."""
    velocity: list[float] | None
    """Velocity [m/s]."""


class Sensor:
    """Sensor of a scenario's vehicle.

    Args:
        rng: chance of its noise, for this vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        sensor, self._dt_ns = scenario.sensor, scenario.dt_ns
        self.delay = -(-seconds_to_ns(sensor.delay_s) // self._dt_ns)
        """Time from measuring to having the measurement, D [steps]."""
        self._every_ns = [
            0 if every_s == "never" else max(seconds_to_ns(every_s), self._dt_ns)
            for every_s in (sensor.position_every_s, sensor.velocity_every_s)
        ]
        """Time from one position, and one velocity, to the next [ns]; 0: never."""
        self._noise = sensor.position_noise_m, sensor.velocity_noise_mps
        nothing = (0.0,) * scenario.model.axes
        self._bias = sensor.position_bias_m or nothing, sensor.velocity_bias_mps or nothing
        wrong = any(self._noise) or any(map(any, self._bias))
        late = self.delay > 0 or self._every_ns != [self._dt_ns, self._dt_ns]
        self.exact = not (wrong or late)
        """Whether it measures the whole state as it is, at every step."""
        self._rng = rng
        self._states: deque[list[list[float]]] = deque(maxlen=self.delay + 1)
        """Those that are still to be had, the oldest first; each of the shape (axes, 2)."""
        self._step = 0

    def measure(self, state: Array) -> Measured:
        """What is had at the next step, from step 0 on.

        Args:
            state: true position [m] and velocity [m/s] at the step; shape (axes, 2).
        """
        states = self._states
        states.append(state.tolist())
        while len(states) <= self.delay:
            states.append(states[0])
        position, velocity = (self._measure(states[0], which) for which in (0, 1))
        self._step += 1
        return Measured(position, velocity)

    def _measure(self, state: list[list[float]], which: int) -> list[float] | None:
        """Position (0) or velocity (1) of a state, where one is due."""
        every_ns, time_ns = self._every_ns[which], self._step * self._dt_ns
        if not every_ns or time_ns % every_ns >= self._dt_ns:
            return None
        noise, bias = self._noise[which], self._bias[which]
        drawn = self._rng.standard_normal(len(state)).tolist() if noise else bias
        return [x[which] + b + noise * n for x, b, n in zip(state, bias, drawn, strict=True)]
