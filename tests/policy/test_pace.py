"""Send rate of an `Exchange` over netem in virtual time: jitter, loss, finite rates, clocks."""

from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import pytest

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy import exchange, pace
from skytether.policy.exchange import Exchange
from skytether.policy.messages import OBSERVATION, Part, Report, decode
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.wire.drop import ProtocolError

MS = MILLISECOND_NS
PERIOD_NS = 100 * MS


def way(number: int, text: str) -> tuple[Link, Lane]:
    made = impairments(text)
    return Link(number, QUEUE_BYTES_MAX, None, made), Lane(0, Fates(made, 1, str(number), 0), 0)


@dataclass
class Course:
    """Messages of `size` bytes every 100 ms, and their reports, from a time on."""

    size: int
    network: str
    back: str = "constant(30ms)"
    """Network of the reports."""
    changes: tuple[tuple[int, str], ...] = ()
    """Later networks, and their times [s]."""
    step_ns: int = 0
    """Step of the receiver's clock after 10 s [ns]."""
    others: int = 0
    """Rate of other traffic through the same queue [B/s]."""
    from_s: int = 10
    until_s: int = 30
    complete: int = 0
    waits_ms: list[float] = field(default_factory=list)
    """Queueing delay at each message [ms]."""
    rates: list[float] = field(default_factory=list)
    """Send rate at each message [B/s]."""
    received: int = 0
    """Bytes of the received datagrams."""

    def __post_init__(self) -> None:
        ends, ways = (Exchange(1), Exchange(1)), (way(0, self.network), way(1, self.back))
        _, other = way(2, "none")
        now_ns, message_ns, other_ns, changes = 0, 0, 0, list(self.changes)
        while now_ns < self.until_s * SECOND_NS:
            if changes and now_ns >= changes[0][0] * SECOND_NS:
                made = impairments(changes.pop(0)[1])
                ways[0][0].change(made, now_ns=now_ns)
                ways[0][1].fates = Fates(made, 1, "0", 0)
            if now_ns >= message_ns:
                message_ns += PERIOD_NS
                ends[0].send(OBSERVATION, now_ns.to_bytes(8) + bytes(self.size - 8))
                self._note(ends[0], ways[0][0], now_ns)
            while self.others and now_ns >= other_ns:
                other_ns += 1200 * SECOND_NS // self.others
                ways[0][0].accept(Datagram(bytes(1172), ("", 9), 0), other, now_ns=now_ns)
            shifts_ns = 0, self.step_ns if now_ns >= 10 * SECOND_NS else 0
            for at, (link, lane) in enumerate(ways):
                for payload in ends[at].outbox(now_ns=now_ns + shifts_ns[at]):
                    link.accept(Datagram(payload, ("", 0), 0), lane, now_ns=now_ns)
                for payload, peer, _ in link.release(now_ns=now_ns):
                    if peer == ("", 0):
                        self._hear(ends[1 - at], payload, now_ns, shifts_ns[1 - at])
            dues = [(end.due_ns(), shift_ns) for end, shift_ns in zip(ends, shifts_ns, strict=True)]
            due = [each - shift_ns for each, shift_ns in dues if each is not None]
            due += [each for link, _ in ways if (each := link.next_due_ns()) is not None]
            due += [message_ns] + [other_ns] * bool(self.others)
            now_ns = max(now_ns + 1, min(due))

    def _note(self, end: Exchange, link: Link, now_ns: int) -> None:
        if now_ns >= self.from_s * SECOND_NS:
            queue = link.impairments.queue
            waiting = link.depth_bytes() - link._bytes
            self.waits_ms.append(waiting / queue.bytes_per_s * 1e3 if queue else 0.0)
            self.rates.append(end.pace.rate)

    def _hear(self, end: Exchange, payload: bytes, now_ns: int, shift_ns: int) -> None:
        message = decode(payload)
        if isinstance(message, Report):
            end.learn(message, now_ns=now_ns + shift_ns)
        if isinstance(message, Part) and now_ns >= self.from_s * SECOND_NS:
            self.received += len(payload) + 28
        if isinstance(message, Part):
            with suppress(ProtocolError):
                self.complete += bool(end.accept(message, now_ns=now_ns + shift_ns)) and (
                    now_ns >= self.from_s * SECOND_NS
                )

    @property
    def share(self) -> float:
        """Share of messages that arrived complete."""
        return self.complete / len(self.rates)

    @property
    def bytes_per_s(self) -> float:
        """Rate of the received datagrams [B/s]."""
        return self.received / (self.until_s - self.from_s)

    def wait_ms(self, quantile: float) -> float:
        return float(np.quantile(self.waits_ms, quantile))


NORMAL = "normal(100ms, 40ms)"
SLOW = "gamma(30ms, 70ms, 40ms, correlation_s=1)"
JITTERS = [
    NORMAL,
    SLOW,
    "gamma(30ms, 50ms, 20ms)",
    "gamma(30ms, 70ms, 40ms)",
    "gamma(30ms, 70ms, 40ms, correlation_s=0.1) & ordered",
]
FALL = (20, "rate(1mbit, queue=500000) & constant(30ms)")


def jittered(jitter: str, loss: int = 10) -> Course:
    """Messages of 20 kB, which take 0.2 to 0.3 MB/s with parity."""
    return Course(20_000, f"{jitter} & loss({loss}%)", back=jitter)


