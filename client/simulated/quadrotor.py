"""Simulated quadrotor: rigid body, rotors, control loops and air, see `quadrotor`.

In a scenario with two axes the quadrotor holds its altitude.
"""

import numpy as np

from skytether.quadrotor.frames import FRAMES
from skytether.quadrotor.loops import ARDUPILOT, CRAZYFLIE, PX4
from skytether.quadrotor.quadrotor import Quadrotor
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario, VehicleConfig

GAINS = {"crazyflie": CRAZYFLIE, "1.5kg": ARDUPILOT, "sih": PX4}
"""Gains of the autopilot, by airframe (`vehicle.frame`)."""
ALTITUDE_M = 5.0
"""Altitude of a flight in the plane [m]."""


class QuadrotorPlant:
    """Quadrotor of a scenario, hovering at the start; `rng` draws its gusts."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator, number: int) -> None:
        vehicle, self._dt_ns = scenario.vehicle, scenario.dt_ns
        self._axes = scenario.model.axes
        frame = "1.5kg" if vehicle.frame == "auto" else vehicle.frame
        start = scenario.start_m(number)
        if self._axes == 2:
            start = np.append(start, ALTITUDE_M)
        self._quadrotor = Quadrotor(
            FRAMES[frame], GAINS[frame], rng, position=start, charge=vehicle.battery
        )
        self.change(vehicle)

    def state(self) -> Array:
        quadrotor = self._quadrotor
        return np.stack((quadrotor.position(), quadrotor.velocity()), -1)[: self._axes]

    def advance(self, command: Array) -> None:
        if self._axes == 2:
            command = np.append(command, ALTITUDE_M - self._quadrotor.position()[2])
        self._quadrotor.advance(command, self._dt_ns)

    def change(self, vehicle: VehicleConfig) -> None:
        self._quadrotor.blow(vehicle.steady_wind_mps, vehicle.turbulence_mps)
