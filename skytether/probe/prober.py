"""Probing end of a measurement: sends probes on a time grid, and records their answers.

    HELLO until WELCOME → probes for the requested time → polls until all arrivals are known and the
    wait for the last answers has ended

At intervals a train of TRAIN packets is sent at once, to measure the data rate of the path. A train
of TRAIN packets takes the time of 2 TRAIN probes: if the path is fast enough for the probes, its
queues are empty again before the next probe, so the train does not delay this probe.
"""

from array import array
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.client.link import ClientLink
from skytether.probe.outages import RoundTrips
from skytether.probe.wire import (
    MESSAGE_BYTES_MIN,
    NO_NUMBER,
    NONCE_BYTES,
    Probe,
    ProbeAnswer,
    ProbeHello,
    ProbeWelcome,
    decode,
    encode,
)
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, by_name
from skytether.shared.law.model import Flags
from skytether.shared.wire.channel import OVERHEAD_BYTES
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX

BYTES_MIN = MESSAGE_BYTES_MIN + OVERHEAD_BYTES
"""Smallest size of a probe, encrypted or not [B]."""
PROBES_MAX = 1_000_000
"""Largest number of probes: the largest number of rows of a trace."""
TRAIN = 16
"""Number of packets of a train."""
TRAIN_SLOTS = 2 * TRAIN
"""Number of points of the time grid that a train takes; no other probe is sent at them."""
TRAIN_EVERY_NS, TRAIN_EVERY_SLOTS = 10 * SECOND_NS, 10 * TRAIN
"""Shortest time [ns] and smallest number of grid points from one train to the next."""
HELLO_BYTES = 64
"""Size of an unencrypted HELLO [B]: larger than a WELCOME, against amplification attacks."""
PATIENCE_NS = 10 * SECOND_NS
"""Longest wait for the first answer [ns]."""
POLL_NS = 100 * MILLISECOND_NS
LAST_MIN_NS, LAST_MAX_NS = 1 * SECOND_NS, 60 * SECOND_NS
"""Bounds of the wait for the last answers, which is twice the longest round trip [ns]."""

Longs = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Way:
    """Packets of one direction, in order of sending.

    Sender and receiver read their own monotonic clocks; the two clocks have different zeros.
    """

    sent_ns: Longs
    """Time of sending, on the sender's clock [ns]; shape (n,)."""
    came_ns: Longs
    """Time of arrival, on the receiver's clock [ns]; 0 for a lost packet; shape (n,)."""
    came: Flags
    train: Longs
    """Number of each packet's train, -1 for a packet sent alone; shape (n,)."""
    copies: int


@dataclass(frozen=True, slots=True)
class MeasuredPath:
    downlink: Way
    """Packets from the prober to the listener, as from a vehicle to the server."""
    uplink: Way
    """Packets from the listener to the prober."""
    size: int
    period_ns: int
    unreported: int
    """Number of arrivals that the listener dropped before reporting them."""


