"""Policies of `vehicle.report`: when an observation is sent.

They combine with & and | like those of a trigger (`shared.scenario.grammar`), and are asked once a
step, aboard, by `client.reporting`. The first observation of a session is sent whatever they say,
and so is one after the longest silence that the server asks for.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

from msgspec import Meta

from skytether.shared.scenario.grammar import Call, Combination, Expression
from skytether.shared.scenario.registry import PERIOD_MAX, REPORTS


class Unreported(NamedTuple):
    """Knowledge that the server lacks, at one step of one vehicle."""

    off_m: float
    """Distance between the vehicle and the place where the server must believe it [m]; see
    `client.reporting.BelievedState`."""
    is_news: bool
    """Whether another horizon has come into force since the newest observation, or another mode, or
    the horizon in force has come once more: then the server may not know that it is."""
    steps: int
    """Number of steps since the newest observation."""
    dt_s: float
    """Length of a step [s]."""


Report = Callable[[Unreported], bool]
"""Whether to send an observation."""


@REPORTS
def always(now: Unreported) -> bool:  # noqa: ARG001
    """Sends at every step."""
    return True


@REPORTS
def periodic(now: Unreported, N: Annotated[int, Meta(ge=1, le=PERIOD_MAX)]) -> bool:
    """Sends N steps after the last observation."""
    return now.steps >= N


@REPORTS
def deviation(now: Unreported, metres: Annotated[float, Meta(ge=0, le=1e9)]) -> bool:
    """Sends where the vehicle has left where the server believes it by more than so many metres,
    where another horizon has come into force or the same one has come once more, and where its mode
    has changed.
    """
    return now.is_news or now.off_m > metres


@REPORTS
def silence(now: Unreported, seconds: Annotated[float, Meta(ge=0.001, le=3600)]) -> bool:
    """Sends after so many seconds without an observation."""
    return now.steps * now.dt_s > seconds - now.dt_s / 2.0


def is_always(text: str) -> bool:
    """Whether a report is at every step, and that is all there is to it."""
    return REPORTS.parse(text) == Call("always")


def make_report(text: str) -> Report:
    """The report that a text describes; it must be one."""

    def make(expression: Expression) -> Report:
        if isinstance(expression, Combination):
            left, right = make(expression.left), make(expression.right)
            if expression.operator == "&":
                return lambda now: left(now) and right(now)
            return lambda now: left(now) or right(now)
        entry, values = REPORTS[expression.name], expression.values
        return lambda now: entry.make(now, *values)

    return make(REPORTS.parse(text))
