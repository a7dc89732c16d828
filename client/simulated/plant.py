"""The paper's model of a vehicle, eq. (1), with what may differ from what the server knows of it.

    v̇(t) = (g u(t - θ) + w - v(t)) / τ + a      g: gain, θ: dead time [s]
                                                w, a: what the air does, see `simulated.weather`

Every part is discretised exactly, the dead time included (`shared.law.dead_time`).
"""

from collections.abc import Sequence

import numpy as np

from skytether.client.simulated.weather import Weather
from skytether.shared.law.dead_time import OnTheirWay, dead_time
from skytether.shared.law.model import Array, advance, discretise
from skytether.shared.scenario.schema import Scenario, VehicleConfig


class FirstOrderPlant:
    """First-order vehicle with the true time constants, gain and dead time of a scenario.

    Args:
        weather: air that it flies in.

    Source: eq. (1).
    """

    def __init__(self, scenario: Scenario, weather: Weather, number: int = 1) -> None:
        tau, late_s = scenario.true_tau_s, scenario.true_dead_time_s.tolist()
        # Plain numbers, of each axis: numpy costs more than it saves on so few.
        self.model = discretise(tau, scenario.control.dt).axes()
        self.gain = scenario.true_gain.tolist()
        self._late = [
            dead_time(*each, scenario.dt_ns) for each in zip(tau.tolist(), late_s, strict=True)
        ]
        self._inputs = OnTheirWay(self.model, self._late) if any(late_s) else None
        """Inputs on their way; None where each acts at once."""
        self.is_simple = self._inputs is None
        """Whether each input acts at once."""
        self.weather = weather
        self.x = [(position, 0.0) for position in scenario.start_m(number).tolist()]
        """Position [m] and velocity [m/s] now, in the world frame, of each axis."""

    def state(self) -> Array:
        """Position [m] and velocity [m/s] now, as an array; shape (axes, 2)."""
        return np.array(self.x)

    def advance(self, command: Array) -> None:
        """Fly one step with this desired velocity [m/s]; shape (axes,)."""
        push, shoves = self.weather.blow()
        due: list[float] = command.tolist()
        swing: Sequence[float] = ()
        if self._inputs is not None:
            due, swing = self._inputs.issue(due)
        for i, u in enumerate(due):
            self.x[i] = advance(self.model[i], *self.x[i], self.gain[i] * u + push[i])
        for i, more in enumerate(swing):
            (p, v), w, (late_p, late_v) = self.x[i], self.gain[i] * more, self._late[i].late
            self.x[i] = (p + late_p * w, v + late_v * w)
        for i, (shove_p, shove_v) in enumerate(shoves):
            p, v = self.x[i]
            self.x[i] = (p + shove_p, v + shove_v)

    def change(self, vehicle: VehicleConfig) -> None:
        """Change the winds from the next step on."""
        self.weather.change(vehicle)
