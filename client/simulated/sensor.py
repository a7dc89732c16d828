"""Sensor of position and velocity, with its rate, delay, noise and bias.

    z(k) = x(k - D) + b + σ n          D: delay [steps]   b: bias   σ n: noise

A measurement is made at the start of a step, and becomes available D steps later, but only at steps
at which the sensor's rate makes it due. At step 0 every measured quantity is due; before step 0 the
vehicle stands at its start.
"""

from collections import deque

import numpy as np

from skytether.client.navigation import sensing
from skytether.client.simulated.normals import Normals
from skytether.client.vehicle import Measurement
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario


@compilable
def sensed(state: Table, bias: Table, noise: Numbers, drawn: Table, measured: Table) -> None:
    """Measure the whole state.

    Args:
        state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        bias: b of positions [m] and velocities [m/s]; shape (2, axes).
        noise: σ of a position [m] and of a velocity [m/s].
        drawn: random numbers n of positions and velocities; shape (2, axes).
        measured: output: positions [m] and velocities [m/s]; shape (2, axes).
    """
    for which in range(2):
        for axis in range(len(state)):
            measured[which, axis] = (
                state[axis, which] + bias[which, axis] + noise[which] * drawn[which, axis]
            )


class Sensor:
    """Sensor of a scenario's vehicle; `rng` draws its noise."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        sensor, self._dt_ns = scenario.sensor, scenario.dt_ns
        self.delay, self._every_ns, self._is_prompt, self._is_exact = sensing(scenario)
        nothing = [0.0] * scenario.model.axes
        biases = sensor.position_bias_m or nothing, sensor.velocity_bias_mps or nothing
        self._bias = np.array(biases, dtype=np.float64)
        """Bias b of positions [m] and of velocities [m/s]; shape (2, axes)."""
        self._noise = np.array((sensor.position_noise_m, sensor.velocity_noise_mps))
        """Standard deviation σ of a position [m] and of a velocity [m/s]."""
        self._rng = rng
        noisy = self._noise.nonzero()[0].tolist()
        self._normals = Normals(rng, (len(noisy), len(nothing))) if noisy else None
        """Random numbers n, for a sensor that measures the whole state at every step."""
        self._noisy = noisy
        """Indices of the quantities with noise: 0: position, 1: velocity."""
        self._drawn = np.zeros_like(self._bias)
        """Numbers n of both quantities; 0 for a quantity without noise. Shape (2, axes)."""
        self._states: deque[Array] = deque(maxlen=self.delay + 1)
        self._step = 0

    def measure(self, state: Array, *, began_ns: int = 0) -> Measurement:
        """Measurement available at the present step; the first call is step 0, each call one step.

        Args:
            state: true position [m] and velocity [m/s] at the step, of each axis; shape (axes, 2).
            began_ns: start of step 0 [ns; the client's clock].
        """
        step, self._step = self._step, self._step + 1
        stamp_ns = began_ns + max(0, step - self.delay) * self._dt_ns
        if self._is_exact:
            return Measurement(stamp_ns, *state.T.tolist())
        states = self._states
        states.append(state)
        # Before step 0 the vehicle stood at its start.
        while len(states) <= self.delay:
            states.append(states[0])
        if self._is_prompt:
            measured, drawn = np.empty_like(self._bias), self._drawn
            if self._normals is not None:
                drawn = self._normals.next()
                if len(drawn) < len(measured):
                    self._drawn[self._noisy], drawn = drawn, self._drawn
            sensed(states[0], self._bias, self._noise, drawn, measured)
            return Measurement(stamp_ns, *measured.tolist())
        return Measurement(stamp_ns, *(self._measure(states[0], which, step) for which in (0, 1)))

    def _measure(self, state: Array, which: int, step: int) -> list[float] | None:
        """Measured position (0) or velocity (1) of a state; None if none is due at the step."""
        every_ns, time_ns = self._every_ns[which], step * self._dt_ns
        # Due at the first step at or after a multiple of the interval, which may not be a multiple
        # of Δt.
        if not every_ns or time_ns % every_ns >= self._dt_ns:
            return None
        measured = state[:, which] + self._bias[which]
        if noise := self._noise[which]:
            measured += noise * self._rng.standard_normal(len(state))
        return measured.tolist()