class Prober(Endpoint):
    """Sends probes, and stores the times at which they were sent, arrived and were answered.

    Args:
        link: encrypts outgoing packets, and opens incoming ones.
        listener: address of the other end.
        nonce: NONCE_BYTES bytes, different for each measurement.
        probes: number of grid points, at most PROBES_MAX.
        period_ns: time between two grid points [ns].
        size: UDP payload of a probe, BYTES_MIN to PAYLOAD_BYTES_MAX [B].
    """

    def __init__(
        self,
        link: ClientLink,
        listener: Address,
        nonce: bytes,
        *,
        probes: int,
        period_ns: int,
        size: int,
    ) -> None:
        super().__init__()
        assert len(nonce) == NONCE_BYTES
        assert BYTES_MIN <= size <= PAYLOAD_BYTES_MAX
        assert 1 <= probes <= PROBES_MAX
        self._link, self._listener, self._nonce = link, listener, nonce
        self._slots, self._period_ns, self._size = probes, period_ns, size
        self._train_every = max(TRAIN_EVERY_SLOTS, TRAIN_EVERY_NS // period_ns)
        self._session = b""
        self._hello = encode(ProbeHello(nonce), 0 if link.secure else HELLO_BYTES)
        self._due_ns: int | None = 0
        """Time of the next wake [ns]; 0 before the first wake."""
        self._hello_ns = 0
        self._began_ns: int | None = None
        self._zero_ns = 0
        self._slot = 0
        """Number of the grid point at which the next probe is sent."""
        self._over_ns: int | None = None
        """Time at which the grid ended, usually that of the last probe [ns]; None while probes are
        still to be sent."""
        self._longest_ns = 0
        self.refused = False
        """Whether the listener has refused a session, because it has too many open measurements."""
        self.failed = False
        self._done = False
        self._sent_ns, self._train = array("q"), array("q")
        self._logged_number, self._logged_ns = array("q"), array("q")
        self._answer_number, self._answer_sent_ns, self._answer_came_ns = (
            array("q"),
            array("q"),
            array("q"),
        )
        self._logged = 0
        """Number of arrivals that the listener has reported, or dropped."""
        self._total = 0
        """Largest number of arrivals that an answer of the listener has stated."""
        self._settled = False
        self._trains = 0
        self._dropped: Counter[str] = Counter()

    # -- incoming ------------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        try:
            if datagram.peer != self._listener:
                raise ProtocolError(Drop.ELSEWHERE)
            payload = self._link.open(datagram.payload, now_ns=now_ns)
            if payload is not None:
                self._hear(payload, now_ns)
        except ProtocolError as error:
            self._dropped[error.reason] += 1
        for packet in self._link.outbox():
            self.send(packet, self._listener)

    def _hear(self, payload: bytes, now_ns: int) -> None:
        message = decode(payload)
        if isinstance(message, ProbeWelcome):
            if message.nonce != self._nonce:
                raise ProtocolError(Drop.UNASKED)
            self._link.adopt(now_ns=now_ns)
            if not self._session:
                self._session = message.nonce + message.cookie
                self.refused = self._done = not message.is_granted
                self._zero_ns = self._due_ns = now_ns
        elif isinstance(message, ProbeAnswer):
            if message.session != self._session:
                raise ProtocolError(Drop.UNKNOWN_SESSION)
            self._learn(message, now_ns)
        else:
            raise ProtocolError(Drop.NOT_FOR_A_CLIENT)

    def _learn(self, answer: ProbeAnswer, now_ns: int) -> None:
        # Without keys an attacker can forge `logged`, so it may be at most two arrivals per probe.
        if answer.logged > 2 * len(self._sent_ns) or len(self._answer_number) > 2 * PROBES_MAX:
            raise ProtocolError(Drop.FIELD)
        if any(number >= len(self._sent_ns) for number, _ in answer.arrivals):
            raise ProtocolError(Drop.FIELD)
        self._total = max(self._total, answer.logged)
        logged = self._logged
        # the listener's memory was full: it has dropped the arrivals before `answer.first`
        if answer.first > logged:
            for _ in range(answer.first - logged):
                self._logged_number.append(-1)
                self._logged_ns.append(0)
            self._logged = logged = answer.first
        for number, came_ns in answer.arrivals[logged - answer.first :]:
            self._logged_number.append(number)
            self._logged_ns.append(came_ns)
            self._logged += 1
        if answer.number != NO_NUMBER:
            self._answer_number.append(answer.number)
            self._answer_sent_ns.append(answer.sent_ns)
            self._answer_came_ns.append(now_ns)
            if answer.number < self._logged and self._logged_number[answer.number] >= 0:
                probe = self._logged_number[answer.number]
                self._longest_ns = max(self._longest_ns, now_ns - self._sent_ns[probe])

    # -- outgoing -----------------------------------------------------------------------------

    def wake(self, *, now_ns: int) -> None:
        if self._done:
            return
        if self._began_ns is None:
            self._began_ns = now_ns
        if not self._session:
            if now_ns - self._began_ns >= PATIENCE_NS:
                self.failed = self._done = True
                return
            self._greet(now_ns)
            self._due_ns = now_ns + self._link.hello_ns
            return
        if self._link.wants_hello(now_ns) and now_ns - self._hello_ns >= SECOND_NS:
            self._greet(now_ns)
        if self._over_ns is None:
            self._probe(now_ns)
        else:
            self._poll(now_ns, self._over_ns)

    def _greet(self, now_ns: int) -> None:
        self._hello_ns = now_ns
        self.send(self._link.hello(self._hello, now_ns=now_ns), self._listener)

    def _probe(self, now_ns: int) -> None:
        """Send the probe, or the train, of this grid point.

        Grid points missed by a late wake are skipped.
        """
        slot = max(self._slot, (now_ns - self._zero_ns) // self._period_ns)
        if now_ns < self._zero_ns + slot * self._period_ns:
            return
        every = self._train_every
        if slot % every == every // 2 and slot + TRAIN_SLOTS <= self._slots:
            for _ in range(TRAIN):
                self._send(TRAIN, self._trains, now_ns)
            self._trains += 1
            self._slot = slot + TRAIN_SLOTS
        elif slot < self._slots:
            self._send(0, -1, now_ns)
            self._slot = slot + 1
        else:
            self._slot = self._slots
        if self._slot >= self._slots:
            self._over_ns = now_ns
        self._due_ns = self._zero_ns + self._slot * self._period_ns

    def _send(self, train: int, number: int, now_ns: int) -> None:
        self._put(len(self._sent_ns), train)
        self._sent_ns.append(now_ns)
        self._train.append(number)

    def _poll(self, now_ns: int, over_ns: int) -> None:
        """Request reports until all arrivals are known, or LAST_MAX_NS after the last probe."""
        waited_ns = now_ns - over_ns
        least_ns = min(max(LAST_MIN_NS, 2 * self._longest_ns), LAST_MAX_NS)
        if waited_ns >= LAST_MAX_NS or (waited_ns >= least_ns and self._logged >= self._total):
            self._settled = self._logged >= self._total
            self._done = True
            return
        self._put(NO_NUMBER, 0)
        self._due_ns = now_ns + POLL_NS

    def _put(self, number: int, train: int) -> None:
        size = self._size - (OVERHEAD_BYTES if self._link.secure else 0)
        probe = Probe(self._session, number, train, self._logged)
        self.send(self._link.seal(encode(probe, size)), self._listener)

    def next_wake_ns(self) -> int | None:
        return None if self._done else self._due_ns

    @property
    def finished(self) -> bool:
        return self._done

    def stop(self) -> None:
        """End this path's measurement, because the measurement of another path has failed."""
        self._done = True

    # -- results -------------------------------------------------------------------------------

    @property
    def probed_s(self) -> float:
        """Length of the measurement so far [s]."""
        return self._slot * self._period_ns / SECOND_NS

    def figures(self) -> dict[str, Any]:
        return {
            "sent": len(self._sent_ns),
            "arrived": self._logged,
            "answered": len(self._answer_number),
            "dropped": by_name(self._dropped),
        }

    def measured(self) -> MeasuredPath:
        """Packets of both directions so far.

        After a measurement that was ended early, all packets newer than the newest reported arrival
        are left out, because they may still be under way.
        """
        number = np.array(self._logged_number, np.int64)
        logged_ns = np.array(self._logged_ns, np.int64)
        downlink = self._downlink(number, logged_ns)
        return MeasuredPath(
            downlink,
            self._uplink(number, logged_ns),
            self._size,
            self._period_ns,
            int((number < 0).sum()),
        )

    def round_trips(self) -> RoundTrips:
        """Round trips of the probes that were sent alone, on the prober's clock."""
        downlink = self.measured().downlink
        number, answered = np.array(self._logged_number), np.array(self._answer_number)
        at = np.flatnonzero(answered < len(number))
        # Reversed, so that the first of several answers to a probe is written last, and stays.
        at = at[number[answered[at]] >= 0][::-1]
        probe = number[answered[at]]
        trip_s = np.full(len(self._sent_ns), np.nan)
        came_ns, sent_ns = np.array(self._answer_came_ns)[at], np.array(self._sent_ns)[probe]
        trip_s[probe] = (came_ns - sent_ns) / SECOND_NS
        alone = np.flatnonzero(downlink.train < 0)
        return RoundTrips(downlink.sent_ns[alone] / SECOND_NS, trip_s[alone])

    def _downlink(self, number: Longs, logged_ns: Longs) -> Way:
        sent_ns, train = np.array(self._sent_ns, np.int64), np.array(self._train, np.int64)
        is_numbered = number >= 0
        first, at = np.unique(number[is_numbered], return_index=True)
        came_ns, came = np.zeros(len(sent_ns), np.int64), np.zeros(len(sent_ns), bool)
        came_ns[first], came[first] = logged_ns[is_numbered][at], True
        end = len(sent_ns) if self._settled else int(first.max(initial=-1)) + 1
        copies = int(is_numbered.sum()) - len(first)
        return Way(sent_ns[:end], came_ns[:end], came[:end], train[:end], copies)

    def _uplink(self, number: Longs, logged_ns: Longs) -> Way:
        """Answers to probes. A lost answer has its probe's time of arrival as time of sending."""
        answered = np.array(self._answer_number, np.int64)
        first, at = np.unique(answered[answered < len(number)], return_index=True)
        end = len(number) if self._settled else int(first.max(initial=-1)) + 1
        sent_ns, came_ns, came = logged_ns.copy(), np.zeros(len(number), np.int64), number < -1
        at = np.flatnonzero(answered < len(number))[at]
        sent_ns[first] = np.array(self._answer_sent_ns, np.int64)[at]
        came_ns[first] = np.array(self._answer_came_ns, np.int64)[at]
        came[first] = True
        train = np.array(self._train, np.int64)[np.maximum(number, 0)]
        kept = (number >= 0) & (np.arange(len(number)) < end)
        order = np.flatnonzero(kept)[np.argsort(sent_ns[kept], kind="stable")]
        copies = len(answered) - len(first)
        return Way(sent_ns[order], came_ns[order], came[order], train[order], copies)
