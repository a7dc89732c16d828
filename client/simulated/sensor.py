"""Sensor of position and velocity, with its rate, delay, noise and bias.

    z(k) = x(k - D) + b + σ n          D: delay [steps]   b: bias   σ n: noise, drawn anew each time

A measurement is made at the begin of a step, and had at the begin of another: of the first that is
no earlier than it is due, and than its delay allows. At step 0 everything is due that is measured
at all. Until then the vehicle has stood where it starts.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from skytether.client.navigation import sensing
from skytether.client.vehicle import Measurement
from skytether.shared.scenario.schema import Scenario


class Sensor:
    """Sensor of a scenario's vehicle.

    Args:
        rng: chance of its noise, for this vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        sensor, self._dt_ns = scenario.sensor, scenario.dt_ns
        self.delay, self._every_ns, self.is_exact = sensing(scenario)
        self._noise = sensor.position_noise_m, sensor.velocity_noise_mps
        nothing = (0.0,) * scenario.model.axes
        self._bias = sensor.position_bias_m or nothing, sensor.velocity_bias_mps or nothing
        self._rng = rng
        self._states: deque[list[Sequence[float]]] = deque(maxlen=self.delay + 1)
        """Measurements that are not available yet, the oldest first; each of shape (axes, 2)."""
        self._step = 0

    def measure(self, state: Sequence[Sequence[float]], *, began_ns: int = 0) -> Measurement:
        """Measurements available at the next step, from step 0 on.

        Args:
            state: true position [m] and velocity [m/s] at the step, of each axis.
            began_ns: begin of step 0 [ns; the client's clock].
        """
        stamp_ns = began_ns + max(0, self._step - self.delay) * self._dt_ns
        if self.is_exact:
            self._step += 1
            return Measurement(stamp_ns, [p for p, _ in state], [v for _, v in state])
        states = self._states
        states.append(list(state))
        # Before the first measurement is due, the vehicle has stood where it begins.
        while len(states) <= self.delay:
            states.append(states[0])
        position, velocity = (self._measure(states[0], which) for which in (0, 1))
        self._step += 1
        return Measurement(stamp_ns, position, velocity)

    def measured_at(self, step: int) -> None:
        """Note that it has measured elsewhere at all steps up to this one."""
        self._step = step + 1

    def _measure(self, state: list[Sequence[float]], which: int) -> list[float] | None:
        """Position (0) or velocity (1) of a state, where one is due."""
        every_ns, time_ns = self._every_ns[which], self._step * self._dt_ns
        # Due at the first step at or after a multiple of the interval, though that is no multiple
        # of Δt.
        if not every_ns or time_ns % every_ns >= self._dt_ns:
            return None
        noise, bias = self._noise[which], self._bias[which]
        drawn = self._rng.standard_normal(len(state)).tolist() if noise else bias
        return [x[which] + b + noise * n for x, b, n in zip(state, bias, drawn, strict=True)]
