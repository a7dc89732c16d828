"""Property-based search for a call without one answer by its deadline, and for skipped or repeated
rows, or rows executed too late.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from policy_lab import MS, Around, Lab, ramp, secured, secured_gate, state
from skytether.policy import values
from skytether.policy.players import Clocked, Freshest, Queue
from skytether.policy.robot import FrameType, RobotOptions
from skytether.policy.serving import PolicyEnd
from skytether.server.gate import PlainGate
from skytether.shared.base.units import SECOND_NS

ROWS, PLAYED, STEP_NS = 10, 5, 20 * MS
OPTIONS = RobotOptions("delta", 150 * MS, hold_ns=SECOND_NS, step_ns=STEP_NS, rows=PLAYED)
LATE_NS = OPTIONS.hold_ns + OPTIONS.deadline_ns + ROWS * 8 * MS
"""Longest allowed time from the planned to the actual execution of a row [ns]."""


@dataclass(frozen=True)
class Move:
    """Events between two calls."""

    jitter_ms: int = 0
    """Time by which the program calls later than after its rows [ms]."""
    is_cut: bool = False
    """Whether the network is cut until the next move."""
    frozen_ms: int = 0
    """Time for which the robot end is frozen, from the middle of the executed rows on [ms]."""
    frozen_call_ms: int = 0
    """Time for which the robot end is frozen, from the call on [ms]."""


def tagged(observation: Any) -> dict[str, Any]:
    """Policy whose rows are (call number, control step)."""
    call, step = (float(each) for each in observation["state"])
    return {"actions": np.array([[call, step + row] for row in range(ROWS)])}


MOVES = st.builds(
    Move,
    st.integers(-8, 8),
    st.booleans(),
    st.sampled_from([0, 0, 0, 0, 400, 5000]),
    st.sampled_from([0, 0, 0, 0, 400, 5000]),
)


def wait_for(lab: Lab, answers: int) -> None:
    lab.run(lab.now_ns + 100 * SECOND_NS, lambda: len(lab.answers) == answers)


@settings(deadline=None, max_examples=400)
@given(
    st.lists(MOVES, min_size=4, max_size=14),
    st.integers(0, 400),
    st.sampled_from([0, 0, 20, 60]),
    st.sampled_from([0.0, 0.02, 0.3, 2.0]),
    st.sampled_from([None, 0, 2]),
    st.sampled_from([STEP_NS, None]),
    st.integers(1, 99),
)
@example([Move()] * 8, 0, 0, 0.0, 0, STEP_NS, 1)
@example([Move(-3), Move(3)] * 4, 125, 0, 0.0, None, STEP_NS, 1)
@example([Move(-30), Move(30)] * 4, 125, 0, 0.0, None, None, 1)
@example([Move(frozen_call_ms=5000)] * 4, 0, 0, 0.0, None, STEP_NS, 1)
@example([Move(is_cut=True)] * 20 + [Move()] * 8, 100, 0, 0.0, None, STEP_NS, 1)
def test_the_promise(
    moves: list[Move],
    delay_ms: int,
    loss: int,
    thinking: float,
    spare: int | None,
    step_ns: int | None,
    seed: int,
) -> None:
    way = f"gamma({delay_ms}ms, {delay_ms + 30}ms, 30ms) & loss({loss}%)"
    options = replace(OPTIONS, spare_rows=spare, step_ns=step_ns)
    lab = Lab(tagged, options, to_policy=way, to_robot=way, thinking=thinking, seed=seed)
    robot: Any = Around(lab.robot)
    lab.robot = robot
    lab.connect()
    step, asked = 0, dict[int, tuple[int, int]]()
    for call, move in enumerate(moves, start=1):
        lab.is_cut = move.is_cut and call > 1
        lab.run(max(lab.now_ns, robot.until_ns))
        began_ns = lab.now_ns
        has_paused = bool(lab.answers) and began_ns - lab.answers[-1][0] > options.pause_ns
        asked[call] = began_ns, step
        lab.say(
            FrameType.MESSAGE.value + values.pack({"state": np.array([float(call), float(step)])})
        )
        robot.until_ns = lab.now_ns + move.frozen_call_ms * MS
        wait_for(lab, call + 1)
        answered_ns, said = lab.answers[-1]
        limit_ns = options.deadline_ns
        if call == 1 or has_paused:
            limit_ns = options.begin_ns if call == 1 else options.pause_ns
        assert answered_ns - began_ns <= max(limit_ns, move.frozen_call_ms * MS)
        rows: list[list[float]] = []
        if said[:1] == FrameType.MESSAGE:
            reply = values.unpack(said[1:])["actions"]
            assert reply.shape == (ROWS, 2)
            rows = [row for row in reply.tolist() if row[0]]
        assert [planned for _, planned in rows] == list(range(step, step + len(rows)))
        for row, (made_of, planned) in enumerate(rows):
            made_ns, made_at = asked[int(made_of)]
            plan_ns = made_ns + (int(planned) - made_at) * STEP_NS
            assert answered_ns + row * STEP_NS - plan_ns <= LATE_NS or made_of == 1 or not step_ns
        played_ns = PLAYED * STEP_NS + move.jitter_ms * MS
        lab.run(lab.now_ns + played_ns // 2)
        robot.until_ns = max(robot.until_ns, lab.now_ns + move.frozen_ms * MS)
        lab.run(lab.now_ns + played_ns - played_ns // 2)
        step += min(PLAYED, len(rows))
        assert len(lab.answers) == call + 1


DOES = st.sampled_from(["raises", "hangs", "thinks", "closes", "twice", "nonsense"])
DOES |= st.sampled_from(
    ["call", "call", "call", "calls", "reconnect", "cut", "mend", "server", "robot", "frozen"]
)


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.tuples(DOES, st.integers(0, 400)), min_size=5, max_size=30),
    st.sampled_from([OPTIONS, replace(OPTIONS, plays_on=True), replace(OPTIONS, step_ns=None)]),
    st.sampled_from([None, 0, 3]),
    st.sampled_from([Clocked, Freshest, partial(Queue, "average")]),
    st.sampled_from([Lab, secured]),
    st.integers(1, 99),
)
def test_whatever_happens_each_call_gets_one_answer_by_its_deadline(
    does: list[tuple[str, int]],
    options: RobotOptions,
    spare: int | None,
    player: Any,
    made: Any,
    seed: int,
) -> None:
    way = "gamma(20ms, 60ms, 30ms) & loss(10%)"
    options = replace(options, spare_rows=spare, player=player, begin_ns=2 * SECOND_NS)
    lab = made(options=options, to_policy=way, to_robot=way, seed=seed)
    world, program = World(lab, seed), ("program", 1)
    lab.say(FrameType.OPENED.value, program)
    lab.sleep(2)
    for number, (what, wait_ms) in enumerate(does, start=2):
        if what == "reconnect":
            program = "program", number
            lab.say(FrameType.OPENED.value, program)
        calls = {"call": 1, "calls": 2}.get(what, 0)
        if not calls:
            world.do(what)
        before, began_ns = len(lab.answers), lab.now_ns
        for _ in range(calls):
            lab.say(FrameType.MESSAGE.value + values.pack(state(float(number))), program)
        assert lab.robot._program
        # A frozen robot end may not have seen yet that a new program has connected.
        is_first = lab.robot._program.newest < 0 or lab.now_ns < world.until_ns
        longest_ns = options.begin_ns if is_first else options.deadline_ns
        if lab.answers and began_ns - lab.answers[-1][0] > options.pause_ns:
            longest_ns = max(longest_ns, options.pause_ns)  # a new episode may begin
        limit_ns = max(began_ns, world.until_ns) + longest_ns + 1
        lab.run(limit_ns if calls else began_ns)
        answers = [each for each in [*lab.answers][before:] if not is_metadata(each[1])]
        assert len(answers) == calls
        lab.sleep(wait_ms / 1e3)


def is_metadata(said: bytes) -> bool:
    return b"scripted" in said


class World:
    """Policy, network and processes around a robot end, with faults."""

    def __init__(self, lab: Lab, seed: int) -> None:
        self._lab, self._rng = lab, np.random.default_rng(seed)
        self.until_ns = 0

    def _draw(self) -> int:
        return int(self._rng.integers(2**32))

    def do(self, what: str) -> None:
        lab = self._lab
        connection = "policy", lab.server._connections
        match what:
            case "cut" | "mend":
                lab.is_cut = what == "cut"
            case "server":
                is_plain = isinstance(lab.server._gate, PlainGate)
                gate = PlainGate() if is_plain else secured_gate()
                lab.server = PolicyEnd(gate, boot_id=int(self._rng.integers(99)), draw=self._draw)
            case "robot" | "frozen":
                name = "robot" if what == "robot" else "server"
                end: Any = getattr(lab, name)
                end = end if isinstance(end, Around) else Around(end)
                end.until_ns = lab.now_ns + int(self._rng.integers(3000)) * MS
                setattr(lab, name, end)
                self.until_ns = lab.robot.until_ns if name == "robot" else self.until_ns
            case "raises":
                lab.policy_says(FrameType.ERROR.value + b"no memory", connection)
            case "hangs" | "thinks":
                lab.thinking_ns = None if what == "hangs" else int(self._rng.integers(2000)) * MS
            case "closes":
                lab.policy_says(FrameType.CLOSED.value, connection)
            case "twice":
                lab.policy_says(FrameType.MESSAGE.value + values.pack(ramp(state(0.0))), connection)
            case "nonsense":
                lab.policy_says(FrameType.MESSAGE.value + self._rng.bytes(30), connection)
