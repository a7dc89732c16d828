"""Parts of a vehicle with an autopilot: clock, robustness against any bytes, parameters, cost."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from airborne import scenario
from skytether.client import vehicles
from skytether.client.clock import DRIFT_MAX, KNOWN, WANDER, WINDOW, BootClock
from skytether.client.mavlink import safety
from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from skytether.shared.base import extras
from skytether.shared.base.extras import ExtraMissing
from skytether.shared.endpoints.endpoint import Datagram

MS, SECOND = 1_000_000, 1_000_000_000
SLOW = 2_100_000
"""Delay of an answer just above the limit for a quick one [ns]."""
PEER = ("autopilot", 0)


def timed(
    *,
    drift: float,
    delays: list[tuple[int, int]],
    every_ns: int = SECOND,
) -> tuple[BootClock, int]:
    """Clock after questions with these delays there and back [ns], and the time of the last."""
    clock, now_ns = BootClock(), 100 * SECOND
    for there_ns, back_ns in delays:
        now_ns += every_ns
        asked_ns = clock.ask(now_ns=now_ns)
        boot_ns = boot(now_ns + there_ns, drift)
        clock.hear(boot_ns, asked_ns, now_ns=now_ns + there_ns + back_ns)
    return clock, now_ns


def boot(local_ns: int, drift: float, offset_ns: int = 7 * SECOND) -> int:
    """Reading of the autopilot's clock."""
    return round((local_ns - offset_ns) * (1.0 - drift))


@settings(max_examples=30)
@given(
    st.floats(-DRIFT_MAX, DRIFT_MAX),
    st.lists(
        st.tuples(st.integers(1 * MS, 40 * MS), st.integers(1 * MS, 40 * MS)),
        min_size=30,
        max_size=100,
    ),
)
@example(0.0, [(MS, MS), *[(3 * MS, MS)] * 6, *[(MS, 3 * MS)] * 6, *[(SLOW, SLOW)] * 50])
def test_the_clock_contradicts_no_answer(drift: float, delays: list[tuple[int, int]]) -> None:
    """The error is at most an answer's round trip plus the drift since."""
    clock, now_ns = timed(drift=drift, delays=delays)
    newest_first = enumerate(reversed(delays[-WINDOW:]))
    bound = min(sum(ways) + 2 * (DRIFT_MAX + WANDER) * age * SECOND for age, ways in newest_first)
    wrong = abs(clock.local_ns(boot(now_ns, drift)) - now_ns)
    assert clock.is_known
    assert wrong <= bound + 0.1 * MS


def test_drift_is_found() -> None:
    """Drift of 100 ppm over 60 s of answers that take 3 to 16 ms."""
    rng = np.random.default_rng(1)
    ways = (1.5 * MS + rng.exponential(0.5 * MS, (60, 2))).astype(int).tolist()
    clock, now_ns = timed(drift=100e-6, delays=[(there, back) for there, back in ways])
    assert clock.drift == pytest.approx(100e-6, abs=20e-6)
    assert abs(clock.local_ns(boot(now_ns + 5 * SECOND, 100e-6)) - now_ns - 5 * SECOND) < MS


