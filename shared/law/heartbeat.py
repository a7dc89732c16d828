"""Heartbeats: how long an end may be silent, which the other end asks of it.

Who waits knows best: an end takes the other for gone after a time-out of its own, and finds from
the numbers of the packets that come how many are lost on the way to it. So each packet of a session
has a number, and asks for a longest silence. Any packet is a heartbeat; where there is nothing else
to say, one is sent after that silence.

With a packet every T, and n of them within the time-out, a link that works is taken for lost

    f = 3600/T pⁿ (1 - p) times an hour                      p: share lost, independent

Asked is the longest T, a whole number of steps and within bounds, with f at most once in ten hours.
Of the time-out a twentieth is left out, for delays that differ.
"""

from bisect import bisect_left
from functools import lru_cache
from itertools import pairwise

from skytether.shared.base.units import SECOND_NS

FALSE_PER_H = 0.1
"""False losses of the link that are put up with [1/h]."""
FEWEST, MOST = 3, 15
"""Fewest and most heartbeats that a time-out is made of."""
ROOM = 0.95
"""Share of the time-out within which n heartbeats are counted."""
WINDOW = 128
"""Newest packets of the other end of which it is known whether they came."""
ASSUMED, WEIGHT = 0.3, 4
"""Share lost that is assumed at first, and for how many packets that counts, always."""
NUMBERS = 128
"""Modulus of the numbers of packets as they are told."""
BEFORE = -(2**64)
"""Time or step before all others."""
SILENCE_MAX = 2**16 - 1
"""Longest silence that can be asked for [half steps]."""
SESSION_NS = 30 * SECOND_NS
"""Silence after which the server forgets a vehicle [ns]."""
# With three, the observations behind the plans became so old that at 30 % loss 5 of 30 flights of
# `target` braked before a newer plan came; with two, none.
PATIENCE = 2
"""Time-outs of the vehicle that the server waits for it."""


def false_per_h(silence_ns: int, timeout_ns: int, loss: float) -> float:
    """Times an hour that a link which works is taken for lost, f.

    Args:
        silence_ns: time from one heartbeat to the next [ns].
        timeout_ns: time without a packet after which the link is lost [ns].
        loss: share of packets that are lost, each independently.
    """
    n = int(ROOM * timeout_ns) // silence_ns
    most = n / (n + 1)  # more lost makes fewer losses of the link, which are longer
    loss = min(loss, most)
    return 3600 * SECOND_NS / silence_ns * loss**n * (1.0 - loss)


@lru_cache
def silences(timeout_ns: int, step_ns: int) -> tuple[tuple[float, int], ...]:
    """Silences that may be asked for: the largest loss for which each will do, and its time [ns].

    The longest comes first, and with the rising loss the shorter ones; the last is for any loss.
    """
    fewest, most = -(-timeout_ns // (MOST * step_ns)), timeout_ns // (FEWEST * step_ns)
    counts = range(max(most, 1), max(fewest, 1) - 1, -1) or (1,)
    # A table, made once: each packet then costs a bisection only.
    grid = [i / 1000 for i in range(1001)]
    found: list[tuple[float, int]] = []
    for count in counts:
        silence_ns = count * step_ns
        good = [loss for loss in grid if false_per_h(silence_ns, timeout_ns, loss) <= FALSE_PER_H]
        up_to = max(good, default=-1.0)
        if not found or up_to > found[-1][0]:
            found.append((up_to, silence_ns))
    assert all(a < b for (a, _), (b, _) in pairwise(found))
    return tuple(found)


class Hearing:
    """Ear of one end: which packets of the other came, and what silence is asked of it.

    Args:
        timeout_ns: time without a packet after which the other end is taken for gone [ns].
        step_ns: length of a step, in which heartbeats are sent [ns].
        fixed_ns: silence that is asked for whatever the loss [ns]; None to follow the loss.
    """

    def __init__(self, timeout_ns: int, step_ns: int, fixed_ns: int | None) -> None:
        self._fixed_ns, self._half_step_ns = fixed_ns, step_ns // 2
        table = silences(timeout_ns, step_ns)
        self._losses, self._silences = [loss for loss, _ in table], [ns for _, ns in table]
        self._came = 0
        """Bits of the newest WINDOW packets, set for those that came; the newest is lowest."""
        self.newest = -1
        """Largest number of a packet that came; -1 before the first."""
        self._newest_at = BEFORE
        """Step or time at which that packet was sent."""
        self._told = 0
        """`silence`, once it has been asked for; 0 where it may be another by now."""

    def begin(self) -> None:
        """Begin anew with another session."""
        self._came, self.newest, self._newest_at, self._told = 0, -1, BEFORE, 0

    def hear(self, number: int, at: int) -> None:
        """Take a packet that came, in whatever order and however often.

        Of a burst of NUMBERS losses or more so many are not seen to be lost.

        Args:
            number: its number, modulo NUMBERS.
            at: step or time at which it was sent; larger for a later one.
        """
        if at > self._newest_at:
            ahead = (number - self.newest - 1) % NUMBERS + 1
            self._came = (self._came << ahead | 1) & (1 << WINDOW) - 1
            self.newest += ahead
            self._newest_at = at
        else:
            # A late packet was not lost, and takes back that it seemed so.
            self._came |= 1 << (self.newest - number) % NUMBERS
        if self._fixed_ns is None:
            self._told = 0

    @property
    def loss(self) -> float:
        """Share of the other end's packets that are lost, rather too large than too small."""
        known = min(self.newest + 1, WINDOW)
        lost = known - self._came.bit_count()
        # A prior of WEIGHT packets: after the first few of a session a single loss must not look
        # like a third.
        return (lost + WEIGHT * ASSUMED) / (known + WEIGHT)

    @property
    def silence_ns(self) -> int:
        """Longest silence that is asked of the other end [ns].

        Where it follows the loss it is half a step shorter than T, for a step is not woken to the
        nanosecond.
        """
        if self._fixed_ns is not None:
            return self._fixed_ns
        index = bisect_left(self._losses, self.loss)
        return self._silences[min(index, len(self._silences) - 1)] - self._half_step_ns

    @property
    def silence(self) -> int:
        """Longest silence that is asked of the other end, as it is told [half steps]."""
        if self._told == 0:
            self._told = min(max(self.silence_ns // self._half_step_ns, 1), SILENCE_MAX)
        return self._told
