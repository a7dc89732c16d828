"""Simulated vehicle: a plant in its weather, advanced step by step, and a sensor."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.weather import Weather
from skytether.client.vehicle import Measurement, Vehicle
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.registry import VEHICLES
from skytether.shared.scenario.schema import Scenario, VehicleConfig

WIND = keys_of(InFlight.WIND)


class Plant(Protocol):
    def state(self) -> Array:
        """Present position [m] and velocity [m/s] of each axis; shape (axes, 2)."""

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""

    def change(self, vehicle: VehicleConfig) -> None:
        """Use the wind of changed keys from the next step on."""


class SimulatedVehicle(Vehicle):
    """Simulated vehicle: a plant, measured at the start of each step."""

    changeable = WIND

    def __init__(self, dt_ns: int, plant: Plant, sensor: Sensor) -> None:
        self._dt_ns = dt_ns
        self.plant, self.sensor = plant, sensor
        self._began_ns = 0
        self._step = -1
        """Step at whose start the plant's state is valid; -1 before the flight."""
        self._state = plant.state()
        """State at the start of `_step` [m, m/s]; shape (axes, 2)."""
        self._velocity = np.zeros(len(self._state))

    def fly(self, velocity: Array) -> None:
        self._velocity = velocity

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        """Measurements that became available. The plant is first advanced to the present step."""
        available: list[Measurement] = []
        if self._step < 0:
            self._began_ns = now_ns
        # The plant's state is the state at the start of a step. The plant has no clock: it is
        # advanced here, on demand.
        while self._began_ns + (self._step + 1) * self._dt_ns <= now_ns:
            if self._step >= 0:
                self.plant.advance(self._velocity)
            self._step, self._state = self._step + 1, self.plant.state()
            measured = self.sensor.measure(self._state, began_ns=self._began_ns)
            if measured.position or measured.velocity:
                available.append(measured)
        return available

    def truth(self) -> Array:
        return self._state

    def change(self, scenario: Scenario) -> None:
        self.plant.change(scenario.vehicle)


@VEHICLES
def quadrotor(scenario: Scenario, number: int) -> SimulatedVehicle:
    """Simulated quadrotor with rotors and control loops, in wind and turbulence."""
    from skytether.client.simulated.quadrotor import (
        QuadrotorPlant,
    )  # importing numba takes a second

    plant = QuadrotorPlant(scenario, stream(scenario.seed, "turbulence", number), number)
    sensor = Sensor(scenario, stream(scenario.seed, "sensor", number))
    return SimulatedVehicle(scenario.dt_ns, plant, sensor)


@VEHICLES
def simulated(scenario: Scenario, number: int) -> SimulatedVehicle:
    """Simulated velocity loop of first order in wind: eq. (1), with optional deviations from it."""
    weather = Weather(scenario, stream(scenario.seed, "wind", number))
    sensor = Sensor(scenario, stream(scenario.seed, "sensor", number))
    return SimulatedVehicle(scenario.dt_ns, FirstOrderPlant(scenario, weather, number), sensor)
