"""Uplink delay compensator, eq. (11): which input to fly now, from a horizon made earlier.

The rule itself is `shared.rule`, which the server's replay flies by as well. Here is what it needs
aboard: the newest horizon, where its first inputs have led so far, and the step it came into force.
The horizon of the newest generation wins, in whatever order they arrive (E11). Without a horizon
the input that was flown last is braked along, and from a standstill that is hovering.
"""

import math

import numpy as np
from numpy.typing import NDArray

from shared.model import Array, advance
from shared.protocol import NO_HORIZON, Horizon, ProtocolError
from shared.rule import (
    bounded,
    entry,
    flown,
    lasting,
    late_max,
    leading,
    led_back,
    remaining,
)
from shared.terms import Terms


class Compensator:
    """Holds the newest horizon and reads the input of any step from it."""

    def __init__(self, terms: Terms) -> None:
        self._H = terms.horizon
        self._age_max = terms.age_max
        self._indexed = terms.indexed
        self._commits = terms.commits
        self._late_max = late_max(terms.horizon)
        self._brake = terms.brake
        self._bounds = terms.u_max
        self._model = terms.model.axes()
        self._nothing = [0.0] * terms.axes
        self._inputs: Array | NDArray[np.float32] = np.zeros((terms.axes, 1))
        """The horizon's inputs that may be flown [m/s], shape (axes, at most d + H); without one
        the input that was flown when it was dropped, shape (axes, 1)."""
        self._dropped = 0
        """Step that this input was flown at."""
        self._speed = 0.0
        """Magnitude of its last input [m/s]."""
        self._feedback: list[list[float]] = []
        """The horizon's feedback of each axis, see `shared.protocol.Horizon`; empty without."""
        self._led: list[tuple[float, float]] = []
        """State x̄ that the horizon leads to, of each axis at stage `_led_stage` [m, m/s]."""
        self._led_stage = 0
        self.told = self._nothing
        """What is flown at the step chosen for last but for the feedback, of each axis [m/s]."""
        self.in_force = NO_HORIZON
        """Step that the horizon was made for, k_h, or NO_HORIZON."""
        self.newest = NO_HORIZON
        """Step that the newest horizon so far was made for, whether or not it is still held."""
        self.since = 0
        """First step that the horizon was chosen for."""
        self._new = False
        self.observed_ns = -1
        """Stamp of the observation that the horizon was computed from [client clock]."""
        self.covered = False
        """Whether the horizon has an input for the step chosen for last; without one the vehicle
        hovers, brakes, or holds the last."""
        self.stale = 0
        """Number of horizons that came after a newer one."""

    def offer(self, horizon: Horizon, step: int, observed: int) -> bool:
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
                or so long after its committed steps that other inputs were flown meanwhile.
        """
        if horizon.step > step + self._H:
            raise ProtocolError("from the future")
        if horizon.step <= self.newest:
            self.stale += 1
            return False
        given = horizon.inputs.shape[1] if self._indexed else self._age_max + self._H
        length = lasting(given, horizon.step, observed, self._age_max)
        if not 0 <= observed < step:
            raise ProtocolError("observation")
        if length < 1:
            raise ProtocolError("too old")
        if self._comes_too_late(step - horizon.step, given - self._H, length):
            raise ProtocolError("too late")
        self.in_force = self.newest = horizon.step
        self._new = True
        self.observed_ns = horizon.observed_ns
        self._inputs = horizon.inputs[:, :length]
        if not self._indexed:
            self._inputs = np.broadcast_to(horizon.inputs[:, :1], (len(self._bounds), length))
        self._speed = math.sqrt(sum(u * u for u in self._input(-1)))
        self._feedback = horizon.feedback.tolist() if horizon.feedback.size else []
        self._led = [(p, v) for p, v, *_ in self._feedback]
        self._led_stage = 0
        return True

    def drop(self, step: int, flown_last: Array) -> None:
        """Drop the horizon; what was flown last is braked along, however often this is called.

        Args:
            step: the step that was flown last.
            flown_last: its input [m/s]; shape (axes,).
        """
        self.in_force, self.observed_ns = NO_HORIZON, -1
        self._new = self.covered = False
        self._dropped, self._inputs = step, flown_last[:, None]
        self._speed = math.sqrt(sum(u * u for u in flown_last.tolist()))
        self._feedback = []

    def _comes_too_late(self, stage: int, committed: int, length: int) -> bool:
        """Whether a horizon that would come into force at a stage is of no use any more.

        Args:
            stage: where in the horizon the step is.
            committed: number of its inputs that were committed, d.
            length: number of its inputs that may be flown.
        """
        ended = bool(self._brake) and stage >= length  # braking is not begun anew
        return ended or (self._commits and stage > committed + self._late_max)

    def choose(self, step: int, state: Array) -> Array:
        """Input u* for `step` [m/s]; shape (axes,).

        Args:
            step: k, never smaller than before.
            state: position [m] and velocity [m/s] at the step; shape (axes, 2).
        """
        if self._new:
            self.since, self._new = step, False
        held = self.in_force != NO_HORIZON
        stage = step - (self.in_force if held else self._dropped)
        self.covered = held and stage < self._inputs.shape[1]
        _, self.told = self._tell(stage)
        back = self._led_back(stage, state) if self._feedback else self._nothing
        return np.array(
            [
                flown(stage, u, led, bound)
                for u, led, bound in zip(self.told, back, self._bounds, strict=True)
            ]
        )

    @property
    def feeds_back(self) -> bool:
        """Whether the horizon that is held brings feedback."""
        return bool(self._feedback)

    def _input(self, index: int) -> list[float]:
        """One of the horizon's inputs, of each axis, within the bound [m/s]."""
        inputs = self._inputs[:, index].tolist()
        return [bounded(u, bound) for u, bound in zip(inputs, self._bounds, strict=True)]

    def _tell(self, stage: int) -> tuple[float, list[float]]:
        """Share of an input that is told at a stage, and what is told, of each axis [m/s]."""
        length = self._inputs.shape[1]
        share = remaining(stage, length, self._speed, self._brake)
        return share, [share * u for u in self._input(entry(stage, length))]

    def _led_back(self, stage: int, state: Array) -> list[float]:
        """Feedback at a stage, of each axis [m/s]; x̄ is rolled on to there."""
        for reached in range(self._led_stage, stage):
            share, told = self._tell(reached)
            self._led = [
                advance(axis, *led, leading(u, feedback[2], share))
                for axis, led, u, feedback in zip(
                    self._model, self._led, told, self._feedback, strict=True
                )
            ]
            self._led_stage = reached + 1
        return [
            led_back(feedback[3], feedback[4], led[0] - p, led[1] - v)
            for feedback, led, (p, v) in zip(self._feedback, self._led, state.tolist(), strict=True)
        ]
