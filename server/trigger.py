"""When a horizon is worth a packet: small policies that combine with & and |.

A scenario writes `cost_gap & budget(5, 2) | silence(1)`; `shared/policy.py` has the grammar,
docs/triggers.md says what each policy is good for, and how to add one.

A trigger is asked once a step, when the new plan is made and everything is known that a policy may
look at. Vehicles at their first step, or after a gap that no plan reached over (`fresh`), have
nothing to fly on with, and fire in every policy but `budget` (E18).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from server.planner import Figures
from shared.config import ControlConfig
from shared.model import Array, Flags, Indices
from shared.policy import SIGNATURES, Combination, Expression, parse


class Situation(NamedTuple):
    """What a trigger may look at, for n vehicles at one step of each."""

    rows: Indices
    """The vehicles; shape (n,)."""
    figures: Figures
    """What their plans are worth, see `server.planner.FIGURES`; shape (n,)."""
    estimate: Array
    """Estimate x̂ where planning starts [m, m/s]; shape (n, axes, 2)."""
    planned: Array
    """Planned state x_p there [m, m/s]; shape (n, axes, 2)."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a trigger says of n vehicles."""

    event: Flags
    """Whether it fires; shape (n,)."""
    figure: Array
    """What the leftmost policy that compares a figure compares; V(k) of eq. (16) where none does;
    shape (n,)."""
    threshold: Array
    """What it compares that with; 0 where nothing is compared; shape (n,)."""


