"""When a horizon is worth a packet: small policies that combine with & and |.

A scenario writes `cost_gap & budget(5, 2) | silence(1)`; `shared/policy.py` has the grammar,
docs/triggers.md says what each policy is good for, and how to add one.

What it costs to fly on without a packet is known only once the new optimum is. So a verdict has
two flags: `surely`, it fires whatever the solve would say, and `perhaps`, it may fire. The server
solves for those with `perhaps` alone and tests these again with the cost gap known; then both are
equal. (They are the ends of Kleene's third truth value, so & and | take them one by one.) For every
policy but `cost_gap` they are equal at once.

`fresh` vehicles, at their first step or after a gap that no plan reached over, have nothing to fly
on with, and fire in every policy but `budget` (E18). A test may be repeated: what a policy
remembers comes from `sent`, or is a function of the step, so that a second test of a step says what
the first did, or what it could not know.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shared.config import ControlConfig
from shared.model import Array, Flags, Indices
from shared.policy import SIGNATURES, Combination, Expression, parse


@dataclass(frozen=True, slots=True)
class Situation:
    """What a trigger may look at, for n vehicles at one step of each."""

    rows: Indices
    """The vehicles; shape (n,)."""
    step: Indices
    """k of each; shape (n,)."""
    fresh: Flags
    """Which are at their first step, or after a gap; shape (n,)."""
    estimate: Array
    """x̂ where planning starts; shape (n, axes, 2)."""
    planned: Array
    """x_p there; shape (n, axes, 2)."""
    deviation_m: Callable[[], Array] | None = None
    """The largest distance between flying on with what was sent and the plan, over the window [m];
    shape (n,). Computed only if somebody asks; None in a scheme that knows no such thing."""
    cost_gap: Callable[[], Array] | None = None
    """(U_old - U*)ᵀ 𝓗 (U_old - U*), what flying on with what was sent costs above the new optimum;
    shape (n,). None before that is known."""

    def of(self, some: Indices) -> "Situation":
        """Of some of the vehicles."""
        deviation_m = self.deviation_m
        return Situation(
            *(self.rows[some], self.step[some], self.fresh[some]),
            *(self.estimate[some], self.planned[some]),
            (lambda: deviation_m()[some]) if deviation_m else None,
        )


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a trigger says of n vehicles; all of shape (n,)."""

    surely: Flags
    """It fires, whatever the solve would say."""
    perhaps: Flags
    """It may fire; true wherever `surely` is."""
    error: Array
    """What the leftmost policy that compares a figure compares (NaN: not known yet); of a trigger
    without such a policy V(k) of eq. (16), for the record."""
    threshold: Array
    """What it compares that with; 0 where nothing is compared."""

    def of(self, some: Indices) -> "Verdict":
        """Of some of the vehicles."""
        return Verdict(
            *(self.surely[some], self.perhaps[some], self.error[some], self.threshold[some])
        )

    def settled(self, some: Indices, verdict: "Verdict") -> "Verdict":
        """With another verdict on some of the vehicles."""
        surely, error, threshold = self.surely.copy(), self.error.copy(), self.threshold.copy()
        surely[some], error[some] = verdict.surely, verdict.error
        threshold[some] = verdict.threshold
        return Verdict(surely, surely, error, threshold)


class Trigger(Protocol):
    """Decides at every step which vehicles are sent a horizon."""

    compares: bool
    """Whether it compares a figure with a threshold."""

    def test(self, situation: Situation) -> Verdict:
        """The verdict on each; asked once or twice a step."""

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """These vehicles were sent a horizon at step k: k_i ← k.

        Args:
            error: of this trigger's own verdict at that step; shape (n,).
        """


def planning_error(estimate: Array, planned: Array, terminal_weight: Array) -> Array:
    """V(k) = ‖x̂(k) - x_p(k|k-1)‖²_P of eq. (16); shape (n,)."""
    return ((estimate - planned) ** 2 @ terminal_weight).sum(axis=1)


def _timed(event: Flags, situation: Situation, terminal_weight: Array) -> Verdict:
    """Of a policy that knows at once, and compares no figure."""
    error = planning_error(situation.estimate, situation.planned, terminal_weight)
    return Verdict(event, event, error, np.zeros(len(event)))


class Always:
    """A packet at every step."""

    compares = False

    def __init__(self, control: ControlConfig, capacity: int) -> None:  # noqa: ARG002 - as all have
        self._P = np.array(control.terminal_weight)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        return _timed(np.ones(len(situation.rows), dtype=np.bool_), situation, self._P)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""


class Periodic:
    """A packet every `period` steps, counted from the last one that was sent."""

    compares = False

    def __init__(self, control: ControlConfig, capacity: int, period: int) -> None:
        self._P = np.array(control.terminal_weight)
        self._period = period
        self._sent_step = np.zeros(capacity, dtype=np.int64)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, step, fresh = situation.rows, situation.step, situation.fresh
        self._sent_step[rows[fresh]] = step[fresh] - self._period  # due now, and until it is sent
        return _timed(step - self._sent_step[rows] >= self._period, situation, self._P)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:  # noqa: ARG002
        """See `Trigger`."""
        self._sent_step[rows] = step


def silence(control: ControlConfig, capacity: int, seconds: float) -> Periodic:
    """No silence is longer than so many seconds, or a step where that is longer."""
    steps = int(seconds / control.dt + 1e-9)  # as much as floating point may take from 0.35 / 0.05
    return Periodic(control, capacity, steps)


