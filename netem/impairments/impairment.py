"""Base class of impairments, and types of their arguments.

@impairment
class Fading(Impairment):
    '''Loses a share of the packets that rises and falls with this period.'''

    def __init__(self, period_s: Annotated[float, Meta(ge=0.001)]) -> None:
        self.period_s, self.loss = period_s, 0.5

    def __call__(self, fate: Fate, draws: Draws) -> None:
        share = 0.5 + 0.5 * sin(2 * pi * fate.time_s / self.period_s)
        fate.lost |= draws.uniform(fate) < share
"""

from typing import Annotated, Literal

from msgspec import Meta

from skytether.netem.impairments.draws import Draws, Fate
from skytether.shared.scenario.registry import IMPAIRMENTS

impairment = IMPAIRMENTS
"""Decorator that registers an impairment's class; the scenario gives the class its arguments."""

Time = Annotated[float, Meta(ge=0, le=3600)]
"""Time from 0 to an hour [s]."""
Share = Annotated[float, Meta(ge=0, le=1)]
"""Share from 0 to 1."""


class Impairment:
    """Base class of an effect of the network on packets. An impairment must not store anything from
    one packet to the next.
    """

    kind: Literal["delay", "loss", "other"] = "other"
    """Kind of effect. The first delay and the first loss of a direction keep their random numbers
    when other impairments are added."""
    least_s: float = 0.0
    """Smallest delay that the impairment adds [s]."""
    mean_s: float = 0.0
    """Mean delay that the impairment adds [s]."""
    loss: float = 0.0
    """Mean share of packets that the impairment loses."""
    is_ordered: bool = False
    """Whether packets of a flow stay in order."""
    is_queue: bool = False
    """Whether the impairment is a finite rate with a queue, see `queues.Queued`."""
    only_packets: bool = False
    """Whether the impairment cannot apply to byte streams, such as TCP connections."""

    def __call__(self, fate: Fate, draws: Draws) -> None:
        """Change the fate of a packet that enters.

        Args:
            fate: fate of the packet after the preceding impairments.
            draws: random numbers of this impairment.
        """
