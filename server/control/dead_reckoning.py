"""Dead reckoning: the vehicle is told where its target is and how it moves, and goes on from there.

No plan is made. What is sent at step k is the desired state p(k), v(k) as the server knows it, with
the velocity within the bounds; until the next packet comes, both ends expect the target at

    p̄(i) = p(k) + (i - k) Δt v(k),    v̄(i) = v(k),    i ≥ k

and the vehicle flies u*(i) = v(k) + K (x̄(i) - x(i)), the rule of flight with feedback aboard
(`shared.law.rule`). K is the regulator that the scenario's weights ask for. What is sent depends on
the target alone: where it has left p̄ (the policy `tolerance`), as in distributed simulation (IEEE
1278.1), or has moved since it was sent (`delta`). Nothing is made of acknowledgements.

This is the scheme "dead_reckoning", and what stands in place of its planner: all that is foreseen
of a vehicle is its newest observation, as it is.
"""

from collections import Counter

import numpy as np

from skytether.server.control.desired import Desired
from skytether.server.control.planner import FIGURES, Figures
from skytether.server.control.scheme import Foresight
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import GAIN_P, GAIN_V, LED, LED_P, LED_V, Observation


class Reckoning:
    """The `Scheme` of dead reckoning for up to `capacity` vehicles, and its horizons.

    Args:
        terms: the rule of flight.
        gain: K of feedback aboard; shape (axes, 2).
        desired: what the server knows of the targets.
        block: number of vehicles that are decided on at a time.
    """

    solve_ns = -1
    """See `server.control.planner.Planner`: there is nothing to solve."""

    def __init__(
        self,
        terms: Terms,
        gain: Array,
        desired: Desired,
        capacity: int,
        block: int,
    ) -> None:
        axes = terms.axes
        self.counts: Counter[str] = Counter()
        self._desired = desired
        self._gain = gain
        self._loop_gain = np.array(terms.gain)
        self._bounds = self._loop_gain * terms.u_max
        self._dt_s = terms.dt_s
        self._age_max = terms.age_max
        self.observed_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        self._state = np.zeros((capacity, axes, 2))
        self._sent = np.zeros((capacity, axes, 2))
        """Desired state that was sent last [m, m/s], as the vehicle reads it."""
        self._sent_step = np.full(capacity, -1, dtype=np.int64)
        """Step that it was sent for."""
        self._last_step = np.full(capacity, -1, dtype=np.int64)
        """Last step for which the vehicle may fly it; -1 where it has nothing to fly."""
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        """How far the targets are from where they are expected; those of a block come first."""
        self.planned = np.zeros((block, axes, 2))
        """Expected desired states x̄(k) [m, m/s]; shape (block, axes, 2)."""

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        self.observed_step[row] = self._last_step[row] = -1

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`; a vehicle that takes no horizon holds none either."""
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        self._state[row] = observation.state
        if not observation.takes:
            self._last_step[row] = -1
        return True

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in `found.horizons`, `found.feedback`, `figures` and `planned`.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is filled in.
        """
        n = len(rows)
        told, figures, planned = found.feedback[:n], self.figures[:n], self.planned[:n]
        desired = self._desired.due(rows, step)
        told[:, :, LED_P] = desired[:, :, 0]
        told[:, :, LED_V] = np.clip(desired[:, :, 1], -self._bounds, self._bounds)
        told[:, :, GAIN_P], told[:, :, GAIN_V] = self._gain.T
        found.horizons[:n, :, 0] = told[:, :, LED_V] / self._loop_gain
        fresh = step > self._last_step[rows]
        since_s = (step - self._sent_step[rows]) * self._dt_s
        sent = self._sent[rows]
        planned[:] = sent
        planned[:, :, 0] += since_s[:, None] * sent[:, :, 1]
        planned[fresh] = told[fresh][:, :, LED]
        figures["row"], figures["step"], figures["start"] = rows, step, step
        figures["fresh"], figures["solved"] = fresh, True
        figures["left_m"] = _distance(desired, planned)
        figures["moved_m"] = np.where(fresh, 0.0, _distance(desired, sent))

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what was sent counts."""
        some = rows[event]
        self._sent[some] = found.feedback[: len(rows)][event][:, :, LED]
        self._sent_step[some] = step[event]
        self._last_step[some] = self.observed_step[some] + self._age_max


def _distance(one: Array, other: Array) -> Array:
    """Distance of the positions of states [m]; shape (n,)."""
    away = one[:, :, 0] - other[:, :, 0]
    return np.sqrt((away * away).sum(axis=1))
