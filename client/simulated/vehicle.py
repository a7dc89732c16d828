"""A vehicle that is computed: a plant in its weather, advanced step by step, and its sensor."""

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
from skytether.shared.scenario.schema import Scenario, VehicleConfig

WIND = keys_of(InFlight.WIND)
"""Wind and gust keys."""


class Plant(Protocol):
    """Simulated vehicle, advanced step by step."""

    def state(self) -> Array:
        """Position [m] and velocity [m/s] now, of each axis; shape (axes, 2)."""

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""

    def change(self, vehicle: VehicleConfig) -> None:
        """Change the winds from the next step on."""


class SimulatedVehicle(Vehicle):
    """A plant that is measured at the begin of each step.

    Args:
        dt_ns: length of a step [ns].
        plant: what flies, wherever it is by now.
        sensor: what measures it.
    """

    changeable = WIND

    def __init__(self, dt_ns: int, plant: Plant, sensor: Sensor) -> None:
        self._dt_ns = dt_ns
        self.plant, self.sensor = plant, sensor
        self._began_ns = 0
        self._step = -1
        """Step at whose begin the plant's state is; -1 before the flight."""
        self._velocity = np.zeros(len(plant.state()))

    def fly(self, velocity: Array) -> None:
        """See `Vehicle`; it is flown from the begin of the step on."""
        self._velocity = velocity

    def measurements(self, *, now_ns: int) -> Sequence[Measurement]:
        """See `Vehicle`; all steps that have begun by now are flown first."""
        told: list[Measurement] = []
        if self._step < 0:
            self._began_ns, self._step = now_ns, 0
            self._measure(told)
        # The plant stands at the begin of a step and is flown on when it is looked at: it needs no
        # clock of its own.
        while self._began_ns + (self._step + 1) * self._dt_ns <= now_ns:
            self.plant.advance(self._velocity)
            self._step += 1
            self._measure(told)
        return told

    def _measure(self, told: list[Measurement]) -> None:
        """Add the measurement that is available at the step, if there is one."""
        measured = self.sensor.measure(self.plant.state(), began_ns=self._began_ns)
        if measured.position or measured.velocity:
            told.append(measured)

    def truth(self) -> Array:
        """See `Vehicle`."""
        return self.plant.state()

    def change(self, scenario: Scenario) -> None:
        """See `Vehicle`."""
        self.plant.change(scenario.vehicle)


def quadrotor(scenario: Scenario, number: int) -> SimulatedVehicle:
    """The quadrotor of a scenario with a number, whose gusts and noise are its own."""
    from skytether.client.simulated.quadrotor import QuadrotorPlant  # numba takes a second

    plant = QuadrotorPlant(scenario, stream(scenario.seed, "turbulence", number), number)
    sensor = Sensor(scenario, stream(scenario.seed, "sensor", number))
    return SimulatedVehicle(scenario.dt_ns, plant, sensor)


def simulated(scenario: Scenario, number: int) -> SimulatedVehicle:
    """The vehicle of a scenario with a number, whose winds and noise are its own."""
    weather = Weather(scenario, stream(scenario.seed, "wind", number))
    sensor = Sensor(scenario, stream(scenario.seed, "sensor", number))
    return SimulatedVehicle(scenario.dt_ns, FirstOrderPlant(scenario, weather, number), sensor)
