"""Several paths between a vehicle and its server: loss and delay of each path, and choice of the
paths for each message.

A message is encrypted once, with one sequence number, and the same bytes are sent over one or more
paths. The first copy counts; later copies are equal byte for byte, so they are recognised before
decryption. Each message is preceded by a loss report, encrypted with the message:

    report = bin [sequence u16 | newest u16 | arrived u16, for each path]

`newest` is the newest sequence number received from the other end, and bit i of `arrived` is set if
the number `newest` - i has arrived over that path. So each end knows the loss, delay and silence of
each path in its own direction, and detects a dead path within a round trip.

A message is sent over the set S of paths with the least expected cost,

    Σ price_p + worth · Π q_p + alive · Π r_p       q_p: probability that a packet on p is lost
        p in S           p in S         all p       r_p: probability that all packets on p are lost

where `worth` is the cost of losing the message, in packets of price 1, and `alive` the cost if
nothing arrives after the newest acknowledged packet. If many packets are in flight on one path, all
of them may be lost at once, so the next message is sent over another path. q_p is computed from the
share of packets that path p loses, and from the probability that p is down. By Bayes' rule this
probability rises with each packet lost in a row, and with the time since the last acknowledgement.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain, combinations
from struct import Struct

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import BIN8, HEAD, PATHS_MAX, Report

EVERYWHERE = 1e9
"""Value of `worth` with which a message is sent over every path."""
SEQUENCES = 2**16
"""Modulus of sequence numbers. Half of the modulus exceeds the number of packets in flight, so that
even a very late packet is not mistaken for a newer packet."""
WINDOW = 16
"""Number of newest packets whose arrival is reported for each path."""
COPIES = 32
"""Number of newest packets whose copies are recognised."""
IN_FLIGHT_MAX = 64
"""Largest number of unacknowledged packets that are tracked on a path."""
DOWN, DOWN_EVERY_S = 0.05, 30.0
"""Share of the time for which a path is assumed to be down, and mean time between two outages [s].
"""
DOWN_S = DOWN * DOWN_EVERY_S
"""Mean length of an outage [s]."""
LOSS, LOSS_MIN, LOSS_WEIGHT = 0.05, 0.02, 1 / 32
"""Loss ratio: initial value, smallest value, and weight of a new packet in the mean."""
OUTAGE = 3
"""Number of packets lost in a row that count as an outage, not as single losses."""
DELAYS = 16
"""Number of newest delays of acknowledgements that are stored."""
GAPS = 16
"""Number of newest intervals between messages of the other end that are stored."""
LATE_PART = 8
"""The newest overtaken packet has the weight 1 / LATE_PART in the mean lateness."""
WAIT_NS, WAIT_MIN_NS, WAIT_MAX_NS = (
    600 * MILLISECOND_NS,
    150 * MILLISECOND_NS,
    5 * SECOND_NS,
)
"""Time after which an unacknowledged packet counts as lost [ns]. Before the first acknowledgement
it is WAIT_NS; later it follows from measured delays, within WAIT_MIN_NS and WAIT_MAX_NS."""
SPARE_NS = 50 * MILLISECOND_NS
"""Margin added to measured delays before a packet counts as lost [ns]."""
LOOK_NS, AGAIN_NS, DEAR_MAX = 2 * SECOND_NS, SECOND_NS, 8.0
"""Times after which an unused path is probed, and a doubted path is probed again [ns]. Both times
are multiplied by the path's price, but at most by DEAR_MAX."""
TRIES_MAX = 4
"""Largest number of doublings of the interval between probes, on a path that delivers only the
other end's packets."""
DOUBT = 0.5
"""Probability of loss of the next packet on a path above which the path is doubted."""
DEAD, DEAD_NS = 0.9, SECOND_NS
"""Probability of loss, and time without an arrival [ns]. A path that exceeds both is reported as
dead, until the probability is at most DOUBT."""
PATIENCE = 3
"""Largest factor on the interval between probes of a path that stays down."""
ALIKE = 1.25
"""Among the sets of paths whose expected cost is at most this multiple of the least cost, those
with the fewest paths are used in turn."""
ALIVE_WORTH = 40.0
"""Cost if the other end considers a working link lost, in packets of price 1."""
_SETS = {
    count: [*chain.from_iterable(combinations(range(count), size) for size in range(1, count + 1))]
    for count in range(1, PATHS_MAX + 1)
}


