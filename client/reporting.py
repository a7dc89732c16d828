"""Reports of the vehicle's state: the decision to send an observation, by comparison with the
server's prediction.

The server predicts the state from the newest observation by the rule of flight (`shared.law.rule`).
The vehicle computes the same prediction from its last observation and the plan in force. While the
prediction is close to the real state, the server needs no observation.
"""

import math

import numpy as np

from skytether.client.compensator import Compensator
from skytether.client.reports import Unreported, is_always, make_report
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import Mode

RETRY_STEPS = 4
"""Number of steps after which a vehicle that waits for its first plan reports again. The interval
then doubles, so that a long wait costs few packets."""


@compilable
def distance_m(tau_s: Numbers, believed: Table, states: Table) -> float:
    """Distance between two states [m]; a velocity error Δv counts as τ Δv.

    Args:
        tau_s: time constant of each axis [s].
        believed, states: position [m] and velocity [m/s] of each axis; shape (axes, 2).
    """
    total = 0.0
    for i in range(len(states)):
        off_p, off_v = believed[i, 0] - states[i, 0], believed[i, 1] - states[i, 1]
        total += (off_p + tau_s[i] * off_v) ** 2
    return math.sqrt(total)


class Reporter:
    """Decides at each step whether to send an observation.

    Args:
        report: `vehicle.report`.
        compensator: holds the plan in force, from which the input of the step was computed.
    """

    def __init__(self, terms: Terms, report: str, compensator: Compensator) -> None:
        self._dt_s, self._tau_s = terms.dt_s, np.array(terms.tau_s)
        self._compensator = compensator
        self.always = is_always(report)
        self._wants = make_report(report)
        self.believed = np.zeros((terms.axes, 2))
        """State that the server predicts for the next step if no packet is lost: position [m] and
        velocity [m/s] of each axis; shape (axes, 2)."""
        self._session: int | None = None
        """Session of the newest observation; None before the first."""
        self._reported: tuple[int, Mode, int] | None = None
        """Plan in force, mode, and `Compensator.repeated`, at the newest observation."""
        self._reported_step, self._step = 0, 0
        """Step of the newest observation, and latest step for which `is_due` was called."""
        self._ready: int | None = None
        """Step since which the vehicle waits for a plan; None while it does not wait."""

    def is_due(
        self,
        session: int,
        step: int,
        mode: Mode,
        states: Array,
        flown: Array,
        silence: int,
    ) -> bool:
        """Whether to send an observation of this step. Called at most once a step; if the result is
        True, the observation counts as sent.

        Args:
            session: number of the session.
            step: k, which has just begun.
            mode: mode of the vehicle.
            states: estimated state; shape (axes, 2).
            flown: input flown from this step on, of each axis [m/s].
            silence: longest silence that the server allows [half steps]; 0 for no bound.
        """
        if self.always:  # this policy needs no prediction
            return True
        situation = self._compensator.in_force, mode, self._compensator.repeated
        slept = step > self._step + 1
        due = self._waits(step, mode) or session != self._session
        if not due:
            is_news, steps = slept or situation != self._reported, step - self._reported_step
            off_m = distance_m(self._tau_s, self.believed, states)
            due = 0 < silence <= 2 * steps
            due |= self._wants(Unreported(off_m, is_news, steps, self._dt_s))
        self._step = step
        if due:
            self._session, self._reported, self._reported_step = session, situation, step
            self.believed = self._compensator.foresee(states, flown)
        else:
            self.believed = self._compensator.foresee(self.believed)
        return due

    def _waits(self, step: int, mode: Mode) -> bool:
        """Whether a vehicle that waits for a plan reports now, for the first time or again.

        The server plans only for a vehicle that has reported that it is ready. Without these
        reports, a vehicle that reports every 4 s began to fly up to 4 s late, and up to 8 s if one
        packet was lost.
        """
        if mode is not Mode.READY:
            self._ready = None
            return False
        if self._ready is None:
            self._ready = step
            return True
        return step - self._reported_step >= max(RETRY_STEPS, self._reported_step - self._ready)
