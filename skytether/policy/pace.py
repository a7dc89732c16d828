"""Send rate and packet loss ratio of one direction, estimated from the receiver's reports.

Delay-based congestion control: the queueing delay is the one-way delay of a message's last part
minus the minimum of the last LEAST_NS. The jitter of the delay is subtracted, because a lower send
rate does not reduce it. If more than QUEUE_HIGH_NS remain, and the last messages were received no
faster than the send rate, the send rate is reduced below the received rate, so that the queue
becomes empty within about a second. Below QUEUE_LOW_NS the send rate is raised if it limited the
sender. Compare LEDBAT (RFC 6817), NADA (RFC 8698) and Google's congestion control.

On radio links loss does not imply a queue, so loss alone does not reduce the send rate. But a short
queue is full before its delay is noticed. So the send rate is also reduced when the share of lost
parts grows by LOST_HIGH within LEAST_NS, once for each growth, and while it exceeds LOST_MOST.

Jitter delays each part of a message by another time. So the delays of the first and the last part,
and the time between receiving them, are those of a straight line through the receive times
(`fit`). A queue that fills makes this line steeper; jitter does not.
"""

from collections import deque
from statistics import linear_regression
from typing import NamedTuple

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

RATE_FIRST, RATE_MIN = 1_250_000.0, 6_250.0
"""Send rate before the first report, and smallest send rate [B/s]."""
RATE_MAX = 125_000_000.0
"""Largest send rate [B/s]."""
BURST_BYTES = 3600
"""Largest burst: bytes that may be sent back to back [B]."""
QUEUE_HIGH_NS, QUEUE_LOW_NS = 40 * MILLISECOND_NS, 15 * MILLISECOND_NS
"""Queueing delay without jitter above which the send rate is reduced, and below which the rate is
raised [ns]."""
JITTERS, JITTER_GAIN = 2.0, 0.125
"""Part of the queueing delay that counts as jitter, as a multiple of the mean change of the delay
from message to message, and filter gain of this mean."""
JITTER_MAX_NS = 80 * MILLISECOND_NS
"""Largest change of the delay that counts as jitter, not as a queue that fills [ns]."""
LOST_HIGH, LOST_MOST = 0.1, 0.5
"""Growth of the mean share of lost parts, and share of lost parts of each of the last messages,
above which the send rate is reduced."""
LOST_PARTS = 400
"""Number of parts over which the share of lost parts is averaged."""
LOWERED_EVERY_NS = 200 * MILLISECOND_NS
"""Shortest time between two reductions [ns]."""
LOWER, LOWER_MIN = 0.8, 0.5
"""Largest and smallest factor of a reduction."""
RISE_PER_S, RISE_NS_MAX = 0.5, 250 * MILLISECOND_NS
"""Share by which the send rate is raised in a second [1/s], and longest time between two reports
for which it is raised [ns]."""
LEAST_NS = 10 * SECOND_NS
"""Window of the smallest delay [ns], in which clocks drift apart by less than 1 ms."""
PARTS_MIN = 6
"""Smallest number of received parts whose rate counts as the rate of the path."""
RECEIVED, RECEIVED_SHARE = 3, 1.1
"""Number of newest received rates of which the largest is compared with the send rate, and the
smallest ratio of the two at which messages count as received faster than the send rate."""
LOSS_FIRST, LOSS_MAX = 0.02, 0.4
"""Packet loss ratio assumed before the first report, and largest estimate."""
GAIN_UP, GAIN_DOWN = 0.3, 0.05
"""Filter gains for a reported loss above and below the estimate."""
GAIN_PARTS = 80
"""Number of sent parts above which GAIN_DOWN is larger, in proportion: on a slow path large
messages are rare, and parity for a loss that has ended would make them rarer."""
OVERTAKEN_MAX = 3
"""A message is counted in the loss when one arrives whose number is greater by more than this:
messages may overtake each other."""


class Least:
    """Smallest value of the last LEAST_NS."""

    def __init__(self) -> None:
        self._held: deque[tuple[int, float]] = deque()
        """Times [ns] and values; values increase, the first is the smallest."""

    def add(self, value: float, now_ns: int) -> float:
        """Add a value; returns the smallest."""
        while self._held and self._held[-1][1] >= value:
            self._held.pop()
        self._held.append((now_ns, value))
        while self._held[0][0] < now_ns - LEAST_NS:
            self._held.popleft()
        return self._held[0][1]


class Fit(NamedTuple):
    """Receive times of the parts of a message, smoothed by a straight line."""

    first_us: int
    """Delay of the part sent first [µs]."""
    last_us: int
    """Delay of the part sent last [µs]."""
    spread_us: int
    """Time between receiving the two [µs]."""


