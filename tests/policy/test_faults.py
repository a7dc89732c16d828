"""Answers to the robot program under faults, as in the table of docs/policy.md."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from policy_lab import (
    MS,
    OPTIONS,
    Around,
    Lab,
    first_row,
    keyed,
    ramp,
    secured,
    secured_gate,
    state,
)
from skytether.client.secure import SecureLink
from skytether.policy import events, metrics, values
from skytether.policy.exchange import Exchange
from skytether.policy.images import Compressor
from skytether.policy.messages import METADATA, OBSERVATION, Part, decode
from skytether.policy.robot import FrameType, RobotEnd, RobotOptions
from skytether.policy.serving import PolicyEnd
from skytether.policy.session import REFUSALS
from skytether.policy.virtual import ROBOT, SERVER, NoActionError
from skytether.server.gate import PlainGate
from skytether.shared.base.units import MICROSECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.wire.protocol import Refusal
from skytether.shell.processes.metrics import families

KEYS = pytest.mark.parametrize("made", [Lab, secured], ids=["plain", "keys"])
FAR = {"to_policy": "constant(20ms)", "to_robot": "constant(20ms)"}


def fly(lab: Lab, calls: int, position: float = 0.0) -> tuple[list[float | None], float]:
    """Make calls, execute five rows of each answer, and check that each meets its deadline.

    Returns: first row of each answer, None for an error; and the final position.
    """
    got = list[float | None]()
    for _ in range(calls):
        began_ns = lab.now_ns
        try:
            rows = lab.infer(state(position))["actions"][:5, 0].tolist()
            position = rows[-1] + 1.0
            got.append(rows[0])
        except NoActionError:
            got.append(None)
        assert lab.now_ns - began_ns <= OPTIONS.deadline_ns
        lab.sleep(0.1)
    return got, position


def flying(made: Any = Lab, **options: Any) -> tuple[Lab, float]:
    lab = made(**(FAR | options))
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    _, position = fly(lab, 3, 5.0)
    return lab, position


def shares(lab: Lab) -> dict[str, int]:
    answers: dict[str, int] = lab.robot.figures()["answers"]
    return answers


# -- processes ---------------------------------------------------------------------------------


@KEYS
def test_a_policys_end_that_was_killed_and_restarted(made: Any) -> None:
    """Remaining rows, hold action, errors; after 3 to 4 s chunks of the new process."""
    lab, position = flying(made)
    gate = PlainGate() if made is Lab else secured_gate()
    lab.server = PolicyEnd(gate, boot_id=77, draw=lambda: 99)
    got, position = fly(lab, 40, position)
    assert got[:3] == [20.0, 24.0, 24.0]
    assert got.index(None) * (OPTIONS.deadline_ns + 100 * MS) >= OPTIONS.hold_ns
    assert None not in got[24:]
    got, _ = fly(lab, 3, 100.0)
    assert got == [100.0, 105.0, 110.0]


@pytest.mark.parametrize(("made", "after_s"), [(Lab, 5), (secured, 2)], ids=["plain", "keys"])
def test_a_robots_end_that_was_killed_and_restarted(made: Any, after_s: float) -> None:
    """The program reconnects and waits for its first answer. Without keys the robot's number
    belongs to the old address until it has been silent for 3 s.
    """
    lab, _ = flying(made)
    link = (
        lab.robot._session._link
        if made is Lab
        else SecureLink(keyed(), entropy=np.random.default_rng(8).bytes)
    )
    lab.robot = RobotEnd(1, {0: SERVER}, link, OPTIONS, boot_id=55)
    moved = Around(lab.server)
    moved.seen_as = lambda each: each if each.socket else each._replace(peer=("192.0.2.2", 5001))
    moved.leaves = lambda each: each.peer != ROBOT
    lab.server = moved  # type: ignore[assignment]
    began_ns, before = lab.now_ns, len(lab.answers)
    lab.say(FrameType.OPENED.value)
    lab.run(lab.now_ns + 60 * SECOND_NS, lambda: len(lab.answers) > before)
    assert first_row(lab.infer(state(7.0))) == 7.0
    assert lab.now_ns - began_ns < after_s * SECOND_NS


@pytest.mark.parametrize(("made", "after_s"), [(Lab, 5), (secured, 0)], ids=["plain", "keys"])
def test_an_address_that_changes(made: Any, after_s: float) -> None:
    """With keys no answer is lost; without, the robot sends HELLO after 3 s without a datagram."""
    lab, position = flying(made)
    moved = Around(lab.server)
    moved.seen_as = lambda each: each if each.socket else each._replace(peer=("198.51.100.7", 9))
    moved.leaves = lambda each: each.peer != ROBOT
    lab.server = moved  # type: ignore[assignment]
    got, _ = fly(lab, 5 + int(after_s * 4), position)
    if after_s:
        assert None in got
        assert first_row(lab.infer(state(70.0))) == 70.0
    else:
        assert got == [20.0, 25.0, 30.0, 35.0, 40.0]


@pytest.mark.parametrize("frozen", ["robot", "server"])
def test_a_process_that_was_frozen(frozen: str) -> None:
    """No earlier row is executed: the hold action or an error, then new chunks."""
    lab, position = flying()
    end = Around(getattr(lab, frozen))
    setattr(lab, frozen, end)
    lab.say(FrameType.MESSAGE.value + values.pack(state(position)))
    before, end.until_ns = len(lab.answers), lab.now_ns + 5 * SECOND_NS
    lab.run(end.until_ns, lambda: len(lab.answers) > before)
    lab.run(end.until_ns + SECOND_NS)
    assert len(lab.answers) == before + 1
    lab.sleep(4)
    got, _ = fly(lab, 3, 100.0)
    assert got[-1] == 110.0 or got[-1] == 105.0
    assert not {20.0, 25.0} & set(got)


def test_a_hello_of_an_earlier_run_ends_no_session() -> None:
    """Replay of a HELLO whose run never had a session, so that the gate cannot recognize it."""
    lab, position = flying(secured)
    link = SecureLink(keyed(), entropy=np.random.default_rng(9).bytes)
    earlier = RobotEnd(1, {0: SERVER}, link, OPTIONS, boot_id=55)
    earlier.wake(now_ns=lab.now_ns)
    for _ in range(2):  # the first is answered with a cookie
        for each in earlier.outbox():
            lab.server.receive(Datagram(each.payload, ("203.0.113.9", 9)), now_ns=lab.now_ns)
        for each in lab.server.outbox():
            if each.peer[0] == "203.0.113.9":
                earlier.receive(Datagram(each.payload, SERVER), now_ns=lab.now_ns)
    assert earlier._session.exchange is not None
    got, _ = fly(lab, 3, position)
    assert got == [20.0, 25.0, 30.0]


def test_of_two_robots_with_one_key_the_newest_run_keeps_the_number() -> None:
    """The earlier run gets the number again after the newer one has been silent for 3 s."""
    lab, _ = flying(secured)
    link = SecureLink(keyed(), entropy=np.random.default_rng(9).bytes)
    newer, there = RobotEnd(1, {0: SERVER}, link, OPTIONS, boot_id=55), ("203.0.113.9", 9)
    server = Around(lab.server)

    def leaves(each: Datagram) -> bool:
        if each.peer == there:
            newer.receive(Datagram(each.payload, SERVER), now_ns=lab.now_ns)
        return each.peer != there

    server.leaves = leaves
    lab.server = server  # type: ignore[assignment]
    for _ in range(80):
        newer.wake(now_ns=lab.now_ns)
        for each in newer.outbox():
            lab.server.receive(Datagram(each.payload, there), now_ns=lab.now_ns)
        lab.sleep(0.1)
    refused = [each for each in lab.robot.events() if isinstance(each, events.JoinRefused)]
    assert REFUSALS[Refusal.TAKEN] in str(refused[-1])
    assert not any(isinstance(each, events.PolicySilent) for each in newer.events())
    lab.sleep(5)
    assert first_row(lab.infer(state(7.0))) == 7.0


# -- policy -------------------------------------------------------------------------------------


def test_a_policy_that_hangs() -> None:
    """Remaining rows, hold action, errors; new chunks after a reconnection after `patience_ns`."""
    lab, position = flying()
    lab.thinking_ns = None
    got, _ = fly(lab, 110, position)
    assert got[0] == 20.0
    assert set(got[10:]) == {None}
    lab.thinking_ns = 0
    lab.sleep(5)
    assert first_row(lab.infer(state(50.0))) == 50.0


def test_a_policy_that_takes_as_long_as_many_calls() -> None:
    """Chunks of 4 s computed in 1.5 s, a call each 20 ms: no row is skipped or repeated."""

    def policy(seen: Any) -> Any:
        return {"actions": seen["state"][0] + np.arange(200.0)[:, None]}

    lab = Lab(policy, replace(OPTIONS, step_ns=20 * MS), thinking=1.5, **FAR)
    lab.connect()
    position, got = 0.0, list[float]()
    for _ in range(400):
        got.append(first_row(lab.infer(state(position))))
        position = got[-1] + 1.0
        lab.sleep(0.02)
    assert np.diff(got).tolist() == [1.0] * 399


def test_an_answer_that_comes_after_its_connection_was_given_up_is_nobodys() -> None:
    lab, position = flying()
    lab.thinking_ns = 31_120 * MS  # 100 ms after the reconnection
    lab.infer(state(-900.0))
    lab.thinking_ns = 500 * MS
    got, _ = fly(lab, 150, position)
    assert all(each is None or each >= 0.0 for each in got)
    assert got[-1] is not None
    assert got[-1] > position


def test_a_policy_that_answers_twice_is_connected_anew() -> None:
    """Otherwise each observation would get the reply to the previous one."""
    lab, position = flying()
    lab.policy_says(FrameType.MESSAGE.value + values.pack(ramp(state(-900.0))), ("policy", 1))
    got, position = fly(lab, 12, position)
    assert all(each is None or each >= 20.0 for each in got)
    assert first_row(lab.infer(state(position))) == position


def test_a_policy_that_raises_at_the_first_call_is_asked_again() -> None:
    fails = [True, True, False]

    def policy(observation: Any) -> Any:
        if fails.pop(0):
            raise RuntimeError("no memory")
        return ramp(observation)

    lab = Lab(policy)
    lab.connect()
    assert first_row(lab.infer(state(3.0))) == 3.0
    assert lab.now_ns < 4 * SECOND_NS


def test_metadata_that_never_comes_is_asked_for_anew() -> None:
    lab = Lab(ramp)
    asked = lab._ask
    lab._ask = lambda *_: None  # type: ignore[method-assign]
    lab.say(FrameType.OPENED.value)
    lab.sleep(20)
    lab._ask = asked  # type: ignore[method-assign]
    lab.sleep(15)
    assert lab.answers
    assert first_row(lab.infer(state(3.0))) == 3.0


def test_rows_of_another_shape_are_not_played() -> None:
    """Remaining rows of earlier chunks, hold action, error; the log gives the reason."""
    lab = Lab(lambda seen: {"actions": np.zeros((10, 2 if seen["state"][0] < 20 else 3))}, **FAR)
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    assert lab.infer(state(20.0))["actions"].shape == (10, 2)
    lab.sleep(2)
    with pytest.raises(NoActionError):
        lab.infer(state(20.0))
    assert any("got row shape (3,), expected (2,)" in str(each) for each in lab.robot.events())


@pytest.mark.parametrize("depth", [100, 600, 2000])
def test_a_reply_that_is_nested_deep_is_an_error_at_most(depth: int) -> None:
    lab = Lab(ramp, replace(OPTIONS, begin_ns=SECOND_NS), thinking=None)
    lab.connect()
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)))
    lab.sleep(0.1)
    actions = values.pack("actions") + values.pack(np.zeros((3, 1)))
    nested = values.pack("nested") + b"\x81\xa1a" * depth + b"\xc0"
    lab.policy_says(FrameType.MESSAGE.value + b"\x82" + actions + nested, ("policy", 1))
    lab.sleep(2)
    assert len(lab.answers) == 2


# -- observations ------------------------------------------------------------------------------


def test_a_camera_that_stops() -> None:
    """Observations without its image reach the policy, and are answered."""
    lab = Lab(ramp, compress=Compressor(64), **FAR)
    lab.connect()
    image = np.zeros((240, 320, 3), np.uint8)
    for position, cameras in enumerate([{"wrist": image, "top": image}, {"wrist": image}, {}] * 3):
        assert first_row(lab.infer(state(position) | cameras)) == position
        assert lab.asked[-1].keys() == {"state", *cameras}
        lab.sleep(0.1)


def test_observations_of_20_mb() -> None:
    """Large images are resized and sent; a large array is refused with its size."""
    lab = Lab(ramp, compress=Compressor(224), **FAR)
    lab.connect()
    image = np.zeros((1700, 1960, 3), np.uint8)
    lab.infer(state(0.0) | {"wrist": image, "top": image})
    assert lab.asked[-1]["top"].shape == (224, 224, 3)
    with pytest.raises(NoActionError, match="expected at most 4000000"):
        lab.infer(state(0.0) | {"cloud": np.zeros(20_000_000, np.uint8)})
    got, _ = fly(lab, 2, 5.0)
    assert got == [5.0, 10.0]


def test_an_observation_that_is_nested_deep_is_an_error_at_once() -> None:
    lab = Lab(ramp, compress=Compressor(32))
    lab.connect()
    lab.infer(state(0.0))
    lab.say(FrameType.MESSAGE.value + b"\x81\xa1a" * 900 + b"\xc0")
    lab.run(lab.now_ns)
    assert lab.answers[-1][1].startswith(FrameType.ERROR.value + b"the observation is refused")


# -- programs ----------------------------------------------------------------------------------


def test_a_program_that_does_not_wait_for_its_answers_gets_each_in_order() -> None:
    lab, position = flying()
    before = len(lab.answers)
    for _ in range(5):
        lab.say(FrameType.MESSAGE.value + values.pack(state(position)))
    lab.sleep(0.2)
    assert len(lab.answers) == before + 5


def test_of_two_programs_the_newest_is_the_robots() -> None:
    lab, _ = flying()
    other = ("program", 2)
    lab.say(FrameType.OPENED.value, other)
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)))  # of the first program: ignored
    before = len(lab.answers)
    lab.sleep(1)
    assert len(lab.answers) == before + 1  # metadata for the second program
    lab.say(FrameType.MESSAGE.value + values.pack(state(300.0)), other)
    lab.sleep(0.2)
    assert first_row(values.unpack(lab.answers[-1][1][1:])) == 300.0
    lab.say(FrameType.CLOSED.value)  # the first program disconnects: no effect
    lab.say(FrameType.MESSAGE.value + values.pack(state(310.0)), other)
    lab.sleep(0.2)
    assert first_row(values.unpack(lab.answers[-1][1][1:])) == 310.0


def test_a_program_that_pauses_plays_nothing_old_and_its_pause_is_no_step() -> None:
    options = RobotOptions("absolute", 150 * MS, rows=5)
    lab, position = flying(options=options)
    lab.is_cut = True
    lab.sleep(60)
    began_ns = lab.now_ns
    with pytest.raises(NoActionError):
        lab.infer(state(position))
    assert lab.now_ns - began_ns == options.pause_ns
    assert fly(lab, 1, position)[0] == [None]
    assert lab.robot.figures()["step_s"] <= 1.0


@pytest.mark.parametrize(("pause_s", "waits"), [(0.5, False), (1.3, True), (60.0, True)])
def test_the_first_call_of_an_episode_waits_for_its_chunk(pause_s: float, *, waits: bool) -> None:
    """Otherwise, with a policy slower than the deadline, each episode would begin with an error."""
    lab, _ = flying(thinking=0.3)
    lab.sleep(pause_s)
    with suppress(NoActionError):
        assert (first_row(lab.infer(state(500.0))) == 500.0) == waits
    assert lab.robot.figures()["answers"]["error"] == 0
    lab.sleep(0.1)
    fly(lab, 3, 505.0)


@pytest.mark.parametrize("hold_ns", [0, 300 * MS])
def test_a_chunk_for_which_the_first_call_of_an_episode_waits_is_not_late(hold_ns: int) -> None:
    """Although the program has waited for longer than the sum of deadline and hold."""
    lab, _ = flying(options=replace(OPTIONS, hold_ns=hold_ns), thinking=0.1)
    lab.thinking_ns = 600 * MS
    lab.sleep(5)
    assert first_row(lab.infer(state(500.0))) == 500.0


def test_the_first_observation_of_an_episode_is_needed_although_rows_remain() -> None:
    options = RobotOptions("absolute", 900 * MS, rows=5, spare_rows=0)
    lab, position = flying(options=options)
    lab.infer(state(position))
    lab.sleep(1.3)
    assert first_row(lab.infer(state(500.0))) == 500.0


def test_an_episode_after_an_error_begins_with_a_chunk() -> None:
    """The program has stopped the robot because of the error, and begins again later."""
    lab, position = flying(thinking=0.1)
    lab.is_cut = True
    assert fly(lab, 20, position)[0][-1] is None
    lab.is_cut = False
    lab.thinking_ns = 300 * MS
    lab.sleep(10)
    assert first_row(lab.infer(state(500.0))) == 500.0


def test_a_program_that_executes_the_hold_action_does_not_pause() -> None:
    """Its ten rows take 2 s."""
    lab = Lab(options=RobotOptions("absolute", 150 * MS, rows=10))
    lab.connect()
    for row in range(3):
        lab.infer(state(10.0 * row))
        lab.sleep(2)
    lab.is_cut = True
    assert first_row(lab.infer(state(30.0))) == 29.0
    lab.sleep(2)
    began_ns = lab.now_ns
    with pytest.raises(NoActionError):
        lab.infer(state(30.0))
    assert lab.now_ns - began_ns == OPTIONS.deadline_ns


@pytest.mark.parametrize("thinking", [0.95, 4.95])
def test_the_second_chunk_of_a_first_observation_that_was_sent_again_is_ignored(
    thinking: float,
) -> None:
    """The observation was sent again while its chunk was under way."""
    lab = Lab(thinking=thinking, to_policy="constant(50ms)", to_robot="constant(50ms)")
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    assert lab.robot.figures()["dropped"] == {"for another life": 1}
    assert not any(isinstance(each, events.ChunkRefused) for each in lab.robot.events())
    lab.thinking_ns = 0
    fly(lab, 3, 5.0)
    assert lab.robot.figures()["delay_s"] < 0.2


# -- network -----------------------------------------------------------------------------------


@KEYS
def test_ten_thousand_hostile_datagrams(made: Any) -> None:
    """From foreign addresses and from the address of each end: they have no effect."""
    lab, position = flying(made)
    rng = np.random.default_rng(6)
    recorded = [payload for _, payload in lab.wire]
    for count in range(10_000):
        payload = bytearray(recorded[count % len(recorded)])
        for at in rng.integers(len(payload), size=3):
            payload[at] = rng.integers(256)
        if made is Lab:  # without keys anybody who knows the session number can send in it
            payload[3:8] = b"\xce" + rng.bytes(4)
        lab.server.receive(Datagram(bytes(payload), ("203.0.113.9", 9)), now_ns=lab.now_ns)
        lab.robot.receive(Datagram(bytes(payload), SERVER), now_ns=lab.now_ns)
        lab.robot.receive(Datagram(bytes(payload), ("203.0.113.9", 9)), now_ns=lab.now_ns)
    got, _ = fly(lab, 4, position)
    assert got == [20.0, 25.0, 30.0, 35.0]


def test_clocks_that_differ_and_jump() -> None:
    """Clock offsets do not matter: only round-trip times and own control steps are used."""
    lab, position = flying(options=OPTIONS)
    server = Around(lab.server)
    lab.server = server  # type: ignore[assignment]
    rate = lab.robot.figures()["link"]["rate_bytes_per_s"]
    for hours in (3, 900, 901):
        server.shift_ns = hours * 3600 * SECOND_NS
        # A clock step of more than SILENCE_NS ends the session; a new one begins.
        lab.sleep(6)
        got, position = fly(lab, 20, position)
        assert None not in got[1:]
        assert got[-1] == position - 5.0
    assert lab.robot.figures()["link"]["rate_bytes_per_s"] >= rate


@pytest.mark.parametrize("sent_us", [2**32 - 50_000, 2**32 - 1])
def test_stamps_that_wrap_and_messages_beyond_2_32(sent_us: int) -> None:
    ends = Exchange(1), Exchange(1)
    ends[0]._numbers[OBSERVATION] = 2**32 - 3
    now_ns = sent_us * MICROSECOND_NS
    for _ in range(5):
        ends[0].send(OBSERVATION, bytes(3000))
        whole = None
        for payload in ends[0].outbox(now_ns=now_ns):
            message = decode(payload)
            assert isinstance(message, Part)
            whole = ends[1].accept(message, now_ns=now_ns + 20 * MS) or whole
        assert whole == bytes(3000)
        for payload in ends[1].outbox(now_ns=now_ns + 20 * MS):
            ends[0].learn(decode(payload), now_ns=now_ns + 40 * MS)  # type: ignore[arg-type]
        assert ends[0].pace.round_trip_ns == 40 * MS
        assert ends[0].pace.queue_ns == 0
        now_ns += 100 * MS


def test_of_several_paths_one_is_dead() -> None:
    lab = Lab(ramp, **FAR)
    lab.robot = RobotEnd(
        1, {0: SERVER, 2: ("192.0.2.9", 1)}, lab.robot._session._link, OPTIONS, boot_id=1
    )
    one = Around(lab.robot)
    one.leaves = lambda each: each.socket != 2
    lab.robot = one  # type: ignore[assignment]
    lab.connect()
    got, _ = fly(lab, 5) if lab.infer(state(0.0)) else ([], 0)
    assert None not in got


def test_a_deadline_below_the_networks_jitter() -> None:
    """Each call is answered by its deadline; no row is skipped or repeated while rows remain."""
    way = "gamma(60ms, 90ms, 30ms)"
    options = RobotOptions("absolute", 20 * MS, step_ns=20 * MS, rows=5)
    lab = Lab(ramp, options, to_policy=way, to_robot=way)
    lab.connect()
    position, rows = 0.0, list[float]()
    for call in range(30):
        began_ns = lab.now_ns
        rows += lab.infer(state(position))["actions"][:5, 0].tolist()
        assert call == 0 or lab.now_ns - began_ns <= 20 * MS
        position = rows[-1] + 1.0
        lab.sleep(0.1)
    assert set(np.diff(rows)) <= {0.0, 1.0}
    assert rows[-1] > 75.0


def test_needed_observations_in_an_outage() -> None:
    lab, position = flying(options=replace(OPTIONS, spare_rows=2))
    lab.is_cut = True
    got, position = fly(lab, 20, position)
    assert None in got
    lab.is_cut = False
    lab.sleep(4)
    got, _ = fly(lab, 6, position)
    assert got[-1] is not None
    assert got[-1] > position


def test_under_a_low_rate_metadata_arrives_and_calls_go_on() -> None:
    """Metadata that take longer than a keep-alive interval are sent once, not restarted."""
    end = Exchange(1, rate_max=12_500.0)
    end.send(METADATA, bytes(50_000))
    streams = list[int]()
    for now_ns in range(0, 6 * SECOND_NS, 10 * MS):
        end.send(OBSERVATION, bytes(2000))
        sent = [decode(each) for each in end.outbox(now_ns=now_ns)]
        streams += [each.stream for each in sent if isinstance(each, Part)]
    assert streams.count(METADATA) >= 45
    assert streams[-1] == OBSERVATION


# -- figures -----------------------------------------------------------------------------------


def test_every_figure_is_a_metric() -> None:
    lab, _ = flying()
    lab.server.receive(Datagram(b"x", ROBOT), now_ns=lab.now_ns)
    lab.robot.receive(Datagram(b"x", SERVER), now_ns=lab.now_ns)
    of_process = {"cpu_s": 1.0, "kernel_drops": 0, "send_errors": 0}
    for end, own, more in (
        (lab.robot, metrics.JOIN, {"image_bytes": {"wrist": 900}}),
        (lab.server, metrics.SERVE, {}),
    ):
        exposed, unknown = families("policy", end.figures() | of_process | more, own)
        assert not unknown
        names = {each.name for each in exposed}
        assert {each.exposed().name for each in own} <= names


def holds_because(lab: Lab) -> list[str]:
    """Reasons of the holds so far."""
    return [each.reason for each in lab.robot.events() if isinstance(each, events.Holding)]


def long_ramp(seen: Any) -> Any:
    return {"actions": seen["state"][0] + np.arange(80.0)[:, None]}


def broken_line(seen: Any) -> Any:
    if seen["state"][0] > 25.0:
        raise RuntimeError("no memory")
    return ramp(seen)


@pytest.mark.parametrize(
    ("options", "cut", "pause_s", "reason"),
    [
        ({}, True, 0.0, "`policy serve` has reported 0 of the last 2 observations"),
        ({"policy": long_ramp}, True, 0.0, "no datagram from `policy serve` for 1.9 s"),
        ({"policy": broken_line}, False, 0.0, "error of the policy: RuntimeError: no memory"),
        ({}, True, 0.9, "the program made no call for 0.80 s"),
    ],
)
def test_a_hold_says_why_no_row_remains(
    options: dict[str, Any], cut: bool, pause_s: float, reason: str
) -> None:
    lab, position = flying(**options)
    lab.is_cut = cut
    lab.sleep(pause_s)
    fly(lab, 20, position)
    (why, *_) = holds_because(lab)
    assert why.startswith(reason)


def test_an_error_says_why_no_row_remains() -> None:
    lab, _ = flying(policy=broken_line)
    for _ in range(10):
        with suppress(NoActionError):
            lab.infer(state(30.0))
        lab.sleep(0.1)
    with pytest.raises(NoActionError, match="error of the policy: RuntimeError: no memory"):
        lab.infer(state(30.0))


def test_a_hold_says_that_the_policy_server_is_gone() -> None:
    """Although no observation was with the policy server when its connection was lost."""
    lab, position = flying()
    lab._ask = lambda *_: None  # type: ignore[method-assign]
    lab.policy_says(FrameType.CLOSED.value + b"killed", ("policy", lab.server._connections))
    fly(lab, 8, position)
    said = lab.robot.events()
    (why,) = (each.reason for each in said if isinstance(each, events.Holding))
    assert why == "error of the policy: no connection to the policy"
    assert sum(isinstance(each, events.PolicyFailed) for each in said) == 1


def test_a_policy_end_that_does_not_reply_is_logged_once() -> None:
    lab = Lab(ramp)
    lab.is_cut = True
    lab.say(FrameType.OPENED.value)
    lab.sleep(60)
    (said,) = (str(each) for each in lab.robot.events() if isinstance(each, events.NoWelcome))
    assert SERVER[0] in said
    lab.is_cut = False
    lab.sleep(5)
    assert first_row(lab.infer(state(1.0))) == 1.0


def test_a_hold_because_of_a_slow_policy_says_what_has_arrived() -> None:
    lab, position = flying()
    lab.thinking_ns = None
    fly(lab, 8, position)
    (why,) = holds_because(lab)
    assert why.startswith("`policy serve` has reported 2 of the last 2 observations")


def test_a_hold_because_chunks_are_later_than_their_rows_says_so() -> None:
    """Chunks of 200 ms arrive after 300 ms."""
    far = {"to_policy": "constant(150ms)", "to_robot": "constant(150ms)"}
    lab = Lab(options=RobotOptions("absolute", 150 * MS, rows=5), **far)
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    fly(lab, 10, 5.0)
    assert "the newest chunk has arrived after the time of its last row" in holds_because(lab)


def test_a_new_program_does_not_get_the_reason_of_the_one_before() -> None:
    lab, position = flying(policy=broken_line)
    fly(lab, 6, position)
    assert holds_because(lab)
    lab.thinking_ns = None
    lab.say(FrameType.OPENED.value, ("program", 2))
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)), ("program", 2))
    lab.sleep(61.0)
    (why,) = holds_because(lab)
    assert "memory" not in why
