"""Random numbers of packets, which follow from names and from where a packet enters, alone.

The fate of a packet depends on the seed, its direction, its flow and the slot of SLOT_NS in which
it enters, counted from when the flow began, and on nothing that was sent before. So two controllers
meet the same network, however often each of them sends. Packets that enter in one slot differ by
their rank among them.
"""

from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from math import floor, log1p
from struct import Struct

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

SLOT_NS = MILLISECOND_NS
"""Length of a slot [ns]: shorter than any step, so that no two horizons and no two observations
share one."""
SLOT_S = SLOT_NS / SECOND_NS
_PLACE = Struct("<qq")
"""Place of a draw: slot and rank, or cell and number."""
_DRAWN = Struct("<QQ")
"""Layout of what is drawn at one place."""


@dataclass(slots=True)
class Fate:
    """Fate of one packet; impairments write into it, one after the other."""

    slot: int = 0
    """Slot in which it enters, counted from when its flow began."""
    rank: int = 0
    """Number of the packets of its flow that have entered in that slot before it."""
    delay_ns: int = 0
    """Delay [ns], drawn for a lost packet, too."""
    lost: bool = False
    """Whether it is lost."""
    copies: int = 0
    """Number of copies that arrive beside it."""
    flipped: float | None = None
    """Place of a bit that is flipped, as a share of the packet's length below 1; None: of none."""

    @property
    def time_s(self) -> float:
        """Time at which it enters, counted from when its flow began [s]."""
        return self.slot * SLOT_NS / SECOND_NS


class Stream:
    """Pairs of uniform numbers that follow from names and a place alone.

    Args:
        names: seed, direction, flow and purpose.
    """

    def __init__(self, *names: str | int) -> None:
        # A hash and no generator: the number of any place is found without drawing those before it.
        self._seeded = blake2b(repr(names).encode(), digest_size=_DRAWN.size)
        self._at, self._number, self._pair = -1, -1, (0.0, 0.0)
        """Place and number of the pair that was drawn last, and the pair."""

    def pair(self, place: int, number: int) -> tuple[float, float]:
        """Two numbers below 1."""
        if place == self._at and number == self._number:
            return self._pair
        # Copying the seeded state hashes the names once per stream and not once per packet.
        drawn = self._seeded.copy()
        drawn.update(_PLACE.pack(place, number))
        one, other = _DRAWN.unpack(drawn.digest())
        self._at, self._number = place, number
        # 53 bits, as many as a float in [0, 1) has.
        self._pair = pair = (one >> 11) * 2.0**-53, (other >> 11) * 2.0**-53
        return pair


class Draws:
    """Random numbers of one impairment for the packets of one flow in one direction.

    Args:
        packets: a pair of numbers for each packet.
        which: which number of the pair is this impairment's.
        names: names of its other stream.
    """

    def __init__(self, packets: Stream, which: int, names: tuple[str | int, ...]) -> None:
        self._pair, self._which, self._names = packets.pair, which, names

    @cached_property
    def _moments(self) -> Stream:
        return Stream(*self._names)

    def uniform(self, fate: Fate) -> float:
        """Number below 1, another for each packet."""
        return self._pair(fate.slot, fate.rank)[self._which]

    def lasting(self, fate: Fate, mean_s: float) -> float:
        """Number below 1 that stays for a while, and is drawn anew at moments that come by chance.

        Moments come at a constant rate, so that the number keeps its distribution and its
        autocorrelation falls exponentially. It follows from the newest moment alone, and is found
        from the time, however far that has jumped. There is one moment in a cell of `mean_s` in
        the mean, and none in a share of 1/e of them.

        Args:
            mean_s: mean time from one moment to the next [s]. Where it is no longer than a slot,
                each packet has a number of its own.
        """
        mean_ns = mean_s * SECOND_NS
        if mean_ns <= SLOT_NS:
            return self.uniform(fate)
        time = fate.slot * SLOT_NS / mean_ns
        cell = floor(time)
        while True:
            moment, number, state = float(cell), 0, None
            while True:
                gap, drawn = self._moments.pair(cell, number)
                moment -= log1p(-gap)
                if moment > time or moment > cell + 1.0:
                    break
                state, number = drawn, number + 1
            if state is not None:
                return state
            # No moment in this cell before the time: the state is that of the newest moment of an
            # earlier cell.
            cell -= 1
