"""The promise, searched for counterexamples: each call is answered by its deadline, no row is left
out or played twice while there is no gap, and nothing old is played after one.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from policy_lab import MS, Around, Lab
from skytether.policy import values
from skytether.policy.robot import RobotOptions, Said
from skytether.shared.base.units import SECOND_NS

ROWS, PLAYED, STEP_NS = 10, 5, 20 * MS
OPTIONS = RobotOptions("delta", 150 * MS, hold_ns=SECOND_NS, step_ns=STEP_NS, rows=PLAYED)
LATE_NS = OPTIONS.hold_ns + OPTIONS.deadline_ns + ROWS * 8 * MS
"""Longest time after that for which it was planned at which a row is played [ns]."""


@dataclass(frozen=True)
class Move:
    """What happens until the next call."""

    jitter_ms: int = 0
    """Time by which the program takes longer than its rows [ms]."""
    is_cut: bool = False
    """Whether nothing passes the network until the next move."""
    frozen_ms: int = 0
    """Time for which the robot's end does nothing, from the middle of the rows on [ms]."""
    frozen_call_ms: int = 0
    """The same from the call on."""


def tagged(observation: Any) -> dict[str, Any]:
    """Rows that say from which call they are, and for which step of the robot."""
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
    st.integers(1, 99),
)
@example([Move()] * 8, 0, 0, 0.0, 0, 1)
@example([Move(-3), Move(3)] * 4, 125, 0, 0.0, None, 1)
@example([Move(frozen_call_ms=5000)] * 4, 0, 0, 0.0, None, 1)
@example([Move(is_cut=True)] * 20 + [Move()] * 8, 100, 0, 0.0, None, 1)
def test_the_promise(
    moves: list[Move], delay_ms: int, loss: int, thinking: float, spare: int | None, seed: int
) -> None:
    way = f"gamma({delay_ms}ms, {delay_ms + 30}ms, 30ms) & loss({loss}%)"
    options = replace(OPTIONS, spare_rows=spare)
    lab = Lab(tagged, options, to_policy=way, to_robot=way, thinking=thinking, seed=seed)
    robot: Any = Around(lab.robot)
    lab.robot = robot
    lab.connect()
    step, asked = 0, dict[int, tuple[int, int]]()
    for call, move in enumerate(moves, start=1):
        lab.is_cut = move.is_cut and call > 1
        lab.run(max(lab.now_ns, robot.until_ns))
        began_ns = lab.now_ns
        asked[call] = began_ns, step
        lab.say(Said.MESSAGE.value + values.pack({"state": np.array([float(call), float(step)])}))
        robot.until_ns = lab.now_ns + move.frozen_call_ms * MS
        wait_for(lab, call + 1)
        answered_ns, said = lab.answers[-1]
        limit_ns = options.deadline_ns if call > 1 else options.begin_ns
        assert answered_ns - began_ns <= max(limit_ns, move.frozen_call_ms * MS)
        rows: list[list[float]] = []
        if said[:1] == Said.MESSAGE:
            reply = values.unpack(said[1:])["actions"]
            assert reply.shape == (ROWS, 2)
            rows = [row for row in reply.tolist() if row[0]]
        assert [planned for _, planned in rows] == list(range(step, step + len(rows)))
        for row, (made_of, planned) in enumerate(rows):
            made_ns, made_at = asked[int(made_of)]
            plan_ns = made_ns + (int(planned) - made_at) * STEP_NS
            assert answered_ns + row * STEP_NS - plan_ns <= LATE_NS or made_of == 1
        played_ns = PLAYED * STEP_NS + move.jitter_ms * MS
        lab.run(lab.now_ns + played_ns // 2)
        robot.until_ns = max(robot.until_ns, lab.now_ns + move.frozen_ms * MS)
        lab.run(lab.now_ns + played_ns - played_ns // 2)
        step += min(PLAYED, len(rows))
        assert len(lab.answers) == call + 1
