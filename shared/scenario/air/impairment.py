"""Impairments: their type, and the annotations of their arguments.

@impairment
class Fading(Impairment):
    '''Loses a share of the packets that rises and falls in so many seconds.'''

    def __init__(self, period_s: Annotated[float, Meta(ge=0.001)]) -> None:
        self.period_s, self.loss = period_s, 0.5

    def __call__(self, fate: Fate, draws: Draws) -> None:
        share = 0.5 + 0.5 * sin(2 * pi * fate.time_s / self.period_s)
        fate.lost |= draws.uniform(fate) < share
"""

from typing import Annotated, Literal

from msgspec import Meta

from skytether.shared.scenario.air.draws import Draws, Fate
from skytether.shared.scenario.registry import IMPAIRMENTS

impairment = IMPAIRMENTS
"""Decorator of an impairment: a class whose numbers a scenario writes."""

Time = Annotated[float, Meta(ge=0, le=3600)]
"""Time from nothing to an hour [s]."""
Share = Annotated[float, Meta(ge=0, le=1)]
"""Share from 0 to 1."""


class Impairment:
    """Base of the effects of a network on packets. None keeps anything from packet to packet."""

    kind: Literal["delay", "loss", "other"] = "other"
    """Delays and losses of a direction keep their random numbers when another is added."""
    least_s: float = 0.0
    """Smallest delay that it adds [s]."""
    mean_s: float = 0.0
    """Mean delay that it adds [s]."""
    loss: float = 0.0
    """Mean share of the packets that it loses."""

    def __call__(self, fate: Fate, draws: Draws) -> None:
        """Change the fate of a packet that enters.

        Args:
            fate: what becomes of it, by the impairments before this one.
            draws: random numbers of this impairment.
        """
