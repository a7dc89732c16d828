"""Triggers, which decide when a horizon is sent: small policies combined with & and |.

A scenario writes `cost_gap & budget(5, 2) | silence(1)` (`shared.scenario.grammar`). Policies are
entries of the table `TRIGGERS` (`shared.scenario.registry`): the built-in policies in `policies`,
`gaps`, `schedules` and `further`, and policies of plug-ins. docs/triggers.md explains how to use
and how to write a policy.

The server evaluates the trigger once per step, after planning. Every policy but `budget` fires for
a vehicle without a usable previous plan (`fresh`: first step, or a gap longer than H; E18).
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from skytether.shared.law.model import Array, Flags, Indices, Model
from skytether.shared.scenario.grammar import Combination, Expression, Value
from skytether.shared.scenario.registry import TRIGGERS, load
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.schemes import HELD, that_compute
from skytether.shared.telemetry.record import Compared

if TYPE_CHECKING:
    from skytether.server.planning.scheme import Foresight

trigger = TRIGGERS
"""Decorator of a policy: a function of a `Situation` and the policy's numbers, or a subclass of
`Trigger`."""
Amount = Annotated[float, Meta(ge=0)]
"""Threshold of any unit."""
Figures = NDArray[np.void]
"""Figures of plans, one `server.planning.scheme.PlanFigures` record for each vehicle; shape
(n,)."""


class SituationArrays(NamedTuple):
    """Arrays of a block of vehicles, whose first n rows belong to a `Situation`.

    Arrays with shape (capacity,) have one row for every vehicle of the server.
    """

    model: Model
    dt_s: float
    """Length of a step [s]."""
    planned: int
    """Number of planned inputs: H, or 1 with a scheme that sends trajectories."""
    foresight: "Foresight"
    """Predictions and plans of the block."""
    computes: tuple[str, ...]
    """Figures that the scheme provides, see `SchemeProperties.computes`."""
    sent_step: Indices
    """Step at which a horizon was last sent to each vehicle, or -1; shape (capacity,)."""
    heartbeat_due: Flags
    """Whether a heartbeat to each vehicle is due at this step; shape (capacity,)."""
    desired: Callable[[Indices, Indices, Indices], Array]
    """Function from rows, steps k and delay bounds d to desired states, see `Situation.desired`."""


class Situation(NamedTuple):
    """Input of a policy: n vehicles, each at its step k.

    Planning starts at step k+d, when a new horizon is in force at the latest; plans end at k+d+H.
    The arrays must not be changed, and are reused at the next step.
    """

    rows: Indices
    """Row of each vehicle, for a policy that stores something per vehicle; shape (n,)."""
    figures: Figures
    """Figures of the new plans, one record each, see docs/triggers.md; shape (n,)."""
    estimate: Array
    """Estimate x̂(k+d): position and velocity where planning starts [m, m/s]; shape (n, axes,
    2)."""
    planned: Array
    """State x_p(k+d) according to the previous plan [m, m/s]; shape (n, axes, 2)."""
    arrays: SituationArrays
    """Arrays from which the properties below are taken."""

    @property
    def plan(self) -> Array:
        """New plan: inputs from k+d on [m/s]; shape (n, axes, H); H = 1 with a scheme that sends
        trajectories.
        """
        n, foresight = len(self.rows), self.arrays.foresight
        stages = foresight.ahead[:n, None] + np.arange(self.arrays.planned)
        inputs = np.take_along_axis(foresight.horizons[:n], stages[:, None], axis=2)
        return inputs.astype(np.float64)

    @property
    def held(self) -> Array:
        """Inputs that the vehicle flies from k+d on if nothing is sent [m/s]; shape (n, axes, H).

        Raises:
            ValueError: the scheme does not compute them.
        """
        if HELD not in self.arrays.computes:
            able = " or ".join(map(repr, that_compute(HELD)))
            raise ValueError(f"held: expected control.scheme = {able}")
        return self.arrays.foresight.held[: len(self.rows)].copy()

    @property
    def desired(self) -> Array:
        """Desired states at k+d … k+d+H, extrapolated where unknown [m, m/s]; shape
        (n, axes, H + 1, 2).
        """
        rows, step = np.array(self.rows), np.array(self.figures["step"])
        return self.arrays.desired(rows, step, self.arrays.foresight.ahead)

    @property
    def since_sent_s(self) -> Array:
        """Time since a horizon was last sent [s], infinite if never; shape (n,)."""
        sent = self.arrays.sent_step[self.rows]
        since: Array = np.where(sent < 0, np.inf, (self.figures["step"] - sent) * self.arrays.dt_s)
        return since

    @property
    def heartbeat_due(self) -> Flags:
        """Whether a heartbeat is due, which a horizon would replace; shape (n,)."""
        return self.arrays.heartbeat_due[self.rows]

    @property
    def model(self) -> Model:
        """Model of the vehicles; `model.step(x, u)` is the state one step later."""
        return self.arrays.model

    @property
    def dt_s(self) -> float:
        """Length of a step [s]."""
        return self.arrays.dt_s


class Verdict(NamedTuple):
    """Verdict of a trigger on n vehicles."""

    event: Flags
    """Whether the trigger fires; shape (n,)."""
    figure: Array
    """Figure of the leftmost policy that compares figures, or else V(k) of eq. (16); shape (n,)."""
    threshold: Array
    """Threshold that `figure` is compared with, or 0 if no policy compares figures; shape (n,)."""
    compared: Compared = Compared.OWN
    """Name of the figure that is compared with the threshold."""

    @property
    def compares(self) -> bool:
        """Whether a figure is compared with a threshold."""
        return self.compared is not Compared.NOTHING


_verdict: Callable[[tuple[Flags, Array, Array, Compared]], Verdict] = partial(
    tuple.__new__, Verdict
)
"""Function that makes a Verdict from its four values, twice as fast as calling `Verdict`."""


class Trigger:
    """Base class of a policy with memory; one instance serves all vehicles.

    The constructor is called with the control section of the scenario, the capacity (number of
    rows), and then the numbers of the policy.
    """

    doubts = False
    """Whether the policy uses `expected_gap`, for which loss cases must be computed."""

    def forget(self, row: int) -> None:
        """Forget the vehicle in this row."""

    def test(self, situation: Situation) -> Verdict:
        """Verdict on each vehicle."""
        raise NotImplementedError

    def sent(self, rows: Indices, figures: Figures) -> None:
        """Note that a horizon is sent to these vehicles at this step: k_i ← k."""


COLUMNS = {each: str(each) for each in Compared}
"""Name of the record's column of each figure of the plans."""


