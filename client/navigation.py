"""What a vehicle knows of its state: what its sensor measures, and what its filter makes of that.

What is known is what the vehicle flies by and reports. The truth is known to its record alone. With
a sensor that measures the whole state as it is, at every step, both are the same to the last bit,
and nothing is filtered.
"""

import math

import numpy as np

from client.filter import Kalman
from client.sensor import Measured, Sensor
from shared.config import Scenario
from shared.model import Array


def navigation(scenario: Scenario, rng: np.random.Generator) -> "Navigation | None":
    """What a scenario's vehicle knows of its state; None where that is the state as it is.

    Args:
        rng: chance of the sensor's noise, for this vehicle alone.
    """
    sensor = Sensor(scenario, rng)
    return None if sensor.exact else Navigation(scenario, sensor)


class Navigation:
    """A vehicle's sensor, and the filter behind it."""

    def __init__(self, scenario: Scenario, sensor: Sensor) -> None:
        self._sensor = sensor
        filters = scenario.sensor.filter == "kalman"
        self._filter = Kalman(scenario, sensor.delay) if filters else Newest()
        self._begun = False
        self.measured = self.estimate = np.full((scenario.model.axes, 2), math.nan)
        """What was measured and is had since the last step, NaN where nothing is; and what is
        reported: position [m] and velocity [m/s], shape (axes, 2)."""

    def advance(self, state: Array, command: Array) -> None:
        """Go on to a step; before the first the vehicle stands.

        Args:
            state: its true state at the step; shape (axes, 2).
            command: the input flown since the step before [m/s]; shape (axes,).
        """
        measured = self._sensor.measure(state)
        if self._begun:
            self._filter.advance(command.tolist())
            self._filter.take(measured)
        else:
            self._filter.begin(measured)
            self._begun = True
        missing = [math.nan] * len(state)
        columns = [values or missing for values in measured]
        self.measured = np.array(columns).T
        self.estimate = np.array(self._filter.estimate())


class Newest:
    """In place of a filter: each number as it was measured last."""

    def __init__(self) -> None:
        self._position: list[float] = []
        self._velocity: list[float] = []

    def begin(self, measured: Measured) -> None:
        """Take the first measurement."""
        self.take(measured)

    def advance(self, command: list[float]) -> None:
        """Nothing changes by itself."""

    def take(self, measured: Measured) -> None:
        """Take what was measured."""
        self._position = measured.position or self._position
        self._velocity = measured.velocity or self._velocity

    def estimate(self) -> list[tuple[float, float]]:
        """Position [m] and velocity [m/s] of each axis."""
        return list(zip(self._position, self._velocity, strict=True))
