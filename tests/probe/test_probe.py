"""Measurement of a path: results on known networks, and abuse by strangers."""

import csv
import json
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from helpers import SKYTETHER, refused
from skytether.__main__ import main
from skytether.client.link import PlainLink
from skytether.figures.probing import drawn
from skytether.netem.impairments.direction import impairments
from skytether.netem.proxy import Proxy
from skytether.probe import analysis, fits
from skytether.probe.listener import HOLD_NS, IDLE_NS, SESSIONS_MAX, Listener
from skytether.probe.outcome import outcome, rows, trace
from skytether.probe.prober import BYTES_MIN, MeasuredPath, Prober
from skytether.probe.wire import (
    NO_NUMBER,
    NONCE_BYTES,
    SESSION_BYTES,
    TRAIN_MAX,
    Probe,
    ProbeAnswer,
    ProbeHello,
    ProbeWelcome,
    decode,
    encode,
)
from skytether.server.gate import PlainGate
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.scenario import reading
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import DOWNLINK, PACKET_COLUMNS, UPLINK, MemoryRecorder, Rows
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX
from skytether.sim.hosts import Clock
from skytether.sim.world import World

LISTENER = ("listener", 0)
HOUR_NS = 3600 * SECOND_NS
NUMBERS = st.integers(0, NO_NUMBER)
TIMES = st.integers(0, 2**63 - 1)


# -- packets --------------------------------------------------------------------------------------


@given(
    st.binary(min_size=SESSION_BYTES, max_size=SESSION_BYTES),
    NUMBERS,
    st.integers(0, TRAIN_MAX),
    NUMBERS,
    st.integers(BYTES_MIN, PAYLOAD_BYTES_MAX),
)
def test_a_probe_has_the_size_that_was_asked_for(
    session: bytes, number: int, train: int, held: int, size: int
) -> None:
    probe = Probe(session, number, train, held)
    payload = encode(probe, size)
    assert size - 1 <= len(payload) <= size
    assert decode(payload) == probe


@given(
    st.lists(st.tuples(NUMBERS, TIMES), max_size=130),
    TIMES,
    st.integers(BYTES_MIN, PAYLOAD_BYTES_MAX),
)
def test_an_answer_tells_of_as_many_arrivals_as_have_room(
    arrivals: list[tuple[int, int]], sent_ns: int, size: int
) -> None:
    """It is no longer than its probe, and reports at least two if there are two."""
    answer = ProbeAnswer(bytes(SESSION_BYTES), 3, sent_ns, 7, 7 + len(arrivals), tuple(arrivals))
    payload = encode(answer, size)
    assert len(payload) <= size
    decoded = decode(payload)
    assert isinstance(decoded, ProbeAnswer)
    assert len(decoded.arrivals) >= min(2, len(arrivals))
    assert decoded == answer._replace(arrivals=answer.arrivals[: len(decoded.arrivals)])


