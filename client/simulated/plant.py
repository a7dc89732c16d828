"""The paper's model of a vehicle, eq. (1), with what may differ from what the server knows of it.

    v̇(t) = (g u(t - θ) + w - v(t)) / τ + a      g: gain, θ: dead time [s]
                                                w, a: what the air does, see `simulated.weather`

Every part is discretised exactly, the dead time included (`shared.law.dead_time`).
"""

import numpy as np

from skytether.client.simulated.weather import Weather
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.dead_time import OnTheirWay, dead_time
from skytether.shared.law.model import Array, Axis, advance, discretise
from skytether.shared.scenario.schema import Scenario, VehicleConfig


@compilable
def moved(x: Table, model: Table, inputs: Numbers) -> None:
    """Move a vehicle on by a step, in place.

    Args:
        x: position [m] and velocity [m/s] of each axis; shape (axes, 2).
        model: rows of `Axis`.
        inputs: what acts as input on each axis [m/s].
    """
    for i in range(len(x)):
        axis = Axis(model[i, 0], model[i, 1], model[i, 2], model[i, 3])
        x[i, 0], x[i, 1] = advance(axis, x[i, 0], x[i, 1], inputs[i])


class FirstOrderPlant:
    """First-order vehicle with the true time constants, gain and dead time of a scenario.

    Args:
        weather: air that it flies in.

    Source: eq. (1).
    """

    def __init__(self, scenario: Scenario, weather: Weather, number: int = 1) -> None:
        tau, late_s = scenario.true_tau_s, scenario.true_dead_time_s.tolist()
        model = discretise(tau, scenario.control.dt)
        self._model, self._gain = np.stack(model, -1), scenario.true_gain
        late = [dead_time(*each, scenario.dt_ns) for each in zip(tau.tolist(), late_s, strict=True)]
        self._late = np.array([each.late for each in late])
        self._inputs = OnTheirWay(model.axes(), late) if any(late_s) else None
        """Inputs on their way; None where each acts at once."""
        self.weather = weather
        self.x = np.zeros((len(tau), 2))
        """Position [m] and velocity [m/s] now, in the world frame; shape (axes, 2)."""
        self.x[:, 0] = scenario.start_m(number)

    def state(self) -> Array:
        """Position [m] and velocity [m/s] now, in the world frame; shape (axes, 2)."""
        return self.x.copy()

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""
        push = self.weather.push()
        due, swing = command, None
        if self._inputs is not None:
            due, swing = self._inputs.issue(command)
        moved(self.x, self._model, self._gain * due + push)
        if swing is not None:
            self.x += self._late * (self._gain * swing)[:, None]
        self.weather.shove(self.x)

    def change(self, vehicle: VehicleConfig) -> None:
        """Change the winds from the next step on."""
        self.weather.change(vehicle)
