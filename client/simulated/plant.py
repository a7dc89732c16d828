"""The paper's vehicle model, eq. (1), with optional deviations from the server's model.

    v̇(t) = (g u(t - θ) + w - v(t)) / τ + a      g: gain, θ: dead time [s]
                                             w, a: effects of the air, see `simulated.weather`

Every part is discretised exactly, including the dead time (`shared.law.dead_time`).
"""

from typing import Any

import numpy as np

from skytether.client.simulated.weather import Weather
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Array, Axis, advance, discretise
from skytether.shared.scenario import rooms
from skytether.shared.scenario.schema import Scenario, VehicleConfig


@compilable
def moved(x: Table, model: Table, inputs: Numbers) -> None:
    """Advance a vehicle by one step, in place.

    Args:
        x: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        model: discrete model of each axis, rows of `Axis`.
        inputs: input that acts on each axis [m/s].
    """
    for i in range(len(x)):
        axis = Axis(model[i, 0], model[i, 1], model[i, 2], model[i, 3])
        x[i, 0], x[i, 1] = advance(axis, x[i, 0], x[i, 1], inputs[i])


class FirstOrderPlant:
    """First-order vehicle with the true time constants, gain and dead time of a scenario.

    Source: eq. (1).
    """

    def __init__(self, scenario: Scenario, weather: Weather, number: int = 1) -> None:
        tau, late_s = scenario.true_tau_s, scenario.true_dead_time_s.tolist()
        model = discretise(tau, scenario.control.dt)
        self._model, self._gain = np.stack(model, -1), scenario.true_gain
        self._inputs: Any = None
        """Inputs that do not act yet (`PendingInputs`); None without a dead time."""
        if any(late_s):
            dead_time = rooms.dead_time()
            late = [
                dead_time.dead_time(*theta_s, scenario.dt_ns)
                for theta_s in zip(tau.tolist(), late_s, strict=True)
            ]
            self._late = np.array([each.late for each in late])
            self._inputs = dead_time.PendingInputs(model.axes(), late)
        self.weather = weather
        self.x = np.zeros((len(tau), 2))
        """Present position [m] and velocity [m/s], in the world frame; shape (axes, 2)."""
        self.x[:, 0] = scenario.start_m(number)

    def state(self) -> Array:
        return self.x.copy()

    def advance(self, command: Array) -> None:
        push = self.weather.push()
        due, swing = command, None
        if self._inputs is not None:
            due, swing = self._inputs.issue(command)
        moved(self.x, self._model, self._gain * due + push)
        if swing is not None:
            self.x += self._late * (self._gain * swing)[:, None]
        self.weather.shove(self.x)

    def change(self, vehicle: VehicleConfig) -> None:
        self.weather.change(vehicle)
