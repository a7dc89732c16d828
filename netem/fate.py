"""Fates of packets: delay, loss, and other impairments of each packet.

Each direction has a list of impairments (`netem.impairments`), which modify the fate of a packet
one after another. In a flight a fate depends on the seed, the direction, the flow and the time slot
in which the packet enters, but not on earlier packets: so two controllers get the same network even
if they send at different rates. For other programs a fate depends on the packet's number in its
flow, see `netem.impairments.draws`. Packets of a flight that enter in the same slot have different
fates, by their rank in the slot: otherwise three CLOSEs sent at once would all be lost together.
Control traffic is so sparse that nearly every packet is the first of its slot.

If an impairment of a plug-in raises an exception or sets an impossible value, it has no effect on
that packet, and the flight continues.
"""

from collections import Counter
from typing import Any

from skytether.netem.impairments.direction import Impairments
from skytether.netem.impairments.draws import Draws, Fate, Stream
from skytether.netem.impairments.impairment import Impairment
from skytether.shared.scenario.registry import IMPAIRMENTS, load


class Fates:
    """Fates of the packets of one flow in one direction.

    Args:
        by_number: whether a packet's random numbers depend on its number in the flow; else they
            depend on its slot.
        is_common: whether lasting effects, such as outages, are common to all flows.
    """

    by_number = False

    def __init__(
        self,
        of: Impairments,
        seed: int,
        name: str,
        flow: int,
        *,
        by_number: bool = False,
        is_common: bool = False,
    ) -> None:
        at, lasting = (seed, name, flow), (seed, name, 0 if is_common else flow)
        packets = Stream(*at, "packets")
        self.by_number = by_number
        self._impairments: list[tuple[Impairment, Draws]] = []
        self.fault = ""
        """Traceback of the first error of a plug-in, or empty."""
        self._guarded: Any = None
        """`guarded.fate_of` if one of the impairments comes from a plug-in, else None."""
        kinds: Counter[str] = Counter()
        names: Counter[str] = Counter()
        for name_, each in of.parts:
            kinds[each.kind] += 1
            names[name_] += 1
            # The first delay and the first loss use fixed streams, so that their numbers do not
            # change when other impairments are added or changed.
            if each.kind != "other" and kinds[each.kind] == 1:
                moments = "moments" if each.kind == "loss" else "moments of the delay"
                stream, which = packets, int(each.kind == "loss")
            else:
                own = f"{name_} {names[name_]}"
                stream, which, moments = Stream(*at, own), 0, f"moments of {own}"
            draws = Draws(stream, which, (*lasting, moments), by_number=by_number)
            self._impairments.append((each, draws))
            if not IMPAIRMENTS[name_].is_ours:
                module = load("skytether.netem.impairments.guarded", f"impairment {name_}")
                self._guarded = module.fate_of

    def at(self, slot: int, rank: int = 0) -> Fate:
        """Fate of a packet.

        Args:
            slot: time slot in which the packet enters.
            rank: number of packets of the flow that entered before this packet: in the same slot,
                or, with `by_number`, in any slot.
        """
        fate = Fate(slot, rank)
        # Built-in impairments are called without the guard, which copies the fate for each of them.
        if self._guarded:
            fate, fault = self._guarded(fate, self._impairments)
            self.fault = self.fault or fault
            return fate
        for impairment, draws in self._impairments:
            impairment(fate, draws)
        return fate
