"""Losses of packets that last for a time."""

from typing import Annotated

from msgspec import Meta

from skytether.netem.impairments.draws import SLOT_S, Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Share, Time, impairment
from skytether.shared.base.units import seconds_to_ns


@impairment(name="gilbert_elliott")
class GilbertElliott(Impairment):
    """Loses packets while a channel is bad: this share of the time, on average for burst_s."""

    kind = "loss"

    def __init__(
        self, share: Share, burst_s: Time, loss_bad: Share = 1.0, loss_good: Share = 0.0
    ) -> None:
        self._share, self._bad, self._good = share, loss_bad, loss_good
        self.loss = share * loss_bad + (1.0 - share) * loss_good
        # A redrawn state is bad again with probability `share`, which makes bursts longer.
        self._cell_s = burst_s * (1.0 - share)

    def __call__(self, fate: Fate, draws: Draws) -> None:
        if self._cell_s <= SLOT_S:  # the state is independent for each packet
            fate.lost |= draws.uniform(fate) < self.loss
            return
        bad = draws.lasting(fate, self._cell_s) < self._share
        loses = self._bad if bad else self._good
        if loses and (loses == 1.0 or draws.uniform(fate) < loses):
            fate.lost = True


@impairment(name="outage")
class Outage(Impairment):
    """Loses all packets for for_s seconds from at_s on, and again every every_s (0: only once)."""

    def __init__(self, at_s: Time, for_s: Time, every_s: Time = 0.0) -> None:
        if every_s and every_s <= for_s:
            raise ValueError(f"every_s of 0, or of more than for_s = {for_s:g}")
        self._at_s, self._for_s, self._every_s = at_s, for_s, every_s
        self.loss = for_s / every_s if every_s else 0.0

    def __call__(self, fate: Fate, draws: Draws) -> None:  # noqa: ARG002
        since_s = fate.time_s - self._at_s
        if since_s < 0.0:
            return
        if (since_s % self._every_s if self._every_s else since_s) < self._for_s:
            fate.lost = True


@impairment(name="outages")
class Outages(Impairment):
    """Loses all packets for random times, for_s on average; gaps last every_s on average."""

    def __init__(self, every_s: Annotated[float, Meta(ge=0.001, le=3600)], for_s: Time) -> None:
        self.loss = for_s / (every_s + for_s)
        self._cell_s = for_s * (1.0 - self.loss)

    def __call__(self, fate: Fate, draws: Draws) -> None:
        if draws.lasting(fate, self._cell_s) < self.loss:
            fate.lost = True


@impairment(name="delivered")
class Delivered(Impairment):
    """Delivers a flow's packets within delay_s; each period is flow, at_s, for_s, delay_s."""

    def __init__(self, *stretches: Annotated[float, Meta(ge=0, le=86400)]) -> None:
        each = list(zip(*(iter(stretches),) * 4, strict=False))
        if not each or len(stretches) % 4:
            raise ValueError("four numbers for each period: flow, at_s, for_s, largest delay_s")
        self._stretches = [
            (flow, round(at_s / SLOT_S), round((at_s + for_s) / SLOT_S), seconds_to_ns(most_s))
            for flow, at_s, for_s, most_s in each
        ]

    def __call__(self, fate: Fate, draws: Draws) -> None:
        for flow, first, end, most_ns in self._stretches:
            if first <= fate.slot < end and flow == draws.flow:
                fate.lost, fate.flipped = False, None
                fate.delay_ns = min(fate.delay_ns, most_ns)
