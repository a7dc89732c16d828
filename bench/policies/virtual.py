"""Runs in virtual time: both ends of `policy` emulated, `Networked`, and bounds."""

from typing import Any

import numpy as np

from bench.policies.robot import Plant, flown, waiting
from bench.policies.runs import NETWORKS, Cell, Result, seconds_of
from bench.policies.tasks import TASKS, Policy, Task
from skytether.gym import ORACLE, Chunk, Networked
from skytether.gym.networked import Options
from skytether.policy import values
from skytether.policy.images import Compressor
from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import Emulated
from skytether.shared.base.units import SECOND_NS, seconds_to_ns


class Virtual:
    """Robot end and policy end in virtual time."""

    def __init__(self, task: Task, network: str, seed: int, *, gives_rows: bool) -> None:
        options = RobotOptions(
            "absolute",
            seconds_to_ns(task.deadline_s),
            step_ns=seconds_to_ns(task.step_s),
            rows=task.calls,
            plays_on=True,
            spare_rows=task.spare_rows,
        )
        self._ends = Emulated(
            Policy(task),
            options,
            to_policy=f"{network} & constant({task.handling_s})",
            to_robot=network,
            thinking=task.thinking_s,
            seed=seed,
            compress=Compressor(),
            gives_rows=gives_rows,
        )
        self._ends.connect()
        self.infer = self._ends.infer

    def now_s(self) -> float:
        return self._ends.now_ns / SECOND_NS

    def sleep_until(self, at_s: float) -> None:
        self._ends.run(seconds_to_ns(at_s))

    def waited_s(self) -> float:
        return 0.0


def fly_virtual(seconds: float | None, cell: Cell) -> Result:
    """One run in virtual time."""
    task, seconds = TASKS[cell.task], seconds_of(cell, seconds)
    kind, _, rows = cell.system.partition("-")
    if kind == "emulated":
        world = Virtual(task, NETWORKS[cell.network], cell.seed, gives_rows=bool(rows))
        plant = Plant(task, cell.seed)
        return Result(cell, waiting(world, task, plant, seconds, task.calls))
    if kind == "nothing sent":
        plant = Plant(task, cell.seed)
        first = Policy(task)(plant.observation)["actions"]
        for step in range(round(seconds / task.step_s)):
            plant.robot.step(first[min(step, len(first) - 1)])
        return Result(cell, flown(task, plant, seconds, 1))
    if kind == "oracle":
        return networked(task, cell, seconds, ORACLE, has_rows=False)
    way = NETWORKS[cell.network]
    # Not in `downlink`: a delay that is not a whole number of steps is rounded up.
    thinking = task.thinking_s + task.handling_s
    network: Options = {"uplink": way, "downlink": way, "thinking": thinking}
    network["rows"] = task.calls
    return networked(task, cell, seconds, network, has_rows=bool(rows))


def networked(
    task: Task, cell: Cell, seconds: float, network: Options, *, has_rows: bool
) -> Result:
    plant, policy, compress = Plant(task, cell.seed), Policy(task), Compressor()
    robot, calls, answered = plant.robot, 0, -1
    options: Options = {
        "step_s": task.step_s,
        "idle": np.zeros(robot.action_space.shape or (), np.float32),
        "compress": lambda observation: len(values.pack(compress(observation))),
        **network,
    }
    env = Networked(robot, **options)
    observation, info = env.reset(seed=cell.seed)

    def is_needed(about: dict[str, Any]) -> bool:
        """Whether `policy join` would have sent this observation, see `RobotOptions.spare_rows`."""
        held, delay = about["held"], about["delay_steps"]
        if task.spare_rows is None or held <= delay:
            return True
        if about["acknowledged"] < about["generation"] and about["step"] <= answered + delay:
            return False
        return bool(held < task.spare_rows + delay)

    while len(robot.rewards) < round(seconds / task.step_s) and not robot.is_over:
        about, answer = info["network"], None
        # The first chunk may be lost, so it is sent until the robot moves.
        if not robot.rewards or (about["step"] > answered and is_needed(about)):
            committed = about["committed"][: about["committed_rows"] if has_rows else 0]
            rows = policy({**observation, "committed": committed})["actions"]
            # The robot waits for its first chunk.
            answer = rows if robot.rewards else Chunk(rows, thought_ns=0)
            answered, calls = about["step"], calls + 1
        observation, *_, info = env.step(answer)
    return Result(cell, flown(task, plant, seconds, calls))