@pytest.mark.parametrize("drift", [-DRIFT_MAX, -8600e-6, 8600e-6, DRIFT_MAX])
def test_a_large_drift_is_followed_from_the_fourth_answer_on(drift: float) -> None:
    """PX4's own simulator runs 0.86 % slow, and answers within 0.2 ms."""
    ways = [(MS // 10, MS // 10)] * 30
    for count in range(KNOWN, len(ways) + 1):
        clock, now_ns = timed(drift=drift, delays=ways[:count], every_ns=SECOND // 5)
        later_ns = now_ns + SECOND
        assert clock.drift == pytest.approx(drift, abs=400e-6)
        assert abs(clock.local_ns(boot(later_ns, drift)) - later_ns) < MS


def test_a_clock_that_stood_still_is_right_from_the_next_answer_on() -> None:
    """A simulator paused for 60 ms, which does not count as a reboot."""
    ways, pause_ns = [(MS // 10, MS // 10)] * 40, 60 * MS
    clock, now_ns = timed(drift=0.0, delays=ways)
    for later_ns in (now_ns + SECOND, now_ns + 2 * SECOND):
        asked_ns = clock.ask(now_ns=later_ns)
        assert clock.hear(boot(later_ns - pause_ns, 0.0), asked_ns, now_ns=later_ns)
        assert abs(clock.local_ns(boot(later_ns - pause_ns, 0.0)) - later_ns) < MS
    assert clock.jumps == 0


@pytest.mark.parametrize("rate", [0.5, 0.95, 1.05, 10.0])
def test_a_rate_that_cannot_be_followed_is_known(rate: float) -> None:
    clock, _ = timed(drift=1.0 - rate, delays=[(MS, MS)] * 12, every_ns=SECOND // 5)
    assert clock.wrong_rate == pytest.approx(rate, rel=0.01)
    followed, _ = timed(drift=DRIFT_MAX, delays=[(MS, MS)] * 12, every_ns=SECOND // 5)
    assert followed.wrong_rate is None


def test_answers_that_nobody_asked_for_count_for_nothing() -> None:
    clock, now_ns = timed(drift=0.0, delays=[(MS, MS)] * KNOWN)
    before = clock.local_ns(SECOND)
    assert not clock.hear(1, 12345, now_ns=now_ns)
    asked_ns = clock.ask(now_ns=now_ns)
    assert not clock.hear(-5, asked_ns, now_ns=now_ns + MS)
    asked_ns = clock.ask(now_ns=now_ns + MS)
    assert not clock.hear(SECOND, asked_ns, now_ns=now_ns + 3 * SECOND)
    assert clock.local_ns(SECOND) == before


def test_a_clock_that_begins_anew_is_believed_after_three_answers() -> None:
    clock, now_ns = timed(drift=0.0, delays=[(MS, MS)] * 10)
    heard = []
    for k in range(1, 6):
        now_ns += SECOND
        asked_ns = clock.ask(now_ns=now_ns)
        heard.append(clock.hear(k * SECOND, asked_ns, now_ns=now_ns + 2 * MS))
    assert heard == [False, False, True, True, True]
    assert clock.local_ns(5 * SECOND) == pytest.approx(now_ns + MS, abs=MS)


def messages() -> st.SearchStrategy[bytes]:
    """Frames of the autopilot with a right checksum and random content."""

    def frame(number: int, payload: bytes, component: int) -> bytes:
        kind = dialect.mavlink_map[number]
        head = bytes([len(payload), 0, 0, 0, 1, component]) + number.to_bytes(3, "little")
        crc = dialect.x25crc(bytearray(head + payload + bytes([kind.crc_extra]))).crc
        return b"\xfd" + head + payload + crc.to_bytes(2, "little")

    wanted = [0, 1, 22, 32, 77, 111, 147, 148, 193, 230, 242, 245, 253]
    numbers = st.sampled_from(wanted) | st.sampled_from(sorted(dialect.mavlink_map))
    return st.builds(frame, numbers, st.binary(max_size=255), st.sampled_from([1, 1, 2]))


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.binary(max_size=80) | messages(), st.integers(0, 2 * SECOND)), max_size=12
    ),
    st.sampled_from([3, 12]),
)
def test_any_bytes_raise_nothing_and_arm_nothing(
    datagrams: list[tuple[bytes, int]], autopilot: int
) -> None:
    flies = vehicles.make(scenario(), 1)
    assert flies.port is not None
    codec, now_ns = Codec(1, 1), 10 * SECOND
    beat = codec.encode(dialect.MAVLink_heartbeat_message(2, autopilot, 81, 0, 4, 3))
    sent = []
    for payload, later_ns in [(beat, 0), *datagrams]:
        now_ns += later_ns
        flies.port.receive(Datagram(payload, PEER, 1), now_ns=now_ns)
        while (due_ns := flies.port.next_wake_ns()) is not None and due_ns <= now_ns:
            flies.port.wake(now_ns=now_ns)
        flies.take_off(now_ns=now_ns)
        flies.measurements(now_ns=now_ns)
        flies.port.figures()
        sent += flies.port.outbox()
    asked = Codec(9, 9).decode(b"".join(each.payload for each in sent))
    commands = {each.command for each in asked if each.get_type() == "COMMAND_LONG"}
    assert commands <= {511, 512}
    assert not any(each.get_type().startswith("SET_POSITION") for each in asked)
    assert len(sent) < 40 * (len(datagrams) + 1)


@given(st.lists(st.binary(max_size=300), max_size=30))
@settings(max_examples=20)
def test_a_line_of_bytes_is_bounded(pieces: list[bytes]) -> None:
    flies = vehicles.make(scenario(vehicle={"address": "tcp:127.0.0.1:5760"}), 1)
    for piece in pieces:
        flies.port.receive(Datagram(piece, ("line", 0), 1), now_ns=SECOND)
    assert flies.port.outbox() == []


@pytest.mark.parametrize("rules", [safety.ardupilot(245), safety.px4()])
def test_what_is_set_is_what_is_safe(rules: tuple[safety.Rule, ...]) -> None:
    """Each rule accepts the value that it would set, and has a text for each value."""
    for rule in rules:
        if rule.wanted:
            assert rule.is_safe(rule.value)
            assert f"set {rule.value:g}" in rule.wanted
        for value in (-1.0, *range(10), 0.5, 1e9):
            assert rule.meaning(value)


@pytest.mark.parametrize(
    ("rules", "name", "unsafe"),
    [
        (safety.ardupilot(245), "GUID_TIMEOUT", (0.0, 3.0)),
        (safety.ardupilot(245), "FS_GCS_ENABLE", (0, 7)),
        (safety.ardupilot(245), "SYSID_MYGCS", (244, 255)),
        (safety.ardupilot(245), "FS_GCS_TIMEOUT", (60.0,)),
        (safety.px4(), "COM_OF_LOSS_T", (2.0,)),
        (safety.px4(), "COM_OBL_RC_ACT", (0, 5, 7)),
        (safety.px4(), "NAV_DLL_ACT", (6,)),
    ],
)
def test_a_value_with_which_silence_is_no_landing_is_unsafe(
    rules: tuple[safety.Rule, ...], name: str, unsafe: tuple[float, ...]
) -> None:
    (rule,) = (each for each in rules if name in each.names)
    assert not any(map(rule.is_safe, unsafe))


def test_the_extra_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pymavlink", None)
    for name in list(__import__("sys").modules):
        if name.startswith(("skytether.mavlink", "skytether.client.mavlink", "pymavlink.")):
            monkeypatch.delitem(__import__("sys").modules, name)
    assert "pymavlink" in extras._extras()["mavlink"]
    with pytest.raises(ExtraMissing, match=r"pip install 'skytether\[mavlink\]'"):
        vehicles.make(scenario(), 1)