@given(st.binary(max_size=200))
def test_garbage_is_none_of_these_packets(payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode(payload)


@given(st.integers(0, 3), st.data())
def test_a_changed_packet_is_refused_or_another_one(kind: int, data: Any) -> None:
    session = bytes(range(SESSION_BYTES))
    messages = (
        ProbeHello(b"12345678"),
        ProbeWelcome(b"12345678", b"87654321", True),
        Probe(session, 3, 16, 2),
        ProbeAnswer(session, 3, 99, 1, 3, ((5, 77), (6, 88))),
    )
    payload = bytearray(encode(messages[kind], 96))
    place = data.draw(st.integers(0, len(payload) - 1))
    payload[place] = data.draw(st.integers(0, 255))
    with suppress(ProtocolError):
        assert type(decode(bytes(payload))) in (ProbeHello, ProbeWelcome, Probe, ProbeAnswer)


# -- the listener ---------------------------------------------------------------------------------


def listener() -> Listener:
    return Listener(PlainGate(), b"secret")


def session_of(far: Listener, peer: tuple[str, int], now_ns: int) -> bytes:
    far.receive(Datagram(encode(ProbeHello(b"12345678"), 64), peer), now_ns=now_ns)
    (packet,) = far.outbox()
    welcome = decode(packet.payload)
    assert isinstance(welcome, ProbeWelcome)
    assert len(packet.payload) <= 64
    return welcome.nonce + welcome.cookie


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_a_listener_answers_with_no_more_than_it_got(payloads: list[bytes]) -> None:
    """So it cannot be used to amplify traffic."""
    far, peer = listener(), ("prober", 1)
    session = session_of(far, peer, 0)
    probes = [encode(Probe(session, n, n % 3, 0), 96 + n) for n in range(5)]
    for payload in [*payloads, *probes, encode(ProbeHello(b"abcdefgh"), 20)]:
        far.receive(Datagram(payload, peer), now_ns=0)
        assert sum(len(each.payload) for each in far.outbox()) <= len(payload) or payload in probes
    assert far.figures()["sessions"] == 1
    assert sum(far.figures()["dropped"].values()) >= len(payloads)


def test_only_who_can_be_answered_at_an_address_is_kept() -> None:
    far = listener()
    session = session_of(far, ("prober", 1), 0)
    probe = encode(Probe(session, 0, 0, 0), 96)
    far.receive(Datagram(probe, ("another", 1)), now_ns=0)
    assert far.outbox() == []
    assert far.figures() == {
        "sessions": 0,
        "answered": 0,
        "dropped": {str(Drop.UNKNOWN_SESSION): 1},
    }
    far.receive(Datagram(probe, ("prober", 1)), now_ns=0)
    assert len(far.outbox()) == 1
    assert far.figures()["sessions"] == 1


@pytest.mark.parametrize("train", [0, 64])
def test_an_open_session_is_answered_at_its_own_address_alone(train: int) -> None:
    """Otherwise a train's worth of packets could be directed at others."""
    far, prober, victim = listener(), ("prober", 1), ("victim", 53)
    session = session_of(far, prober, 0)
    far.receive(Datagram(encode(Probe(session, 0, 0, 0), 96), prober), now_ns=0)
    assert [sent.peer for sent in far.outbox()] == [prober]
    for number in range(1, 65):
        far.receive(Datagram(encode(Probe(session, number, train, 0), 96), victim), now_ns=0)
    far.wake(now_ns=HOLD_NS)
    assert far.outbox() == []
    assert far.figures()["dropped"] == {str(Drop.UNKNOWN_SESSION): 64}
    for number in range(train or 1):
        far.receive(Datagram(encode(Probe(session, number, train, 0), 96), prober), now_ns=HOLD_NS)
    assert {sent.peer for sent in far.outbox()} == {prober}


def begin(far: Listener, prober: tuple[str, int], now_ns: int) -> bool:
    far.receive(Datagram(encode(ProbeHello(b"12345678"), 64), prober), now_ns=now_ns)
    (packet,) = far.outbox()
    welcome = decode(packet.payload)
    assert isinstance(welcome, ProbeWelcome)
    probe = encode(Probe(welcome.nonce + welcome.cookie, 0, 0, 0), 96)
    far.receive(Datagram(probe, prober), now_ns=now_ns)
    assert len(far.outbox()) == welcome.is_granted
    return welcome.is_granted


def test_a_listener_has_room_for_so_many_measurements() -> None:
    """The next one is refused, until one has been silent for a minute."""
    far = listener()
    assert all(begin(far, (f"prober {number}", 1), 0) for number in range(SESSIONS_MAX))
    assert not begin(far, ("new", 1), 1)
    assert begin(far, ("new", 1), IDLE_NS + 2)
    assert far.figures()["sessions"] == SESSIONS_MAX


def test_a_host_with_many_measurements_keeps_no_other_out() -> None:
    """Its oldest measurement ends, until it has no more than others."""
    far = listener()
    assert all(begin(far, ("crowd", port), port) for port in range(SESSIONS_MAX))
    assert not begin(far, ("crowd", SESSIONS_MAX), SESSIONS_MAX)
    others = [(f"prober {number}", 1) for number in range(SESSIONS_MAX)]
    assert [begin(far, other, 99) for other in others] == [True] * 15 + [False]
    assert far.figures()["sessions"] == SESSIONS_MAX


def test_a_train_is_answered_together_or_as_far_as_it_has_come() -> None:
    """The rest of a train is awaited for HOLD_NS, whatever else is sent meanwhile."""
    far, peer = listener(), ("prober", 1)
    session = session_of(far, peer, 0)
    for number in range(3):
        far.receive(Datagram(encode(Probe(session, number, 4, 0), 96), peer), now_ns=number)
    assert far.outbox() == []
    assert far.next_wake_ns() == 2 + HOLD_NS
    far.receive(Datagram(encode(Probe(session, 9, 0, 0), 96), peer), now_ns=HOLD_NS)
    assert len(far.outbox()) == 1
    far.wake(now_ns=2 + HOLD_NS)
    assert len(far.outbox()) == 3
    assert far.next_wake_ns() is None
    for number in range(4):
        far.receive(Datagram(encode(Probe(session, number, 4, 0), 96), peer), now_ns=HOLD_NS)
    assert len(far.outbox()) == 4


# -- a measurement --------------------------------------------------------------------------------

CLOCK = Clock(HOUR_NS, 20_000)
"""Clock of the listener: an hour ahead, and 20 ppm fast."""


def measure(
    uplink: str, downlink: str, *, seconds: float, clock: Clock = CLOCK
) -> tuple[MeasuredPath, Rows]:
    """Measure a netem network in virtual time, 20 packets a second; with netem's rows."""
    recorder, world = MemoryRecorder(PACKET_COLUMNS), World()
    listener = world.add("listener", Listener(PlainGate(), b"secret" * 5), clock=clock)
    scenario = reading.check({"network": {"uplink": uplink, "downlink": downlink}}, "measured")
    netem = world.add("netem", Proxy(scenario, server=listener, recorder=recorder))
    prober = Prober(
        PlainLink(),
        netem,
        bytes(range(NONCE_BYTES)),
        probes=round(seconds * 20),
        period_ns=SECOND_NS // 20,
        size=400,
    )
    world.add("prober", prober)
    world.run(lambda: prober.finished, limit_ns=round((seconds + 120.0) * SECOND_NS))
    return prober.measured(), recorder.rows()


def models(text: str) -> set[str]:
    return {name for name, _ in impairments(text).parts} - {"rate", "ordered"}


def in_order(packets: Rows, direction: int) -> Rows:
    mine = packets[packets["direction"] == direction]
    return mine[np.lexsort((mine["number"], mine["arrived_ns"]))]


def test_every_packet_is_measured_as_it_was() -> None:
    uplink, downlink = (
        "lognormal(0.05, 0.08, 0.02) & loss(0.1)",
        "gamma(0.05, 0.09, 0.03) & loss(0.3)",
    )
    measured, truth = measure(uplink, downlink, seconds=80.0, clock=Clock(HOUR_NS))
    found = outcome(measured, "x", secure=False)
    measured_rows = rows(measured, found.clocks)
    for direction in (UPLINK, DOWNLINK):
        mine, real = in_order(measured_rows, direction), in_order(truth, direction)
        came, passed = mine[~mine["lost"]], real[~real["lost"] & (real["bytes"] >= 399)]
        # netem writes packets as they leave, including those that are sent after the last probe.
        passed = passed[: len(came)]
        shift = came["delay_ns"] - passed["delay_ns"]
        assert np.ptp(shift) < 200_000
        assert abs(shift.mean()) < found.clocks.doubt_s * SECOND_NS
    both = found.figures
    assert both.round_trip_mean_s == pytest.approx(0.17, rel=0.01)
    assert both.uplink.loss_low < 0.1 < both.uplink.loss_high
    assert both.downlink.loss_low < 0.3 < both.downlink.loss_high
    assert both.unreported == 0


@pytest.mark.long
def test_gaps_of_a_picture_are_the_trains() -> None:
    """A grey span for each."""
    text = "gamma(0.05, 0.09, 0.03) & loss(0.1)"
    measured, _ = measure(text, text, seconds=35.0)
    figure = drawn(outcome(measured, "x", secure=False))
    assert [len(over_time.patches) for over_time in figure.axes[::2]] == [3, 3]


def test_a_clock_that_drifts_is_found_out() -> None:
    """Offset and drift of the listener's clock are within the stated uncertainty."""
    measured, _ = measure("gamma(0.05, 0.06, 0.005)", "gamma(0.05, 0.06, 0.005)", seconds=200.0)
    figures = outcome(measured, "x", secure=False).figures
    assert figures.drift_doubt_ppm < 5.0
    assert figures.drift_ppm == pytest.approx(
        CLOCK.drift_ppb / 1e3, abs=4.0 * figures.drift_doubt_ppm
    )
    assert figures.offset_s == pytest.approx(3600.0, abs=figures.offset_doubt_s)
    assert figures.offset_doubt_s == pytest.approx(figures.round_trip_least_s / 2)


@pytest.mark.parametrize(
    ("text", "rate"),
    [
        ("gamma(0.02, 0.03, 0.005) & loss(0.1) & rate(12500, queue=20000)", 12_500.0),
        ("paper(0.4, 0.02, 2) & loss(0.1)", None),
    ],
)
def test_a_finite_rate_is_found_where_there_is_one(text: str, rate: float | None) -> None:
    """Within three per cent and the stated uncertainty; none where there is none."""
    measured, _ = measure(text, text, seconds=60.0)
    figures = outcome(measured, "x", secure=False).figures
    for way in (figures.uplink, figures.downlink):
        assert (way.rate_bytes_per_s is None) == (rate is None)
        if rate and way.rate_bytes_per_s and way.rate_low and way.rate_high:
            assert way.rate_bytes_per_s == pytest.approx(rate, rel=0.03)
            assert way.rate_low <= rate * 1.001
            assert way.rate_high >= rate * 0.999
            assert f"rate({way.rate_bytes_per_s:.4g})" in way.text


def test_the_models_are_those_of_the_network_and_fly() -> None:
    text = "gamma(0.02, 0.06, 0.03) & gilbert_elliott(0.2, 0.5)"
    measured, _ = measure(text, text, seconds=60.0)
    figures = outcome(measured, "x", secure=False).figures
    for way in (figures.uplink, figures.downlink):
        assert models(way.text) == models(text)
        assert way.rate_bytes_per_s is None
        made = impairments(way.text)
        assert made.mean_s == pytest.approx(0.06, rel=0.03)
        assert made.loss == pytest.approx(way.loss, abs=0.03)


@pytest.mark.parametrize("law", ["uniform", "normal", "gamma", "lognormal"])
def test_the_law_of_delays_is_recognised(law: str) -> None:
    made = {
        "uniform": stats.uniform(0.02, 0.08),
        "normal": stats.norm(0.1, 0.01),
        "gamma": stats.gamma(2.0, loc=0.03, scale=0.02),
        "lognormal": stats.lognorm(0.8, loc=0.03, scale=0.03),
    }[law]
    for seed in range(2):
        delay_s = made.rvs(1000, random_state=seed)
        best = fits.fit_delays(delay_s, 1000.0)[0]
        assert best.name == law
        mean_s = best.numbers[0] if law == "normal" else best.numbers[1]
        assert law == "uniform" or mean_s == pytest.approx(made.mean(), rel=0.1)


def test_the_slots_of_the_papers_delays_are_found() -> None:
    rng = np.random.default_rng(1)
    delay_s = 0.4 + 0.02 * rng.poisson(2.0, 1000) + 1e-4 * rng.standard_normal(1000)
    best = fits.fit_delays(delay_s, 1000.0)[0]
    assert best.name == "paper"
    assert best.numbers[:2] == pytest.approx((0.4, 0.02), rel=0.001)
    assert best.numbers[2] == pytest.approx(2.0, rel=0.05)


def test_an_interval_of_a_share_is_wilsons() -> None:
    for lost, count in ((0, 50), (3, 100), (50, 100), (999, 1000)):
        known = stats.binomtest(lost, count).proportion_ci(method="wilson")
        low, high = analysis.wilson(lost / count, count)
        assert (low, high) == pytest.approx((known.low, known.high), abs=1e-9)


POINTS = st.tuples(st.integers(0, 1000), st.floats(0, 1))


@settings(max_examples=40)
@given(st.lists(POINTS, min_size=2, max_size=40, unique_by=lambda point: point[0]))
def test_a_lower_hull_lies_below_all_points(points: list[tuple[int, float]]) -> None:
    x, y = (np.array(each) for each in zip(*points, strict=True))
    corner_x, corner_y = analysis.lower_hull(x, y)
    assert np.all(np.interp(x, corner_x, corner_y) <= y + 1e-9)
    assert corner_x[0] == x.min()
    assert corner_x[-1] == x.max()


def test_what_was_measured_is_replayed_as_a_trace(tmp_path: Path) -> None:
    """Delays over a recorded link, measured, replayed and measured again, are the same."""
    file = tmp_path / "slow.csv"
    times_s = np.arange(0.0, 60.0, 0.05)
    slow_s = 0.1 + 0.05 * np.sin(times_s / 3.0)
    lines = [f"{t:.3f},{d:.6f},{int(30 < t < 31)}" for t, d in zip(times_s, slow_s, strict=True)]
    file.write_text("\n".join(["time_s,delay_s,lost", *lines]) + "\n")
    first, _ = measure(f"trace({file})", f"trace({file})", seconds=50.0)
    delays = outcome(first, "x", secure=False).delays["downlink"]
    again = tmp_path / "again.csv"
    again.write_text(trace(delays))
    second, _ = measure("none", f"trace({again})", seconds=40.0)
    replayed = outcome(second, "x", secure=False).delays["downlink"]
    came, known = replayed.came, delays.came
    # The flow begins with a HELLO, before the first probe: the trace is ahead by a round trip.
    ahead_s = [float(each) for each in np.arange(0.0, 0.5, 0.001)]
    at, was = replayed.time_s[came], replayed.delay_s[came] - replayed.delay_s[came].mean()

    def off(shift_s: float) -> float:
        known_s = np.interp(at + shift_s, delays.time_s[known], delays.delay_s[known])
        return float(np.quantile(np.abs(known_s - known_s.mean() - was), 0.99))

    assert min(map(off, ahead_s)) < 0.0005
    assert replayed.delay_s[came].mean() > 0.0
    gap = replayed.time_s[~came]
    assert 0.8 < np.ptp(gap) < 1.2


def prober(probes: int = 10, period_ns: int = SECOND_NS) -> Prober:
    return Prober(
        PlainLink(), LISTENER, bytes(NONCE_BYTES), probes=probes, period_ns=period_ns, size=200
    )


def test_a_measurement_that_ends_early_leaves_out_what_is_under_way() -> None:
    far = listener()
    near = prober(100, SECOND_NS // 20)
    now_ns = 0
    late: list[tuple[int, Datagram]] = []
    while now_ns < 3 * SECOND_NS:
        near.wake(now_ns=now_ns)
        late += [(now_ns + SECOND_NS, packet) for packet in near.outbox()]
        while late and late[0][0] <= now_ns:
            _, packet = late.pop(0)
            far.receive(Datagram(packet.payload, ("prober", 1)), now_ns=now_ns)
        for packet in far.outbox():
            near.receive(Datagram(packet.payload, LISTENER), now_ns=now_ns)
        now_ns += SECOND_NS // 100
    measured = near.measured()
    assert not near.finished
    assert 10 < len(measured.downlink.sent_ns) < 40
    assert measured.downlink.came.all()
    assert measured.uplink.came.all()


def test_who_is_not_answered_gives_up() -> None:
    near = prober()
    now_ns: int | None = 0
    hellos = 0
    while now_ns is not None and now_ns < 60 * SECOND_NS:
        near.wake(now_ns=now_ns)
        hellos += len(near.outbox())
        now_ns = near.next_wake_ns()
    assert near.failed
    assert near.finished
    assert 5 <= hellos <= 50


def test_strangers_and_forgers_change_nothing() -> None:
    near = prober()
    near.wake(now_ns=0)
    near.outbox()
    far = listener()
    session = session_of(far, ("prober", 1), 0)
    welcome = encode(ProbeWelcome(bytes(NONCE_BYTES), b"12345678", True))
    near.receive(Datagram(welcome, ("stranger", 1)), now_ns=1)
    near.receive(Datagram(encode(ProbeWelcome(b"87654321", b"12345678", True)), LISTENER), now_ns=1)
    assert near.next_wake_ns() is not None
    near.receive(Datagram(welcome, LISTENER), now_ns=1)
    mine = bytes(NONCE_BYTES) + b"12345678"
    for answer in (
        ProbeAnswer(session, 0, 1, 0, 1, ((0, 1),)),
        ProbeAnswer(mine, 0, 1, 0, 1, ((500, 1),)),
        ProbeAnswer(mine, 0, 1, 0, 4_000_000, ()),
    ):
        near.receive(Datagram(encode(answer, 200), LISTENER), now_ns=2)
    near.receive(Datagram(b"garbage", LISTENER), now_ns=2)
    assert sum(near.figures()["dropped"].values()) == 6
    assert near.figures()["arrived"] == 0


# -- the command ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "got neither, expected either HOST:PORT"),
        (("127.0.0.1:1", "--listen", "127.0.0.1:2"), "got both, expected either HOST:PORT"),
        (("127.0.0.1:1", "--duration", "0"), "--duration: got 0, expected 1 to"),
        (("127.0.0.1:1", "--rate", "1e9"), "--rate: got 1e+09, expected 0.1 to 1000"),
        (("127.0.0.1:1", "--bytes", "10"), f"--bytes: got 10, expected {BYTES_MIN} to 1200"),
        (("127.0.0.1:1", "--duration", "86400", "--rate", "1000"), "packets, expected at most"),
        (("192.0.2.1:1",), "there are no keys"),
        (("127.0.0.1:1", "--path", "=127.0.0.1:1"), "got both, expected either HOST:PORT"),
        (("--path", "127.0.0.1:1"), "--path: got '127.0.0.1:1', expected LOCAL=HOST:PORT"),
        (("--path", "=127.0.0.1:1") * 5, "--path: got 5, expected 1 to 4"),
        (("--path", "=127.0.0.1:1") * 2, "--path: got '=127.0.0.1:1' twice"),
        (("--path", "=127.0.0.1:1", "--path", "=192.0.2.1:1"), "192.0.2.1:1: other machines"),
        (
            ("--id", "65535", "--path", "=127.0.0.1:1", "--path", "=127.0.0.1:2"),
            "--id: got 65535, expected 0 to 65534",
        ),
    ],
)
def test_bad_options_are_one_line(
    flags: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in refused(["probe", *flags], capsys)


@contextmanager
def started(*command: str) -> Iterator[str]:
    """Process that listens; yields its address."""
    process = subprocess.Popen(
        [*SKYTETHER, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    try:
        yield next(word for word in line.replace(",", " ").split() if word.startswith("127.0.0.1:"))
    finally:
        process.terminate()
        process.communicate(timeout=180)


def listening(*flags: str) -> AbstractContextManager[str]:
    return started("probe", "--listen", "127.0.0.1:0", *flags)


@pytest.mark.realtime
def test_a_path_over_loopback_is_measured_and_sealed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = ["--keys", str(tmp_path / "keys")]
    assert main(["keygen", keys[1]]) == 0
    capsys.readouterr()
    with listening(*keys) as address:
        out = [f"--{name}" for name in ("out", "json", "figure", "record")]
        files = [str(tmp_path / name) for name in ("probed", "p.json", "p.png", "p.rows")]
        flags = [each for pair in zip(out, files, strict=True) for each in pair]
        limits = ["--duration", "2", "--rate", "50"]
        assert main(["probe", address, *limits, *flags, *keys]) == 0
    content = json.loads((tmp_path / "p.json").read_text())
    assert content["secure"]
    for name in ("uplink", "downlink"):
        assert 0 < content[name]["came"] <= content[name]["sent"]
        with (tmp_path / "probed" / f"{name}.csv").open() as file_of_rows:
            assert len(list(csv.DictReader(file_of_rows))) == content[name]["sent"]
    assert (tmp_path / "p.png").stat().st_size > 10_000
    assert len(parse((tmp_path / "p.rows").read_bytes())) > 0
    printed = capsys.readouterr().out
    assert "may be wrong by up to" in printed
    flown = [line for line in printed.splitlines() if line.startswith("skytether fly demo")]
    assert len(flown) == 2


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.parametrize("sealed", [False, True])
def test_two_paths_are_probed_at_once_of_which_one_is_cut(
    sealed: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scenario that is written loses packets on the second path, and flies."""
    keys: list[str] = []
    if sealed:
        keys = ["--keys", str(tmp_path / "keys")]
        assert main(["keygen", keys[1], "--vehicles", "2"]) == 0
        capsys.readouterr()
    cut = ("--to-server", "constant(20ms) & outage(1, 1.5)")
    out = [f"--{name}={tmp_path / name}" for name in ("out", "json", "record")]
    limits = ["--duration", "4", "--rate", "100", "--bytes", "200"]
    with (
        listening(*keys) as listener,
        started("netem", "--bind", "127.0.0.1:0", "--server", listener, *cut) as netem,
    ):
        paths = [f"127.0.0.1={listener}", f"127.0.0.2={netem}"]
        flags = [each for path in paths for each in ("--path", path)]
        assert main(["probe", *flags, *limits, *out, *keys]) == 0
    content = json.loads((tmp_path / "json").read_text())
    assert [each["listener"] for each in content["paths"]] == paths
    assert [each["secure"] for each in content["paths"]] == [sealed, sealed]
    first, second = content["outages"]["paths"]
    assert second["share"] > 0.2
    assert content["outages"]["product"] == pytest.approx(first["share"] * second["share"])
    assert content["outages"]["common"]["share"] <= first["share"]
    flown = reading.load(str(tmp_path / "out" / "paths.toml"))
    assert flown.on_path(1).downlink.loss > 0.2
    assert set(parse((tmp_path / "record").read_bytes())["path"].tolist()) == {0, 1}
    printed = capsys.readouterr().out
    for said in (*paths, "all at once", "if independent", "--network.paths '[{", "paths.toml"):
        assert said in printed
