"""Inputs computed from a horizon of inputs or from a spline, eq. (11).

The equations are in `shared.law.rule` and `shared.law.spline`, which the server uses too; here they
are applied aboard, to all axes of one vehicle. Stage 0 is the first step of a horizon.
"""

import math
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law import rule, spline
from skytether.shared.law.model import Array, Axis, Model
from skytether.shared.law.rule import bounded
from skytether.shared.law.spline import along
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import DISTURBANCE, GAIN_P, GAIN_V, REFERENCE

SENT = [GAIN_P, GAIN_V, DISTURBANCE]
TABLED = [rule.GAIN_P, rule.GAIN_V, rule.DISTURBANCE]
"""Columns of the same feedback quantities: in a horizon as sent (SENT), and in the table of
`shared.law.rule` (TABLED)."""


class Follower(Protocol):
    """Source of inputs: a horizon or a spline."""

    length: int
    feeds_back: bool

    def input_at(self, stage: int, state: Array, disturbance: Array, before: Array) -> Array:
        """Inputs u* with and without feedback [m/s]; shape (2, axes).

        Args:
            stage: present stage.
            state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
            disturbance: estimated disturbance ŵ of each axis [m/s]; used along a spline only.
            before: input of the previous step, of each axis [m/s]; used along a spline only.

        Source: eq. (11).
        """

    def foresee(self, stage: int, state: Array, flown: Array | None) -> Array:
        """State of each axis one step later, as the server predicts it [m, m/s]; shape (axes, 2).

        Args:
            stage: stage of the newest `input_at`.
            state: position [m] and velocity [m/s] of each axis; shape (axes, 2).
            flown: input flown at that stage [m/s]; None: the input computed from the state.
        """


class Constants(NamedTuple):
    terms: Terms
    model: Model
    axes: list[Axis]
    """Model of each axis."""
    horizon: Array
    """Parameters that are the same for every horizon of inputs, in the columns of
    `shared.law.rule`; shape (axes, n)."""
    guide: Array
    """Parameters that are the same for every spline, in the columns of `shared.law.spline`; shape
    (axes, n)."""

    @classmethod
    def of(cls, terms: Terms, regulator: Array) -> Self:
        model = terms.model
        horizon = np.zeros((terms.axes, rule.DISTURBANCE + 1))
        horizon[:, : rule.MODEL] = np.stack(model, -1)
        horizon[:, rule.BRAKE], horizon[:, rule.BOUND] = terms.brake, terms.u_max
        guide = np.zeros((terms.axes, spline.LAG + 1))
        guide[:, : rule.MODEL] = np.stack(model, -1)
        guide[:, spline.DT_S], guide[:, spline.BRAKE] = terms.dt_s, terms.brake
        guide[:, spline.BOUND] = terms.u_max
        guide[:, [spline.GAIN_P, spline.GAIN_V, spline.LAG]] = regulator
        return cls(terms, model, model.axes(), horizon, guide)


class HorizonFollower:
    """Follows a horizon of inputs.

    Args:
        inputs: inputs [m/s]; shape (axes, n).
        length: number of inputs that may be flown.
        feedback: feedback of the horizon, see `wire.protocol.Horizon`; shape (axes, 5).
    """

    def __init__(
        self,
        constants: Constants,
        inputs: NDArray[np.floating],
        length: int,
        feedback: NDArray[np.floating] | None = None,
    ) -> None:
        terms, self._model = constants.terms, constants.model
        self.length, self.feeds_back = length, feedback is not None
        self._inputs = np.array(inputs, np.float64, order="C")
        self._table = constants.horizon.copy()
        last = self._inputs[:, length - 1].tolist()
        within = [bounded(u, bound) for u, bound in zip(last, terms.u_max, strict=True)]
        self._table[:, rule.LENGTH], self._table[:, rule.FEEDS_BACK] = length, self.feeds_back
        # math.hypot is not used: in 17 % of cases it is rounded differently from the square root in
        # the server's replay.
        self._table[:, rule.SPEED] = math.sqrt(sum(u * u for u in within))
        self.reference = np.zeros((terms.axes, 2))
        """Reference state x̄ of the feedback at the newest stage [m, m/s]; shape (axes, 2)."""
        if feedback is not None:
            self._table[:, TABLED] = feedback[:, SENT]
            self.reference[:] = feedback[:, REFERENCE]
        self._reference_stage = 0

    def input_at(
        self,
        stage: int,
        state: Array,
        disturbance: Array,  # noqa: ARG002 - the horizon contains ŵ
        before: Array,  # noqa: ARG002 - used along a spline only
    ) -> Array:
        flown = np.empty((2, len(state)))
        rule.fly_horizon(
            self._table, self._inputs, self.reference, self._reference_stage, stage, state, flown
        )
        self._reference_stage = max(stage, self._reference_stage)
        return flown

    def foresee(self, stage: int, state: Array, flown: Array | None) -> Array:
        if flown is not None:
            return self._model.step(state, flown + self._table[:, rule.DISTURBANCE])
        ahead = np.empty(state.shape)
        rule.foresee_horizon(self._table, self._inputs, self.reference, stage, state, ahead)
        return ahead


class SplineFollower:
    """Follows a spline.

    Args:
        knots: position [m] and velocity [m/s] of each knot; shape (axes, n, 2).
        spacing: steps from one knot to the next.
        length: number of stages for which the spline may be flown.
    """

    feeds_back = True

    def __init__(
        self, constants: Constants, knots: NDArray[np.floating], spacing: int, length: int
    ) -> None:
        bounds, dt_s = constants.terms.u_max, constants.terms.dt_s
        self.length = length
        self.spacing, self.sent = spacing, knots
        self.last = spacing * (knots.shape[1] - 1)
        """Stage of the last knot."""
        self._knots = np.array(knots, np.float64, order="C").reshape(len(knots), -1)
        last = [
            bounded(along(model, row, spacing, dt_s, length - 1), bound)
            for model, row, bound in zip(constants.axes, self._knots, bounds, strict=True)
        ]
        self._table = table = constants.guide.copy()
        table[:, spline.SPACING], table[:, spline.LENGTH] = spacing, length
        table[:, spline.LAST], table[:, spline.SPEED] = last, math.hypot(*last)
        self.reference = self._knots[:, :2].copy()
        """Reference state x̄ on the spline at the newest stage [m, m/s]; shape (axes, 2)."""
        self._reference_stage = 0

    def input_at(self, stage: int, state: Array, disturbance: Array, before: Array) -> Array:
        flown = np.empty((2, len(state)))
        spline.fly_spline(
            self._table,
            self._knots,
            self.reference,
            self._reference_stage,
            stage,
            state,
            disturbance,
            before,
            flown,
        )
        self._reference_stage = stage
        return flown

    def foresee(self, stage: int, state: Array, flown: Array | None) -> Array:  # noqa: ARG002
        ahead = np.empty(state.shape)
        spline.foresee_spline(self._table, self._knots, self.reference, stage, state, ahead)
        return ahead