class Budget:
    """A hard cap, as a token bucket: b ← min(b + g, burst) at every step, b ← b - 1 with a packet.

    Without b ≥ 1 there is none: a window of T seconds has at most burst + packets_per_s · T. A
    packet for which another policy, behind a |, asked without a token takes what there is.
    """

    compares = False

    def __init__(
        self, control: ControlConfig, capacity: int, packets_per_s: float, burst: float
    ) -> None:
        self._P = np.array(control.terminal_weight)
        self._gain = packets_per_s * control.dt
        self._burst = burst
        self._tokens = np.full(capacity, burst, dtype=np.float64)
        """b right after step `_step`."""
        self._step = np.zeros(capacity, dtype=np.int64)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, step = situation.rows, situation.step
        # A new life begins at an earlier step, and with the tokens that the old one left.
        self._step[rows] = np.minimum(self._step[rows], step)
        return _timed(self._filled(rows, step) >= 1.0, situation, self._P)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:  # noqa: ARG002
        """See `Trigger`."""
        self._tokens[rows] = np.maximum(self._filled(rows, step) - 1.0, 0.0)
        self._step[rows] = step

    def _filled(self, rows: Indices, step: Indices) -> Array:
        """b at these steps; shape (n,)."""
        gained = self._gain * (step - self._step[rows])
        return np.minimum(self._tokens[rows] + gained, self._burst)


class StateGap:
    """Eq. (16): V(k) = ‖x̂(k) - x_p(k|k-1)‖²_P above S(k) = V(k_i) exp(-λ Δt (k - k_i)) + ε.

    k_i is the last event; λ is per second (E5).
    """

    compares = True

    def __init__(
        self, control: ControlConfig, capacity: int, epsilon: float, decay_rate: float
    ) -> None:
        self._P = np.array(control.terminal_weight)
        self._decay = decay_rate * control.dt
        self._epsilon = epsilon
        self._event_step = np.zeros(capacity, dtype=np.int64)
        self._event_error = np.zeros(capacity)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, step, fresh = situation.rows, situation.step, situation.fresh
        self.sent(rows[fresh], step[fresh], np.zeros(int(fresh.sum())))  # V(k_0) = 0
        error = planning_error(situation.estimate, situation.planned, self._P)
        since = step - self._event_step[rows]
        threshold = self._event_error[rows] * np.exp(-self._decay * since) + self._epsilon
        event = fresh | (error > threshold)
        return Verdict(event, event, error, threshold)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""
        self._event_step[rows] = step
        self._event_error[rows] = error


class Deviation:
    """Flying on with what was sent would lead further than so many metres from the plan."""

    compares = True

    def __init__(self, control: ControlConfig, capacity: int, metres: float) -> None:  # noqa: ARG002
        self._metres = metres

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        assert situation.deviation_m is not None
        deviation_m = situation.deviation_m()
        event = situation.fresh | (deviation_m > self._metres)
        return Verdict(event, event, deviation_m, np.full(len(event), self._metres))

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""


class CostGap:
    """Flying on with what was sent costs more than c above the new optimum."""

    compares = True

    def __init__(self, control: ControlConfig, capacity: int, c: float) -> None:  # noqa: ARG002
        self._c = c

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        n = len(situation.rows)
        threshold = np.full(n, self._c)
        if situation.cost_gap is None:
            unknown = np.full(n, np.nan)
            return Verdict(situation.fresh, np.ones(n, dtype=np.bool_), unknown, threshold)
        gap = situation.cost_gap()
        event = situation.fresh | (gap > self._c)
        return Verdict(event, event, gap, threshold)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:
        """See `Trigger`."""


class Combined:
    """Two triggers, of which both (`np.logical_and`) or either (`np.logical_or`) must fire."""

    def __init__(
        self,
        combine: Callable[[Flags, Flags], Flags],
        left: Trigger,
        right: Trigger,
        capacity: int,
    ) -> None:
        self.compares = left.compares or right.compares
        self._combine = combine
        self._left, self._right = left, right
        self._left_error, self._right_error = np.zeros((2, capacity))
        """Of the last test: what each is told once a packet was sent."""

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        left, right = self._left.test(situation), self._right.test(situation)
        self._left_error[situation.rows] = left.error
        self._right_error[situation.rows] = right.error
        shown = left if self._left.compares or not self._right.compares else right
        return Verdict(
            self._combine(left.surely, right.surely),
            self._combine(left.perhaps, right.perhaps),
            shown.error,
            shown.threshold,
        )

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:  # noqa: ARG002 - of one of them
        """See `Trigger`."""
        self._left.sent(rows, step, self._left_error[rows])
        self._right.sent(rows, step, self._right_error[rows])


POLICIES: dict[str, Callable[..., Trigger]] = {
    "always": Always,
    "periodic": Periodic,
    "state_gap": StateGap,
    "cost_gap": CostGap,
    "deviation": Deviation,
    "silence": silence,
    "budget": Budget,
}
"""What makes each policy of `SIGNATURES`, of the scenario, the capacity and its arguments."""


def make_trigger(control: ControlConfig, capacity: int) -> Trigger:
    """The trigger that a scenario describes, for up to `capacity` vehicles."""

    def make(expression: Expression) -> Trigger:
        if isinstance(expression, Combination):
            combine = np.logical_and if expression.operator == "&" else np.logical_or
            return Combined(combine, make(expression.left), make(expression.right), capacity)
        name, values = expression.name, expression.values
        if not values:
            values = tuple(getattr(control, item.key) for item in SIGNATURES[name].parameters)
        return POLICIES[name](control, capacity, *values)

    return make(parse(control.trigger))
