"""What flies. `Plant` is all the client knows of it; here it is the paper's model with wind.

    v̇(t) = (g u(t - θ) + w - v(t)) / τ + a      g: gain, θ: dead time [s], w: steady wind [m/s],
                                                a: gusts [m/s²], constant over a step, plus
                                                   white acceleration

Every part is discretised exactly. A constant acceleration a acts like the input τ a. Where the dead
time is no whole number of steps, the input changes once within each, and the two inputs share B of
eq. (4). The covariance of the white part over a step has a closed form.
"""

from collections import deque
from typing import Protocol

import numpy as np

from shared.config import Scenario, VehicleConfig
from shared.endpoint import SECOND_NS, seconds_to_ns
from shared.model import Array, advance, discretise


class Plant(Protocol):
    """A vehicle whose velocity can be commanded."""

    def state(self) -> Array:
        """Position [m] and velocity [m/s] now, in the world frame; shape (axes, 2)."""

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""

    def change(self, vehicle: VehicleConfig) -> None:
        """Let other winds blow from the next step on; nothing but the air is another."""


class FirstOrderPlant:
    """Eq. (1), with the true time constants, gain, dead time, wind and gusts of a scenario.

    Args:
        rng: chance of wind and gusts, for this vehicle alone.
    """

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        vehicle, dt, tau = scenario.vehicle, scenario.control.dt, scenario.true_tau_s
        # Plain numbers, of each axis: numpy costs more than it saves on so few.
        model = discretise(tau, dt)
        self._model = model.axes()
        self._gain = vehicle.gain
        whole, rest_ns = divmod(seconds_to_ns(vehicle.dead_time_s), scenario.dt_ns)
        self._commands = deque([[0.0] * len(tau)] * (whole + 2), whole + 2)
        """On their way: the first was flown before, the second is due now [m/s]."""
        after = discretise(tau, dt - rest_ns / SECOND_NS)
        self._B_before = (model.B - after.B).tolist() if rest_ns else []
        """The part of B that is still the input's flown before."""
        self._rng = rng
        self._dt_s = dt
        self._tau = tau
        self._gust: Array | None = None
        """Way that the gust blows, of any length; shape (axes,). None between gusts."""
        self.change(vehicle)
        start = scenario.vehicle.start_m or scenario.make_reference()(np.zeros(()))[:, 0]
        self._x = [(float(position), 0.0) for position in start]

    def change(self, vehicle: VehicleConfig) -> None:
        """See `Plant`."""
        white = vehicle.wind * white_acceleration(self._tau, self._dt_s)
        self._wind = white.tolist() if vehicle.wind else []
        self._gust_mps2 = vehicle.gust_mps2
        self._gust_end_chance = float(-np.expm1(-self._dt_s / vehicle.gust_s))
        self._gust_start_chance = float(-np.expm1(-self._dt_s / vehicle.gust_every_s))
        self._steady_mps = np.array(vehicle.steady_wind_mps or np.zeros(len(self._tau)))
        if self._gust_mps2 == 0.0:
            self._gust = None
        self._push = self._pushed()
        """Push w + τ a on each axis, gusts included [m/s]."""

    def state(self) -> Array:
        """See `Plant`."""
        return np.array(self._x)

    def advance(self, command: Array) -> None:
        """See `Plant`."""
        self._blow()
        self._commands.append(command.tolist())
        before, due = self._commands[0], self._commands[1]
        for i, u in enumerate(due):
            self._x[i] = advance(self._model[i], *self._x[i], self._gain * u + self._push[i])
        for i, L in enumerate(self._B_before):
            (p, v), w = self._x[i], self._gain * (before[i] - due[i])
            self._x[i] = (p + L[0] * w, v + L[1] * w)
        if self._wind:
            for i, (n, m) in enumerate(self._rng.standard_normal((len(self._x), 2)).tolist()):
                (p, v), L = self._x[i], self._wind[i]
                self._x[i] = (p + L[0][0] * n, v + (L[1][0] * n + L[1][1] * m))

    def _blow(self) -> None:
        """Gusts begin and end by chance, each blowing one way all along."""
        if self._gust_mps2 == 0.0:
            return
        chance = self._rng.random()
        if self._gust is not None:
            if chance < self._gust_end_chance:
                self._gust = None
                self._push = self._pushed()
        elif chance < self._gust_start_chance:
            self._gust = self._rng.standard_normal(len(self._tau))
            self._push = self._pushed()

    def _pushed(self) -> list[float]:
        """Push of the air now on each axis [m/s]."""
        if self._gust is None:
            return self._steady_mps.tolist()
        gust_mps2 = self._gust_mps2 * self._gust / np.linalg.norm(self._gust)
        pushed: list[float] = (self._steady_mps + self._tau * gust_mps2).tolist()
        return pushed


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
