"""Uplink delay compensator, eq. (11): which input to fly now, from a horizon made earlier.

    u* = u(min(k, k_h + H - 1) | k_h)        k_h: the step that the horizon was made for

With committed inputs at its head a horizon is that much longer, and read in the same way. Where it
brings feedback, the vehicle is led back to where it would be, x̄, had nothing else happened:

    u*(k) = u(k|k_h) + K (x̄(k) - x(k)),     x̄(i+1) = A x̄(i) + B (u(i|k_h) + w)

The horizon of the newest generation wins, in whatever order they arrive (E11).
"""

import numpy as np

from shared.config import Scenario
from shared.model import Array, discretise
from shared.protocol import NO_HORIZON, Horizon, ProtocolError


class Compensator:
    """Holds the newest horizon and reads the input of any step from it."""

    def __init__(self, scenario: Scenario) -> None:
        self._H = scenario.control.horizon
        self._compensate = scenario.control.scheme != "none"
        self._brakes = scenario.vehicle.exhausted == "brake"
        self._brake_per_step = scenario.vehicle.brake_mps2 * scenario.control.dt
        self._bound = scenario.u_max[:, None]
        self._inputs: Array = np.zeros((self._H, scenario.model.axes))
        self._model = discretise(scenario.tau_s, scenario.control.dt)
        self._back: tuple[Array, Array] | None = None
        """With feedback, x̄ along the inputs, and K; shapes (stages, axes, 2) and (axes, 2)."""
        self.in_force = NO_HORIZON
        """k_h, or NO_HORIZON: then the vehicle hovers."""
        self.since = 0
        """The first step that it was chosen for."""
        self._new = False
        self.observed_ns = -1
        """Stamp of the observation that the horizon was computed from [client clock]."""
        self.stale = 0
        """Horizons that came after a newer one."""

    def offer(self, horizon: Horizon, step: int) -> None:
        """A horizon arrived during `step`.

        Raises:
            ProtocolError: it is made for a time so far ahead that nothing later could replace it.
        """
        if horizon.step > step + self._H:
            raise ProtocolError("from the future")
        if horizon.step <= self.in_force:
            self.stale += 1
            return
        self.in_force, self._new = horizon.step, True
        self.observed_ns = horizon.observed_ns
        self._inputs = horizon.inputs.clip(-self._bound, self._bound).T
        self._back = None
        if horizon.feedback.size:
            told = horizon.feedback.astype(np.float64)
            led = self._model.roll_out(told[:, :2], self._inputs + told[:, 2])
            self._back = led, told[:, 3:]

    def choose(self, step: int, state: Array) -> Array:
        """u* for `step` [m/s]; shape (axes,).

        Args:
            state: position [m] and velocity [m/s] at the step; shape (axes, 2).
        """
        if self._new:
            self.since, self._new = step, False
        if self.in_force == NO_HORIZON:
            return np.zeros(len(self._bound))
        if not self._compensate:
            return self._inputs[0].copy()
        stage, length = step - self.in_force, len(self._inputs)
        if stage >= length and self._brakes:
            return self._braked(stage - length + 1)
        told: Array = self._inputs[min(max(stage, 0), length - 1)]
        if self._back and 0 <= stage < length:
            led, gain = self._back
            back = (gain * (led[stage] - state)).sum(axis=1)
            return (told + back).clip(-self._bound[:, 0], self._bound[:, 0])
        return told.copy()

    def _braked(self, steps: int) -> Array:
        """The last input, slowed down for `steps` at a constant rate, straight ahead."""
        last: Array = self._inputs[-1]
        speed = float(np.linalg.norm(last))
        left = max(0.0, speed - steps * self._brake_per_step)
        return last * (left / speed) if speed > 0.0 else last.copy()
