"""Fates of packets: how long each is delayed, and which are lost.

The paper's delay, eq. (17) as corrected (E1, E2), is 0.4 s + 0.02 s · m with m Poisson of mean 2.
The fate of a packet depends on the seed, its direction, its flow and the slot of SLOT_NS in which
it enters, counted from when the flow began, and on nothing that was sent before. So two controllers
meet the same network, however often each of them sends. Of packets that enter in one slot each has
a fate of its own, by its rank among them: the three CLOSEs that are sent at once are not lost all
together. Control traffic is so sparse that nearly every packet is the first of its slot.

With bursts, what is lost is lost by the slot: a channel in turns good and bad (Gilbert), for times
that are exponential. Such a channel forgets: at moments that come by chance, at a constant rate,
its state is drawn anew, bad with the share that is lost. A state therefore follows from the newest
of these moments alone, and is found from the time, however far that has jumped.
"""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from math import floor, lgamma, log, log1p, sqrt
from struct import Struct
from typing import NamedTuple

import numpy as np

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.scenario.schema import DirectionConfig

SLOT_NS = MILLISECOND_NS
"""Length of a slot [ns]: shorter than any step, so that no two horizons and no two observations
share one."""
PLACE = Struct("<qq")
"""Place of a draw: slot and rank, or cell and number."""
DRAWN = Struct("<QQ")
"""Layout of what is drawn at one place."""


class Fate(NamedTuple):
    """Fate of one packet."""

    delay_ns: int
    """Delay in this direction [ns], drawn for a lost packet, too."""
    lost: bool
    """Whether it is lost."""


class Fates:
    """Fates of the packets of one flow in one direction.

    Args:
        direction: law of delays and losses.
        seed: seed of the scenario.
        name: name of the direction.
        flow: number of the flow.
    """

    def __init__(self, direction: DirectionConfig, seed: int, name: str, flow: int) -> None:
        self._packets = _seeded(seed, name, flow, "packets")
        self._moments = _seeded(seed, name, flow, "moments")
        self._loss = direction.loss
        self._least_ns = seconds_to_ns(direction.least_s)
        mean = direction.slots_mean if direction.delay == "poisson" else 0.0
        self._fewest, self._cumulative = _poisson(mean)
        self._slot_ns = seconds_to_ns(direction.slot_s)
        self._cell_ns = direction.burst_s * (1.0 - direction.loss) * SECOND_NS
        """Mean time between the moments at which a channel with bursts is drawn anew [ns]: a bad
        one then stays bad with the share that is lost, and so for `burst_s` in the mean."""

    def at(self, slot: int, rank: int = 0) -> Fate:
        """Fate of a packet.

        Args:
            slot: slot in which it enters.
            rank: number of the packets of the flow that have entered in that slot before it.
        """
        waits, loses = _uniform(self._packets, slot, rank)
        slots = self._fewest + bisect_right(self._cumulative, waits)
        if self._cell_ns > SLOT_NS:
            loses = self._state(slot * SLOT_NS / self._cell_ns)
        return Fate(self._least_ns + slots * self._slot_ns, loses < self._loss)

    def _state(self, time: float) -> float:
        """What was drawn at the newest moment before a time, counted in cells: below the share
        that is lost while the channel is bad.

        There is one moment in a cell in the mean, and none in a share of 1/e of them.
        """
        cell = floor(time)
        while True:
            moment, number, state = float(cell), 0, None
            while True:
                gap, drawn = _uniform(self._moments, cell, number)
                moment -= log1p(-gap)
                if moment > time or moment > cell + 1.0:
                    break
                state, number = drawn, number + 1
            if state is not None:
                return state
            cell -= 1


def _seeded(*names: str | int) -> blake2b:
    """Hash of names, to which a place is added for a draw."""
    return blake2b(repr(names).encode(), digest_size=DRAWN.size)


def _uniform(seeded: blake2b, place: int, number: int) -> tuple[float, float]:
    """Two numbers below 1 that follow from names and a place alone."""
    drawn = seeded.copy()
    drawn.update(PLACE.pack(place, number))
    one, other = DRAWN.unpack(drawn.digest())
    return (one >> 11) * 2.0**-53, (other >> 11) * 2.0**-53


@lru_cache(maxsize=64)
def _poisson(mean: float) -> tuple[int, Sequence[float]]:
    """Cumulative probabilities of a Poisson law, as far as they differ from 0 and from 1.

    Returns:
        The number that the first of them is of, and the probabilities of no more than each number.
    """
    if mean == 0.0:
        return 0, (1.0,)
    wide = 10.0 * sqrt(mean) + 20.0
    numbers = range(max(0, floor(mean - wide)), floor(mean + wide))
    logs = [number * log(mean) - mean - lgamma(number + 1.0) for number in numbers]
    cumulative = np.cumsum(np.exp(logs))
    return numbers[0], (cumulative / cumulative[-1]).tolist()
