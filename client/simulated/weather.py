"""Wind and gusts: effects of the air on a simulated vehicle over each step.

    w      steady wind [m/s]
    a      gusts [m/s²], constant over a step: they start and end at random, each in one direction
    white  acceleration of the strength `vehicle.wind` [m/s per √s]

A constant acceleration a acts like the input τ a. The covariance of the white part over a step has
a closed form, see `shared.law.model.white_acceleration`.
"""

import numpy as np

from skytether.client.simulated.normals import Normals
from skytether.shared.base.compilable import Table, compilable
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario.schema import Scenario, VehicleConfig


@compilable
def shoved(x: Table, white: Table, drawn: Table) -> None:
    """Add the effect of white acceleration over a step to positions and velocities, in place.

    Args:
        x: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        white: Cholesky factor of the effect's covariance, [L11, L21, L22] of each axis.
        drawn: two normal random numbers per axis.
    """
    for i in range(len(x)):
        n, m = drawn[i, 0], drawn[i, 1]
        x[i, 0] += white[i, 0] * n
        x[i, 1] += white[i, 1] * n + white[i, 2] * m


class Weather:
    """Weather of a scenario; `rng` draws wind and gusts of one vehicle."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self._rng = rng
        self._dt_s = scenario.control.dt
        self._tau = scenario.true_tau_s
        self._gust: Array | None = None
        """Direction of the gust, not normalised; shape (axes,). None between gusts."""
        self._normals = Normals(rng, (len(self._tau), 2))
        self.change(scenario.vehicle)

    def change(self, vehicle: VehicleConfig) -> None:
        self._normals.give_back()
        L = vehicle.wind * white_acceleration(self._tau, self._dt_s)
        self._white = np.stack((L[:, 0, 0], L[:, 1, 0], L[:, 1, 1]), -1) if vehicle.wind else None
        self._gust_mps2 = vehicle.gust_mps2
        # Probability that a gust ends (or begins) within a step, at a constant rate: exact for any
        # length of the step.
        self._gust_end_chance = float(-np.expm1(-self._dt_s / vehicle.gust_s))
        self._gust_start_chance = float(-np.expm1(-self._dt_s / vehicle.gust_every_s))
        self._steady_mps = np.array(vehicle.steady_wind_mps or np.zeros(len(self._tau)))
        if self._gust_mps2 == 0.0:
            self._gust = None
        self._push = self._pushed()

    def push(self) -> Array:
        """Wind and gust over the next step as an input, w + τ a [m/s]; shape (axes,)."""
        if self._gust_mps2 != 0.0:
            self._gusts()
        return self._push

    def shove(self, x: Array) -> None:
        """Add the effect of one step of white acceleration to `x`, in place.

        `x` has position [m] and velocity [m/s] of each axis; shape (axes, 2).
        """
        if self._white is None:
            return
        # With gusts the numbers are drawn now, because gusts use the same stream between two steps.
        gusty = self._gust_mps2 != 0.0
        drawn = self._rng.standard_normal(x.shape) if gusty else self._normals.next()
        shoved(x, self._white, drawn)

    def _gusts(self) -> None:
        # Drawn at every step, so that the times of gusts do not depend on their strength.
        chance = self._rng.random()
        if self._gust is not None:
            if chance < self._gust_end_chance:
                self._gust = None
                self._push = self._pushed()
        elif chance < self._gust_start_chance:
            self._gust = self._rng.standard_normal(len(self._tau))
            self._push = self._pushed()

    def _pushed(self) -> Array:
        if self._gust is None:
            return self._steady_mps
        gust_mps2 = self._gust_mps2 * self._gust / np.linalg.norm(self._gust)
        # An acceleration a acts like an input τ a in eq. (1).
        return self._steady_mps + self._tau * gust_mps2
