"""When a horizon is worth a packet: the event trigger (16), sending always, sending periodically.

    V(k) = ‖x̂(k) - x_p(k|k-1)‖²_P
    S(k) = V(k_i) exp(-λ Δt (k - k_i)) + ε          k_i: the last event
    event: V(k) > S(k)

λ is per second (E5); the first step is an event (E18).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shared.config import ControlConfig
from shared.model import Array, Flags, Indices


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a trigger says of n vehicles; all of shape (n,)."""

    event: Flags
    error: Array
    """V(k)"""
    threshold: Array
    """S(k)"""


class Trigger(Protocol):
    """Decides at every step which vehicles are sent a horizon."""

    def test(
        self, rows: Indices, step: Indices, estimate: Array, planned: Array, fresh: Flags
    ) -> Verdict:
        """The verdict on each.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            estimate: x̂(k); shape (n, axes, 2).
            planned: x_p(k|k-1); shape (n, axes, 2).
            fresh: which of them are at their first step; shape (n,).
        """

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """These vehicles were sent a horizon: k_i ← k."""


def planning_error(estimate: Array, planned: Array, terminal_weight: Array) -> Array:
    """V(k) of eq. (16); shape (n,)."""
    return ((estimate - planned) ** 2 @ terminal_weight).sum(axis=1)


class Always:
    """A packet at every step."""

    def __init__(self, control: ControlConfig) -> None:
        self._P = np.array(control.terminal_weight)

    def test(
        self,
        rows: Indices,
        step: Indices,  # noqa: ARG002 - a `Trigger`'s, but it sends without looking
        estimate: Array,
        planned: Array,
        fresh: Flags,  # noqa: ARG002
    ) -> Verdict:
        """See `Trigger`."""
        error = planning_error(estimate, planned, self._P)
        return Verdict(np.ones(len(rows), dtype=np.bool_), error, np.zeros(len(rows)))

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""


class Paper:
    """Eq. (16)."""

    def __init__(self, control: ControlConfig, capacity: int) -> None:
        self._P = np.array(control.terminal_weight)
        self._decay = control.decay_rate * control.dt
        self._epsilon = control.epsilon
        self._event_step = np.zeros(capacity, dtype=np.int64)
        self._event_error = np.zeros(capacity)

    def test(
        self, rows: Indices, step: Indices, estimate: Array, planned: Array, fresh: Flags
    ) -> Verdict:
        """See `Trigger`."""
        self.sent(rows[fresh], step[fresh], np.zeros(int(fresh.sum())))  # V(k_0) = 0
        error = planning_error(estimate, planned, self._P)
        since = step - self._event_step[rows]
        threshold = self._event_error[rows] * np.exp(-self._decay * since) + self._epsilon
        return Verdict(fresh | (error > threshold), error, threshold)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""
        self._event_step[rows] = step
        self._event_error[rows] = error


class Periodic:
    """A packet every so many steps, counted from the last one that was sent."""

    def __init__(self, control: ControlConfig, capacity: int) -> None:
        self._P = np.array(control.terminal_weight)
        self._period = control.period
        self._sent_step = np.zeros(capacity, dtype=np.int64)

    def test(
        self, rows: Indices, step: Indices, estimate: Array, planned: Array, fresh: Flags
    ) -> Verdict:
        """See `Trigger`."""
        self._sent_step[rows[fresh]] = step[fresh] - self._period  # due now, and until it is sent
        error = planning_error(estimate, planned, self._P)
        event = step - self._sent_step[rows] >= self._period
        return Verdict(event, error, np.zeros(len(rows)))

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:  # noqa: ARG002
        """See `Trigger`."""
        self._sent_step[rows] = step


def make_trigger(control: ControlConfig, capacity: int) -> Trigger:
    """The trigger that a scenario names."""
    match control.trigger:
        case "paper":
            return Paper(control, capacity)
        case "always":
            return Always(control)
        case "periodic":
            return Periodic(control, capacity)
