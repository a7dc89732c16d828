"""Reports of the vehicle's state: what the server believes, and when an observation is sent.

The server rolls the newest observation on by the rule of flight (`shared.law.rule`). So does the
vehicle, from the observation that it sent last and by the horizon that it holds. While the two lead
to about the same, the server knows what it needs, and the vehicle may be silent.
"""

import math

import numpy as np

from skytether.client.compensator import Compensator
from skytether.shared.base.compilable import Numbers, Table, compilable
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.observing import Unreported, is_always, make_report
from skytether.shared.wire.protocol import Mode

RETRY_STEPS = 4
"""Number of steps after which a vehicle that waits for its first horizon reports once more. Later
it waits as long again as it has waited, so that a long wait costs few packets."""


@compilable
def distance_m(tau_s: Numbers, believed: Table, states: Table) -> float:
    """Distance of two states [m]; a velocity that is off by Δv counts for τ Δv.

    Args:
        tau_s: time constant of each axis [s].
        believed, states: position [m] and velocity [m/s] of each axis; shape (axes, 2).
    """
    total = 0.0
    for i in range(len(states)):
        off_p, off_v = believed[i, 0] - states[i, 0], believed[i, 1] - states[i, 1]
        total += (off_p + tau_s[i] * off_v) ** 2
    return math.sqrt(total)


class BelievedState:
    """State that the server must take the vehicle to be in, as long as nothing is lost.

    Args:
        terms: the rule of flight.
        compensator: holds the horizon.
    """

    def __init__(self, terms: Terms, compensator: Compensator) -> None:
        self._tau_s, self._compensator = np.array(terms.tau_s), compensator
        self._states = np.zeros((terms.axes, 2))

    def off_m(self, states: Array) -> float:
        """Distance of the vehicle from it [m], see `distance_m`; states of shape (axes, 2)."""
        return distance_m(self._tau_s, self._states, states)

    def told(self, states: Array, flown: Array) -> None:
        """Advance from an observation to the next step.

        Args:
            states: what it says; shape (axes, 2).
            flown: input that is flown from there on, of each axis [m/s].
        """
        self._states = self._compensator.foresee(states, flown)

    def silent(self) -> None:
        """Advance from a step without an observation to the next."""
        self._states = self._compensator.foresee(self._states)


class Reporter:
    """Says at each step whether an observation is sent.

    Args:
        terms: the rule of flight.
        report: `vehicle.report`.
        compensator: holds the horizon; at each step the input has been chosen from it.
    """

    def __init__(self, terms: Terms, report: str, compensator: Compensator) -> None:
        self._dt_s = terms.dt_s
        self._compensator = compensator
        self.always = is_always(report)
        """Whether there is an observation of every step."""
        self._wants = make_report(report)
        self.belief = BelievedState(terms, compensator)
        """State that the server must take the vehicle to be in."""
        self._session: int | None = None
        """Session in which an observation was sent last; None before the first."""
        self._known: tuple[int, Mode, int] | None = None
        """Horizon in force, mode, and how often a horizon had come once more, as they were told."""
        self._told, self._step = 0, 0
        """Step that was told last, and the one that was asked about last."""
        self._ready: int | None = None
        """Step since which the vehicle waits for a horizon; None while it does not."""

    def is_due(
        self,
        session: int,
        step: int,
        mode: Mode,
        states: Array,
        flown: Array,
        silence: int,
    ) -> bool:
        """Whether an observation of this step is sent; asked once, and taken for sent where it is.

        Args:
            session: number of the session.
            step: k; it has just begun.
            mode: what the vehicle does.
            states: what is known of its state; shape (axes, 2).
            flown: input that is flown from here on, of each axis [m/s].
            silence: longest silence that the server asks for [half steps]; 0 for none.
        """
        if self.always:  # nothing need be known of what the server believes
            return True
        known = self._compensator.in_force, mode, self._compensator.repeated
        slept = step > self._step + 1
        due = self._waits(step, mode) or session != self._session
        if not due:
            is_news, steps = slept or known != self._known, step - self._told
            off_m = self.belief.off_m(states)
            due = 0 < silence <= 2 * steps
            due |= self._wants(Unreported(off_m, is_news, steps, self._dt_s))
        self._step = step
        if due:
            self._session, self._known, self._told = session, known, step
            self.belief.told(states, flown)
        else:
            self.belief.silent()
        return due

    def _waits(self, step: int, mode: Mode) -> bool:
        """Whether a vehicle that waits for a horizon says so, at once or once more.

        The server plans only for a vehicle that it knows to be ready. Without this, a vehicle that
        reports every 4 s began to fly up to 4 s late, and 8 s where one packet was lost.
        """
        if mode is not Mode.READY:
            self._ready = None
            return False
        if self._ready is None:
            self._ready = step
            return True
        return step - self._told >= max(RETRY_STEPS, self._told - self._ready)