def _ahead(sequence: int, of: int) -> int:
    """Number of packets by which a sequence number is ahead of another; negative if behind."""
    half = SEQUENCES // 2
    return (sequence - of + half) % SEQUENCES - half


def _names(report: Report, arrived: int, sequence: int) -> bool:
    """Whether the bits `arrived` of a report include a sequence number."""
    back = _ahead(report.newest, sequence)
    return 0 <= back < WINDOW and bool(arrived >> back & 1)


@dataclass(slots=True)
class _InFlight:
    """Unacknowledged packet on a path."""

    sequence: int
    sent_ns: int
    is_lost: bool = False
    """Whether the packet counts as lost, until a late acknowledgement shows that it arrived."""


@dataclass(slots=True)
class PathState:
    """State of one path in the direction in which this end sends."""

    price: float
    in_flight: deque[_InFlight] = field(default_factory=lambda: deque(maxlen=IN_FLIGHT_MAX))
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=DELAYS))
    """Newest times from sending a packet to its acknowledgement [ns]."""
    loss: float = LOSS
    missing: int = 0
    """Number of packets in a row, up to the newest, that have not arrived."""
    arrived_ns: int | None = None
    """Time at which the newest acknowledged packet was sent."""
    used_ns: int | None = None
    """Time of the newest packet sent on the path."""
    looked_ns: int | None = None
    """Time at which the path was last probed."""
    packets: int = 0
    bytes: int = 0
    first: int = 0
    """Number of packets of the other end whose first copy arrived over this path."""
    copies: int = 0
    """Number of later copies that arrived over this path."""
    has_brought: bool = False
    """Whether a packet has arrived over the path since the last packet was sent on it."""
    is_dead: bool = False
    """Whether the path is reported as dead."""
    tries: int = 0
    """Number of unacknowledged probes that were sent because packets arrived over the path."""

    def failure(self, now_ns: int) -> float:
        """Probability q that a packet sent now does not arrive."""
        down = self._down(now_ns)
        return down + (1.0 - down) * self.loss

    def silence(self, now_ns: int, under_way: int, *, is_sent: bool) -> float:
        """Probability r that no packet sent on the path arrives.

        Args:
            under_way: number of packets in flight.
            is_sent: whether one more packet is sent now; an outage may have ended since the last
                packet.
        """
        down, loss = self._down(now_ns), self.loss
        if is_sent and self.used_ns is not None:
            away_s = max(now_ns - self.used_ns, 0) / SECOND_NS
            stays = math.exp(-away_s / DOWN_S)
            down_after = down * (stays + (1.0 - stays) * loss)
        else:
            down_after = down
        return down_after + (1.0 - down) * loss ** (under_way + is_sent)

    def _down(self, now_ns: int) -> float:
        """Probability that the path is down."""
        down = DOWN
        if self.arrived_ns is not None:
            away_s = max(now_ns - self.arrived_ns, 0) / SECOND_NS
            down *= 1.0 - math.exp(-away_s / DOWN_S)
            down = max(down, 1.0 - math.exp(-0.2 / DOWN_EVERY_S))
        up = (1.0 - down) * self.loss**self.missing
        return down / (up + down)

    @property
    def quick_ns(self) -> int:
        """Time after which a packet counts as lost if no report acknowledges it [ns]."""
        if not self.delays_ns:
            return WAIT_NS
        return _within(min(self.delays_ns) * 3 // 2 + 2 * SPARE_NS)

    def acknowledge(self, report: Report, arrived: int, now_ns: int, *, is_newest: bool) -> None:
        """Note which packets a report acknowledges.

        Args:
            arrived: bits of the report for this path.
            is_newest: whether no newer report has arrived; an older report does not show losses.
        """
        waiting, has_arrived = list(self.in_flight), False
        self.in_flight.clear()
        for packet in waiting:
            if _names(report, arrived, packet.sequence):
                if packet.is_lost:  # the packet was only late
                    self.delays_ns.clear()
                self.delays_ns.append(now_ns - packet.sent_ns)
                self._arrived(packet)
                has_arrived = True
                continue
            was_lost, is_past = packet.is_lost, _ahead(report.newest, packet.sequence) >= WINDOW
            packet.is_lost |= is_past or (is_newest and now_ns - packet.sent_ns > self.quick_ns)
            if packet.is_lost and (has_arrived or not was_lost):
                self.missing += 1
            if not is_past:
                self.in_flight.append(packet)

    def expire(self, silence_ns: int, now_ns: int) -> None:
        """Count packets as lost if no report acknowledged them although a report was due.

        Args:
            silence_ns: silence of the other end after which a report is due.
        """
        wait_ns = self.quick_ns + silence_ns + SPARE_NS
        for packet in self.in_flight:
            if now_ns - packet.sent_ns <= wait_ns:
                break
            if not packet.is_lost:
                packet.is_lost = True
                self.missing += 1
        while self.in_flight and now_ns - self.in_flight[0].sent_ns > wait_ns + WAIT_MAX_NS:
            self.in_flight.popleft()

    def _arrived(self, packet: _InFlight) -> None:
        missing = self.missing - packet.is_lost
        lost = missing if 0 <= missing < OUTAGE else 0
        self.loss += LOSS_WEIGHT * (lost - self.loss) / max(lost, 1)
        self.loss, self.missing, self.tries = max(self.loss, LOSS_MIN), 0, 0
        self.arrived_ns = max(packet.sent_ns, self.arrived_ns or packet.sent_ns)


def _within(time_ns: int) -> int:
    return min(max(time_ns, WAIT_MIN_NS), WAIT_MAX_NS)


@dataclass(slots=True)
class _Newest:
    """Newest packet, which is sent again if it does not arrive."""

    sequence: int
    worth: float
    datagram: bytes
    sent_on: set[int]


class Paths:
    """One end of a session with several paths.

    Args:
        prices: price of a packet on each path.
        timeout_ns: time without a packet after which the other end considers the link lost [ns].
        spread: `link.spread`.
    """

    def __init__(self, prices: Sequence[float], timeout_ns: int, spread: str = "auto") -> None:
        self._timeout_ns, self._spread = timeout_ns, spread
        self.each = [PathState(price / min(prices)) for price in prices]
        self._sets = _SETS[len(prices)]
        self._sequence = 0
        self._newest: _Newest | None = None
        self._heard: int | None = None
        """Newest sequence number of the other end; None before the first."""
        self._masks = [0] * len(prices)
        self._heard_ns: int | None = None
        self._newest_path: int | None = None
        """Path over which the newest packet arrived."""
        self._awaited: dict[int, int] = {}
        """Times at which packets of the other end were found missing [ns], by sequence number."""
        self._late_ns = 0
        """Mean lateness of missing packets that arrived after all [ns]."""
        self._sent_ns = 0
        """Time of the newest packet sent [ns]."""
        self._gaps_ns: deque[int] = deque(maxlen=GAPS)
        """Newest intervals between messages of the other end [ns]."""
        self.peer_may_restart = False
        """Whether the other end may restart its sequence numbers."""
        self._before: int | None = None
        """Newest sequence number before the other end restarted its numbers, or None."""
        self._copies: dict[bytes, int] = {}
        """Sequence numbers of the newest datagrams of the other end, oldest first."""

    def set_prices(self, prices: Sequence[float]) -> None:
        for path, price in zip(self.each, prices, strict=True):
            path.price = price / min(prices)

    # -- sending -----------------------------------------------------------------------------

    def report(self) -> bytes:
        """Loss report to precede the next message, which gets the next sequence number."""
        self._sequence = (self._sequence + 1) % SEQUENCES
        masks = Struct(f"<{len(self._masks)}H").pack(*self._masks)
        head = HEAD.pack(self._sequence, self._heard or 0)
        return bytes((BIN8, len(head) + len(masks))) + head + masks

    def choose(self, worth: float, now_ns: int, among: Sequence[int]) -> tuple[int, ...]:
        """Paths for the next message. Of several sets of paths with about equal cost, the set that
        was unused for longest is chosen.

        Args:
            worth: cost of losing the message, in packets on the cheapest path.
            among: paths that may be used, at least one.
        """
        if self._spread == "all":
            return tuple(among)
        failure = [path.failure(now_ns) for path in self.each]
        under_way = self._under_way()
        alive = self.alive_worth(now_ns)
        costs, best = [], self._spread == "best"
        for chosen in self._sets:
            if all(one in among for one in chosen) and not (best and len(chosen) > 1):
                missing = math.prod(failure[one] for one in chosen)
                silent = math.prod(
                    path.silence(now_ns, under_way[one], is_sent=one in chosen)
                    for one, path in enumerate(self.each)
                )
                price = sum(self.each[one].price for one in chosen)
                costs.append((price + max(worth, 1.0) * missing + alive * silent, chosen))
        least = min(costs)[0]
        alike = [chosen for cost, chosen in costs if cost <= ALIKE * least]
        few = min(map(len, alike))
        return min(
            (chosen for chosen in alike if len(chosen) == few),
            key=lambda chosen: max(self.each[one].used_ns or 0 for one in chosen),
        )

    def _arrived_ns(self) -> int | None:
        """Time at which the newest acknowledged packet of any path was sent."""
        return max(
            (path.arrived_ns for path in self.each if path.arrived_ns is not None), default=None
        )

    def _under_way(self) -> list[int]:
        """Number of packets on each path that were sent after the newest acknowledged packet."""
        since_ns = self._arrived_ns()
        return [
            sum(since_ns is None or packet.sent_ns > since_ns for packet in path.in_flight)
            for path in self.each
        ]

    def alive_worth(self, now_ns: int) -> float:
        """Cost if nothing arrives any more, in packets of price 1: after its time-out the other end
        considers the link lost.
        """
        since_ns = self._arrived_ns()
        share = 1.0 if since_ns is None else max(now_ns - since_ns, 0) / self._timeout_ns
        return ALIVE_WORTH * min(share, 1.0) ** 2

    def sent(
        self,
        datagram: bytes,
        on: Sequence[int],
        now_ns: int,
        *,
        worth: float = 0.0,
        is_probe: bool = False,
    ) -> None:
        """Note that a datagram with the newest report was sent.

        Args:
            worth: cost of losing the datagram, see `choose`; 0 for a heartbeat, which does not
                replace a message that may have to be sent again.
            is_probe: whether the datagram only probes a path; a probe is not sent again.
        """
        newest = self._newest
        if newest and _ahead(self._sequence, newest.sequence) >= WINDOW:
            newest = None
        if not is_probe and not (newest and newest.worth and not worth):
            self._newest = _Newest(self._sequence, worth, datagram, set(on))
        self._sent_ns = now_ns
        self._note(self._sequence, datagram, on, now_ns)

    def _note(self, sequence: int, datagram: bytes, on: Sequence[int], now_ns: int) -> None:
        for one in on:
            path = self.each[one]
            path.in_flight.append(_InFlight(sequence, now_ns))
            path.used_ns, path.has_brought = now_ns, False
            path.packets += 1
            path.bytes += len(datagram)

    def again(self, silence_ns: int, now_ns: int, among: Sequence[int]) -> tuple[bytes, int] | None:
        """Newest datagram, and another path over which it must be sent again now; None if no
        datagram must be sent again now.

        Args:
            silence_ns: longest silence of the other end.
            among: paths that may be used.
        """
        if self._gaps_ns:  # the other end usually sends before its longest silence ends
            silence_ns = min(silence_ns, sum(self._gaps_ns) // len(self._gaps_ns))
        for path in self.each:
            path.expire(silence_ns, now_ns)
        newest = self._newest
        if newest is None:
            return None
        waits = any(
            packet.sequence == newest.sequence and not packet.is_lost
            for path in self.each
            for packet in path.in_flight
        )
        others = [one for one in among if one not in newest.sent_on]
        if waits or not others:
            return None
        best = min(others, key=lambda one: self.each[one].failure(now_ns))
        newest.sent_on.add(best)
        self._note(newest.sequence, newest.datagram, (best,), now_ns)
        return newest.datagram, best

    def looks(self, now_ns: int) -> list[int]:
        """Paths on which a probe is due: paths that were not used for a long time, are doubted, or
        have delivered nothing yet; and the newest packet's path if a missing packet is to be
        reported.
        """
        due = []
        for one, path in enumerate(self.each):
            dear = min(path.price, DEAR_MAX)
            doubted = path.arrived_ns is None
            if path.missing and path.failure(now_ns) > DOUBT:
                doubted = True
                dear *= min(max(path.missing - OUTAGE, 1), PATIENCE)  # longer after more losses
            since_ns = path.looked_ns if doubted else path.used_ns
            wait_ns = (AGAIN_NS if doubted else LOOK_NS) * dear
            is_back = doubted and path.missing > 0 and path.has_brought
            if is_back:  # the path works again, at least in the other direction
                wait_ns = min(wait_ns, path.quick_ns << path.tries)
            if since_ns is None or now_ns - since_ns >= wait_ns:
                path.looked_ns = now_ns
                path.tries = min(path.tries + is_back, TRIES_MAX)
                due.append(one)
        newest = self._newest_path
        if self._awaited and newest is not None and newest not in due and self._misses(now_ns):
            due.append(newest)
        return due

    def turned(self, now_ns: int) -> list[tuple[int, bool]]:
        """Paths that have failed or work again since the last call, and for each whether it failed.

        Paths over which no packet has arrived yet are omitted.
        """
        turned = []
        for one, path in enumerate(self.each):
            if path.arrived_ns is None or not (path.missing or path.is_dead):
                continue
            if path.is_dead:
                is_dead = path.failure(now_ns) > DOUBT
            else:
                is_dead = path.failure(now_ns) > DEAD and now_ns - path.arrived_ns >= DEAD_NS
            if is_dead != path.is_dead:
                path.is_dead = is_dead
                turned.append((one, is_dead))
        return turned

    def _misses(self, now_ns: int) -> bool:
        """Whether to report to the other end that an overtaken packet has not arrived."""
        wait_ns = 2 * self._late_ns + SPARE_NS
        return any(
            self._sent_ns < due_ns <= now_ns
            for due_ns in (at_ns + wait_ns for at_ns in self._awaited.values())
        )

    # -- receiving ---------------------------------------------------------------------------

    def is_copy(self, datagram: bytes, path: int | None) -> bool:
        """Whether a datagram has arrived before; if so, note the path of this copy."""
        sequence = self._copies.get(datagram)
        if sequence is None:
            return False
        if path is not None:
            self.each[path].copies += 1
            self._mark(sequence, path)
        return True

    def heard(
        self,
        report: Report,
        datagram: bytes,
        path: int | None,
        now_ns: int,
        *,
        is_recent: bool = True,
    ) -> None:
        """Note an authentic datagram, and the packets that its report acknowledges.

        Args:
            is_recent: whether the datagram's message proved to be recent. Only then the report may
                be from a new run of the other end, whose numbers begin anew.

        Raises:
            ProtocolError: the report has another number of paths than this session; or the report
                is older than WINDOW packets and `is_recent` is False.
        """
        if len(report.arrived) != len(self.each):
            raise ProtocolError(Drop.FIELD)
        ahead = self._progress(report.sequence, is_recent=is_recent)
        if ahead <= -WINDOW:
            if is_recent:
                return
            raise ProtocolError(Drop.OVERTAKEN)
        self._copies[datagram] = report.sequence
        if len(self._copies) > COPIES:
            del self._copies[next(iter(self._copies))]
        if ahead > 0:
            self._masks = [mask << min(ahead, WINDOW) & 0xFFFF for mask in self._masks]
            self._await(report.sequence, ahead, now_ns)
            self._heard, self._newest_path = report.sequence, path
        elif (since_ns := self._awaited.pop(report.sequence, None)) is not None:
            late_ns = min(max(now_ns - since_ns, 0), WAIT_MAX_NS)
            self._late_ns += (late_ns - self._late_ns) // LATE_PART
        if self._heard_ns is not None:
            self._gaps_ns.append(now_ns - self._heard_ns)
        self._heard_ns = now_ns
        if path is not None:
            self.each[path].first += 1
            self._mark(report.sequence, path)
        if not any(report.arrived):  # the other end has received no packet yet
            return
        for one, arrived in zip(self.each, report.arrived, strict=True):
            one.acknowledge(report, arrived, now_ns, is_newest=ahead > 0)
        if self._newest and any(
            _names(report, each, self._newest.sequence) for each in report.arrived
        ):
            self._newest = None

    def _progress(self, sequence: int, *, is_recent: bool) -> int:
        """Number of packets by which a packet is ahead of the newest received packet. WINDOW: it is
        the first packet; -WINDOW: it is from the other end's earlier run.
        """
        ahead = WINDOW if self._heard is None else _ahead(sequence, self._heard)
        if self.peer_may_restart and is_recent and ahead <= -WINDOW:
            self.peer_may_restart, ahead, self._before = False, WINDOW, self._heard
        elif self._before is not None and abs(_ahead(sequence, self._before)) <= IN_FLIGHT_MAX:
            if ahead >= WINDOW:
                return -WINDOW
            if _ahead(sequence, self._before) > 0:  # the new run now uses these numbers
                self._before = None
        return ahead

    def _await(self, sequence: int, ahead: int, now_ns: int) -> None:
        """Note the missing packets that a packet with this sequence number has overtaken."""
        if ahead >= WINDOW:
            self._awaited.clear()
            return
        for back in range(ahead - 1, 0, -1):
            self._awaited[(sequence - back) % SEQUENCES] = now_ns
        while self._awaited and _ahead(sequence, next(iter(self._awaited))) >= WINDOW:
            del self._awaited[next(iter(self._awaited))]

    def _mark(self, sequence: int, path: int) -> None:
        self.each[path].has_brought = True
        back = _ahead(self._heard if self._heard is not None else sequence, sequence)
        if 0 <= back < WINDOW:
            self._masks[path] |= 1 << back

    # -- figures -----------------------------------------------------------------------------

    def figures(self, now_ns: int) -> list[dict[str, float | int | None]]:
        return [
            {
                "packets": path.packets,
                "bytes": path.bytes,
                "loss": round(path.loss, 3),
                "failure": round(path.failure(now_ns), 3),
                "delay_ms": round(min(path.delays_ns) / MILLISECOND_NS, 1)
                if path.delays_ns
                else None,
                "first": path.first,
                "copies": path.copies,
            }
            for path in self.each
        ]
