"""Triggers: when a horizon is sent, by small policies that combine with & and |.

A scenario writes `cost_gap & budget(5, 2) | silence(1)`; `shared.scenario.grammar` has the
grammar, docs/triggers.md says what each policy is good for, and how to write one. Those below are
entries of the table `TRIGGERS` (`shared.scenario.registry`) like any plug-in's.

A trigger is asked once a step, when the new plan is made and everything is known that a policy may
look at. Vehicles at their first step, or after a gap that no plan reached over (`fresh`), have
nothing to fly on with, and fire in every policy but `budget` (E18).
"""

import traceback
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from skytether.shared.law.model import Array, Flags, Indices, Model
from skytether.shared.scenario.grammar import Combination, Expression, Value
from skytether.shared.scenario.registry import PERIOD_MAX, TRIGGERS
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.schemes import HELD, that_compute

trigger = TRIGGERS
"""Decorator of a policy: a function of a `Situation` and its numbers, or a class like `Trigger`."""
Amount = Annotated[float, Meta(ge=0)]
"""Threshold of any unit."""
Figures = NDArray[np.void]
"""Figures of plans, a record for each vehicle, see `server.common.scheme.FIGURES`;
shape (n,)."""


class KnownArrays(NamedTuple):
    """Arrays of a block of vehicles, from which the `Situation` of a trigger takes its rows.

    Those of the situation come first; `sent_step` has a row for each vehicle there may be.
    """

    model: Model
    """The vehicle as both ends know it."""
    dt_s: float
    """Length of a step [s]."""
    planned: int
    """Number of inputs of a plan, H; 1 without a plan."""
    ahead: Indices
    """Delay bound d [steps]; shape (block,)."""
    horizons: NDArray[np.float32]
    """Inputs from k on, d committed and then H planned [m/s]; shape (block, axes, most + H)."""
    held: Array | None
    """Inputs from k+d on if nothing is sent [m/s]; shape (block, axes, H). None without committed
    inputs, where they are not known."""
    sent_step: Indices
    """Step at which each vehicle was sent a horizon last, or -1; shape (capacity,)."""
    heartbeat_due: Flags
    """Whether each vehicle is sent a heartbeat at this step if nothing else; shape (capacity,)."""
    desired: Callable[[Indices, Indices, Indices], Array]
    """Desired states of some rows, at their steps k, from k+d on; see `Situation.desired`."""


class Situation(NamedTuple):
    """Situation that a policy judges: n vehicles at one step k of each.

    Planning starts at step k+d, where a new horizon can be in force; its plan goes on to k+d+H.
    Nothing may be written into a situation, and it holds at this step alone.
    """

    rows: Indices
    """Numbers of the vehicles' places in what a policy remembers; shape (n,)."""
    figures: Figures
    """Figures of their plans, a record each; docs/triggers.md has the fields; shape (n,)."""
    estimate: Array
    """Estimate x̂(k+d): position and velocity where planning starts [m, m/s]; shape (n, axes, 2)."""
    planned: Array
    """State x_p there according to the plan before [m, m/s]; shape (n, axes, 2)."""
    known: KnownArrays
    """Arrays of all vehicles, from which other fields are cut when they are read."""

    @property
    def plan(self) -> Array:
        """New plan: the inputs from k+d on [m/s]; shape (n, axes, H), H = 1 without a plan."""
        n, known = len(self.rows), self.known
        stages = known.ahead[:n, None] + np.arange(known.planned)
        inputs = np.take_along_axis(known.horizons[:n], stages[:, None], axis=2)
        return inputs.astype(np.float64)

    @property
    def held(self) -> Array:
        """Horizon held aboard: the inputs flown from k+d on if nothing is sent [m/s]; shape
        (n, axes, H).

        Raises:
            ValueError: the scheme does not know them.
        """
        if self.known.held is None:
            able = " or ".join(map(repr, that_compute(HELD)))
            raise ValueError(f"held: expected control.scheme = {able}")
        return self.known.held[: len(self.rows)].copy()

    @property
    def desired(self) -> Array:
        """Desired states at k+d … k+d+H as the server knows or predicts them [m, m/s]; shape
        (n, axes, H + 1, 2).
        """
        rows, step = np.array(self.rows), np.array(self.figures["step"])
        return self.known.desired(rows, step, self.known.ahead)

    @property
    def since_sent_s(self) -> Array:
        """Time since a horizon was sent [s], infinite where none was; shape (n,)."""
        sent = self.known.sent_step[self.rows]
        since: Array = np.where(sent < 0, np.inf, (self.figures["step"] - sent) * self.known.dt_s)
        return since

    @property
    def heartbeat_due(self) -> Flags:
        """Whether a heartbeat is due, which a horizon would take the place of; shape (n,)."""
        return self.known.heartbeat_due[self.rows]

    @property
    def model(self) -> Model:
        """The vehicle as both ends know it; `model.step(x, u)` is its state a step later."""
        return self.known.model

    @property
    def dt_s(self) -> float:
        """Length of a step [s]."""
        return self.known.dt_s


