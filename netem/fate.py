"""Fates of packets: how long each is delayed, and which are lost.

The paper's delay, eq. (17) as corrected (E1, E2), is 0.4 s + 0.02 s · m with m Poisson of mean 2.
The fate of a packet depends on the seed, its direction, its flow and its number in them, and on
nothing else: delay and loss are drawn from two streams for every packet, also for a lost one, so
that two controllers that send alike meet the same network.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.chance import stream
from shared.config import DirectionConfig
from shared.endpoint import seconds_to_ns

BLOCK = 256
"""Number of fates drawn at once; drawing them singly costs forty times as much."""


class Fate(NamedTuple):
    """Fate of one packet."""

    delay_ns: int
    """Delay in this direction [ns], drawn for a lost packet, too."""
    lost: bool
    """Whether it is lost."""


def delays_ns(
    direction: DirectionConfig, rng: np.random.Generator, count: int
) -> NDArray[np.int64]:
    """Delays of packets [ns]; shape (count,)."""
    match direction.delay:
        case "poisson":
            slots = rng.poisson(direction.slots_mean, count)
            return seconds_to_ns(direction.minimum_s) + slots * seconds_to_ns(direction.slot_s)
        case "constant":
            return np.full(count, seconds_to_ns(direction.minimum_s), dtype=np.int64)
        case "none":
            return np.zeros(count, dtype=np.int64)


def fates(direction: DirectionConfig, seed: int, name: str, flow: int) -> Iterator[Fate]:
    """The fates of packet 0, 1, 2, … of one flow in the direction called `name`."""
    delay_rng, loss_rng = (stream(seed, name, purpose, flow) for purpose in ("delay", "loss"))
    while True:
        delays = delays_ns(direction, delay_rng, BLOCK).tolist()
        lost = (loss_rng.random(BLOCK) < direction.loss).tolist()
        yield from map(Fate, delays, lost)
