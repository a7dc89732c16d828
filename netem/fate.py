"""Fates of packets: how long each is delayed, which are lost, and what else befalls them.

Each direction has a list of impairments (`shared.scenario.air`), which write into the fate of a
packet one after the other. A fate depends on the seed, the direction, the flow and the slot in
which the packet enters, and on nothing that was sent before: so two controllers meet the same
network, however often each of them sends. Of packets that enter in one slot each has a fate of its
own, by its rank among them: the three CLOSEs that are sent at once are not lost all together.
Control traffic is so sparse that nearly every packet is the first of its slot.
"""

from collections import Counter

from skytether.shared.scenario.air.draws import Draws, Fate, Stream
from skytether.shared.scenario.air.impairment import Impairment
from skytether.shared.scenario.schema import DirectionConfig


class Fates:
    """Fates of the packets of one flow in one direction.

    Args:
        direction: its impairments.
        seed: seed of the scenario.
        name: name of the direction.
        flow: number of the flow.
    """

    def __init__(self, direction: DirectionConfig, seed: int, name: str, flow: int) -> None:
        at = seed, name, flow
        packets = Stream(*at, "packets")
        self._impairments: list[tuple[Impairment, Draws]] = []
        kinds: Counter[str] = Counter()
        names: Counter[str] = Counter()
        for name_, each in direction.path.impairments:
            kinds[each.kind] += 1
            names[name_] += 1
            # The first delay and the first loss share a pair, so that they keep their numbers
            # whatever else is added or changed.
            if each.kind != "other" and kinds[each.kind] == 1:
                moments = "moments" if each.kind == "loss" else "moments of the delay"
                draws = Draws(packets, int(each.kind == "loss"), (*at, moments))
            else:
                own = f"{name_} {names[name_]}"
                draws = Draws(Stream(*at, own), 0, (*at, f"moments of {own}"))
            self._impairments.append((each, draws))

    def at(self, slot: int, rank: int = 0) -> Fate:
        """Fate of a packet.

        Args:
            slot: slot in which it enters.
            rank: number of the packets of the flow that have entered in that slot before it.
        """
        fate = Fate(slot, rank)
        for impairment, draws in self._impairments:
            impairment(fate, draws)
        return fate
