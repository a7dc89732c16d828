"""Exchange of messages between the two ends of a session, each as datagrams with parity.

Once its first part is sent, a message is sent completely, however slow the path is. Of a stream's
messages that wait meanwhile, only the newest is kept. Each end reports the received parts of each
message, from which the sender estimates send rate, packet loss ratio and round-trip time.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any

from skytether.policy.form import PART_HEAD_BYTES, Form, block_parts, form_of
from skytether.policy.messages import STAMPS, Part, Report, encode
from skytether.policy.pace import RATE_MAX, Pace, Tally, filtered, fit
from skytether.policy.parts import Reassembly, split
from skytether.shared.base.units import HEADER_BYTES, MICROSECOND_NS, MILLISECOND_NS
from skytether.shared.wire.drop import Drop, ProtocolError

QUIET_NS = 300 * MILLISECOND_NS
"""Time without a further part after which an incomplete message is reported [ns]; longer than the
time between two datagrams at the smallest send rate."""
REMEMBERED_MAX = 64
"""Largest number of sent messages whose reports are awaited, and of reports that are not sent."""


@dataclass(slots=True)
class _Coming:
    """Message whose first parts have arrived, and on which no report has been sent."""

    number: int
    expected: int
    last_ns: int = 0
    """Receive time of the newest part [ns]."""
    sent_us: int = 0
    """Send time of the first received part, by the sender's clock [µs]."""
    bytes: int = 0
    places: set[tuple[int, int]] = field(default_factory=set)
    """Block and index of each received part."""
    times_us: list[tuple[int, int]] = field(default_factory=list)
    """Send time after the first received part's, and receive time, of each received part [µs]."""


