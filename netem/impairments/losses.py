"""Independent losses of packets; `outages` has losses that last for a time."""

from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Share, impairment


@impairment(name="none")
class Nothing(Impairment):
    """Passes every packet at once and unchanged."""


@impairment(name="loss")
class Loss(Impairment):
    """Loses a share of the packets, each independently of the others (Bernoulli)."""

    kind = "loss"

    def __init__(self, share: Share) -> None:
        self.loss = share

    def __call__(self, fate: Fate, draws: Draws) -> None:
        if draws.uniform(fate) < self.loss:
            fate.lost = True
