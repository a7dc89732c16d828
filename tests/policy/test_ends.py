"""Robot end and policy end in virtual time: each call is answered by its deadline."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy_lab import MS, OPTIONS, Lab, first_row, keyed, ramp, secured, state
from skytether.policy import events, values
from skytether.policy.images import Compressor
from skytether.policy.players import PLAYERS, Clocked, Freshest
from skytether.policy.robot import LINE, FrameType, RobotOptions
from skytether.policy.schedule import Kind, Schedule
from skytether.policy.serving import PolicyEnd
from skytether.policy.virtual import ROBOT, SERVER, NoActionError
from skytether.server.gate import PlainGate
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.wire.drop import ProtocolError


def test_without_a_network_the_answer_is_the_policys_own() -> None:
    lab = Lab(ramp)
    assert lab.connect() == {"name": "scripted"}
    for position in (0.0, 5.0, 7.0):
        reply = lab.infer(state(position))
        assert reply["actions"].dtype == np.float32
        assert np.array_equal(reply["actions"], ramp(state(position))["actions"])
        assert reply["time"] == 3
        lab.sleep(0.1)


@settings(deadline=None, max_examples=30)
@given(
    st.integers(0, 400),
    st.sampled_from([0, 5, 20, 60]),
    st.integers(0, 300),
    st.lists(st.booleans(), min_size=8, max_size=8),
    st.integers(1, 99),
)
def test_every_call_is_answered_by_its_deadline(
    delay_ms: int, loss: int, thinking_ms: int, cuts: list[bool], seed: int
) -> None:
    way = f"gamma({delay_ms}ms, {delay_ms + 30}ms, 30ms) & loss({loss}%)"
    lab = Lab(ramp, OPTIONS, to_policy=way, to_robot=way, thinking=thinking_ms / 1e3, seed=seed)
    lab.connect()
    for answers, cut in enumerate(cuts):
        lab.is_cut = cut and answers > 0
        before, began_ns = len(lab.answers), lab.now_ns
        with suppress(NoActionError):
            lab.infer(state(1.0))
        limit_ns = OPTIONS.deadline_ns if answers else OPTIONS.begin_ns
        assert lab.answers[-1][0] - began_ns <= limit_ns
        assert len(lab.answers) == before + 1
        lab.sleep(0.06)


def test_a_late_answer_is_cut_to_now_and_the_robot_goes_on_without_a_jump() -> None:
    """Round-trip time 250 ms, 100 ms of rows executed per answer: no row is skipped or repeated."""
    lab = Lab(ramp, to_policy="constant(125ms)", to_robot="constant(125ms)")
    lab.connect()
    position, played = 0.0, list[float]()
    for _ in range(20):
        rows = lab.infer(state(position))["actions"][:5, 0].tolist()
        played += rows
        position = rows[-1] + 1.0
        lab.sleep(0.1)
    assert np.diff(played).max() <= 1.0
    assert np.diff(played).min() >= 0.0
    assert played[-1] > 60.0
    kinds = lab.robot.figures()["answers"]
    assert kinds["rest"] > 10


@pytest.mark.parametrize("actions", ["absolute", "delta"])
def test_without_rows_the_robot_is_held_then_gets_an_error_and_begins_where_it_is(
    actions: Any,
) -> None:
    options = RobotOptions(actions, 150 * MS, hold_ns=SECOND_NS, step_ns=20 * MS)
    lab = Lab(ramp, options)
    lab.connect()
    assert first_row(lab.infer(state(1.0))) == 1.0
    lab.sleep(0.1)
    lab.is_cut = True
    rest = lab.infer(state(6.0))["actions"][:, 0].tolist()
    held = 10.0 if actions == "absolute" else 0.0
    assert rest == [6.0, 7.0, 8.0, 9.0, 10.0] + [held] * 5
    lab.sleep(0.1)
    for _ in range(3):
        assert lab.infer(state(11.0))["actions"][:, 0].tolist() == [held] * 10
        lab.sleep(0.1)
    lab.sleep(1)
    with pytest.raises(NoActionError, match="no action from the policy for"):
        lab.infer(state(11.0))
    lab.is_cut = False
    lab.sleep(4)
    reply = lab.infer(state(11.0))
    assert reply["actions"][:, 0].tolist() == ramp(state(11.0))["actions"][:, 0].tolist()


def test_a_chunk_from_before_an_outage_is_not_played_after_it() -> None:
    lab = Lab(ramp, thinking=3.0)
    lab.connect()
    lab.infer(state(0.0))
    for _ in range(15):
        try:
            row = first_row(lab.infer(state(50.0)))
        except RuntimeError:
            row = 0.0
        lab.sleep(0.1)
    # Its observation was made during the pause, so its first row is the next one.
    assert row in (0.0, 9.0) or row >= 50.0


def test_an_error_of_the_policy_leaves_the_rest_then_an_error() -> None:
    def fails(observation: Any) -> Any:
        if observation["state"][0] > 0:
            raise RuntimeError("CUDA out of memory")
        return ramp(observation)

    lab = Lab(fails)
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    assert first_row(lab.infer(state(5.0))) == 5.0  # of the earlier chunk
    assert any("CUDA out of memory" in str(event) for event in lab.robot.events())


@pytest.mark.parametrize(
    "reply",
    [
        {},
        {"actions": np.zeros((0, 2))},
        {"actions": np.array([[np.nan]])},
        {"actions": np.zeros((2000, 1))},
        {"actions": "run"},
        {"actions": [[1.0], [2.0, 3.0]]},
        {"actions": []},
        [1, 2],
    ],
)
def test_a_reply_without_rows_is_none(reply: Any) -> None:
    lab = Lab(lambda _: reply, RobotOptions("absolute", 150 * MS, begin_ns=SECOND_NS))
    lab.connect()
    with pytest.raises(NoActionError):
        lab.infer(state(0.0))


def test_rows_may_be_lists() -> None:
    lab = Lab(lambda seen: {"actions": ramp(seen)["actions"].tolist()})
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.1)
    lab.is_cut = True
    assert lab.infer(state(5.0))["actions"][:5].tolist() == [[row] for row in range(5, 10)]


def test_rows_of_another_shape_than_before_are_refused() -> None:
    lab = Lab(lambda seen: {"actions": np.zeros((5, 2 + int(seen["state"][0])))})
    lab.connect()
    lab.infer(state(0.0))
    assert lab.infer(state(1.0))["actions"].shape == (5, 2)


def test_while_the_policy_thinks_a_newer_observation_replaces_one_that_waits() -> None:
    lab = Lab(ramp, thinking=0.9)
    lab.connect()
    for position in range(8):
        with suppress(NoActionError):
            lab.infer(state(float(position)))
        lab.sleep(0.05)
    lab.sleep(2)
    assert lab.server.figures()["observations_replaced"] >= 2
    assert [int(each["state"][0]) for each in lab.asked][-1] == 7


def test_while_a_needed_chunk_is_under_way_no_other_observation_is_sent() -> None:
    """Chunks of 30 rows arrive after 4 steps, and are needed when 13 rows remain."""

    def long_ramp(observation: Any) -> dict[str, Any]:
        return {"actions": float(observation["state"][0]) + np.arange(30.0)[:, None]}

    options = RobotOptions("absolute", MS, step_ns=20 * MS, plays_on=True, spare_rows=10)
    far = {"to_policy": "constant(30ms)", "to_robot": "constant(30ms)"}
    lab = Lab(long_ramp, options, **far)
    lab.connect()
    lab.infer(state(0.0))
    for _ in range(85):
        began_ns = lab.now_ns
        lab.infer(state(0.0))
        lab.run(began_ns + 20 * MS)
    assert lab.robot.figures()["answers"]["hold"] == 0
    assert len(lab.asked) == 5


def test_observations_that_are_not_needed_are_not_sent() -> None:
    def flown(spare: int | None) -> tuple[int, dict[str, int]]:
        options = RobotOptions("absolute", 150 * MS, step_ns=20 * MS, spare_rows=spare)
        lab = Lab(ramp, to_policy="constant(20ms)", to_robot="constant(20ms)", options=options)
        lab.connect()
        position = 0.0
        for _ in range(60):
            position = first_row(lab.infer(state(position))) + 1.0
            lab.sleep(0.02)
        return lab.server.figures()["observations"], lab.robot.figures()["answers"]

    every, _ = flown(None)
    some, answers = flown(2)
    assert every == 60
    assert some < 20
    assert answers["hold"] == answers["error"] == 0


@pytest.mark.parametrize("player", PLAYERS.values(), ids=PLAYERS)
def test_each_rule_of_merging_plays_every_row_once(player: Any) -> None:
    options = RobotOptions("absolute", 150 * MS, step_ns=20 * MS, player=player)
    lab = Lab(ramp, to_policy="constant(50ms)", to_robot="constant(50ms)", options=options)
    lab.connect()
    position, played = 0.0, list[float]()
    for _ in range(10):
        rows = lab.infer(state(position))["actions"][:5, 0].tolist()
        played += rows
        position = rows[-1] + 1.0
        lab.sleep(0.1)
    assert np.allclose(np.diff(played), 1.0)


def test_means_of_whole_numbers_are_rounded() -> None:
    schedule = Schedule(PLAYERS["average"](), "absolute", "actions", 20 * MS, 1, SECOND_NS, 0)
    for call, value in ((1, 0), (2, 1)):
        schedule.accept(call, 0, 0.0, {"actions": np.full((4, 1), value)}, now_ns=0)
    actions = schedule.answer(Kind.FRESH, now_ns=0).reply["actions"]  # of 0.7
    assert actions.dtype.kind == "i"
    assert (actions == 1).all()


def test_the_policy_is_given_the_rows_that_the_robot_will_play() -> None:
    moves_on = replace(OPTIONS, plays_on=True)
    far = {"to_policy": "constant(60ms)", "to_robot": "constant(60ms)"}
    lab = Lab(ramp, moves_on, gives_rows=True, **far)
    lab.connect()
    lab.infer(state(0.0))
    lab.sleep(0.04)
    lab.infer(state(2.0))
    seen = lab.asked[-1]
    assert seen["delay_steps"] == 6
    assert seen["coming"][:, 0].tolist() == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert seen["committed"][:, 0].tolist() == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


def test_while_a_robot_waits_for_its_chunk_no_row_is_committed() -> None:
    lab = Lab(ramp, to_policy="constant(60ms)", to_robot="constant(60ms)", gives_rows=True)
    lab.connect()
    for position in (0.0, 2.0, 4.0):
        lab.infer(state(position))
        lab.sleep(0.04)
    assert lab.asked[-1]["delay_steps"] == 0
    assert len(lab.asked[-1]["committed"]) == 0
    assert lab.asked[-1]["coming"][0, 0] == 4.0


def test_the_time_in_which_a_policy_compiles_does_not_count() -> None:
    moves_on = replace(OPTIONS, plays_on=True)
    lab = Lab(ramp, moves_on, gives_rows=True, thinking=20.0)
    lab.connect()
    lab.infer(state(0.0))
    lab.thinking_ns = 40 * MS
    for position in range(1, 4):
        lab.sleep(0.02)
        lab.infer(state(float(position)))
        lab.sleep(0.06)
    assert lab.asked[-1]["delay_steps"] == 2


def test_a_policy_end_restarted_with_other_options_gives_rows() -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(0.0))
    lab.server = PolicyEnd(PlainGate(), boot_id=9, draw=lambda: 77, gives_rows=True)
    for _ in range(60):
        lab.sleep(0.1)
        with suppress(NoActionError):
            lab.infer(state(1.0))
    assert "delay_steps" in lab.asked[-1]


def test_images_and_their_bytes() -> None:
    lab = Lab(ramp, compress=Compressor(64))
    lab.connect()
    image = np.zeros((240, 320, 3), np.uint8)
    lab.infer(state(0.0) | {"camera": image})
    assert lab.asked[-1]["camera"].shape == (64, 64, 3)


def test_an_observation_that_is_too_large_is_an_error_by_name() -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(0.0))
    with pytest.raises(NoActionError, match="5000"):
        lab.infer({"state": np.zeros(1), "camera": np.zeros(5_000_000, np.uint8)})
    assert first_row(lab.infer(state(0.0))) == 0.0


def test_the_step_is_measured_by_the_time_between_calls() -> None:
    options = RobotOptions("absolute", 150 * MS, rows=5)
    lab = Lab(ramp, options)
    lab.connect()
    for _ in range(12):
        lab.infer(state(0.0))
        lab.sleep(0.1)
    assert lab.robot.figures()["step_s"] == pytest.approx(0.02)


def test_a_new_program_plays_nothing_of_the_one_before() -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(100.0))
    lab.is_cut = True
    lab.say(FrameType.CLOSED.value)
    lab.say(FrameType.OPENED.value, ("program", 2))
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)), ("program", 2))
    lab.run(lab.now_ns + 61 * SECOND_NS)
    assert lab.answers[-1][1][:1] == FrameType.ERROR


def test_a_lost_connection_to_the_policy_is_opened_again() -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(0.0))
    lab.policy_says(FrameType.CLOSED.value + b"gone", ("policy", 1))
    lab.sleep(2)
    assert first_row(lab.infer(state(3.0))) == 3.0


def test_a_server_that_was_restarted_is_found_again() -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(0.0))
    lab.server = Lab(boot_ids=(1, 10)).server
    lab.sleep(5)
    assert first_row(lab.infer(state(3.0))) == 3.0


# -- keys --------------------------------------------------------------------------------------


def test_with_keys_nothing_is_readable_and_replays_change_nothing() -> None:
    lab = secured(to_policy="constant(20ms)", to_robot="constant(20ms)")
    lab.connect()
    for position in range(5):
        assert (
            first_row(lab.infer({"state": np.array([float(position)]), "prompt": "secret!"}))
            == position
        )
        lab.sleep(0.1)
    assert not any(b"secret!" in payload for _, payload in lab.wire)
    before, answers = lab.server.figures()["observations"], len(lab.answers)
    for peer, payload in list(lab.wire):
        if peer == SERVER:
            lab.server.receive(Datagram(payload, ("203.0.113.9", 9), 0), now_ns=lab.now_ns)
        else:
            lab.robot.receive(Datagram(payload, SERVER, 0), now_ns=lab.now_ns)
    assert lab.server.figures()["observations"] == before
    assert len(lab.answers) == answers
    assert first_row(lab.infer(state(9.0))) == 9.0


def test_another_key_gets_no_session() -> None:
    lab = secured(keyed(2))
    lab.say(FrameType.OPENED.value)
    lab.sleep(5)
    assert not lab.answers
    assert lab.server.figures()["robots"] == 0


@settings(deadline=None, max_examples=60)
@given(st.lists(st.binary(max_size=60) | st.binary(max_size=20).map(lambda b: b"\x9b\x01\x14" + b)))
def test_hostile_datagrams_change_nothing(payloads: list[bytes]) -> None:
    lab = Lab(ramp)
    lab.connect()
    lab.infer(state(0.0))
    for payload in payloads:
        lab.server.receive(Datagram(payload, ROBOT, 0), now_ns=lab.now_ns)
        lab.server.receive(Datagram(payload, ("203.0.113.9", 9), 0), now_ns=lab.now_ns)
        lab.robot.receive(Datagram(payload, SERVER, 0), now_ns=lab.now_ns)
        lab.say(FrameType.MESSAGE.value + payload)
    lab.run(lab.now_ns)
    lab.sleep(0.2)
    assert first_row(lab.infer(state(2.0))) == 2.0


def test_without_keys_a_second_robot_with_the_same_number_is_refused() -> None:
    lab = Lab(ramp)
    lab.connect()
    other = Lab(ramp, boot_ids=(8, 2)).robot
    other.wake(now_ns=lab.now_ns)
    for payload, _, _ in other.outbox():
        lab.server.receive(Datagram(payload, ("203.0.113.9", 9), 0), now_ns=lab.now_ns)
    answer = lab.server.outbox()[-1]
    other.receive(Datagram(answer.payload, SERVER, 0), now_ns=lab.now_ns)
    assert "--id" in str(other.events()[-1])


# -- what a review found -----------------------------------------------------------------------


def test_what_comes_over_udp_is_never_taken_for_the_policy() -> None:
    lab = Lab()
    lab.connect()
    lab.infer(state(0.0))
    for said in (b"+", b"m" + values.pack(ramp(state(66.0))), b"-"):
        lab.server.receive(Datagram(said, ("203.0.113.9", 1), LINE), now_ns=lab.now_ns)
    lab.sleep(0.1)
    assert first_row(lab.infer(state(5.0))) == 5.0
    assert not any("66" in str(event) for event in lab.server.events())


def test_a_first_chunk_is_not_executed_after_its_call_was_answered_with_an_error() -> None:
    options = RobotOptions("absolute", 150 * MS, begin_ns=SECOND_NS, step_ns=20 * MS)
    lab = Lab(options=options, thinking=1.5)
    lab.connect()
    with pytest.raises(NoActionError):
        lab.infer(state(1.0))
    lab.thinking_ns = 0
    assert first_row(lab.infer(state(50.0))) == 50.0  # the robot was moved meanwhile


def test_the_hold_action_is_the_last_row_that_was_executed() -> None:
    schedule = Schedule(Clocked(), "absolute", "actions", 20 * MS, 1, SECOND_NS, 0)
    first = {"actions": np.arange(6.0)[:, None]}
    schedule.accept(1, 0, 0.0, first, now_ns=0)
    assert schedule.answer(Kind.FRESH, now_ns=0).left == 6
    schedule.accept(2, 1, 0.0, {"actions": np.array([[100.0], [101.0]])}, now_ns=200 * MS)
    answer = schedule.answer(Kind.REST, now_ns=200 * MS)
    assert answer.kind is Kind.HOLD
    assert answer.reply["actions"][0, 0] == 5.0


def test_the_hold_action_is_no_row_that_was_discarded_before_it_was_executed() -> None:
    """The robot has executed 3 of 6 rows, then the call takes longer than `late_ns`."""
    schedule = Schedule(Clocked(), "absolute", "actions", 20 * MS, 1, SECOND_NS, 0)
    schedule.accept(1, 0, 0.0, {"actions": np.arange(6.0)[:, None]}, now_ns=0)
    schedule.answer(Kind.FRESH, now_ns=0)
    schedule.stand(now_ns=60 * MS)
    schedule.go(now_ns=2 * SECOND_NS)
    answer = schedule.answer(Kind.REST, now_ns=2 * SECOND_NS)
    assert answer.kind is Kind.HOLD
    assert answer.reply["actions"].tolist() == [[2.0]] * 6


def test_rows_of_a_slow_robot_remain_while_its_step_is_measured() -> None:
    """Eight rows of 200 ms, and a policy that takes longer than the deadline."""
    policy = {"actions": np.arange(16.0)[:, None]}
    lab = Lab(lambda _: policy, RobotOptions("absolute", 150 * MS, rows=8), thinking=0.3)
    lab.connect()
    lab.infer(state(0.0))
    for _ in range(5):
        lab.sleep(1.6)
        assert first_row(lab.infer(state(0.0))) == 8.0


def test_with_needed_a_program_gets_the_rows_that_it_executes() -> None:
    """Chunks of 8 rows, of which 5 are executed: 3 rows and two hold actions are not enough."""
    lab = Lab(
        lambda seen: {"actions": ramp(seen)["actions"][:8]},
        RobotOptions("absolute", 150 * MS, rows=5, spare_rows=2),
    )
    lab.connect()
    for position in (0.0, 5.0, 10.0, 15.0):
        rows = lab.infer(state(position))["actions"][:5, 0]
        assert rows.tolist() == [position + row for row in range(5)]
        lab.sleep(0.1)


def test_rows_keep_their_fractions_when_the_policy_returns_whole_numbers_next() -> None:
    chunks = iter([np.arange(6)[:, None] + 0.5, np.array([[7], [8]])])
    options = RobotOptions("absolute", 150 * MS, player=Freshest)
    lab = Lab(lambda _: {"actions": next(chunks)}, options)
    lab.connect()
    got = []
    for _ in range(4):
        got.append(first_row(lab.infer(state(0.0))))
        lab.sleep(0.02)
    assert got == [0.5, 7.0, 8.0, 3.5]


def test_metadata_that_are_too_large_are_refused_by_name() -> None:
    lab = Lab()
    lab.robot.wake(now_ns=0)
    lab.run(MS)
    metadata = values.pack("x" * values.BYTES_MAX)
    lab.policy_says(FrameType.OPENED.value + metadata, ("policy", 1))
    (reason,) = [
        each.reason for each in lab.server.events() if isinstance(each, events.UpstreamLost)
    ]
    assert f"metadata of {len(metadata)} B" in reason


@pytest.mark.parametrize(
    ("rows", "way_ms", "delay"), [(1, 65, 7), (1, 60, 7), (2, 65, 8), (3, 65, 9), (2, 60, 8)]
)
def test_committed_rows_are_executed_also_with_several_chunks_under_way(
    rows: int, way_ms: int, delay: int
) -> None:
    """A chunk that arrives between two calls, or just after one, is used from the next call on."""
    rng, committed = np.random.default_rng(1), list[list[float]]()

    def continued(observation: Any) -> Any:
        rows = observation.get("committed", np.zeros((0, 1)))
        committed.append(rows[:, 0].tolist())
        return {"actions": np.concatenate([rows, rng.uniform(size=(12 - len(rows), 1))])}

    options = RobotOptions("absolute", MS, step_ns=20 * MS, rows=rows, plays_on=True)
    ways = {"to_policy": f"constant({way_ms}ms)", "to_robot": f"constant({way_ms}ms)"}
    lab, executed = Lab(continued, options, gives_rows=True, **ways), list[float]()
    lab.connect()
    lab.infer(state(0.0))
    committed.clear()
    for _ in range(40):
        began_ns = lab.now_ns
        executed += lab.infer(state(0.0))["actions"][:rows, 0].tolist()
        lab.run(began_ns + rows * 20 * MS)
    assert [len(each) for each in committed[20:]] == [delay] * (len(committed) - 20)
    assert len(committed) >= 35
    for call, coming in enumerate(committed[20:33], start=20):
        assert coming == executed[call * rows : call * rows + delay]


def test_chunks_under_way_to_the_previous_program_are_not_predicted() -> None:
    far = {"to_policy": "constant(60ms)", "to_robot": "constant(60ms)"}
    lab = Lab(ramp, replace(OPTIONS, plays_on=True), gives_rows=True, **far)
    lab.connect()
    lab.infer(state(0.0))
    lab.say(FrameType.MESSAGE.value + values.pack(state(1.0)))
    lab.sleep(0.1)  # its chunk is under way
    lab.say(FrameType.OPENED.value, ("program", 2))
    lab.say(FrameType.MESSAGE.value + values.pack(state(9.0)), ("program", 2))
    lab.sleep(0.2)
    assert lab.asked[-1]["state"][0] == 9.0
    assert "coming" not in lab.asked[-1]
    assert lab.asked[-1]["delay_steps"] == 6


@pytest.mark.parametrize(
    "coming",
    [
        *(np.array(1.0), "rows", [1, 2], 3, ["actions", 0, 0, np.array(1.0)]),
        *(["actions", 0, 0, "rows"], ["actions", 0.5, 0, None], [3, 0, 0, None]),
        ["actions", 0, 0, np.zeros((0, 2))],
    ],
)
def test_rows_that_a_robot_cannot_have_are_refused(coming: Any) -> None:
    lab = Lab(gives_rows=True)
    lab.connect()
    lab.infer(state(0.0))
    robot = lab.server._robots[1]
    message = values.pack([9, 1, 1, coming, values.pack(state(3.0))])
    with pytest.raises(ProtocolError):
        lab.server._observe(robot, message, lab.now_ns)


def test_an_observation_with_rows_of_another_shape_than_the_policys_is_dropped() -> None:
    lab = Lab(gives_rows=True, thinking=None)
    lab.connect()
    robot = lab.server._robots[1]
    for call, row in ((9, np.zeros((1, 2))), (10, np.zeros((3, 1)))):
        message = values.pack([call, 1, 9, ["actions", 5, 0, row], values.pack(state(3.0))])
        lab.server._observe(robot, message, lab.now_ns)
        lab.policy_says(FrameType.MESSAGE.value + values.pack(ramp(state(0.0))), ("policy", 1))
    lab.server._observe(
        robot, values.pack([11, 1, 9, ["actions", 8, 0, np.zeros((9, 2))], b"\x80"]), 0
    )
    assert lab.server.figures()["dropped"] == {"field": 1}


@pytest.mark.parametrize(
    "chunk",
    [
        [1, b"", [[[[[]]]]]],
        [1, values.pack({"actions": 1}), 3],
        [1, b"", None],
        ["1", b"", ""],
    ],
)
def test_a_chunk_with_other_fields_is_refused(chunk: Any) -> None:
    lab = Lab()
    lab.connect()
    with pytest.raises(ProtocolError):
        lab.robot._accept(values.pack(chunk), lab.now_ns)


def test_an_array_without_numbers_but_with_a_huge_shape_is_no_chunk() -> None:
    lab = Lab(lambda _: {"actions": np.zeros((1, 2**40, 0), np.uint8)})
    lab.connect()
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)))
    lab.sleep(1.0)
    assert len(lab.answers) == 1  # the metadata alone, and no exception


def test_a_number_that_is_infinite_as_a_double_is_refused() -> None:
    with pytest.raises(values.ValueRefused):
        values.pack(np.array([1.0], np.longdouble))
