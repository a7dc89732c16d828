"""Expected inputs of a vehicle under a horizon or trajectory, computed independently and by the
compiled rule.

A course is the motion that one message prescribes. Its inputs are computed twice: by the equations
of `shared.law.rule` and `shared.law.spline`, written here a second time, which must agree within
rounding; and by those functions themselves, compiled as in the server, which must agree to the last
bit.
"""

import math
from collections.abc import Sequence

import numpy as np

from skytether.server.common.compiled import reference_at, step
from skytether.server.schemes.trajectory import along, follow, guided_to
from skytether.shared.base.kernel import F1, kernel
from skytether.shared.law.model import Array, Axis
from skytether.shared.law.rule import AxisHorizon, bounded
from skytether.shared.law.spline import AxisSpline
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    FEEDBACK,
    GAIN_P,
    GAIN_V,
    LED,
    LED_P,
    LED_V,
    Horizon,
    Trajectory,
)


class PlannedCourse:
    """Course by a horizon of inputs.

    Args:
        horizon: the horizon.
        length: number of usable inputs.
        terms: the rule of flight.
    """

    def __init__(self, horizon: Horizon, length: int, terms: Terms) -> None:
        bound = np.array(terms.u_max)[:, None]
        self._length, self._terms = length, terms
        self._given = horizon.inputs.astype(float)
        self._inputs = np.clip(self._given[:, :length], -bound, bound)
        self._speed = float(np.linalg.norm(self._inputs[:, -1]))
        self._model, self._brake = terms.model, terms.brake
        feedback = horizon.feedback.astype(float)
        self.feeds_back = feedback.size > 0
        """Whether the horizon contains feedback gains."""
        if not self.feeds_back:
            feedback = np.zeros((terms.axes, FEEDBACK))
        self._feedback, self.lag = feedback, np.zeros(terms.axes)
        self._gain, self._disturbance = feedback[:, [GAIN_P, GAIN_V]], feedback[:, DISTURBANCE]
        self._led, self._stage = feedback[:, LED], 0

    def told(self, stage: int) -> Array:
        """Prescribed input at a stage, and after the last stage the braking curve [m/s]."""
        length = self._inputs.shape[1]
        u: Array = self._inputs[:, min(max(stage, 0), length - 1)]
        left = self._speed - max(stage - length + 1, 0) * self._brake
        return u * (max(0.0, left) / self._speed) if self._speed else 0.0 * u

    def back(self, stage: int, state: Array, found: Sequence[float]) -> Array:  # noqa: ARG002
        """Feedback at a stage for a state of shape (axes, 2) [m/s]; stages must not decrease.

        Args:
            found: disturbance estimate of the vehicle's filter, unused here [m/s].
        """
        if stage < 0 or not self.feeds_back:
            return np.zeros(len(self._inputs))
        for reached in range(self._stage, stage):
            told = self.told(reached)
            stands = reached >= self._inputs.shape[1] and not told.any()
            self._led = self._model.step(self._led, told if stands else told + self._disturbance)
        self._stage = max(self._stage, stage)
        back: Array = (self._gain * (self._led - state)).sum(axis=1)
        return back

    def by_rule(
        self,
        stage: int,
        state: Array,
        found: Sequence[float],  # noqa: ARG002
        before: Sequence[float],  # noqa: ARG002
    ) -> list[float]:
        """Input at a stage by the compiled rule, of each axis [m/s]; see `back`."""
        speed = math.sqrt(sum(u * u for u in self._inputs[:, -1].tolist()))
        return [
            _by_inputs(
                model,
                inputs,
                self._length,
                speed,
                self._brake,
                bound,
                self.feeds_back,
                row,
                stage,
                p,
                v,
            )
            for model, inputs, bound, row, (p, v) in zip(
                self._model.axes(),
                self._given,
                self._terms.u_max,
                self._feedback,
                state.tolist(),
                strict=True,
            )
        ]


