"""Steps a second of Gymnasium environments, alone and behind a network: CPU time of one core.

All take turns, so that other load affects them alike. An environment that ends is reset, which
counts as time and not as a step.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import numpy as np

from bench.harness import TextTable, median, progress, without_gc
from skytether.gym import Networked, NetworkedVector
from skytether.gym.flights import Crowd
from skytether.gym.networked import Options
from skytether.shared.base.units import SECOND_NS

TASK = "Pendulum-v1"
VEHICLES = 8
NETWORK: Options = {
    "uplink": "constant(100ms) & loss(10%)",
    "downlink": "constant(100ms) & loss(10%)",
    "step_s": 0.05,
}


@dataclass(frozen=True)
class EnvironmentsCounts:
    turns: int = 7
    seconds: float = 1.0
    """CPU time of a turn of one environment [s]."""
    robots: int = 16


FULL, QUICK = EnvironmentsCounts(), EnvironmentsCounts(turns=2, seconds=0.2)


class Stepped:
    """Environment to be measured.

    Args:
        answer: action that is passed to each call of `step`.
        each: number of steps that a call counts for.
    """

    def __init__(self, env: Any, answer: Any, each: int = 1) -> None:
        self._env, self._answer, self._each = env, answer, each
        env.reset(seed=1)

    def pace(self, seconds: float) -> float:
        """Steps a second over this CPU time [1/s]."""
        steps, start_ns = 0, time.process_time_ns()
        until_ns = start_ns + round(seconds * SECOND_NS)
        while (now_ns := time.process_time_ns()) < until_ns:
            *_, terminated, truncated, _ = self._env.step(self._answer)
            steps += self._each
            if over(terminated) or over(truncated):
                self._env.reset()
        return steps * SECOND_NS / (now_ns - start_ns)


def over(ended: Any) -> bool:
    """Whether an episode is over; a vector environment starts its next ones itself."""
    if isinstance(ended, dict):
        return all(ended.values())
    return ended is True


def environments(robots: int) -> dict[str, dict[str, Callable[[], Stepped]]]:
    """Makers of each row of the table, alone and behind a network where there are both."""
    torque = np.zeros(1, np.float32)

    def far(answer: Any) -> Callable[[], Stepped]:
        return lambda: Stepped(Networked(gymnasium.make(TASK), **NETWORK), answer)

    def many() -> Any:
        return gymnasium.make_vec(TASK, num_envs=robots)

    vector = np.zeros((robots, 1), np.float32)
    crowd = Crowd(VEHICLES)
    return {
        f"{TASK}, an action at each step": {
            "alone": lambda: Stepped(gymnasium.make(TASK), torque),
            "networked": far(torque),
        },
        f"{TASK}, 16 rows at each step": {"networked": far(np.zeros((16, 1), np.float32))},
        f"{TASK}, nothing sent": {"networked": far(None)},
        f"{robots} of them as a vector environment, an action for each": {
            "alone": lambda: Stepped(many(), vector, robots),
            "networked": lambda: Stepped(NetworkedVector(many(), **NETWORK), vector, robots),
        },
        "`skytether/Target-v0`, a packet at each step": {
            "networked": lambda: Stepped(gymnasium.make("skytether/Target-v0"), 1),
        },
        f"`Crowd` of {VEHICLES} vehicles, vehicles' steps": {
            "networked": lambda: Stepped(crowd, dict.fromkeys(crowd.possible_agents, 1), VEHICLES),
        },
    }


def measure(counts: EnvironmentsCounts) -> dict[str, Any]:
    made = {
        (row, place): make()
        for row, places in environments(counts.robots).items()
        for place, make in places.items()
    }
    paces: dict[tuple[str, str], list[float]] = {name: [] for name in made}
    rng = np.random.default_rng(1)
    with without_gc():
        for _ in progress(range(counts.turns), "environments"):
            for name in (list(made)[i] for i in rng.permutation(len(made))):
                paces[name].append(made[name].pace(counts.seconds))
    steps: dict[str, dict[str, float]] = {}
    for (row, place), each in paces.items():
        steps.setdefault(row, {})[place] = median(each)
    return {"counts": asdict(counts), "steps_per_s": steps}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    rows = [
        [row, *(f"{paces[each]:.0f}" if each in paces else "-" for each in ("alone", "networked"))]
        for row, paces in result["steps_per_s"].items()
    ]
    headings = ["environment", "alone [steps/s]", "behind a network"]
    return {"environments": TextTable(headings, rows)}
