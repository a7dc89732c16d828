"""`Networked` and the ends of `skytether policy`: equal decisions, and equal scores."""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from bench.tasks import Pendulum
from policy_lab import process
from skytether.gym import Chunk, Networked
from skytether.lab.engine.intervals import interval
from skytether.policy import Robot
from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import Emulated, NoActionError
from skytether.shared.base.units import seconds_to_ns

TASK = Pendulum()
STEP_NS = seconds_to_ns(TASK.step_s)
IDLE = np.array([1e-7], np.float32)
"""Action that `Moving` takes for none."""


def policy(observation: dict[str, Any]) -> dict[str, Any]:
    rows = TASK.plan(observation["state"], observation.get("committed", np.zeros((0, 1))))
    return {"actions": rows.astype(np.float32)}


class Moving(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Pendulum that does not move before its first action, as a robot that waits for it."""

    def __init__(self) -> None:
        super().__init__(TASK.make())
        self.actions, self.rewards = list[float](), list[float]()

    def reset(self, **options: Any) -> Any:
        self.seen = self.env.reset(**options)
        return self.seen

    def step(self, action: Any) -> Any:
        if not self.actions and action == IDLE:
            return self.seen[0], 0.0, False, False, {}
        outcome = self.env.step(action)
        self.actions.append(float(action[0]))
        self.rewards.append(float(outcome[1]))
        return outcome


def evaluated(
    seed: int, steps: int, *, knows: bool = True, size: int = 0, **options: Any
) -> Moving:
    """Run of the policy with `Networked`; its first chunk takes no thinking time.

    The policy answers each observation once, and gets the committed rows if it `knows` them. Once
    the robot moves, an observation has `size` B: a deployed robot that waits sends only one.
    """
    world, answered = Moving(), -1
    if size:
        options["compress"] = lambda _: size if world.actions else 0
    env = Networked(world, step_s=TASK.step_s, idle=IDLE, **options)
    observation, info = env.reset(seed=seed)
    while len(world.actions) < steps:
        network = info["network"]
        if world.actions and network["step"] == answered:
            observation, *_, info = env.step(None)
            continue
        answered = network["step"]
        committed = network["committed"][: network["committed_rows"] if knows else 0]
        rows = policy({"state": observation, "committed": committed})["actions"]
        is_first = network["generation"] == 0
        observation, *_, info = env.step(Chunk(rows, thought_ns=0) if is_first else rows)
    return world


def deployed(
    seed: int,
    steps: int,
    thinking: float,
    way: str = "none",
    rows: int = 1,
    *,
    knows: bool = True,
    size: int = 0,
) -> Moving:
    """Run of the policy with `RobotEnd` and `PolicyEnd`, with a call every `rows` steps.

    Args:
        knows: whether the policy gets the committed rows.
        size: size of other content of each observation [B].
    """
    world = Moving()
    observation, _ = world.reset(seed=seed)
    options = RobotOptions("absolute", 1, step_ns=STEP_NS, rows=rows, plays_on=True)
    network = {"to_policy": way, "to_robot": way, "seed": seed}
    ends = Emulated(policy, options, thinking=0.0, gives_rows=knows, **network)  # type: ignore[arg-type]
    ends.connect()
    while len(world.actions) < steps:
        try:
            seen = {"state": observation, "other": bytes(size)}
            actions = ends.infer(seen)["actions"][:rows]
        except NoActionError:
            actions = np.zeros((rows, 1), np.float32)
        if not world.actions:
            began_ns, ends.thinking_ns = ends.now_ns, seconds_to_ns(thinking)
        for action in actions:
            observation, *_ = world.step(action)
            ends.run(began_ns + len(world.actions) * STEP_NS)
    return world


@pytest.mark.parametrize("thinking", [0.0, 0.03])
def test_without_a_network_each_decision_is_that_of_the_deployed_ends(thinking: float) -> None:
    expected = deployed(1, 150, thinking).actions
    assert evaluated(1, 150, thinking=thinking).actions == expected
    assert len(set(expected)) > 100


def test_a_robot_that_executes_several_rows_of_each_answer_decides_as_the_deployed_ends() -> None:
    assert evaluated(1, 150, rows=5).actions == deployed(1, 150, 0.0, rows=5).actions


def test_with_several_rows_of_each_answer_scores_are_those_of_the_deployed_ends() -> None:
    """A policy that ignores committed rows suffers more, the more rows a program executes."""
    way, scores = "constant(50ms) & loss(5%)", list[list[float]]()
    for seed in range(1, 9):
        network = {"uplink": way, "downlink": way, "thinking": 0.02, "knows": False}
        one, five = (evaluated(seed, 150, rows=rows, **network) for rows in (1, 5))
        there = deployed(seed, 150, 0.02, way, 5, knows=False)
        scores.append([sum(world.rewards[:150]) for world in (one, five, there)])
    one, five, there = np.transpose(scores)
    middle, half = interval(list(five - there))
    assert middle is not None
    assert half is not None
    assert abs(middle) < max(half, 30.0)
    assert (one - there).mean() > 3 * abs(middle)


@pytest.mark.realtime
def test_without_a_network_each_decision_is_that_over_udp(tmp_path: Path) -> None:
    """The robot waits for each answer, so its decisions do not depend on the machine's speed."""
    script = tmp_path / "serves.py"
    script.write_text(
        "import numpy as np\n"
        "from bench.tasks import Pendulum\n"
        "from skytether import policy\n"
        "def infer(seen):\n"
        "    return Pendulum().plan(seen['state'], np.zeros((0, 1))).astype(np.float32)\n"
        "print('listening on 127.0.0.1:47911, soon', flush=True)\n"
        "policy.serve(infer, bind='127.0.0.1:47911')\n"
    )
    world = Moving()
    observation, _ = world.reset(seed=1)
    with (
        process(sys.executable, "-P", str(script)) as server,
        Robot(server, actions="absolute", deadline=60.0) as robot,
    ):
        for _ in range(60):
            observation, *_ = world.step(robot.infer({"state": observation})["actions"][0])
    assert evaluated(1, 60).actions == world.actions


def test_over_a_network_scores_are_those_of_the_deployed_ends() -> None:
    """The means differed by 400 before both had one rule for committed rows."""
    way, thinking = "gamma(50ms, 100ms, 20ms) & loss(10%)", TASK.thinking_s
    differences = list[float]()
    for seed in range(1, 13):
        here = evaluated(seed, 180, uplink=way, downlink=way, thinking=thinking)
        there = deployed(seed, 180, thinking, way)
        differences.append(sum(here.rewards[:180]) - sum(there.rewards))
    middle, half = interval(differences)
    assert middle is not None
    assert half is not None
    assert abs(middle) < half < 60.0


def test_over_a_slow_network_scores_are_those_of_the_deployed_ends() -> None:
    """Observations at 10 Hz take 80 or 120 % of the rate, to which both adapt the send rate."""
    way, rows, differences = "constant(20ms) & rate(4mbit)", 2, list[float]()
    network = {"uplink": way, "downlink": way, "thinking": 0.02, "rows": rows}
    for size in (40_000, 60_000):
        for seed in range(1, 7):
            here = evaluated(seed, 150, size=size, **network)
            there = deployed(seed, 150, 0.02, way, rows, size=size)
            differences.append(sum(here.rewards[:150]) - sum(there.rewards))
    assert max(map(abs, differences)) < 30.0