class FollowedCourse:
    """Course along a trajectory.

    Args:
        trajectory: the trajectory.
        length: number of usable stages.
        terms: the rule of flight.
        regulator: K and λ of the vehicle's regulator; shape (axes, 3).
    """

    feeds_back = True

    def __init__(self, trajectory: Trajectory, length: int, terms: Terms, regulator: Array) -> None:
        self._knots, self._spacing = trajectory.knots.astype(float), trajectory.spacing
        self._length, self._terms = length, terms
        self._gain, self.lag = regulator[:, :2], regulator[:, 2]
        """K; and λ, the share of the input before that is kept; shape (axes,)."""
        self._model, self._bound = terms.model, np.array(terms.u_max)
        self._last = self._along(length - 1)
        self._led, self._stage = self._state(length), length

    def _state(self, stage: int) -> Array:
        """State of the spline at a stage, position [m] and velocity [m/s]; shape (axes, 2)."""
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

    def told(self, stage: int) -> Array:
        """Prescribed input ū at a stage, and after the last stage the braking curve [m/s]."""
        if stage < self._length or not self._terms.brake:
            return self._along(stage)
        speed = float(np.linalg.norm(self._last))
        left = speed - (stage - self._length + 1) * self._terms.brake
        return self._last * (max(0.0, left) / speed) if speed else 0.0 * self._last

    def back(self, stage: int, state: Array, found: Sequence[float]) -> Array:
        """Feedback minus the disturbance at a stage [m/s]; stages must not decrease.

        Args:
            state: state of the vehicle [m, m/s]; shape (axes, 2).
            found: disturbance estimate of the vehicle's filter on each axis [m/s].
        """
        led = self._state(stage)
        if stage > self._length and self._terms.brake:
            for reached in range(self._stage, stage):
                self._led = self._model.step(self._led, self.told(reached))
            led, self._stage = self._led, stage
        back: Array = (self._gain * (led - state)).sum(axis=1) - np.array(found)
        return back

    def by_rule(
        self, stage: int, state: Array, found: Sequence[float], before: Sequence[float]
    ) -> list[float]:
        """Input at a stage by the compiled rule, of each axis [m/s]; see `back`.

        Args:
            before: input flown until now, of each axis [m/s].
        """
        terms = self._terms
        axes = list(
            zip(
                self._model.axes(),
                self._knots.reshape(terms.axes, -1),
                terms.u_max,
                self._gain.tolist(),
                self.lag.tolist(),
                state.tolist(),
                found,
                before,
                strict=True,
            )
        )
        last = [
            _last_along(model, knots, self._spacing, terms.dt_s, self._length, bound)
            for model, knots, bound, *_ in axes
        ]
        speed = math.hypot(*last)
        return [
            _by_spline(
                model,
                knots,
                self._spacing,
                terms.dt_s,
                self._length,
                end,
                speed,
                terms.brake,
                bound,
                gain_p,
                gain_v,
                lag,
                stage,
                p,
                v,
                w,
                u,
            )
            for end, (model, knots, bound, (gain_p, gain_v), lag, (p, v), w, u) in zip(
                last, axes, strict=True
            )
        ]


Course = PlannedCourse | FollowedCourse


@kernel
def _by_inputs(
    model: Axis,
    inputs: F1,
    length: int,
    speed: float,
    brake: float,
    bound: float,
    feeds_back: bool,
    feedback: F1,
    stage: int,
    p: float,
    v: float,
) -> float:
    """Input on one axis at a stage of a horizon [m/s]; see `shared.law.rule.step`."""
    gain_p, gain_v, w = feedback[GAIN_P], feedback[GAIN_V], feedback[DISTURBANCE]
    held = AxisHorizon(
        model, inputs, length, True, speed, brake, bound, feeds_back, gain_p, gain_v, w
    )
    led_p, led_v = feedback[LED_P], feedback[LED_V]
    if feeds_back:
        led_p, led_v = reference_at(held, 0, stage, led_p, led_v)
    u, _, _, _ = step(held, stage, led_p, led_v, p, v)
    return u


@kernel
def _last_along(
    model: Axis, knots: F1, spacing: int, dt_s: float, length: int, bound: float
) -> float:
    """Input ū on one axis at the last usable stage of a trajectory [m/s]."""
    return bounded(along(model, knots, spacing, dt_s, length - 1), bound)


@kernel
def _by_spline(
    model: Axis,
    knots: F1,
    spacing: int,
    dt_s: float,
    length: int,
    last: float,
    speed: float,
    brake: float,
    bound: float,
    gain_p: float,
    gain_v: float,
    lag: float,
    stage: int,
    p: float,
    v: float,
    w: float,
    before: float,
) -> float:
    """Input on one axis at a stage of a trajectory [m/s]; see `shared.law.spline.follow`."""
    guide = AxisSpline(
        model, knots, spacing, dt_s, length, last, speed, brake, bound, gain_p, gain_v, lag
    )
    led_p, led_v = guided_to(guide, 0, stage, knots[0], knots[1])
    u, _ = follow(guide, stage, led_p, led_v, p, v, w, before)
    return u
