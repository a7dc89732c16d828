"""Estimate of the state without a filter, for a sensor that measures the exact state."""

import math

import numpy as np

from skytether.client.vehicle import Measurement
from skytether.shared.law.model import Array


class Newest:
    """Replacement for the filter: returns the newest measured positions and velocities."""

    def __init__(self, axes: int) -> None:
        self._zero = np.zeros(axes)
        self._state = np.full((axes, 2), math.nan)

    def begin(self, measured: Measurement, numbers: Array) -> None:
        self.take(measured, numbers)

    def advance(self, due: Array, swing: Array | None = None) -> None:
        pass

    def disturbance(self) -> Array:
        """Disturbance of each axis [m/s]: 0, because it is not estimated."""
        return self._zero

    def take(self, measured: Measurement, numbers: Array) -> None:
        if measured.position is not None:
            self._state[:, 0] = numbers[0]
        if measured.velocity is not None:
            self._state[:, 1] = numbers[1]

    def estimate(self) -> Array:
        return self._state.copy()