class Trigger(Protocol):
    """Decides at every step which vehicles are sent a horizon."""

    compares: bool
    """Whether it compares a figure with a threshold."""
    doubts: bool
    """Whether it looks at what becomes of the vehicle where packets in flight are lost."""

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row."""

    def test(self, situation: Situation) -> Verdict:
        """The verdict on each vehicle."""

    def sent(self, rows: Indices, figures: Figures) -> None:
        """Take note of vehicles that are sent a horizon at this step: k_i ← k."""


def _timed(event: Flags, figures: Figures) -> Verdict:
    """The verdict of a policy that compares no figure."""
    return Verdict(event, figures["error"], np.zeros(len(event)))


class Always:
    """A packet at every step."""

    compares = False
    doubts = False

    def __init__(self, control: ControlConfig, capacity: int) -> None:
        """See `POLICIES`."""

    def forget(self, row: int) -> None:
        """See `Trigger`."""

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        return _timed(np.ones(len(situation.rows), dtype=np.bool_), situation.figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""


class Periodic:
    """A packet every `period` steps, counted from the last one that was sent."""

    compares = False
    doubts = False

    def __init__(self, control: ControlConfig, capacity: int, period: int) -> None:  # noqa: ARG002
        self._period = period
        self._sent_step = np.zeros(capacity, dtype=np.int64)

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        self._sent_step[row] = 0

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, figures = situation.rows, situation.figures
        due = figures["step"] - self._sent_step[rows] >= self._period
        # What is due at a fresh step stays due until it is sent.
        fresh = figures["fresh"]
        if fresh.any():
            self._sent_step[rows[fresh]] = figures["step"][fresh] - self._period
        return _timed(due | fresh, figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._sent_step[rows] = figures["step"]


def silence(control: ControlConfig, capacity: int, seconds: float) -> Periodic:
    """No silence is longer than so many seconds or half a horizon, or a step where that is longer.

    A horizon of which half is left is replaced in time even if the first that follows is lost. With
    dead reckoning no horizon is planned that could end.
    """
    steps = int(seconds / control.dt + 1e-9)  # as much as floating point may take from 0.35 / 0.05
    if control.scheme != "dead_reckoning":
        steps = min(steps, control.horizon // 2)
    return Periodic(control, capacity, steps)


class Budget:
    """A hard cap, as a token bucket: b ← min(b + g, burst) at every step, b ← b - 1 with a packet.

    Without b ≥ 1 there is none: a window of T seconds has at most burst + packets_per_s · T. A
    packet for which another policy, behind a |, asked without a token takes what there is.
    """

    compares = False
    doubts = False

    def __init__(
        self, control: ControlConfig, capacity: int, packets_per_s: float, burst: float
    ) -> None:
        self._gain = packets_per_s * control.dt
        self._burst = burst
        self._tokens = np.full(capacity, burst, dtype=np.float64)
        """Tokens b right after step `_step`; shape (capacity,)."""
        self._step = np.zeros(capacity, dtype=np.int64)

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        self._tokens[row], self._step[row] = self._burst, 0

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        filled = self._filled(situation.rows, situation.figures)
        return _timed(filled >= 1.0, situation.figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._tokens[rows] = np.maximum(self._filled(rows, figures) - 1.0, 0.0)
        self._step[rows] = figures["step"]

    def _filled(self, rows: Indices, figures: Figures) -> Array:
        """Tokens b at these steps; shape (n,)."""
        gained = self._gain * (figures["step"] - self._step[rows])
        return np.minimum(self._tokens[rows] + gained, self._burst)


class StateGap:
    """Eq. (16): V(k) = ‖x̂(k) - x_p(k|k-1)‖²_P above S(k) = V(k_i) exp(-λ Δt (k - k_i)) + ε.

    k_i is the last event; λ is per second (E5).
    """

    compares = True
    doubts = False

    def __init__(
        self, control: ControlConfig, capacity: int, epsilon: float, decay_rate: float
    ) -> None:
        self._decay = decay_rate * control.dt
        self._epsilon = epsilon
        self._event_step = np.zeros(capacity, dtype=np.int64)
        self._event_error = np.zeros(capacity)

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        self._event_step[row], self._event_error[row] = 0, 0.0

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, figures = situation.rows, situation.figures
        step, error, fresh = figures["step"], figures["error"], figures["fresh"]
        if fresh.any():  # V(k_0) = 0
            self._event_step[rows[fresh]], self._event_error[rows[fresh]] = step[fresh], 0.0
        since = step - self._event_step[rows]
        threshold = self._event_error[rows] * np.exp(-self._decay * since) + self._epsilon
        return Verdict(fresh | (error > threshold), error, threshold)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._event_step[rows], self._event_error[rows] = figures["step"], figures["error"]


class Above:
    """A packet where one of the figures is above a fixed threshold."""

    compares = True

    def __init__(self, name: str, threshold: float, *, doubts: bool = False) -> None:
        self.doubts = doubts
        self._name = name
        self._threshold = threshold

    def forget(self, row: int) -> None:
        """See `Trigger`."""

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        figure = situation.figures[self._name]
        event = situation.figures["fresh"] | (figure > self._threshold)
        return Verdict(event, figure, np.full(len(figure), self._threshold))

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""


def deviation(control: ControlConfig, capacity: int, metres: float) -> Above:  # noqa: ARG001
    """Flying on with what was sent would lead further than so many metres from the plan."""
    return Above("deviation_m", metres)


def cost_gap(control: ControlConfig, capacity: int, c: float) -> Above:  # noqa: ARG001
    """Flying on with what was sent costs more than c above the new optimum."""
    return Above("cost_gap", c)


def tolerance(control: ControlConfig, capacity: int, metres: float) -> Above:  # noqa: ARG001
    """The desired position has left what both ends expect by more than so many metres."""
    return Above("left_m", metres)


def delta(control: ControlConfig, capacity: int, metres: float) -> Above:  # noqa: ARG001
    """The desired position has moved by more than so many metres since it was sent last."""
    return Above("moved_m", metres)


def expected_gap(control: ControlConfig, capacity: int, c: float) -> Above:  # noqa: ARG001
    """Flying on is expected to cost more than c, as packets in flight may be lost."""
    return Above("expected_gap", c, doubts=True)


class Combined:
    """Two triggers, of which both (`np.logical_and`) or either (`np.logical_or`) must fire."""

    def __init__(
        self, combine: Callable[[Flags, Flags], Flags], left: Trigger, right: Trigger
    ) -> None:
        self.compares = left.compares or right.compares
        self.doubts = left.doubts or right.doubts
        self._combine = combine
        self._left, self._right = left, right

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        self._left.forget(row)
        self._right.forget(row)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        left, right = self._left.test(situation), self._right.test(situation)
        shown = left if self._left.compares or not self._right.compares else right
        event = self._combine(left.event, right.event)
        return Verdict(event, shown.figure, shown.threshold)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._left.sent(rows, figures)
        self._right.sent(rows, figures)


POLICIES: dict[str, Callable[..., Trigger]] = {
    "always": Always,
    "periodic": Periodic,
    "state_gap": StateGap,
    "cost_gap": cost_gap,
    "expected_gap": expected_gap,
    "deviation": deviation,
    "tolerance": tolerance,
    "delta": delta,
    "silence": silence,
    "budget": Budget,
}
"""What makes each policy of `SIGNATURES`, of the scenario, the capacity and its arguments."""


def make_trigger(control: ControlConfig, capacity: int) -> Trigger:
    """The trigger that a scenario describes, for up to `capacity` vehicles."""

    def make(expression: Expression) -> Trigger:
        if isinstance(expression, Combination):
            combine = np.logical_and if expression.operator == "&" else np.logical_or
            return Combined(combine, make(expression.left), make(expression.right))
        name, values = expression.name, expression.values
        if not values:
            values = tuple(getattr(control, item.key) for item in SIGNATURES[name].parameters)
        return POLICIES[name](control, capacity, *values)

    return make(parse(control.trigger))
