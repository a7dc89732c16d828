"""Policies of `vehicle.report`, which decide when the vehicle sends an observation.

Policies are combined with & and | as in a trigger (`shared.scenario.grammar`), and
`client.reporting` evaluates them aboard, once per step. Two observations are sent in any case: the
first of a session, and one after the longest silence that the server allows.
"""

from collections.abc import Callable
from typing import Annotated

from msgspec import Meta, Struct

from skytether.shared.scenario.grammar import Call, Combination, Expression
from skytether.shared.scenario.registry import REPORTS


class Unreported(Struct, frozen=True):
    """Input of a policy at one step: what has changed since the last observation."""

    off_m: float
    """Distance of the vehicle from the state that the server predicts [m], see
    `client.reporting.distance_m`."""
    is_news: bool
    """Whether, since the last observation, another plan has come into force, the mode has changed,
    or the plan in force was received again, so that its acknowledgement may have been lost."""
    steps: int
    dt_s: float


Report = Callable[[Unreported], bool]
"""Function that decides whether to send an observation."""


@REPORTS
def silence(now: Unreported, seconds: Annotated[float, Meta(ge=0.001, le=3600)]) -> bool:
    """Sends an observation if none was sent for the given time in seconds."""
    return now.steps * now.dt_s > seconds - now.dt_s / 2.0


def is_always(text: str) -> bool:
    return REPORTS.parse(text) == Call("always")


def make_report(text: str) -> Report:
    """Function that evaluates a valid text of `vehicle.report`."""

    def make(expression: Expression) -> Report:
        if isinstance(expression, Combination):
            left, right = make(expression.left), make(expression.right)
            if expression.operator == "&":
                return lambda now: left(now) and right(now)
            return lambda now: left(now) or right(now)
        entry, values = REPORTS[expression.name], expression.values
        return lambda now: entry.make(now, *values)

    return make(REPORTS.parse(text))