def above(situation: Situation, figure: Array | Compared, threshold: float) -> Verdict:
    """Verdict of a policy that fires if a figure exceeds a threshold; both are recorded.

    Args:
        situation: the vehicles.
        figure: a figure of the plans, or the policy's own numbers; shape (n,).
        threshold: threshold in the figure's unit.
    """
    compared = figure if isinstance(figure, Compared) else Compared.OWN
    values = situation.figures[COLUMNS[figure]] if isinstance(figure, Compared) else figure
    event = situation.figures["fresh"] | (values > threshold)
    return _verdict((event, values, _constant(len(values), threshold), compared))


@lru_cache(maxsize=256)
def _constant(n: int, number: float) -> Array:
    column = np.full(n, number)
    column.flags.writeable = False
    return column


@lru_cache(maxsize=256)
def all_of(n: int) -> Flags:
    flags = np.ones(n, dtype=np.bool_)
    flags.flags.writeable = False
    return flags


def timed(event: Flags, figures: Figures) -> Verdict:
    """Verdict of a policy without a comparison of figures."""
    return _verdict((event, figures["state_gap"], _constant(len(event), 0.0), Compared.NOTHING))


class _Stateless(Trigger):
    """Policy made from a function.

    If the function returns flags, the policy also fires for vehicles that are `fresh` or were never
    sent a horizon.

    Args:
        function: returns a verdict, or flags of shape (n,).
        values: the policy's numbers, passed after the `Situation`.
    """

    def __init__(self, function: Callable[..., Verdict | Flags], values: Sequence[Value]) -> None:
        self._function, self._values = function, values

    def test(self, situation: Situation) -> Verdict:
        verdict = self._function(situation, *self._values)
        if isinstance(verdict, Verdict):
            return verdict
        new = situation.figures["fresh"] | (situation.arrays.sent_step[situation.rows] < 0)
        return timed(new | verdict, situation.figures)


class Combined(Trigger):
    def __init__(
        self, combine: Callable[[Flags, Flags], Flags], left: Trigger, right: Trigger
    ) -> None:
        self.doubts = left.doubts or right.doubts
        self._combine = combine
        self._left, self._right = left, right

    def forget(self, row: int) -> None:
        self._left.forget(row)
        self._right.forget(row)

    def test(self, situation: Situation) -> Verdict:
        left, right = self._left.test(situation), self._right.test(situation)
        # The record has one figure: the figure of the leftmost policy that compares figures.
        shown = left if left.compares or not right.compares else right
        event = self._combine(left.event, right.event)
        return _verdict((event, shown.figure, shown.threshold, shown.compared))

    def sent(self, rows: Indices, figures: Figures) -> None:
        self._left.sent(rows, figures)
        self._right.sent(rows, figures)


def make_trigger(
    control: ControlConfig,
    capacity: int,
    tell: Callable[[str, str], None] = lambda _count, _text: None,
) -> Trigger:
    """Make the trigger of a scenario.

    Args:
        control: `trigger`, and the keys that policies use.
        capacity: largest number of vehicles.
        tell: function called at each error of a plug-in in flight.
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
        if entry.is_ours:
            return policy
        guarded = load("skytether.server.triggers.guarded", "control.trigger").Guarded
        made: Trigger = guarded(expression.name, policy, tell)
        return made

    return make(TRIGGERS.parse(control.trigger))
