"""Inputs that a horizon or trajectory prescribes, computed independently for checks.

The equations of `shared.law.rule` and `shared.law.spline` are written a second time here, in plain
numpy, so that checks do not share an error with the compiled functions that both ends use.
"""

from collections.abc import Sequence

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    FEEDBACK,
    GAIN_P,
    GAIN_V,
    REFERENCE,
    Horizon,
    Trajectory,
)


class PlannedCourse:
    """Inputs prescribed by a horizon.

    Args:
        length: number of inputs that may be flown.
    """

    def __init__(self, horizon: Horizon, length: int, terms: Terms) -> None:
        bound = np.array(terms.u_max)[:, None]
        self._inputs = np.clip(horizon.inputs[:, :length].astype(float), -bound, bound)
        self._speed = float(np.linalg.norm(self._inputs[:, -1]))
        self._model, self._brake = terms.model, terms.brake
        feedback = horizon.feedback.astype(float)
        self.feeds_back = feedback.size > 0
        if not self.feeds_back:
            feedback = np.zeros((terms.axes, FEEDBACK))
        self.lag = np.zeros(terms.axes)
        self._gain, self._disturbance = feedback[:, [GAIN_P, GAIN_V]], feedback[:, DISTURBANCE]
        self._reference, self._stage = feedback[:, REFERENCE], 0

    def prescribed(self, stage: int) -> Array:
        """Prescribed input [m/s]; after the last stage it falls along the braking curve."""
        length = self._inputs.shape[1]
        u: Array = self._inputs[:, min(max(stage, 0), length - 1)]
        left = self._speed - max(stage - length + 1, 0) * self._brake
        return u * (max(0.0, left) / self._speed) if self._speed else 0.0 * u

    def feedback(
        self,
        stage: int,
        state: Array,
        disturbance: Sequence[float],  # noqa: ARG002
    ) -> Array:
        """Feedback at a stage for a state [m, m/s] of shape (axes, 2); stages must not decrease.

        `disturbance`, the estimate of the vehicle's filter [m/s], is unused here.
        """
        if stage < 0 or not self.feeds_back:
            return np.zeros(len(self._inputs))
        for reached in range(self._stage, stage):
            u = self.prescribed(reached)
            is_at_rest = reached >= self._inputs.shape[1] and not u.any()
            u = u if is_at_rest else u + self._disturbance
            self._reference = self._model.step(self._reference, u)
        self._stage = max(self._stage, stage)
        u_feedback: Array = (self._gain * (self._reference - state)).sum(axis=1)
        return u_feedback


class FollowedCourse:
    """Inputs prescribed by a trajectory.

    Args:
        length: number of usable stages.
        regulator: K and λ of the vehicle's regulator; shape (axes, 3).
    """

    feeds_back = True

    def __init__(self, trajectory: Trajectory, length: int, terms: Terms, regulator: Array) -> None:
        self._knots, self._spacing = trajectory.knots.astype(float), trajectory.spacing
        self._length, self._terms = length, terms
        self._gain, self.lag = regulator[:, :2], regulator[:, 2]
        """Weight λ of the previous input; shape (axes,)."""
        self._model, self._bound = terms.model, np.array(terms.u_max)
        self._last = self._along(length - 1)
        self._reference, self._stage = self._state(length), length

    def _state(self, stage: int) -> Array:
        """State of the spline at a stage [m, m/s]; shape (axes, 2)."""
        knots, dt_s = self._knots, self._terms.dt_s
        last = knots.shape[1] - 1
        knot = min(max(stage // self._spacing, 0), last)
        since_s, T = (stage - knot * self._spacing) * dt_s, self._spacing * dt_s
        (p, v), s = knots[:, knot].T, since_s / T
        if stage < 0 or knot == last:
            return np.stack([p + since_s * v, v], axis=1)
        after_p, after_v = knots[:, knot + 1].T
        basis = np.array([2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, s**3 - s**2])
        slope = np.array([6 * s**2 - 6 * s, 3 * s**2 - 4 * s + 1, 3 * s**2 - 2 * s])
        ends = np.array([p - after_p, T * v, T * after_v])
        return np.stack([after_p + basis @ ends, slope @ ends / T], axis=1)

    def _along(self, stage: int) -> Array:
        """Input with which the model's velocity follows the spline at a stage [m/s]."""
        v, ahead = self._state(stage)[:, 1], self._state(stage + 1)[:, 1]
        u: Array = (ahead - self._model.A[:, 1, 1] * v) / self._model.B[:, 1]
        return np.clip(u, -self._bound, self._bound)

    def prescribed(self, stage: int) -> Array:
        """Prescribed input ū [m/s]; after the last stage it falls along the braking curve."""
        if stage < self._length or not self._terms.brake:
            return self._along(stage)
        speed = float(np.linalg.norm(self._last))
        left = speed - (stage - self._length + 1) * self._terms.brake
        return self._last * (max(0.0, left) / speed) if speed else 0.0 * self._last

    def feedback(self, stage: int, state: Array, disturbance: Sequence[float]) -> Array:
        """Feedback minus the disturbance at a stage [m/s]; stages must not decrease.

        Args:
            state: state of the vehicle [m, m/s]; shape (axes, 2).
            disturbance: estimate of the vehicle's filter on each axis [m/s].
        """
        reference = self._state(stage)
        if stage > self._length and self._terms.brake:
            for reached in range(self._stage, stage):
                self._reference = self._model.step(self._reference, self.prescribed(reached))
            reference, self._stage = self._reference, stage
        u_feedback: Array = (self._gain * (reference - state)).sum(axis=1) - np.array(disturbance)
        return u_feedback


Course = PlannedCourse | FollowedCourse
