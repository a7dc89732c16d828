"""Send rate and packet loss ratio of one direction, estimated from the receiver's reports.

Delay-based congestion control: the queueing delay is the one-way delay minus its minimum over the
last LEAST_NS. Above QUEUE_HIGH_NS the send rate is reduced below the received rate. Below
QUEUE_LOW_NS the send rate is raised if it limited the sender. Loss alone does not reduce the send
rate, because on radio links loss does not imply a queue. Compare LEDBAT (RFC 6817), NADA (RFC 8698)
and Google's congestion control.
"""

from collections import deque

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

RATE_FIRST, RATE_MIN = 1_250_000.0, 12_500.0
"""Send rate before the first report, and smallest send rate [B/s]."""
RATE_MAX = 125_000_000.0
"""Largest send rate [B/s]."""
BURST_BYTES = 3600
"""Largest burst: bytes that may be sent back to back [B]."""
QUEUE_HIGH_NS, QUEUE_LOW_NS = 40 * MILLISECOND_NS, 15 * MILLISECOND_NS
"""Queueing delay above which the send rate is reduced, and below which the rate is raised [ns]."""
LOWERED_EVERY_NS = 200 * MILLISECOND_NS
"""Shortest time between two reductions [ns]."""
LOWER, RISE = 0.85, 1.08
"""Factors of the send rate at a reduction and at a raise."""
LEAST_NS = 10 * SECOND_NS
"""Window of the smallest delay [ns], in which clocks drift apart by less than 1 ms."""
PARTS_MIN = 6
"""Smallest number of received parts whose rate counts as the rate of the path."""
LOSS_FIRST, LOSS_MAX = 0.02, 0.4
"""Packet loss ratio assumed before the first report, and largest estimate."""
GAIN_UP, GAIN_DOWN = 0.3, 0.05
"""Filter gains for a reported loss above and below the estimate."""
OVERTAKEN_MAX = 3
"""A message is counted in the loss when one arrives whose number is greater by more than this:
messages may overtake each other."""


class Tally:
    """Parts sent and received of a stream's messages, counted by their receiver.

    A message of which no part has arrived counts with as many parts as the newest message.
    """

    def __init__(self) -> None:
        self._open: dict[int, tuple[int, set[tuple[int, int]]]] = {}
        """Number of parts of each message not counted yet, and block and index of those received.
        """
        self._first: int | None = None
        """Number of the first message not counted yet; None before the first part."""

    def add(self, number: int, parts: int, place: tuple[int, int]) -> tuple[int, int]:
        """Add a received part, at a block and index, of a message of `parts` parts.

        Returns: numbers of parts sent and received of messages that are now counted.
        """
        first = number if self._first is None else self._first
        if number >= first:
            self._open.setdefault(number, (parts, set()))[1].add(place)
        self._first = max(first, number - OVERTAKEN_MAX)
        if self._first == first:
            return 0, 0
        counted = [self._open.pop(each) for each in list(self._open) if each < self._first]
        missed = self._first - first - len(counted)
        sent = parts * missed + sum(each for each, _ in counted)
        return sent, sum(len(places) for _, places in counted)


def filtered(loss: float, sent: int, came: int) -> float:
    """Packet loss ratio, from its last value and the number of parts sent and received since."""
    share = max(0.0, 1.0 - came / sent)
    return min(loss + (GAIN_UP if share > loss else GAIN_DOWN) * (share - loss), LOSS_MAX)


class Pace:
    """Send rate and loss estimate of one direction.

    Args:
        most: largest send rate [B/s].
    """

    def __init__(self, most: float = RATE_MAX) -> None:
        self._most = most
        self.rate = min(RATE_FIRST, most)
        """Send rate [B/s]."""
        self.loss = LOSS_FIRST
        """Estimated packet loss ratio, 0 to LOSS_MAX."""
        self.round_trip_ns: int | None = None
        """Newest round-trip time, without the processing time of the other end [ns]."""
        self.queue_ns = 0
        """Newest queueing delay [ns]."""
        self._least: deque[tuple[int, int]] = deque()
        """Times and delays [ns] of a moving minimum; delays increase, the first is the minimum."""
        self._lowered_ns = -LOWERED_EVERY_NS
        self._free_ns = 0

    def due_ns(self) -> int:
        """Time from which the next datagram may be sent [ns]."""
        return self._free_ns - int(BURST_BYTES / self.rate * SECOND_NS)

    def sent(self, size: int, now_ns: int) -> None:
        """Count a datagram of this size [B] as sent."""
        self._free_ns = max(self._free_ns, now_ns) + int(size / self.rate * SECOND_NS)

    def heard(
        self,
        came: int,
        size: int,
        delay_ns: int,
        round_trip_ns: int,
        spread_ns: int,
        *,
        was_limited: bool,
        now_ns: int,
    ) -> None:
        """Update the send rate from a report on a message.

        Args:
            came: number of parts received.
            size: bytes of the received parts [B].
            delay_ns: one-way delay of the last part, plus an unknown constant clock offset [ns].
            round_trip_ns: round-trip time of the last part, an upper bound of the queueing delay
                [ns].
            spread_ns: time between receiving the first and the last part [ns].
            was_limited: whether the send rate delayed the message.
        """
        self.round_trip_ns = round_trip_ns
        if self._least and delay_ns - self._least[0][1] > round_trip_ns:
            self._least.clear()  # longer than the round-trip time: a clock was stepped
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
