"""Policies for trajectories; `gaps`, `schedules` and `further` have the others."""

from skytether.server.triggers.trigger import (
    Amount,
    Situation,
    Trigger,
    Verdict,
    above,
    trigger,
)
from skytether.shared.law.model import Flags
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.telemetry.record import Compared


@trigger
def heartbeat(situation: Situation) -> Flags:
    """Sends a plan in place of each heartbeat that is due, so that no packet is added."""
    return situation.heartbeat_due


@trigger(name="expected_gap", needs="expected_gap")
class ExpectedGap(Trigger):
    """Sends if the expected cost of not sending, over losses of packets in flight, exceeds c."""

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
