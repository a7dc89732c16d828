"""Heartbeats: each end requests the longest time without a packet from the other end.

Each end considers the other as gone after its own time-out, and measures the loss from the numbers
of the packets that arrive. So each packet of a session has a number, and carries the longest
silence that its sender allows the receiver. Any packet counts as a heartbeat; an end with nothing
else to send sends a heartbeat after that silence.

If a packet is sent every T seconds, n packets within the time-out, and packets are lost
independently with the probability p, then a working link is mistaken for lost

    f = 3600/T pⁿ (1 - p) times an hour.

An end requests the longest T, a whole number of steps and within bounds, with f at most once in ten
hours. A twentieth of the time-out is a margin for varying delays.
"""

from bisect import bisect_left
from functools import lru_cache
from itertools import pairwise

from skytether.shared.base.units import SECOND_NS

FALSE_PER_H = 0.1
"""Accepted rate of false losses of the link [1/h]."""
FEWEST, MOST = 3, 15
"""Smallest and largest number of heartbeats in a time-out."""
TIMEOUT_SHARE = 0.95
"""Share of the time-out within which n heartbeats are counted."""
WINDOW = 128
"""Number of newest packets whose arrival is recorded."""
ASSUMED, WEIGHT = 0.3, 4
"""Loss ratio that is assumed initially, and the weight of this assumption [packets]."""
NUMBERS = 128
BEFORE = -(2**64)
SILENCE_MAX = 2**16 - 1
"""Longest silence that can be requested [half steps]."""
SESSION_NS = 30 * SECOND_NS
"""Silence after which the server forgets a vehicle [ns]."""
RARE_TIMES = 2
"""Longest silence between a vehicle and a server that does not lead it, as a multiple of the
time-out; bounded by SESSION_NS."""
# At 30 % loss, no flight of `target` braked with the value 2. With the value 3, five of 30 flights
# braked, because plans were made from observations that were too old.
PATIENCE = 2
"""Server's time-out for a vehicle, as a multiple of the vehicle's own time-out."""


def false_per_h(silence_ns: int, timeout_ns: int, loss: float) -> float:
    """Rate f at which a working link is mistaken for lost [1/h].

    Args:
        silence_ns: time from one heartbeat to the next [ns].
        timeout_ns: time without a packet after which the link counts as lost [ns].
        loss: share of packets lost, independently.
    """
    n = int(TIMEOUT_SHARE * timeout_ns) // silence_ns
    most = n / (n + 1)  # with more loss, the link is mistaken for lost less often, but for longer
    loss = min(loss, most)
    return 3600 * SECOND_NS / silence_ns * loss**n * (1.0 - loss)


@lru_cache
def silences(timeout_ns: int, step_ns: int) -> tuple[tuple[float, int], ...]:
    """Pairs of a loss ratio and a heartbeat interval [ns], longest interval first. Up to its loss
    ratio an interval keeps `false_per_h` within FALSE_PER_H; the last one serves all higher losses.
    """
    fewest, most = -(-timeout_ns // (MOST * step_ns)), timeout_ns // (FEWEST * step_ns)
    counts = range(max(most, 1), max(fewest, 1) - 1, -1) or (1,)
    # A table, computed once, so that each packet takes only a bisection.
    grid = [i / 1000 for i in range(1001)]
    table: list[tuple[float, int]] = []
    for count in counts:
        silence_ns = count * step_ns
        good = [loss for loss in grid if false_per_h(silence_ns, timeout_ns, loss) <= FALSE_PER_H]
        up_to = max(good, default=-1.0)
        if not table or up_to > table[-1][0]:
            table.append((up_to, silence_ns))
    assert all(a < b for (a, _), (b, _) in pairwise(table))
    return tuple(table)


class Hearing:
    """Reception statistics of one end: the arrived packets, and the silence that the other end may
    keep.

    Args:
        timeout_ns: time without a packet after which the other end counts as gone [ns].
        step_ns: length of a step, the resolution of heartbeats [ns].
        fixed_ns: silence to allow at any loss [ns]; None if it depends on the measured loss.
    """

    def __init__(self, timeout_ns: int, step_ns: int, fixed_ns: int | None) -> None:
        self._fixed_ns, self._half_step_ns = fixed_ns, step_ns // 2
        self.overtaken_ns = min(timeout_ns, (NUMBERS - 1) * step_ns)
        """Delay behind newer packets above which a packet counts as lost [ns]: a longer delay would
        exceed the time-out, or make the number (modulo NUMBERS) ambiguous."""
        rare_ns = min(RARE_TIMES * timeout_ns, SESSION_NS // 4)
        self.rare = min(rare_ns // self._half_step_ns, SILENCE_MAX)
        """Longest silence between a vehicle and a server that does not lead it [half steps]."""
        table = silences(timeout_ns, step_ns)
        self._losses, self._silences = [loss for loss, _ in table], [ns for _, ns in table]
        self._received = 0
        """Bits of the newest WINDOW packets, each 1 if its packet arrived; the lowest bit belongs
        to the newest packet."""
        self.newest = -1
        """Largest number of a packet that arrived; -1 before the first."""
        self._newest_at = BEFORE
        """Step or time at which the packet with the largest number was sent."""
        self._silence = 0
        """Cached value of `silence` [half steps]; 0 if it is outdated."""

    def begin(self) -> None:
        self._received, self.newest, self._newest_at, self._silence = 0, -1, BEFORE, 0

    def hear(self, number: int, at: int) -> None:
        """Note a packet, in any order and possibly repeated.

        Bursts of NUMBERS losses or more are counted as shorter by a multiple of NUMBERS.

        Args:
            number: number of the packet, modulo NUMBERS.
            at: step or time at which the packet was sent; larger for a later packet.
        """
        if at > self._newest_at:
            ahead = (number - self.newest - 1) % NUMBERS + 1
            self._received = (self._received << ahead | 1) & (1 << WINDOW) - 1
            self.newest += ahead
            self._newest_at = at
        else:
            # A late packet was counted as lost until it arrived.
            self._received |= 1 << (self.newest - number) % NUMBERS
        if self._fixed_ns is None:
            self._silence = 0

    @property
    def loss(self) -> float:
        """Estimated share of the other end's packets that are lost; ASSUMED before any packet."""
        counted = min(self.newest + 1, WINDOW)
        lost = counted - self._received.bit_count()
        # A prior of WEIGHT packets: a single loss among the first three packets of a session must
        # not count as a loss of one third.
        return (lost + WEIGHT * ASSUMED) / (counted + WEIGHT)

    @property
    def silence_ns(self) -> int:
        """Longest silence to allow the other end [ns].

        Unless the silence is fixed, it is T minus half a step, because steps may begin late.
        """
        if self._fixed_ns is not None:
            return self._fixed_ns
        index = bisect_left(self._losses, self.loss)
        return self._silences[min(index, len(self._silences) - 1)] - self._half_step_ns

    @property
    def silence(self) -> int:
        """Longest silence to allow the other end [half steps]."""
        if self._silence == 0:
            self._silence = min(max(self.silence_ns // self._half_step_ns, 1), SILENCE_MAX)
        return self._silence
