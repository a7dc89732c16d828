"""Quadrotor that flies a commanded velocity, in steps of 2 ms.

The interface has x north, y east, altitude up.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from skytether.quadrotor.air import Air
from skytether.quadrotor.body import STATES, STEP_NS
from skytether.quadrotor.frames import Frame
from skytether.quadrotor.loops import Gains, Quad, drain, fly
from skytether.shared.base.kernel import plain
from skytether.shared.law.model import Array

UP = np.array([1.0, 1.0, -1.0])
"""Signs that convert (north, east, down) to (x north, y east, z up), and back."""


class Attitude(NamedTuple):
    roll: float
    """Roll angle, positive to the right [rad]."""
    pitch: float
    """Pitch angle, positive nose up [rad]."""
    yaw: float
    """Heading, from north to east [rad]."""
    rates: tuple[float, float, float]
    """Rates about the axes forward, right and down [rad/s]."""


class Battery(NamedTuple):
    charge: float
    """Remaining charge of the battery, from 1 to 0."""
    voltage: float
    """Voltage of the battery [V]."""
    current: float
    """Current drawn from the battery [A]."""


class Quadrotor:
    """Quadrotor and the air around it.

    Args:
        rng: random generator of the gusts, for this vehicle only.
        position: initial position, at rest [m]; shape (3,).
        ground_m: altitude of the ground; None for no ground.
        charge: charge of the battery, from 0 to 1; "endless" for a battery that never discharges.
        hovers: whether the quadrotor begins in hover; otherwise its rotors stand still.
    """

    def __init__(
        self,
        frame: Frame,
        gains: Gains,
        rng: np.random.Generator,
        *,
        position: Array,
        ground_m: float | None = None,
        charge: float | Literal["endless"] = 1.0,
        hovers: bool = True,
    ) -> None:
        if charge == "endless":
            frame, charge = frame._replace(capacity_ah=np.inf), 1.0
        self.frame, self._rng = frame, rng
        self.gains = gains
        self._ground = np.inf if ground_m is None else -ground_m
        self.on = hovers
        x = np.zeros(STATES)
        x[:3], x[6] = UP * position, 1.0
        x[13:] = frame.hover if hovers else 0.0
        empty = np.zeros(3)
        self._quad = Quad(
            x, np.zeros(9), empty, empty.copy(), empty.copy(), np.array([charge, 0.0, 0.0])
        )
        plain(drain)(frame, x, self._quad.battery)
        self._air = Air(np.zeros(3), np.zeros(1), np.zeros(5))
        self._rest_ns = 0

    def blow(self, steady_mps: Sequence[float], turbulence_mps: float) -> None:
        """Set the wind.

        Args:
            steady_mps: velocity of the steady wind [m/s; x, y, z]; 0 along missing axes.
            turbulence_mps: wind speed 6 m above ground that determines the gusts [m/s].
        """
        steady = np.zeros(3)
        steady[: len(steady_mps)] = steady_mps
        self._air.steady[:] = UP * steady
        self._air.turbulence[0] = turbulence_mps

    def advance(self, velocity: Array, duration_ns: int) -> None:
        """Fly for a duration; a remainder of less than a time step is added to the next duration.

        Args:
            velocity: commanded velocity [m/s]; shape (3,).
        """
        steps, self._rest_ns = divmod(self._rest_ns + duration_ns, STEP_NS)
        if not steps:
            return
        turbulent = self._air.turbulence[0] > 0.0
        drawn = self._rng.standard_normal((steps, 3)) if turbulent else np.zeros((steps, 3))
        target = UP * velocity
        fly(self.frame, self.gains, self._quad, self._air, drawn, target, self._ground, self.on)

    def position(self) -> Array:
        """True position [m]; shape (3,)."""
        return UP * self._quad.x[:3]

    def velocity(self) -> Array:
        """True velocity [m/s]; shape (3,)."""
        return UP * self._quad.x[3:6]

    def wanted_position(self) -> Array:
        """Position of the shaped motion, which the control loops track [m]; shape (3,).

        If there is no position loop (`Gains.catch_up` is 0), this is the true position.
        """
        ahead = self._quad.wanted[6:] if self.gains.catch_up else 0.0
        wanted: Array = UP * (self._quad.x[:3] + ahead)
        return wanted

    def attitude(self) -> Attitude:
        w, x, y, z = self._quad.x[6:10].tolist()
        p, q, r = self._quad.x[10:13].tolist()
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return Attitude(float(roll), float(pitch), float(yaw), (p, q, r))

    def battery(self) -> Battery:
        charge, voltage, current = self._quad.battery.tolist()
        return Battery(max(charge, 0.0), voltage, current)

    def discharge(self, charge: float) -> None:
        self._quad.battery[0] = min(self._quad.battery[0], charge)

    def stands(self) -> bool:
        return bool(self._quad.x[2] >= self._ground)