class Compared(IntEnum):
    """Figure that a trigger compares with its threshold, by the column of the record that has it.

    `server.common.scheme.PlanFigures` says what each is.
    """

    NOTHING = 0
    STATE_GAP = 1
    COST_GAP = 2
    EXPECTED_GAP = 3
    DEVIATION_M = 4
    OWN = 5
    """Figure of a plug-in's policy, in a unit that it knows itself."""

    def __str__(self) -> str:
        return self.name.lower()


class Verdict(NamedTuple):
    """Verdict of a trigger on n vehicles."""

    event: Flags
    """Whether it fires; shape (n,)."""
    figure: Array
    """Figure of the leftmost policy that compares one; V(k) of eq. (16) where none does;
    shape (n,)."""
    threshold: Array
    """Threshold of that figure; 0 where nothing is compared; shape (n,)."""
    compared: Compared = Compared.OWN
    """Name of the figure that is compared with the threshold."""

    @property
    def compares(self) -> bool:
        """Whether a figure is compared with a threshold."""
        return self.compared is not Compared.NOTHING


class Trigger:
    """Base of a policy that remembers something; it is made once, for all vehicles.

    Args of a policy: the control section of the scenario; capacity, the number of rows that there
    may be; then its numbers.
    """

    doubts = False
    """Whether it looks at what becomes of the vehicle where packets in flight are lost."""

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row."""

    def test(self, situation: Situation) -> Verdict:
        """The verdict on each vehicle."""
        raise NotImplementedError

    def sent(self, rows: Indices, figures: Figures) -> None:
        """Take note of vehicles that are sent a horizon at this step: k_i ← k."""


def above(situation: Situation, figure: Array | Compared, threshold: float) -> Verdict:
    """The verdict of a policy that sends where a figure is above a threshold, and records both.

    Args:
        situation: what it is shown.
        figure: one of the figures of the plans, or one of its own of shape (n,).
        threshold: what that is compared with.
    """
    compared = figure if isinstance(figure, Compared) else Compared.OWN
    values = situation.figures[str(figure)] if isinstance(figure, Compared) else figure
    event = situation.figures["fresh"] | (values > threshold)
    return Verdict(event, values, _each(len(values), threshold), compared)


@lru_cache(maxsize=256)
def _each(n: int, number: float) -> Array:
    """Column with one number for each of n vehicles; read only, made once; shape (n,)."""
    column = np.full(n, number)
    column.flags.writeable = False
    return column


@lru_cache(maxsize=256)
def _all_of(n: int) -> Flags:
    """Constant read-only array of n flags that are all True; shape (n,)."""
    flags = np.ones(n, dtype=np.bool_)
    flags.flags.writeable = False
    return flags


def _timed(event: Flags, figures: Figures) -> Verdict:
    """The verdict of a policy that compares no figure."""
    return Verdict(event, figures["state_gap"], _each(len(event), 0.0), Compared.NOTHING)


class _Stateless(Trigger):
    """A policy that is a function.

    Where it says yes or no, a vehicle that is `fresh` or was never sent to is sent to in any case.

    Args:
        function: gives a verdict, or which vehicles to send to.
        values: its numbers.
    """

    def __init__(self, function: Callable[..., Verdict | Flags], values: Sequence[Value]) -> None:
        self._function, self._values = function, values

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        said = self._function(situation, *self._values)
        if isinstance(said, Verdict):
            return said
        # A vehicle that holds nothing is sent its first horizon, whatever the policy says.
        new = situation.figures["fresh"] | (situation.known.sent_step[situation.rows] < 0)
        return _timed(new | said, situation.figures)


@trigger
def always(situation: Situation) -> Verdict:
    """Sends at every step."""
    return _timed(_all_of(len(situation.rows)), situation.figures)


@trigger
def heartbeat(situation: Situation) -> Flags:
    """Sends where a heartbeat is due, in its place: as many packets, and each says something."""
    return situation.heartbeat_due


@trigger(name="periodic")
class Periodic(Trigger):
    """Sends N steps after the last packet."""

    def __init__(
        self,
        control: ControlConfig,  # noqa: ARG002
        capacity: int,
        N: Annotated[int, Meta(ge=1, le=PERIOD_MAX)] = 10,
    ) -> None:
        self._period = N
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


@trigger(name="state_gap", needs="state_gap")
class StateGap(Trigger):
    """Sends where the estimate is off the plan by more than eq. (16) allows, V(k) > S(k).

    V(k) = ‖x̂(k) - x_p(k|k-1)‖²_P, S(k) = V(k_i) exp(-λ Δt (k - k_i)) + ε. k_i is the last event; λ
    is per second (E5).

    Source: eq. (16).
    """

    def __init__(
        self,
        control: ControlConfig,
        capacity: int,
        epsilon: Amount = 3.6,
        decay_rate: Amount = 1.5,
    ) -> None:
        self._decay = decay_rate * control.dt
        self._epsilon = epsilon
        self._event_step = np.zeros(capacity, dtype=np.int64)
        self._event_gap = np.zeros(capacity)

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        self._event_step[row], self._event_gap[row] = 0, 0.0

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, figures = situation.rows, situation.figures
        step, gap, fresh = figures["step"], figures["state_gap"], figures["fresh"]
        if fresh.any():  # V(k_0) = 0
            self._event_step[rows[fresh]], self._event_gap[rows[fresh]] = step[fresh], 0.0
        since = step - self._event_step[rows]
        # λ is per second and not per step (E5): per step, 1.5 would be gone within three steps.
        threshold = self._event_gap[rows] * np.exp(-self._decay * since) + self._epsilon
        return Verdict(fresh | (gap > threshold), gap, threshold, Compared.STATE_GAP)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._event_step[rows], self._event_gap[rows] = figures["step"], figures["state_gap"]


@trigger(needs="cost_gap")
def cost_gap(situation: Situation, c: Amount = 0.05) -> Verdict:
    """Sends where flying on with what was sent costs more than c above the new optimum."""
    return above(situation, Compared.COST_GAP, c)


@trigger(name="expected_gap", needs="expected_gap")
class ExpectedGap(Trigger):
    """Sends where flying on is expected to cost more than c, as packets in flight may be lost."""

    doubts = True

    def __init__(
        self,
        control: ControlConfig,  # noqa: ARG002
        capacity: int,  # noqa: ARG002
        c: Amount = 0.05,
    ) -> None:
        self._most = c

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        return above(situation, Compared.EXPECTED_GAP, self._most)


@trigger(needs="deviation_m")
def deviation(situation: Situation, metres: Amount = 0.05) -> Verdict:
    """Sends where flying on with what was sent leads further than so many metres from the plan."""
    return above(situation, Compared.DEVIATION_M, metres)


@trigger(name="silence")
class Silence(Periodic):
    """Sends after so many seconds without a packet, or half a horizon where that is shorter.

    It sends at most at every step. A horizon of which half is left is replaced in time even if the
    first that follows is lost. A trajectory has no inputs that could end.
    """

    def __init__(
        self,
        control: ControlConfig,
        capacity: int,
        seconds: Annotated[float, Meta(ge=0.001, le=3600)],
    ) -> None:
        steps = int(
            seconds / control.dt + 1e-9
        )  # as much as floating point may take from 0.35 / 0.05
        if not control.properties.splines:
            steps = min(steps, control.horizon // 2)
        super().__init__(control, capacity, steps)


@trigger(name="budget")
class Budget(Trigger):
    """Sends while it has a token: a hard cap behind a &.

    A token bucket: b ← min(b + g, burst) at every step, b ← b - 1 with a packet. Without b ≥ 1
    there is none: a window of T seconds has at most burst + packets_per_s · T. A packet for which
    another policy, behind a |, asked without a token takes what there is.
    """

    def __init__(
        self,
        control: ControlConfig,
        capacity: int,
        packets_per_s: Annotated[float, Meta(ge=0.001, le=1_000_000)],
        burst: Annotated[float, Meta(ge=1, le=1_000_000)],
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
        # Never below 0: a packet without a token, asked for by a policy behind a |, leaves no debt.
        self._tokens[rows] = np.maximum(self._filled(rows, figures) - 1.0, 0.0)
        self._step[rows] = figures["step"]

    def _filled(self, rows: Indices, figures: Figures) -> Array:
        """Tokens b at these steps; shape (n,)."""
        gained = self._gain * (figures["step"] - self._step[rows])
        # Computed from the steps that have passed, so that a missed tick fills the bucket as well.
        return np.minimum(self._tokens[rows] + gained, self._burst)


class Combined(Trigger):
    """Two triggers, of which both (`np.logical_and`) or either (`np.logical_or`) must fire."""

    def __init__(
        self, combine: Callable[[Flags, Flags], Flags], left: Trigger, right: Trigger
    ) -> None:
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
        # The record has one figure: that of the leftmost policy which compares one.
        shown = left if left.compares or not right.compares else right
        event = self._combine(left.event, right.event)
        return Verdict(event, shown.figure, shown.threshold, shown.compared)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        self._left.sent(rows, figures)
        self._right.sent(rows, figures)


class Guarded(Trigger):
    """A plug-in's policy, whose mistakes end no flight: where it fails, it sends.

    A packet too many costs bytes, a packet too few the flight. `budget` behind a & caps it as
    ever. What it is shown it cannot write into.

    Args:
        name: its name, for the message.
        inner: the policy.
        tell: told the traceback of its first mistake.
    """

    def __init__(self, name: str, inner: Trigger, tell: Callable[[str], None]) -> None:
        self.doubts = inner.doubts
        self._name, self._inner, self._tell = name, inner, tell
        self._told = False

    def forget(self, row: int) -> None:
        """See `Trigger`."""
        try:
            self._inner.forget(row)
        except Exception as error:
            self._fail(error)

    def test(self, situation: Situation) -> Verdict:
        """See `Trigger`."""
        rows, figures, estimate, planned, known = situation
        # Views that cannot be written into: a policy's mistake must not change what is sent.
        seen = map(_sealed, (rows, figures, estimate, planned))
        shown = Situation._make((*seen, known))
        try:
            verdict = self._inner.test(shown)
            return Verdict(
                _column(verdict.event, np.bool_, len(rows)),
                _column(verdict.figure, np.float64, len(rows)),
                _column(verdict.threshold, np.float64, len(rows)),
                Compared(verdict.compared),
            )
        except Exception as error:
            self._fail(error)
            return _timed(_all_of(len(rows)), figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        """See `Trigger`."""
        try:
            self._inner.sent(rows.copy(), figures.copy())
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        if not self._told:
            self._told = True
            what = f"the trigger {self._name}: {type(error).__name__}: {error}"
            trace = "".join(traceback.format_exception(error))
            self._tell(f"{trace}{what}; where it fails, it sends")


def _sealed(array: NDArray[Any]) -> NDArray[Any]:
    """View of an array into which nothing can be written."""
    view = array.view()
    view.flags.writeable = False
    return view


def _column(values: Any, kind: type[np.generic], n: int) -> NDArray[Any]:
    """Values of n vehicles.

    Raises:
        ValueError: they are of another shape or kind.
    """
    column = np.asarray(values)
    if column.shape != (n,) or not np.can_cast(column.dtype, kind):
        got = f"{column.dtype.name} of shape {column.shape}"
        raise ValueError(f"got {got}, expected {np.dtype(kind).name} of shape ({n},)")
    # As kernels read it, which do not look at types once they are called: float64, side by side.
    return np.ascontiguousarray(column, dtype=kind)


def make_trigger(
    control: ControlConfig, capacity: int, tell: Callable[[str], None] = lambda _: None
) -> Trigger:
    """The trigger that a scenario describes, for up to `capacity` vehicles.

    Args:
        tell: told the traceback of each plug-in's first mistake, while it flies.
    """

    def make(expression: Expression) -> Trigger:
        if isinstance(expression, Combination):
            combine = np.logical_and if expression.operator == "&" else np.logical_or
            return Combined(combine, make(expression.left), make(expression.right))
        entry = TRIGGERS[expression.name]
        numbers = expression.values
        is_class = isinstance(entry.make, type)
        policy = (
            entry.make(control, capacity, *numbers) if is_class else _Stateless(entry.make, numbers)
        )
        return policy if entry.is_ours else Guarded(expression.name, policy, tell)

    return make(TRIGGERS.parse(control.trigger))
