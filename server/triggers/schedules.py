"""Policies that send at fixed times, independently of the plans."""

from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.server.triggers.trigger import (
    Figures,
    Situation,
    Trigger,
    Verdict,
    all_of,
    timed,
    trigger,
)
from skytether.shared.law.model import Indices
from skytether.shared.scenario.registry import PERIOD_MAX
from skytether.shared.scenario.schema import ControlConfig


@trigger
def always(situation: Situation) -> Verdict:
    """Sends at every step."""
    return timed(all_of(len(situation.rows)), situation.figures)


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
        self._sent_step[row] = 0

    def test(self, situation: Situation) -> Verdict:
        rows, figures = situation.rows, situation.figures
        due = figures["step"] - self._sent_step[rows] >= self._period
        # A plan that is due because there is no previous plan stays due until it is sent.
        fresh = figures["fresh"]
        if fresh.any():
            self._sent_step[rows[fresh]] = figures["step"][fresh] - self._period
        return timed(due | fresh, figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        self._sent_step[rows] = figures["step"]


@trigger(name="silence")
class Silence(Periodic):
    """Sends after the given time without a packet [s], or after half a horizon if that is shorter.

    A horizon that is replaced at half its length does not run out even if the first replacement is
    lost. Trajectories do not run out, so for trajectories only the given time counts.
    """

    def __init__(
        self,
        control: ControlConfig,
        capacity: int,
        seconds: Annotated[float, Meta(ge=0.001, le=3600)],
    ) -> None:
        # 1e-9: the quotient 0.35 / 0.05 is slightly below 7 in floating point.
        steps = int(seconds / control.dt + 1e-9)
        if not control.properties.splines:
            steps = min(steps, control.horizon // 2)
        super().__init__(control, capacity, steps)
