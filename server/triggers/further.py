"""Further policies of the table TRIGGERS, loaded only with a scenario that names one of them."""

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
    timed,
    trigger,
)
from skytether.shared.law.model import Array, Indices
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.telemetry.record import Compared
from skytether.shared.wire.protocol import AXES_MAX


@trigger(needs="deviation_m")
def deviation(situation: Situation, metres: Amount = 0.05) -> Verdict:
    """Sends if the flight with the inputs already sent would deviate from the previous plan by more
    than `metres`.
    """
    return above(situation, Compared.DEVIATION_M, metres)


@trigger(name="send_on_delta")
class SendOnDelta(Trigger):
    """Sends if the reference has moved by more than a number of metres since the last packet.

    This is sampling at level crossings with a hysteresis of one level, without a prediction.
    Source: Miskowicz, Send-on-delta concept, Sensors 6 (2006).
    """

    def __init__(self, control: ControlConfig, capacity: int, metres: Amount = 0.5) -> None:  # noqa: ARG002
        self._metres = metres
        self._latest, self._sent = np.zeros((2, capacity, AXES_MAX))

    def forget(self, row: int) -> None:
        self._latest[row] = self._sent[row] = 0.0

    def test(self, situation: Situation) -> Verdict:
        rows, desired_m = situation.rows, situation.desired[:, :, 0, 0]
        axes = slice(desired_m.shape[1])
        self._latest[rows, axes] = desired_m
        moved_m = np.linalg.norm(desired_m - self._sent[rows, axes], axis=1)
        return above(situation, moved_m, self._metres)

    def sent(self, rows: Indices, figures: Figures) -> None:  # noqa: ARG002
        self._sent[rows] = self._latest[rows]


@trigger(name="self_triggered")
class SelfTriggered(Trigger):
    """Sends when the reference, extrapolated at its velocity at the last packet, has moved by a
    number of metres since that packet, and after a number of seconds at the latest.

    Source: Velasco, Fuertes, Marti, The self triggered task model for real-time control systems,
    RTSS (2003).
    """

    def __init__(
        self,
        control: ControlConfig,  # noqa: ARG002
        capacity: int,
        metres: Amount = 0.5,
        seconds: Annotated[float, Meta(ge=0.001, le=3600)] = 5.0,
    ) -> None:
        self._metres, self._most_s = metres, seconds
        self._latest_s, self._wait_s = np.zeros((2, capacity))

    def test(self, situation: Situation) -> Verdict:
        rows = situation.rows
        speed_mps = np.linalg.norm(situation.desired[:, :, 0, 1], axis=1)
        self._latest_s[rows] = self._metres / np.maximum(speed_mps, self._metres / self._most_s)
        # 1e-9 allows for rounding errors of the time.
        due = situation.since_sent_s > self._wait_s[rows] - 1e-9
        return timed(situation.figures["fresh"] | due, situation.figures)

    def sent(self, rows: Indices, figures: Figures) -> None:  # noqa: ARG002
        self._wait_s[rows] = self._latest_s[rows]


@trigger(name="budget")
class Budget(Trigger):
    """Sends while a vehicle has a token; joined by &, this is a hard limit on the packet rate.

    A token bucket: b ← min(b + g, burst) at every step, b ← b - 1 with a packet, and no packet if
    b < 1. So T seconds have at most burst + packets_per_s · T packets. If another policy, joined by
    |, sends a packet although b < 1, b becomes 0.
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
        """Tokens b after step `_step`; shape (capacity,)."""
        self._step = np.zeros(capacity, dtype=np.int64)

    def forget(self, row: int) -> None:
        self._tokens[row], self._step[row] = self._burst, 0

    def test(self, situation: Situation) -> Verdict:
        filled = self._filled(situation.rows, situation.figures)
        return timed(filled >= 1.0, situation.figures)

    def sent(self, rows: Indices, figures: Figures) -> None:
        # The number of tokens is at least 0, even if another policy sent a packet without a token.
        self._tokens[rows] = np.maximum(self._filled(rows, figures) - 1.0, 0.0)
        self._step[rows] = figures["step"]

    def _filled(self, rows: Indices, figures: Figures) -> Array:
        gained = self._gain * (figures["step"] - self._step[rows])
        # The gain counts all steps since the last packet, so that missed ticks fill the bucket too.
        return np.minimum(self._tokens[rows] + gained, self._burst)
