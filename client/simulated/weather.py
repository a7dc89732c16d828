"""Wind and gusts: what the air does to a simulated vehicle over each step.

    w      steady wind [m/s]
    a      gusts [m/s²], constant over a step: they begin and end by chance, each blowing one way
    white  acceleration of the strength `vehicle.wind` [m/s per √s]

A constant acceleration a acts like the input τ a. The covariance of the white part over a step has
a closed form, see `shared.law.model.white_acceleration`.
"""

from typing import NamedTuple

import numpy as np

from skytether.client.simulated.normals import BLOCK, Normals
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario.schema import Scenario, VehicleConfig


class AirStep(NamedTuple):
    """Wind over one step."""

    push: list[float]
    """Push w + τ a on each axis, which acts like an input [m/s]."""
    shoves: list[tuple[float, float]]
    """White acceleration's part of position [m] and velocity [m/s] of each axis; empty without
    any."""


class Weather:
    """Weather of a scenario.

    Args:
        rng: chance of wind and gusts, for one vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self._rng = rng
        self._dt_s = scenario.control.dt
        self._tau = scenario.true_tau_s
        self._gust: Array | None = None
        """Way that the gust blows, of any length; shape (axes,). None between gusts."""
        self._still = np.zeros((len(self._tau), 2))
        self._stills = np.zeros((BLOCK, *self._still.shape))
        self._normals = Normals(rng, self._still.shape)
        self._drawn: Array | None = None
        """Wind drawn for the next step and not used yet, where there are gusts."""
        self.change(scenario.vehicle)

    def change(self, vehicle: VehicleConfig) -> None:
        """Change the winds from the next step on."""
        self._normals.give_back()
        white = vehicle.wind * white_acceleration(self._tau, self._dt_s)
        self.white = white.tolist() if vehicle.wind else []
        self._gust_mps2 = vehicle.gust_mps2
        # Chance in a step of an event that comes at a constant rate: exact for any length of a
        # step.
        self._gust_end_chance = float(-np.expm1(-self._dt_s / vehicle.gust_s))
        self._gust_start_chance = float(-np.expm1(-self._dt_s / vehicle.gust_every_s))
        self._steady_mps = np.array(vehicle.steady_wind_mps or np.zeros(len(self._tau)))
        if self._gust_mps2 == 0.0:
            self._gust = None
        self.calm = self._pushed()
        """The air over a step, but for white acceleration."""

    def blow(self) -> AirStep:
        """The air over the next step."""
        (drawn,) = self.draw()
        self.pass_by()
        if not self.white:
            return self.calm
        shoves = [
            (L[0][0] * n, L[1][0] * n + L[1][1] * m)
            for L, (n, m) in zip(self.white, drawn.tolist(), strict=True)
        ]
        return AirStep(self.calm.push, shoves)

    def draw(self, steps: int = 1) -> Array:
        """Normal numbers of the white acceleration over the next steps.

        They are the same until `pass_by`: until then the air stays as it is.

        Args:
            steps: number of steps, at least 1.

        Returns:
            numbers of 1 to so many steps, with gusts of one alone; shape (n, axes, 2).
        """
        if self._gust_mps2 == 0.0:
            if self.white:
                return self._normals.ahead(steps)
            return self._stills[:steps]
        if self._drawn is None:
            # What gusts draw lies between the numbers of two steps.
            self._gusts()
            drawn = self._rng.standard_normal(self._still.shape) if self.white else self._still
            self._drawn = drawn[None]
        return self._drawn

    @property
    def has_gusts(self) -> bool:
        """Whether gusts begin and end by chance."""
        return self._gust_mps2 != 0.0

    def pass_by(self, steps: int = 1) -> None:
        """Let the air of the next steps, which `draw` has told, pass by."""
        if self._gust_mps2 == 0.0 and self.white:
            self._normals.use(steps)
        self._drawn = None

    def _gusts(self) -> None:
        """Gusts begin and end by chance, each blowing one way all along."""
        # Drawn at every step, so that the times of gusts do not depend on their strength.
        chance = self._rng.random()
        if self._gust is not None:
            if chance < self._gust_end_chance:
                self._gust = None
                self.calm = self._pushed()
        elif chance < self._gust_start_chance:
            self._gust = self._rng.standard_normal(len(self._tau))
            self.calm = self._pushed()

    def _pushed(self) -> AirStep:
        """The air now, but for white acceleration."""
        if self._gust is None:
            return AirStep(self._steady_mps.tolist(), [])
        gust_mps2 = self._gust_mps2 * self._gust / np.linalg.norm(self._gust)
        # An acceleration a acts like an input τ a under eq. (1).
        return AirStep((self._steady_mps + self._tau * gust_mps2).tolist(), [])
