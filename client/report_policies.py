"""Policies of `vehicle.report` other than `silence`, see `client.reports`."""

from typing import Annotated

from msgspec import Meta

from skytether.client.reports import Unreported
from skytether.shared.scenario.registry import PERIOD_MAX, REPORTS


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
    """Sends if the vehicle is more than `metres` away from the state that the server predicts, if
    another horizon has come into force or the same horizon was received again, or if the vehicle's
    mode has changed.
    """
    return now.is_news or now.off_m > metres
