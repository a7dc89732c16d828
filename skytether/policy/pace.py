"""Rate and loss of one direction, from what the receiver reports.

The rate follows the delay: while packets queue up (their delay exceeds the least of the last
seconds by more than QUEUE_HIGH_NS) it falls below what arrived, and while the queue is short and
the rate was used, it rises. Loss alone does not lower it: on radio links it is no sign of a queue.
See LEDBAT (RFC 6817) and Google's congestion control (RFC 8698 has a kindred one) for the idea.
"""

from collections import deque

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

RATE_FIRST, RATE_MIN = 1_250_000.0, 12_500.0
"""Rate before the first report, and the least [B/s]."""
RATE_MAX = 125_000_000.0
BURST_BYTES = 3600
"""Bytes that may leave at once."""
QUEUE_HIGH_NS, QUEUE_LOW_NS = 40 * MILLISECOND_NS, 15 * MILLISECOND_NS
LOWERED_EVERY_NS = 200 * MILLISECOND_NS
LOWER, RISE = 0.85, 1.08
LEAST_NS = 10 * SECOND_NS
"""Time for which the least delay is remembered: clocks drift apart by less than 1 ms in it."""
PARTS_MIN = 6
"""Number of parts from which on the rate at which they came is taken as that of the path."""
LOSS_FIRST, LOSS_MAX = 0.02, 0.4
GAIN_UP, GAIN_DOWN = 0.3, 0.05
"""Weight of a report that says more, or less, than the estimate of the loss."""


class Pace:
    """Pace of one direction.

    Args:
        most: bound of the rate [B/s].
    """

    def __init__(self, most: float = RATE_MAX) -> None:
        self._most = most
        self.rate = min(RATE_FIRST, most)
        """Bytes that may be sent in a second [B/s]."""
        self.loss = LOSS_FIRST
        """Share of the parts that are lost."""
        self.round_trip_ns: int | None = None
        """Newest round trip, without the time at the other end [ns]."""
        self.queue_ns = 0
        """Newest delay minus the least [ns]."""
        self._least: deque[tuple[int, int]] = deque()
        """Times and delays [ns] of which each is the least since; the first is the least of all."""
        self._lowered_ns = -LOWERED_EVERY_NS
        self._free_ns = 0

    def due_ns(self) -> int:
        """Time at which the next datagram may leave [ns]."""
        return self._free_ns - int(BURST_BYTES / self.rate * SECOND_NS)

    def sent(self, size: int, now_ns: int) -> None:
        """Note that a datagram has left, of this size [B]."""
        self._free_ns = max(self._free_ns, now_ns) + int(size / self.rate * SECOND_NS)

    def heard(
        self,
        sent: int,
        came: int,
        size: int,
        delay_ns: int,
        round_trip_ns: int,
        spread_ns: int,
        *,
        was_limited: bool,
        now_ns: int,
    ) -> None:
        """Learn from a report.

        Args:
            sent, came: number of parts of a message that were sent, and that came.
            size: bytes of those that came.
            delay_ns: delay of the last, up to a constant [ns].
            round_trip_ns: round trip of the last, which is no shorter than any queue on it [ns].
            spread_ns: time from the first to the last at the receiver [ns].
            was_limited: whether the message took as long as the rate allows.
        """
        self.round_trip_ns = round_trip_ns
        share = max(0.0, 1.0 - came / sent)
        self.loss += (GAIN_UP if share > self.loss else GAIN_DOWN) * (share - self.loss)
        self.loss = min(self.loss, LOSS_MAX)
        if self._least and delay_ns - self._least[0][1] > round_trip_ns:
            self._least.clear()  # no queue is that long: a clock has jumped
        while self._least and self._least[-1][1] >= delay_ns:
            self._least.pop()
        self._least.append((now_ns, delay_ns))
        while self._least[0][0] < now_ns - LEAST_NS:
            self._least.popleft()
        self.queue_ns = delay_ns - self._least[0][1]
        if self.queue_ns > QUEUE_HIGH_NS:
            if now_ns - self._lowered_ns >= LOWERED_EVERY_NS:
                self._lowered_ns = now_ns
                lower = self.rate * LOWER
                if came >= PARTS_MIN and spread_ns > 0:
                    lower = min(lower, LOWER * size / spread_ns * SECOND_NS)
                self.rate = max(lower, min(RATE_MIN, self._most))
        elif self.queue_ns < QUEUE_LOW_NS and was_limited:
            self.rate = min(self.rate * RISE, self._most)
