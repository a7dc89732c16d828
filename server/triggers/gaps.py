"""Policies that compare the new plan with the plan sent last."""

import numpy as np

from skytether.server.triggers.trigger import (
    Amount,
    Figures,
    Situation,
    Trigger,
    Verdict,
    above,
    trigger,
)
from skytether.shared.law.model import Indices
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.telemetry.record import Compared


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
        if fresh.any():  # without a usable previous plan V is 0
            self._event_step[rows[fresh]], self._event_gap[rows[fresh]] = step[fresh], 0.0
        since = step - self._event_step[rows]
        # λ is per second, not per step (E5): per step, S would decay within three steps at λ = 1.5.
        threshold = self._event_gap[rows] * np.exp(-self._decay * since) + self._epsilon
        return Verdict(fresh | (gap > threshold), gap, threshold, Compared.STATE_GAP)

    def sent(self, rows: Indices, figures: Figures) -> None:
        self._event_step[rows], self._event_gap[rows] = figures["step"], figures["state_gap"]


@trigger(needs="cost_gap")
def cost_gap(situation: Situation, c: Amount = 0.05) -> Verdict:
    """Sends if the cost gap (cost with the old plan minus cost with the new plan) exceeds c."""
    return above(situation, Compared.COST_GAP, c)