def _signed(difference_us: int) -> int:
    """Difference of two timestamps, without wrap-around [µs]."""
    return (difference_us + STAMPS // 2) % STAMPS - STAMPS // 2


class Exchange:
    """One end of a session.

    Args:
        session: session number.
        rate_max: largest send rate [B/s].
    """

    def __init__(self, session: int, rate_max: float = RATE_MAX) -> None:
        self.session = session
        self.pace = Pace(rate_max)
        self._queue: dict[int, deque[Part]] = {}
        """Parts to be sent, by stream."""
        self._next: dict[int, tuple[bytes, bool]] = {}
        """Next message of each stream, sent after these parts, and whether it is urgent."""
        self._replies: deque[bytes] = deque(maxlen=REMEMBERED_MAX)
        """Encoded reports to be sent."""
        self._sent: OrderedDict[tuple[int, int], tuple[int, bool]] = OrderedDict()
        """Number of parts, and whether the send rate delayed one, by stream and message number."""
        self._numbers: dict[int, int] = {}
        self.forms: dict[int, Form] = {}
        """Form of the newest message of each stream."""
        self._coming: dict[int, _Coming] = {}
        self._whole: dict[int, Reassembly] = {}
        self._tallies: dict[int, Tally] = {}
        self._counted = [0, 0]
        """Numbers of parts sent and received, of messages counted since the last report."""
        self._delay_us = 0
        """Newest one-way delay plus the unknown clock offset, without wrap-around [µs]."""
        self.sent = self.sent_bytes = self.dropped = self.came = self.repaired = 0

    def send(self, stream: int, message: bytes, *, is_urgent: bool = False) -> None:
        """Send a message, which replaces a message of the same stream that still waits.

        Args:
            is_urgent: whether at least as many parity parts as data parts are sent, so that any
                half of the parts restores the message.
        """
        self.dropped += stream in self._next
        self._next[stream] = message, is_urgent
        if not self._queue.get(stream):
            self._begin(stream)

    def _begin(self, stream: int) -> None:
        message, is_urgent = self._next.pop(stream)
        number = self._numbers[stream] = self._numbers.get(stream, -1) + 1
        form = self.forms[stream] = form_of(len(message), self.pace.loss, is_urgent=is_urgent)
        self._queue[stream] = deque(split(message, self.session, stream, number, form.parity))
        self._sent[stream, number] = len(self._queue[stream]), False
        while len(self._sent) > REMEMBERED_MAX:
            self._sent.popitem(last=False)

    def number(self, stream: int) -> int:
        """Number of the stream's newest message of which parts were sent; -1 if there is none."""
        return self._numbers.get(stream, -1)

    def newest(self, stream: int) -> int:
        """Number of the stream's newest message that has arrived completely."""
        return self._whole[stream].newest if stream in self._whole else -1

    def is_sending(self, stream: int) -> bool:
        """Whether parts of a message of this stream remain to be sent."""
        return bool(self._queue.get(stream))

    def due_ns(self) -> int | None:
        """Time at which `outbox` must be called next [ns]; None if nothing is pending."""
        due = [each.last_ns + QUIET_NS for each in self._coming.values()]
        if self._replies:
            due.append(0)
        if any(self._queue.values()):
            due.append(self.pace.due_ns())
        return min(due, default=None)

    def outbox(self, *, now_ns: int) -> list[bytes]:
        """Datagrams to be sent now, not yet encrypted."""
        for stream, coming in list(self._coming.items()):
            if now_ns >= coming.last_ns + QUIET_NS:
                self._report(stream, now_ns)
        out = list(self._replies)
        self._replies.clear()
        while now_ns >= self.pace.due_ns():
            waiting = list(filter(self.is_sending, self._queue))
            if not waiting:
                break
            stream = max(waiting)  # metadata has the highest number, and is sent first
            part = self._queue[stream].popleft()
            sent_us = now_ns // MICROSECOND_NS % STAMPS
            out.append(encode(part._replace(sent_us=sent_us)))
            size = len(part.data) + PART_HEAD_BYTES + HEADER_BYTES
            self.pace.sent(size, now_ns)
            self.sent += 1
            self.sent_bytes += size
            if not self._queue[stream] and stream in self._next:
                self._begin(stream)
        for stream, queued in self._queue.items():
            if queued and (stream, queued[0].number) in self._sent:
                parts, _ = self._sent[stream, queued[0].number]
                self._sent[stream, queued[0].number] = parts, True
        return out

    def accept(self, part: Part, *, now_ns: int) -> bytes | None:
        """Accept a part; returns the message if this part completes it.

        Raises:
            ProtocolError: see `parts.Reassembly.accept`.
        """
        stream = part.stream
        whole = self._whole.setdefault(stream, Reassembly())
        coming = self._coming.get(stream)
        if coming and part.number > coming.number:
            self._report(stream, now_ns)
            coming = None
        arrived = spare = None
        try:
            arrived = whole.accept(part)
        except ProtocolError as error:
            if error.reason is Drop.FIELD:
                raise
            spare = error  # a duplicate, or a surplus part of a complete message
        count, _ = block_parts(part.size, part.blocks)
        expected = part.blocks * (count + part.parity)
        tally = self._tallies.setdefault(stream, Tally())
        for i, more in enumerate(tally.add(part.number, expected, (part.block, part.place))):
            self._counted[i] += more
        if coming is None and spare is None:
            coming = self._coming[stream] = _Coming(part.number, expected)
        if coming and part.number == coming.number:
            self._count(coming, part, now_ns)
            if len(coming.places) == coming.expected:
                self._report(stream, now_ns)
        elif spare:
            raise spare
        if arrived is None:
            return None
        self.repaired += arrived.repaired
        return arrived.message

    def _count(self, coming: _Coming, part: Part, now_ns: int) -> None:
        place = part.block, part.place
        if place in coming.places:
            return  # a duplicate over another path
        coming.places.add(place)
        self.came += 1
        coming.bytes += len(part.data) + PART_HEAD_BYTES + HEADER_BYTES
        if not coming.times_us:
            coming.sent_us = part.sent_us
        coming.last_ns = now_ns
        after_us = _signed(part.sent_us - coming.sent_us)
        coming.times_us.append((after_us, now_ns // MICROSECOND_NS))

    def _report(self, stream: int, now_ns: int) -> None:
        coming = self._coming.pop(stream)
        train = fit(coming.times_us)
        seen = Report(
            self.session,
            stream,
            coming.number,
            len(coming.places),
            min(coming.bytes, 2**32 - 1),
            (train.first_us - coming.sent_us) % STAMPS,
            (train.last_us - coming.sent_us) % STAMPS,
            min(train.spread_us, STAMPS - 1),
            (coming.sent_us + coming.times_us[-1][0]) % STAMPS,
            min((now_ns - coming.last_ns) // MICROSECOND_NS, STAMPS - 1),
            *(min(each, 2**16 - 1) for each in self._counted),
        )
        self._counted = [0, 0]
        self._replies.append(encode(seen))

    def learn(self, seen: Report, *, now_ns: int) -> None:
        """Update send rate and loss from the other end's report on a message."""
        if seen.counted:
            self.pace.loss = filtered(self.pace.loss, seen.counted, seen.counted_came)
        if (seen.stream, seen.number) not in self._sent:
            return
        parts, was_limited = self._sent.pop((seen.stream, seen.number))
        round_trip_us = (now_ns // MICROSECOND_NS - seen.sent_us - seen.held_us) % STAMPS
        # The clock offset is unknown, so the delay is unwrapped relative to the previous one.
        self._delay_us += _signed(seen.last_us - self._delay_us)
        growth_us = _signed(seen.last_us - seen.first_us)
        self.pace.heard(
            parts,
            seen.came,
            seen.bytes,
            (self._delay_us - growth_us) * MICROSECOND_NS,
            self._delay_us * MICROSECOND_NS,
            round_trip_us * MICROSECOND_NS,
            seen.spread_us * MICROSECOND_NS,
            was_limited=was_limited,
            now_ns=now_ns,
        )

    def figures(self) -> dict[str, Any]:
        round_trip_ns = self.pace.round_trip_ns
        return {
            "sent": self.sent,
            "sent_bytes": self.sent_bytes,
            "replaced": self.dropped,
            "came": self.came,
            "repaired": self.repaired,
            "given_up": sum(each.given_up for each in self._whole.values()),
            "loss": round(self.pace.loss, 4),
            "rate_bytes_per_s": int(self.pace.rate),
            "queue_s": self.pace.queue_ns / 1e9,
            "round_trip_s": None if round_trip_ns is None else round_trip_ns / 1e9,
        }
