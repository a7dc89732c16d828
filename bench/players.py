"""Players of remote policies over bad networks: what each makes of the same policy, and its price.

Every player gets chunks of one policy, or single actions, over one network with the same seeds. A
policy here is scripted; it predicts its chunk by a model that knows nothing of the disturbances.
Delays are the same in both directions, at least half of the mean, with a standard deviation of a
fifth of it. Bounds tell whether a task can judge players at all: nothing sent, and no network.
Needs the extra `bench`, for gym-pusht.
"""

import sys
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import gymnasium
import msgspec
import numpy as np
from numpy.typing import NDArray

from bench.harness import Study, TextTable
from bench.tasks import Pendulum, PushT
from skytether.gym import (
    NOTHING_SENT,
    ORACLE,
    Clocked,
    Freshest,
    Networked,
    Newest,
    Player,
    Queue,
)
from skytether.gym.networked import Options
from skytether.lab.engine.intervals import interval
from skytether.shell.commandline import command

Rows = NDArray[np.float64]
PLAYERS: dict[str, tuple[str, Callable[[], Player]]] = {
    "newest": ("newest action held", Newest),
    "replace": ("queue, replaced", Queue),
    "average": ("queue, averaged", lambda: Queue("average")),
    "freshest": ("queue, freshest (DRTC)", Freshest),
    "clocked": ("by the clock", Clocked),
    "sparing": ("by the clock, when needed", Clocked),
}
"""Title of each player, and what the robot runs. For the first two queues a chunk is sent when half
of one is left or less (LeRobot's threshold), for DRTC's when a quarter was played and the one
before should have come (its cooldown), for the last player when it differs from what the robot
plays anyway, for the others always."""
BOUNDS: dict[str, tuple[str, str, Options]] = {
    "nothing": ("nothing sent", "newest", NOTHING_SENT),
    "oracle": ("no network", "newest", ORACLE),
    "chunks": ("no network", "replace", ORACLE),
}
"""Row, player and options of each bound."""
NETWORKS = ((0.0, 0.0), (0.05, 0.1), (0.1, 0.1), (0.1, 0.3), (0.2, 0.1))
"""Mean delay [s] and share of losses, each way, of each network of the table."""
SEEDS = 50
"""Number of seeds of the table in docs/gym.md, from 1 on."""
FOR_S = 0.4
"""Time of rows that the robot keeps in hand when a chunk is not needed [s]."""


TASKS: dict[str, Any] = {"pendulum": Pendulum(), "pusht": PushT()}


class Played(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes the rewards of an episode, step by step."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.rewards: list[float] = []

    def step(self, action: Any) -> Any:
        outcome = self.env.step(action)
        self.rewards.append(float(outcome[1]))
        return outcome


class Cell(NamedTuple):
    task: str
    player: str
    delay_s: float
    loss: float
    seed: int


class FlownCell(msgspec.Struct, frozen=True):
    cell: Cell
    score: float
    packets_per_s: float
    """Datagrams with answers, parity included, a second."""


def differs(task: Any, rows: Rows, coming: Rows) -> bool:
    """Whether a chunk differs from what the robot plays anyway, or that runs out soon."""
    both = min(len(rows), len(coming))
    if both * task.step_s <= FOR_S:
        return True
    return bool(np.abs(rows[:both] - coming[:both]).max() > task.tolerance)


def fly_cell(cell: Cell) -> FlownCell:
    task, name = TASKS[cell.task], cell.player
    mean = cell.delay_s
    delays = f"gamma({mean / 2:g}, {mean:g}, {mean / 5:g})" if mean else "none"
    way = f"{delays} & loss({cell.loss:g})"
    _, player, bound = BOUNDS.get(name, ("", name, Options()))
    played, make_player = Played(task.make()), PLAYERS[player][1]
    options: Options = {
        "uplink": way,
        "downlink": way,
        "thinking": task.thinking_s,
        "player": make_player,
        "step_s": task.step_s,
        **bound,
    }
    env = Networked(played, **options)
    observation, info = env.reset(seed=cell.seed)
    terminated = truncated = False
    ready = 0
    while not (terminated or truncated):
        network = info["network"]
        committed, coming = (
            network[key][: network[f"{key}_rows"]] for key in ("committed", "coming")
        )
        delay = min(network["delay_steps"], task.rows // 2)  # DRTC's bound
        settled = {"freshest": delay, "clocked": None, "sparing": None}.get(name, 0)
        rows = task.plan(observation, committed[:settled])
        answer = rows[0] if make_player is Newest else rows
        if name in ("replace", "average", "chunks") and 2 * network["held"] > task.rows:
            answer = None
        if name == "freshest":
            step = len(played.rewards)
            if step < ready or network["held"] > 3 * task.rows / 4:
                answer = None
            else:
                ready = step + delay + 1
        if name == "sparing" and not differs(task, rows, coming):
            answer = None
        observation, _, terminated, truncated, info = env.step(answer)
    env.close()
    packets, flown_s = info["network"]["uplink_packets"], len(played.rewards) * task.step_s
    return FlownCell(cell, task.score(played.rewards, terminated), packets / flown_s)


def cells(seeds: int) -> list[Cell]:
    numbers = range(1, seeds + 1)
    bounds = product(TASKS, BOUNDS, (0.0,), (0.0,), numbers)
    networks = [
        Cell(task, player, delay_s, loss, number)
        for task, player, (delay_s, loss), number in product(TASKS, PLAYERS, NETWORKS, numbers)
    ]
    return [*(Cell(*each) for each in bounds), *networks]


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    """For each task and network, and for the bounds, the mean score and packets a second."""
    found: dict[tuple[str, str], dict[str, list[FlownCell]]] = {}
    for each in flights:
        cell = each.cell
        network = f"{1e3 * cell.delay_s:g} ms, {cell.loss:.0%}"
        row, player, _ = BOUNDS.get(cell.player, (network, cell.player, Options()))
        found.setdefault((cell.task, row), {}).setdefault(player, []).append(each)
    rows = [
        [
            TASKS[task].title,
            row,
            *(_score(cells[name]) if name in cells else "" for name in PLAYERS),
        ]
        for (task, row), cells in sorted(found.items(), key=lambda each: [*TASKS].index(each[0][0]))
    ]
    headings = ["task", "delay, loss each way", *(title for title, _ in PLAYERS.values())]
    return {"players": TextTable(headings, rows)}


def _mean(flown: Sequence[FlownCell]) -> str:
    """Mean score with half of its 95 % interval."""
    middle, half = interval([each.score for each in flown])
    assert middle is not None
    digits = 2 if abs(middle) < 10 else 0
    return f"{middle:.{digits}f} ± {half or 0.0:.{digits}f}"


def _score(flown: Sequence[FlownCell]) -> str:
    """Mean score, and over a network packets a second."""
    if flown[0].cell.player in BOUNDS:
        return _mean(flown)
    return f"{_mean(flown)}, {np.mean([each.packets_per_s for each in flown]):.1f}/s"


STUDY = Study(__doc__, cells, fly_cell, FlownCell, tables, SEEDS)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "players"))
