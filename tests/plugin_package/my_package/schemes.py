"""Scheme in a package of its own, which only a server has to import."""

import numpy as np

from skytether.plugin_scheme import (
    Fleet,
    Foresight,
    Indices,
    Observation,
    SchemeProperties,
    SplineScheme,
    scheme,
)


@scheme(name="beacon")
class Beacon(SplineScheme):
    """Sends the present state of the reference; compares by the distance from it."""

    properties = SchemeProperties(flown_as="trajectory", figures=("deviation_m",), feedback=True)

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._desired = fleet.desired
        self._state = np.zeros((fleet.capacity, fleet.terms.axes, 2))

    def forget(self, row: int) -> None:
        self.observed_step[row] = -1

    def observe(self, row: int, observation: Observation) -> bool:
        newer = observation.step > self.observed_step[row]
        if newer:
            self.observed_step[row] = observation.step
            self._state[row] = observation.state
        return newer

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:  # noqa: ARG002
        """Use the observed states unchanged."""
        foresight.estimate[:] = foresight.start[:] = self._state[rows]

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Plan a spline of one knot."""
        now = self._desired.states(rows, step, foresight.ahead)[:, :, 0]
        foresight.splines.knots[:, :, :2] = now
        away = np.linalg.norm(now[:, :, 0] - self._state[rows, :, 0], axis=1)
        self.figures["deviation_m"][: len(rows)] = away
