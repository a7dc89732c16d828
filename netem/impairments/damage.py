"""Impairments that duplicate or corrupt packets."""

from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Share, impairment


@impairment(name="duplicate")
class Duplicate(Impairment):
    """Sends a share of the packets twice."""

    only_packets = True

    def __init__(self, share: Share) -> None:
        self._share = share

    def __call__(self, fate: Fate, draws: Draws) -> None:
        if draws.uniform(fate) < self._share:
            fate.copies += 1


@impairment(name="corrupt")
class Corrupt(Impairment):
    """Flips one bit of a share of the packets."""

    only_packets = True

    def __init__(self, share: Share) -> None:
        self._share = share

    def __call__(self, fate: Fate, draws: Draws) -> None:
        drawn = draws.uniform(fate)
        if drawn < self._share:
            fate.flipped = drawn / self._share