def fit(times_us: list[tuple[int, int]]) -> Fit:
    """Fit a line to the receive times of parts in the order of sending.

    Args:
        times_us: send and receive time of each received part, at least one [µs].
    """
    sent_us, came_us = zip(*sorted(times_us), strict=True)
    slope_us, first_us = 0.0, float(came_us[0])
    if len(times_us) > 1:
        slope_us, first_us = linear_regression(range(len(times_us)), came_us)
    spread_us = slope_us * (len(times_us) - 1)
    last_us = first_us + spread_us
    # Where a queue becomes empty within a message, the line is below all receive times.
    least_us = min(came - sent for sent, came in times_us)
    first_us, last_us = max(first_us - sent_us[0], least_us), max(last_us - sent_us[-1], least_us)
    return Fit(round(first_us), round(last_us), max(round(spread_us), 0))


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
    gain = GAIN_UP if share > loss else min(GAIN_DOWN * max(sent / GAIN_PARTS, 1.0), GAIN_UP)
    return min(loss + gain * (share - loss), LOSS_MAX)


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
        self._least = Least()
        """Smallest delay [ns]."""
        self._lost: deque[float] = deque(maxlen=RECEIVED)
        """Shares of lost parts of the newest messages of at least PARTS_MIN parts."""
        self._lost_mean: float | None = None
        """Mean share of lost parts."""
        self._lost_least = Least()
        """Smallest mean share of lost parts since the last reduction."""
        self._jitter_ns = 0.0
        """Mean change of the delay from one message to the next [ns]."""
        self._last_ns: int | None = None
        """Newest delay [ns]."""
        self._received: deque[float] = deque(maxlen=RECEIVED)
        """Newest received rates of messages of at least PARTS_MIN parts [B/s]."""
        self._heard_ns = 0
        """Time of the newest report [ns]."""
        self._path = 0.0
        """Received rate at the last reduction [B/s]."""
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
        sent: int,
        came: int,
        size: int,
        first_ns: int,
        last_ns: int,
        round_trip_ns: int,
        spread_ns: int,
        *,
        was_limited: bool,
        now_ns: int,
    ) -> None:
        """Update the send rate from a report on a message.

        Args:
            sent, came: number of parts sent, and received.
            size: bytes of the received parts [B].
            first_ns, last_ns: one-way delays of the parts sent first and last, see `fit`, plus an
                unknown constant clock offset [ns].
            round_trip_ns: round-trip time of the last part, an upper bound of the queueing delay
                [ns].
            spread_ns: time between receiving these two parts [ns].
            was_limited: whether the send rate delayed the message.
        """
        self.round_trip_ns = round_trip_ns
        if last_ns - self._least.add(min(first_ns, last_ns), now_ns) > 2 * round_trip_ns:
            self._least = Least()  # longer than the round-trip time: a clock was stepped
            self._last_ns = last_ns
        least_ns = self._least.add(min(first_ns, last_ns), now_ns)
        change_ns = 0 if self._last_ns is None else abs(last_ns - self._last_ns)
        self._jitter_ns += JITTER_GAIN * (min(change_ns, JITTER_MAX_NS) - self._jitter_ns)
        self._last_ns = last_ns
        self.queue_ns = int(last_ns - least_ns)
        excess_ns = self.queue_ns - JITTERS * self._jitter_ns
        if came >= PARTS_MIN:
            self._received.append(size * (came - 1) / came / max(spread_ns, 1) * SECOND_NS)
        received = max(self._received, default=self.rate)
        is_lossy = self._is_lossy(sent, came, now_ns)
        is_slower = received < RECEIVED_SHARE * self.rate
        if is_slower and (excess_ns > QUEUE_HIGH_NS or is_lossy):
            if now_ns - self._lowered_ns >= LOWERED_EVERY_NS:
                self._lowered_ns = now_ns
                self._lost_least = Least()  # a loss that remains is not due to the send rate
                self._lost.clear()
                self._path = min(received, self.rate)
                share = max(min(LOWER, 1.0 - excess_ns / SECOND_NS), LOWER_MIN)
                self.rate = max(share * self._path, min(RATE_MIN, self._most))
        elif excess_ns < QUEUE_LOW_NS and was_limited:
            since_s = min(now_ns - self._heard_ns, RISE_NS_MAX) / SECOND_NS
            raised = max(self.rate * (1.0 + RISE_PER_S * since_s), LOWER * self._path)
            self.rate = min(raised, self._most)
        self._heard_ns = now_ns

    def _is_lossy(self, sent: int, came: int, now_ns: int) -> bool:
        """Whether so many parts are lost that the send rate is too high."""
        if sent < PARTS_MIN:
            return False
        share = 1.0 - came / sent
        self._lost.append(share)
        mean = share if self._lost_mean is None else self._lost_mean
        self._lost_mean = mean + min(sent / LOST_PARTS, 1.0) * (share - mean)
        growth = self._lost_mean - self._lost_least.add(self._lost_mean, now_ns)
        return growth > LOST_HIGH or (len(self._lost) == RECEIVED and min(self._lost) > LOST_MOST)
