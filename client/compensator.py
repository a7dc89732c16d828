"""Uplink delay compensator, eq. (11): which input to fly now, from a horizon made earlier.

    u* = u(min(k, k_h + H - 1) | k_h)        k_h: the step that the horizon was made for

With committed inputs at its head a horizon is that much longer, and read in the same way.
The horizon of the newest generation wins, in whatever order they arrive (E11).
"""

import numpy as np

from shared.config import Scenario
from shared.model import Array
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

    def choose(self, step: int) -> Array:
        """u* for `step` [m/s]; shape (axes,)."""
        if self._new:
            self.since, self._new = step, False
        if self.in_force == NO_HORIZON:
            return np.zeros(len(self._bound))
        if not self._compensate:
            return self._inputs[0].copy()
        stage, length = step - self.in_force, len(self._inputs)
        if stage >= length and self._brakes:
            return self._braked(stage - length + 1)
        return self._inputs[min(max(stage, 0), length - 1)].copy()

    def _braked(self, steps: int) -> Array:
        """The last input, slowed down for `steps` at a constant rate, straight ahead."""
        last: Array = self._inputs[-1]
        speed = float(np.linalg.norm(last))
        left = max(0.0, speed - steps * self._brake_per_step)
        return last * (left / speed) if speed > 0.0 else last.copy()
