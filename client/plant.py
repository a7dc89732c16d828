"""What flies. `Plant` is all the client knows of it; here it is the paper's model with wind.

    v̇ = (u - v) / τ + a        a: gusts [m/s²], constant over a step, plus white acceleration

A constant acceleration a acts like the input τ a, so a step with gusts stays exact. The white part
is discretised exactly too: its covariance over a step has a closed form.
"""

from typing import Protocol

import numpy as np

from shared.config import Scenario
from shared.model import Array, discretise


class Plant(Protocol):
    """A vehicle whose velocity can be commanded."""

    def state(self) -> Array:
        """Position [m] and velocity [m/s] now, in the world frame; shape (axes, 2)."""

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""


class FirstOrderPlant:
    """Eq. (1), with the true time constants, wind and gusts of a scenario.

    Args:
        rng: chance of wind and gusts, for this vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        vehicle, dt = scenario.vehicle, scenario.control.dt
        self._tau = scenario.true_tau_s
        self._model = discretise(self._tau, dt)
        self._rng = rng
        self._wind = vehicle.wind * white_acceleration(self._tau, dt) if vehicle.wind else None
        self._gust_mps2 = vehicle.gust_mps2
        self._gust_end_chance = -np.expm1(-dt / vehicle.gust_s)
        self._gust_start_chance = -np.expm1(-dt / vehicle.gust_every_s)
        self._gust = np.zeros(len(self._tau))
        self._x = np.zeros((len(self._tau), 2))
        start = scenario.vehicle.start_m or scenario.make_reference()(np.zeros(()))[:, 0]
        self._x[:, 0] = start

    def state(self) -> Array:
        """See `Plant`."""
        return self._x.copy()

    def advance(self, command: Array) -> None:
        """See `Plant`."""
        self._blow()
        self._x = self._model.step(self._x, command + self._tau * self._gust)
        if self._wind is not None:
            noise = self._rng.standard_normal((len(self._tau), 2))
            self._x += np.einsum("aij,aj->ai", self._wind, noise)

    def _blow(self) -> None:
        """Gusts begin and end by chance, each blowing one way all along."""
        if self._gust_mps2 == 0.0:
            return
        chance = self._rng.random()
        if self._gust.any():
            if chance < self._gust_end_chance:
                self._gust[:] = 0.0
        elif chance < self._gust_start_chance:
            way = self._rng.standard_normal(len(self._tau))
            self._gust = self._gust_mps2 * way / np.linalg.norm(way)


def white_acceleration(tau_s: Array, dt_s: float) -> Array:
    """Square root L of a step's covariance under white acceleration, L Lᵀ = ∫ e^{As} G Gᵀ e^{Aᵀs}.

    With G = [0, 1], e^{As}G = [τ(1 - e^{-s/τ}), e^{-s/τ}], and the integrals over [0, Δt] follow.

    Args:
        tau_s: shape (axes,).

    Returns:
        shape (axes, 2, 2).
    """
    tau = np.asarray(tau_s, dtype=np.float64)
    one = -tau * np.expm1(-dt_s / tau)  # ∫ e^{-s/τ}
    two = -0.5 * tau * np.expm1(-2.0 * dt_s / tau)  # ∫ e^{-2s/τ}
    positions = tau**2 * (dt_s - 2.0 * one + two)
    both = tau * (one - two)
    covariance = np.stack([np.stack([positions, both], -1), np.stack([both, two], -1)], -2)
    root: Array = np.linalg.cholesky(covariance).astype(np.float64)
    return root