def fallen() -> Course:
    return Course(
        80_000,
        "rate(8mbit, queue=500000) & constant(30ms)",
        changes=(FALL,),
        from_s=30,
        until_s=40,
    )


def of_newest_part(times_us: list[tuple[int, int]]) -> pace.Fit:
    (sent_us, came_us), (_, first_us) = times_us[-1], times_us[0]
    return pace.Fit(came_us - sent_us, came_us - sent_us, came_us - first_us)


@pytest.mark.parametrize("loss", [0, 10])
@pytest.mark.parametrize("jitter", JITTERS)
def test_jitter_is_no_queue(jitter: str, loss: int) -> None:
    """Up to 8 % of the messages are incomplete, because a newer one overtakes them."""
    assert jittered(jitter, loss).share > 0.9


@pytest.mark.parametrize("loss", [0, 10])
@pytest.mark.parametrize("jitter", ["constant(30ms)", JITTERS[3]])
@pytest.mark.parametrize(("rate", "size"), [(500_000, 80_000), (125_000, 20_000), (12_500, 8000)])
def test_a_rate_is_found_and_used(rate: int, size: int, jitter: str, loss: int) -> None:
    """The sender has 1.2 to 6 times as much to send. Lost datagrams use the rate, too."""
    network = f"rate({rate}) & {jitter} & loss({loss}%)"
    course = Course(size, network, back=jitter, from_s=20, until_s=40)
    assert course.bytes_per_s > 0.75 * rate * (1 - loss / 100)
    assert course.wait_ms(0.5) < 200
    assert course.wait_ms(0.95) < 800


def test_the_send_rate_follows_the_rate_of_the_path() -> None:
    course = fallen()
    assert course.bytes_per_s > 0.75 * 125_000
    assert course.wait_ms(0.95) < 300
    change = (20, "rate(8mbit) & constant(30ms)")
    risen = Course(80_000, "rate(1mbit) & constant(30ms)", changes=(change,), from_s=35, until_s=45)
    assert risen.share == 1.0


def test_other_traffic_leaves_half_of_the_rate() -> None:
    course = Course(80_000, "rate(4mbit) & constant(30ms)", others=250_000)
    assert course.bytes_per_s > 200_000
    assert course.wait_ms(0.95) < 130


@pytest.mark.parametrize(
    "step_ns", [3 * 3600 * SECOND_NS, -3 * 3600 * SECOND_NS, -80 * MS, 80 * MS]
)
def test_a_clock_step_is_no_queue(step_ns: int) -> None:
    assert Course(20_000, "rate(4mbit) & constant(30ms)", step_ns=step_ns).share == 1.0


@pytest.mark.parametrize(
    ("name", "value", "network"),
    [
        ("JITTERS", 0.0, NORMAL),
        ("RECEIVED_SHARE", 1e9, SLOW),
        ("fit", of_newest_part, NORMAL),
    ],
)
def test_ablated_jitter_limits_the_send_rate(
    name: str, value: object, network: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exchange if name == "fit" else pace, name, value)
    assert jittered(network).share < 0.7


@pytest.mark.parametrize(
    ("name", "value"), [("LOWER_MIN", pace.LOWER), ("JITTER_MAX_NS", 3600 * SECOND_NS)]
)
def test_ablated_a_queue_lasts(name: str, value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, name, value)
    assert fallen().wait_ms(0.95) > 600


SHORT = [(1_200_000, 10_000, 60_000), (1_200_000, 20_000, 200_000), (125_000, 6000, 20_000)]


@pytest.mark.parametrize(("rate", "queue", "size"), SHORT)
def test_a_queue_too_short_for_a_delay_is_noticed_by_its_loss(
    rate: int, queue: int, size: int
) -> None:
    course = Course(size, f"rate({rate}, queue={queue}) & constant(30ms)")
    assert course.complete * size > 0.55 * 20 * min(rate, 10 * size)


@pytest.mark.parametrize("loss", ["loss(20%)", "loss(30%)", "gilbert_elliott(0.02, 0.2)"])
@pytest.mark.parametrize("size", [20_000, 100_000])
def test_loss_without_a_queue_does_not_limit_the_send_rate(loss: str, size: int) -> None:
    change = (5, f"{loss} & constant(30ms)")
    course = Course(size, "constant(30ms)", changes=(change,), from_s=7)
    assert min(course.rates) > 2 * 10 * size
    assert course.share > 0.95


def test_ablated_a_short_queue_is_overrun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, "LOST_HIGH", 1.0)
    monkeypatch.setattr(pace, "LOST_MOST", 1.0)
    rate, queue, size = SHORT[0]
    assert Course(size, f"rate({rate}, queue={queue}) & constant(30ms)").share < 0.1


def test_the_line_does_not_fall_below_the_delays() -> None:
    """A queue of 9 ms becomes empty within the message; the smallest delay is 1 ms."""
    times_us = [(each * 1000, max(10_000, (each + 1) * 1000)) for each in range(30)]
    slope_us, first_us = np.polyfit(range(30), [came_us for _, came_us in times_us], 1)
    assert first_us + 29 * slope_us - times_us[-1][0] < 0
    assert pace.fit(times_us) == (round(first_us), 1000, round(29 * slope_us))
    assert pace.fit([(5, 105)]) == (100, 100, 0)
