"""Random numbers of packets, as functions of the seed and the packet's time or number.

In a flight the fate of a packet depends on the seed, its direction, its flow and the slot of
SLOT_NS in which it enters, counted from the start of the flow. It does not depend on earlier
packets. So two controllers are compared on the same network, even if they send at different rates.
Packets of one flow in one slot are numbered by rank.

Two runs of any other program send the same packets, but never in the same milliseconds. So for
other programs a packet's rank is its number in its flow, and its own random numbers depend on that
number. Lasting effects depend on the time since the flow's first packet, or, if they are common to
all flows of a program (`netem.tunnel`), since the program's first packet.
"""

from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from math import floor, log1p
from struct import Struct

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

SLOT_NS = MILLISECOND_NS
"""Length of a slot: shorter than any step, so that two horizons or observations share no slot."""
SLOT_S = SLOT_NS / SECOND_NS
_PLACE = Struct("<qq")
"""Input of the hash: slot and rank, or cell and number."""
_DRAWN = Struct("<QQ")
"""Output of the hash: two random integers."""


@dataclass(slots=True)
class Fate:
    """Fate of one packet; impairments write into it, one after the other."""

    slot: int = 0
    """Slot in which the packet enters, counted from the start of its flow."""
    rank: int = 0
    """Number of earlier packets of the flow in the same slot; with `by_number`, in all slots."""
    delay_ns: int = 0
    """Delay [ns]; a lost packet has a delay, too."""
    lost: bool = False
    """Whether the packet is lost."""
    copies: int = 0
    """Number of extra copies that arrive."""
    flipped: float | None = None
    """Position of a flipped bit as a share of the packet's length, below 1; None: no flip."""

    @property
    def time_s(self) -> float:
        """Time at which the packet enters, counted from the start of its flow [s]."""
        return self.slot * SLOT_NS / SECOND_NS


class Stream:
    """Pairs of uniform random numbers, each pair a hash of names, a place and a number.

    Args:
        names: seed, direction, flow and purpose.
    """

    def __init__(self, *names: str | int) -> None:
        # A hash, not a generator: a draw does not depend on earlier draws.
        self._names = names
        self._seeded = blake2b(repr(names).encode(), digest_size=_DRAWN.size)
        self._at, self._number, self._pair = -1, -1, (0.0, 0.0)
        """Arguments and result of the last call of `pair`."""

    def __reduce__(self) -> tuple[type["Stream"], tuple[str | int, ...]]:
        return Stream, self._names  # a hash cannot be pickled

    def pair(self, place: int, number: int) -> tuple[float, float]:
        """Two random numbers from 0 to below 1.

        Args:
            place: slot or cell.
            number: rank in the slot, or number within the cell.
        """
        if place == self._at and number == self._number:
            return self._pair
        # A copy of the hash: the names need not be hashed again for each packet.
        drawn = self._seeded.copy()
        drawn.update(_PLACE.pack(place, number))
        one, other = _DRAWN.unpack(drawn.digest())
        self._at, self._number = place, number
        # 53 bits, the precision of a float.
        self._pair = pair = (one >> 11) * 2.0**-53, (other >> 11) * 2.0**-53
        return pair


class Draws:
    """Random numbers of one impairment for the packets of one flow in one direction.

    Args:
        packets: stream with a pair of numbers for each packet, shared by two impairments.
        which: index of the impairment's number in that pair, 0 or 1.
        names: names of the stream for `lasting`.
        by_number: whether a packet's own numbers depend only on its rank, not on its slot.
    """

    def __init__(
        self, packets: Stream, which: int, names: tuple[str | int, ...], *, by_number: bool = False
    ) -> None:
        self._pair, self._which, self._names = packets.pair, which, names
        self._by_number = by_number
        self.flow = names[2]
        """Number of the packets' flow, from 0; always 0 if lasting effects are common."""

    @cached_property
    def _events(self) -> Stream:
        return Stream(*self._names)

    def uniform(self, fate: Fate) -> float:
        """Random number below 1, independent for each packet."""
        return self._pair(0 if self._by_number else fate.slot, fate.rank)[self._which]

    def lasting(self, fate: Fate, mean_s: float) -> float:
        """Random number below 1 that is redrawn at the events of a Poisson process.

        The number's distribution is uniform, and its autocorrelation falls exponentially. The
        number depends only on the newest event before the packet. To find that event, time is
        divided into cells of length `mean_s`, and the events of one cell after another are drawn,
        backwards from the packet's time. A cell has one event on average, and none with probability
        1/e.

        Args:
            fate: the packet.
            mean_s: mean time between two events [s]. If it is not longer than a slot, each
                packet has an independent number.
        """
        mean_ns = mean_s * SECOND_NS
        if mean_ns <= SLOT_NS:
            return self.uniform(fate)
        time = fate.slot * SLOT_NS / mean_ns
        cell = floor(time)
        while True:
            event, number, state = float(cell), 0, None
            while True:
                gap, drawn = self._events.pair(cell, number)
                event -= log1p(-gap)
                if event > time or event > cell + 1.0:
                    break
                state, number = drawn, number + 1
            if state is not None:
                return state
            # No event in this cell before the packet: continue with the cell before.
            cell -= 1
