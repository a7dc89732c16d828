"""Policies that our own scenarios use; `server.triggers.further` has the others."""

from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.server.triggers.trigger import (
    Amount,
    Figures,
    Situation,
    Trigger,
    Verdict,
    above,
    all_of,
    timed,
    trigger,
)
from skytether.shared.law.model import Flags, Indices
from skytether.shared.scenario.registry import PERIOD_MAX
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.telemetry.record import Compared


@trigger
def always(situation: Situation) -> Verdict:
    """Sends at every step."""
    return timed(all_of(len(situation.rows)), situation.figures)


@trigger
def heartbeat(situation: Situation) -> Flags:
    """Sends if a heartbeat is due, and replaces it: the same number of packets, each useful."""
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
        self._sent_step[row] = 0

    def test(self, situation: Situation) -> Verdict:
        rows, figures = situation.rows, situation.figures
        due = figures["step"] - self._sent_step[rows] >= self._period
        # A horizon that is due at a fresh step stays due until it is sent.
        fresh = figures["fresh"]
        if fresh.any():
            self._sent_step[rows[fresh]] = figures["step"][fresh] - self._period
        return timed(due | fresh, figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        self._sent_step[rows] = figures["step"]


@trigger(name="state_gap", needs="state_gap")
class StateGap(Trigger):
    """Sends if the estimate deviates from the plan by more than eq. (16) allows, V(k) > S(k).

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
        self._event_step[row], self._event_gap[row] = 0, 0.0

    def test(self, situation: Situation) -> Verdict:
        rows, figures = situation.rows, situation.figures
        step, gap, fresh = figures["step"], figures["state_gap"], figures["fresh"]
        if fresh.any():  # V(k_0) = 0
            self._event_step[rows[fresh]], self._event_gap[rows[fresh]] = step[fresh], 0.0
        since = step - self._event_step[rows]
        # λ is per second, not per step (E5): per step, λ = 1.5 would decay within three steps.
        threshold = self._event_gap[rows] * np.exp(-self._decay * since) + self._epsilon
        return Verdict(fresh | (gap > threshold), gap, threshold, Compared.STATE_GAP)

    def sent(self, rows: Indices, figures: Figures) -> None:
        self._event_step[rows], self._event_gap[rows] = figures["step"], figures["state_gap"]


@trigger(needs="cost_gap")
def cost_gap(situation: Situation, c: Amount = 0.05) -> Verdict:
    """Sends if flying on with the inputs already sent costs over c more than the new plan."""
    return above(situation, Compared.COST_GAP, c)


@trigger(name="expected_gap", needs="expected_gap")
class ExpectedGap(Trigger):
    """Sends if the expected extra cost of flying on is above c; packets in flight may be lost."""

    doubts = True

    def __init__(
        self,
        control: ControlConfig,  # noqa: ARG002
        capacity: int,  # noqa: ARG002
        c: Amount = 0.05,
    ) -> None:
        self._most = c

    def test(self, situation: Situation) -> Verdict:
        return above(situation, Compared.EXPECTED_GAP, self._most)


@trigger(name="silence")
class Silence(Periodic):
    """Sends after this many seconds without a packet, or after half a horizon if that is shorter.

    A horizon that is replaced at its half does not run out, even if the first replacement is lost.
    Trajectories do not run out, so only the seconds count for them.
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
