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
from skytether.client.simulated.normals import BLOCK, Normals
from skytether.client.vehicle import Measurement
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario


class Sensor:
    """Sensor of a scenario's vehicle.

    Args:
        rng: chance of its noise, for this vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        sensor, self._dt_ns = scenario.sensor, scenario.dt_ns
        self.delay, self._every_ns, self.is_prompt, self.is_exact = sensing(scenario)
        self.noise = sensor.position_noise_m, sensor.velocity_noise_mps
        """Standard deviation σ of a position [m] and of a velocity [m/s]."""
        nothing = (0.0,) * scenario.model.axes
        self.bias = sensor.position_bias_m or nothing, sensor.velocity_bias_mps or nothing
        """Bias b of a position [m] and of a velocity [m/s], on each axis."""
        self._rng = rng
        noisy = [bool(noise) for noise in self.noise]
        self._normals = Normals(rng, (sum(noisy), scenario.model.axes)) if any(noisy) else None
        """Numbers n of a sensor that measures the whole state at every step."""
        self._without = np.array([self.bias] * BLOCK)
        """Numbers n of as many steps without noise; shape (BLOCK, 2, axes)."""
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
        position: list[float] | None
        velocity: list[float] | None
        if self.is_prompt:
            numbers = zip((0, 1), self.draw()[0].tolist(), strict=True)
            position, velocity = (self._told(states[0], which, drawn) for which, drawn in numbers)
            self.pass_by()
        else:
            position, velocity = (self._measure(states[0], which) for which in (0, 1))
        self._step += 1
        return Measurement(stamp_ns, position, velocity)

    def measured_at(self, step: int) -> None:
        """Note that it has measured elsewhere at all steps up to this one."""
        self._step = step + 1

    def draw(self, steps: int = 1) -> Array:
        """Numbers n of the next steps' measurements, which stay the next ones until `pass_by`.

        Only for a sensor that measures the whole state at every step.

        Args:
            steps: number of steps, at least 1.

        Returns:
            numbers of 1 to so many steps, of positions and of velocities; those without noise are
            the bias, which noise of 0 makes nothing of; shape (n, 2, axes).
        """
        if self._normals is None:
            return self._without[:steps]
        drawn = self._normals.ahead(steps)
        if all(self.noise):
            return drawn
        told = np.array([self.bias] * len(drawn))
        told[:, 0 if self.noise[0] else 1] = drawn[:, 0]
        return told

    def pass_by(self, steps: int = 1) -> None:
        """Leave the next steps, whose numbers `draw` has told, behind."""
        if self._normals is not None:
            self._normals.use(steps)

    def _measure(self, state: list[Sequence[float]], which: int) -> list[float] | None:
        """Position (0) or velocity (1) of a state, where one is due."""
        every_ns, time_ns = self._every_ns[which], self._step * self._dt_ns
        # Due at the first step at or after a multiple of the interval, though that is no multiple
        # of Δt.
        if not every_ns or time_ns % every_ns >= self._dt_ns:
            return None
        noisy, bias = self.noise[which], self.bias[which]
        drawn = self._rng.standard_normal(len(state)).tolist() if noisy else bias
        return self._told(state, which, drawn)

    def _told(
        self, state: list[Sequence[float]], which: int, drawn: Sequence[float]
    ) -> list[float]:
        """Position (0) or velocity (1) of a state, with bias and the noise that was drawn."""
        noise, bias = self.noise[which], self.bias[which]
        return [x[which] + b + noise * n for x, b, n in zip(state, bias, drawn, strict=True)]
