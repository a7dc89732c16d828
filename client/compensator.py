"""Uplink delay compensator, eq. (11): which input to fly now, from a horizon made earlier.

The rule itself is `shared.law.rule`, which the server's replay flies by as well. Here is what it
needs aboard: the newest horizon, where its first inputs have led so far, and the step it came into
force. The horizon of the newest generation wins, in whatever order they arrive (E11). Without a
horizon the input that was flown last is braked along, and from a standstill that is hovering.

A horizon that is a spline (the scheme "trajectory") is flown by the rule of `shared.law.spline`.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law import rule, spline
from skytether.shared.law.model import Array, advance
from skytether.shared.law.rule import Held, bounded, lasting, late_max
from skytether.shared.law.spline import Guide, along
from skytether.shared.law.terms import Terms
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import (
    AXES_MAX,
    DISTURBANCE,
    FEEDBACK,
    GAIN_P,
    GAIN_V,
    LED_P,
    LED_V,
    NO_HORIZON,
    Horizon,
    Trajectory,
)

FOREVER = 2**30
"""Stages for which a place is held: none come after."""
ZEROS = (0.0,) * AXES_MAX
"""Disturbance and input before of each axis where none are known [m/s]."""


class Compensator:
    """Holds the newest horizon and reads the input of any step from it.

    Args:
        terms: the rule of flight.
        regulator: K and λ by which the vehicle flies along a spline, see
            `shared.scenario.gain.regulator`; shape (axes, 3).
            Horizons of inputs bring theirs along.
    """

    def __init__(self, terms: Terms, regulator: Array | None = None) -> None:
        self._regulator = np.zeros((terms.axes, 3)) if regulator is None else regulator
        self._H = terms.horizon
        self._age_max = terms.age_max
        self._indexed = terms.indexed
        self._commits, self._dt_s = terms.commits, terms.dt_s
        self._late_max = late_max(terms.horizon)
        self._brake, self._join = terms.brake, terms.join
        self._bounds = terms.u_max
        self._model = terms.model.axes()
        self.begins = 0
        """Step of stage 0: that which the horizon was made for, or that at which it was dropped."""
        self.held: list[Held] = []
        """The horizon on each axis; without one the input that was flown when it was dropped."""
        self.guides: list[Guide] = []
        """Spline on each axis; empty where inputs are held."""
        self.knots = np.zeros((terms.axes, 0, 2), dtype=np.float32)
        """Knots of the newest spline that was sent; shape (axes, knots, 2)."""
        self.feeds_back = False
        """Whether what is flown is told and feedback on top of that."""
        self.lead: list[tuple[float, float]] = []
        """State x̄ that the horizon leads to, of each axis at stage `lead_stage` [m, m/s]."""
        self.lead_stage = 0
        self._length = 0
        """Number of stages for which the horizon is flown."""
        self._hold([[0.0]] * terms.axes, 1)
        self._chosen = 0
        """Step chosen for last."""
        self.told = [0.0] * terms.axes
        """Input of each axis at the step chosen for last, without the feedback [m/s]."""
        self.in_force = NO_HORIZON
        """Step that the horizon was made for, k_h, or NO_HORIZON."""
        self.newest = NO_HORIZON
        """Step that the newest horizon so far was made for, whether or not it is still held."""
        self.since = 0
        """First step that the horizon was chosen for."""
        self._new = False
        self.observed = -1
        """Step of the observation that the horizon was computed from, or -1."""
        self.covered = False
        """Whether the horizon has an input for the step chosen for last; without one the vehicle
        hovers, brakes, or holds the last."""
        self.stale = 0
        """Number of horizons that came after a newer one, or once more."""
        self.repeated = 0
        """Number of times that the horizon in force came once more: the server may not know."""

    def offer(self, horizon: Horizon | Trajectory, step: int, observed: int) -> bool:
        """Take a horizon that came before the input of a step is chosen, unless a newer has come.

        Args:
            horizon: what arrived.
            step: k, the step whose input is chosen next.
            observed: step of the observation that the horizon was planned from.

        Returns:
            Whether it is held now.

        Raises:
            ProtocolError: it is made for a time so far ahead that nothing later could replace it,
                from an observation that was not made yet, or too long ago for any of its inputs,
                or so long after its committed steps that other inputs were flown meanwhile, or it
                is a motion of a mission whose first knot is yet to come.
        """
        if horizon.step > step + self._H:
            raise ProtocolError(Drop.FROM_THE_FUTURE)
        # Newest generation wins, whatever comes last (E11).
        if horizon.step <= self.newest:
            self.stale += 1
            self.repeated += horizon.step == self.in_force
            return False
        # Without compensation the one input lasts for as long as its observation is young enough.
        given = self._age_max + self._H
        if self._indexed and isinstance(horizon, Horizon):
            given = horizon.inputs.shape[1]
        length = lasting(given, horizon.step, observed, self._age_max)
        if not 0 <= observed < step:
            raise ProtocolError(Drop.OBSERVATION)
        if length < 1:
            raise ProtocolError(Drop.TOO_OLD)
        if self._join and horizon.step > step:
            # The server takes the vehicle's clock for further on than it is: before its first knot
            # the motion is not the one in force, and would be a leap.
            raise ProtocolError(Drop.TOO_EARLY)
        is_late = bool(self._join) and step - horizon.step > self._join
        if is_late or self._comes_too_late(step - horizon.step, given - self._H, length):
            raise ProtocolError(Drop.TOO_LATE)
        if isinstance(horizon, Trajectory):
            self.go_on_along(horizon.step, observed, horizon.spacing, horizon.knots)
            return True
        self._put_in_force(horizon.step, observed)
        self._hold(
            horizon.inputs.tolist(),
            length,
            horizon.feedback.tolist() if horizon.feedback.size else (),
        )
        return True

    def go_on_along(
        self, made_for: int, observed: int, spacing: int, knots: NDArray[np.float32]
    ) -> None:
        """Put a spline in force: a new one, or one that an earlier run of this client has accepted.

        Args:
            made_for: step of the first knot.
            observed: step of the observation that it was planned from.
            spacing: steps from one knot to the next.
            knots: position [m] and velocity [m/s] of each; shape (axes, knots, 2).
        """
        self._put_in_force(made_for, observed)
        self.knots = knots
        length = lasting(self._age_max + self._H, made_for, observed, self._age_max)
        self._guide(knots.reshape(len(knots), -1).tolist(), spacing, length)

    def _put_in_force(self, made_for: int, observed: int) -> None:
        """Let a horizon be in force from the step on that is chosen next."""
        self.in_force = self.newest = self.begins = made_for
        self._new = True
        self.observed = observed

    def drop(self, step: int, flown_last: Array) -> None:
        """Drop the horizon; what was flown last is braked along, however often this is called.

        Args:
            step: the step that was flown last.
            flown_last: its input [m/s]; shape (axes,).
        """
        self.in_force, self.observed = NO_HORIZON, -1
        self._new = self.covered = False
        # A horizon of one input, which is over: the rule of flight brakes along it from the next
        # step on.
        self.begins = step
        self._hold(flown_last[:, None].tolist(), 1)

    def _hold(
        self, inputs: list[list[float]], length: int, feedback: Sequence[Sequence[float]] = ()
    ) -> None:
        """Fly by a horizon from now on.

        Args:
            inputs: its inputs [m/s]; shape (axes, n).
            length: number of them that are flown.
            feedback: its feedback, see `wire.protocol.Horizon`; empty without.
        """
        last = [each[length - 1 if self._indexed else 0] for each in inputs]
        within = [bounded(u, bound) for u, bound in zip(last, self._bounds, strict=True)]
        # No math.hypot: it rounds otherwise in 17 % of cases, and the server's replay has a plain
        # root.
        speed = math.sqrt(sum(u * u for u in within))
        told = feedback or [[0.0] * FEEDBACK] * len(inputs)
        self.held = [
            Held(
                model=model,
                inputs=each,
                length=length,
                indexed=self._indexed,
                speed=speed,
                brake=self._brake,
                bound=bound,
                feeds_back=bool(feedback),
                gain_p=columns[GAIN_P],
                gain_v=columns[GAIN_V],
                disturbance=columns[DISTURBANCE],
            )
            for model, each, bound, columns in zip(
                self._model, inputs, self._bounds, told, strict=True
            )
        ]
        self.guides, self.feeds_back = [], bool(feedback)
        self._length = length
        self.lead = [(columns[LED_P], columns[LED_V]) for columns in told]
        self.lead_stage = 0

    def rest(self, step: int, state: Sequence[tuple[float, float]]) -> None:
        """Hold the present place until a horizon comes, or what is held is dropped.

        Args:
            step: k, the step whose input is chosen next.
            state: position [m] and velocity [m/s] of each axis.
        """
        self.begins = step
        self._guide([[position, 0.0] for position, _ in state], 1, FOREVER)

    @property
    def rests(self) -> bool:
        """Whether a place is held."""
        return bool(self.guides) and self.in_force == NO_HORIZON

    def _guide(self, knots: list[list[float]], spacing: int, length: int) -> None:
        """Fly along a spline from now on, for so many stages."""
        last = [
            bounded(along(model, each, spacing, self._dt_s, length - 1), bound)
            for model, each, bound in zip(self._model, knots, self._bounds, strict=True)
        ]
        speed = math.hypot(*last)
        self.guides = [
            Guide(
                model=model,
                knots=each,
                spacing=spacing,
                dt_s=self._dt_s,
                length=length,
                last=u,
                speed=speed,
                brake=self._brake,
                bound=bound,
                gain_p=gain_p,
                gain_v=gain_v,
                lag=lag,
            )
            for model, each, u, bound, (gain_p, gain_v, lag) in zip(
                self._model, knots, last, self._bounds, self._regulator.tolist(), strict=True
            )
        ]
        self._length, self.feeds_back = length, True
        self.lead = [(each[0], each[1]) for each in knots]
        self.lead_stage = 0

    def _comes_too_late(self, stage: int, committed: int, length: int) -> bool:
        """Whether a horizon that would come into force at a stage is of no use any more.

        Args:
            stage: where in the horizon the step is.
            committed: number of its inputs that were committed, d.
            length: number of its inputs that may be flown.
        """
        ended = bool(self._brake) and stage >= length  # braking is not begun anew
        return ended or (self._commits and stage > committed + self._late_max)

    def choose(
        self,
        step: int,
        state: Sequence[tuple[float, float]],
        disturbance: Sequence[float] = ZEROS,
        before: Sequence[float] = ZEROS,
    ) -> list[float]:
        """Input u* for `step` on each axis [m/s].

        Args:
            step: k, never smaller than before.
            state: position [m] and velocity [m/s] of each axis at the step.
            disturbance: ŵ that the vehicle itself has found on each axis; counts only along a
                spline [m/s].
            before: input flown until now, of each axis; counts only along a spline [m/s].

        Source: eq. (11).
        """
        stage = self._go_on(step)
        if self.guides:
            return self._follow(stage, state, disturbance, before)
        if self.feeds_back:
            self._lead_to(stage)
        axes = zip(self.held, self.lead, state, strict=True)
        flown = [rule.step(held, stage, *lead, *x) for held, lead, x in axes]
        self.told = [told for _, told, _, _ in flown]
        return [u for u, _, _, _ in flown]

    def covers(self, step: int) -> bool:
        """Whether the horizon has an input for a step."""
        return self.in_force != NO_HORIZON and step - self.begins < self._length

    def alike_until(self, step: int) -> int:
        """Last step up to which `covered` stays as it is at a step, and nothing is braked."""
        if self.in_force != NO_HORIZON:
            return self.begins + self._length - 1 if self.covered else step
        return FOREVER if self.rests else step

    def _go_on(self, step: int) -> int:
        """Advance to a step; returns its stage in the horizon."""
        if self._new:
            self.since, self._new = step, False
        self._chosen = step
        self.covered = self.covers(step)
        return step - self.begins

    def note(self, step: int, told: list[float]) -> None:
        """Note what was chosen for a step elsewhere; `lead` is left as it was.

        Args:
            step: k, never smaller than before.
            told: what is flown but for the feedback, of each axis [m/s].
        """
        self._go_on(step)
        self.told = told

    def _follow(
        self,
        stage: int,
        state: Sequence[tuple[float, float]],
        disturbance: Sequence[float],
        before: Sequence[float],
    ) -> list[float]:
        """Input along the spline at a stage, see `choose`."""
        flown = []
        # Not strict: ZEROS has as many axes as there can be.
        axes = zip(self.guides, disturbance, before, strict=False)
        for axis, (guide, w, last) in enumerate(axes):
            lead = spline.guided_to(guide, self.lead_stage, stage, *self.lead[axis])
            self.lead[axis] = lead
            flown.append(spline.follow(guide, stage, *lead, *state[axis], w, last))
        self.lead_stage = stage
        self.told = [told for _, told in flown]
        return [u for u, _ in flown]

    def foresee(
        self, states: Sequence[tuple[float, float]], flown: Sequence[float] | None = None
    ) -> list[tuple[float, float]]:
        """State of each axis a step after the one chosen for last, as the server foresees it.

        Args:
            states: position [m] and velocity [m/s] of each axis at that step.
            flown: input flown there [m/s]; None for what the rule of flight makes of the states.
        """
        stage = self._chosen - self.begins
        if self.guides:  # what the wind does is flown off
            # What λ keeps of the input before is left out: it lasts for a few steps only.
            led = zip(self.guides, self.lead, states, strict=True)
            told = [spline.regulated(guide, stage, *lead, *x, 0.0)[0] for guide, lead, x in led]
            return [advance(m, *x, u) for m, x, u in zip(self._model, states, told, strict=True)]
        if flown is None:
            axes = zip(self.held, self.lead, states, strict=True)
            flown = [rule.step(held, stage, *lead, *x)[0] for held, lead, x in axes]
        flying = zip(self.held, states, flown, strict=True)
        return [advance(held.model, p, v, u + held.disturbance) for held, (p, v), u in flying]

    def _lead_to(self, stage: int) -> None:
        """Roll x̄ on to a stage, unless it is there already."""
        if stage > self.lead_stage:
            self.lead = [
                rule.lead_to(held, self.lead_stage, stage, *lead)
                for held, lead in zip(self.held, self.lead, strict=True)
            ]
            self.lead_stage = stage
