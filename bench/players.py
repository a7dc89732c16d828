"""Players of remote policies over bad networks: what each makes of the same policy, and its price.

Every player gets chunks of one policy, or single actions, over one network with the same seeds. A
policy here is scripted; it predicts its chunk by a model that knows nothing of the disturbances.
Delays are the same in both directions, at least half of the mean, with a standard deviation of a
fifth of it. Bounds tell whether a task can judge players at all: nothing sent, and no network.
Needs the extra `bench`, for gym-pusht.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import product
from math import cos, sin
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray

from bench import push_t
from bench.harness import TextTable
from skytether.gym import (
    NOTHING_SENT,
    ORACLE,
    Clocked,
    Freshest,
    Held,
    Networked,
    Newest,
    Player,
    Queue,
)
from skytether.gym.networked import Options
from skytether.gym.players import Row
from skytether.lab.commands.pool import Flags, study
from skytether.lab.intervals import interval
from skytether.shared.base import files
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
BOUNDS: dict[str, tuple[str, Callable[[], Player], Options]] = {
    "nothing": ("nothing sent", Newest, NOTHING_SENT),
    "oracle": ("no network, an action a step", Newest, ORACLE),
    "chunks": ("no network, half a chunk at once", Queue, ORACLE),
}
"""Title, player and options of each bound."""
DELAYS_S, LOSSES = (0.0, 0.05, 0.1, 0.2), (0.0, 0.1, 0.3)
SEEDS = 50
"""Number of seeds of the tables in docs/gym.md, from 1 on."""
FOR_S = 0.4
"""Time of rows that the robot keeps in hand when a chunk is not needed [s]."""


class Pendulum:
    """Pendulum-v1, with gusts: swung up by its energy, held by a linear law."""

    title, step_s, thinking_s, rows, steps = "Pendulum-v1", 0.05, 0.05, 16, 200
    tolerance = 0.4

    def make(self) -> gymnasium.Env[Any, Any]:
        return Gusts(gymnasium.make("Pendulum-v1"), 0.1)

    def plan(self, observation: Rows, committed: Rows) -> Rows:
        angle, rate = float(np.arctan2(observation[1], observation[0])), float(observation[2])
        planned = []
        for i in range(self.rows):
            if i < len(committed):
                torque = float(committed[i, 0])
            elif abs(angle) < 0.5 and abs(rate) < 3.0:
                torque = -8.0 * angle - 1.8 * rate
            else:
                torque = -0.15 * rate * (0.5 * rate * rate + 15.0 * (cos(angle) - 1.0))
            torque = min(max(torque, -2.0), 2.0)
            rate = min(max(rate + (15.0 * sin(angle) + 3.0 * torque) * 0.05, -8.0), 8.0)
            angle = (angle + rate * 0.05 + np.pi) % (2.0 * np.pi) - np.pi
            planned.append([torque])
        return np.array(planned)

    def score(self, rewards: Sequence[float], ended: bool) -> float:  # noqa: ARG002
        return float(sum(rewards))


class CartPole:
    """CartPole-v1 with a pole of 4 m, a force from -10 to 10 N, and gusts; the score is the number
    of steps that it stands.
    """

    title, step_s, thinking_s, rows, steps = "CartPole-v1, any force", 0.02, 0.04, 40, 500
    tolerance = 0.15

    def make(self) -> gymnasium.Env[Any, Any]:
        env: Any = gymnasium.make("CartPole-v1")
        env.unwrapped.length, env.unwrapped.polemass_length = 2.0, 0.2
        return AnyForce(env, 0.05)

    def plan(self, observation: Rows, committed: Rows) -> Rows:
        x, speed, angle, rate = map(float, observation)
        planned = []
        for i in range(self.rows):
            if i < len(committed):
                share = float(committed[i, 0])
            else:
                share = 0.1 * (0.8 * x + 2.5 * speed + 45.0 * angle + 22.0 * rate)
            share = min(max(share, -1.0), 1.0)
            sine, cosine = sin(angle), cos(angle)
            push = (10.0 * share + 0.2 * rate * rate * sine) / 1.1
            turning = (9.8 * sine - cosine * push) / (2.0 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1))
            pushing = push - 0.2 * turning * cosine / 1.1
            x, speed = x + 0.02 * speed, speed + 0.02 * pushing
            angle, rate = angle + 0.02 * rate, rate + 0.02 * turning
            planned.append([share])
        return np.array(planned)

    def score(self, rewards: Sequence[float], ended: bool) -> float:  # noqa: ARG002
        return float(sum(rewards))


class PushT:
    """gym-pusht; the score is the mean coverage of the goal over 300 steps, 1 once it is solved."""

    title, step_s, thinking_s, rows, steps = "PushT", 0.1, 0.1, 16, 300
    tolerance = 12.0

    def make(self) -> gymnasium.Env[Any, Any]:
        import gym_pusht  # noqa: F401 - registers the environment

        return gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True)

    def plan(self, observation: Rows, committed: Rows) -> Rows:
        return push_t.plan(observation, committed, self.rows)

    def score(self, rewards: Sequence[float], ended: bool) -> float:
        # gym-pusht adds areas in an order that differs from run to run, and so their last digits.
        return round((sum(rewards) + (self.steps - len(rewards)) * ended) / self.steps, 12)


TASKS: dict[str, Any] = {"pendulum": Pendulum(), "cartpole": CartPole(), "pusht": PushT()}


class Gusts(gymnasium.ActionWrapper[Any, Any, Any]):
    """Adds a normal disturbance to each action."""

    def __init__(self, env: gymnasium.Env[Any, Any], sd: float) -> None:
        super().__init__(env)
        self._sd = sd

    def action(self, action: Any) -> Any:
        return action + self._sd * self.np_random.standard_normal(action.shape)


class AnyForce(Gusts):
    """CartPole with a continuous force, as a share of 10 N."""

    def __init__(self, env: gymnasium.Env[Any, Any], sd: float) -> None:
        super().__init__(env, sd)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def action(self, action: Any) -> Any:
        force: Any = self.unwrapped
        share = float(super().action(action)[0])
        force.force_mag = 10.0 * abs(share)
        return int(share > 0.0)


class Played(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes the rewards of an episode, step by step."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.rewards: list[float] = []

    def step(self, action: Any) -> Any:
        outcome = self.env.step(action)
        self.rewards.append(float(outcome[1]))
        return outcome


class Watched(Player):
    """A player, and how far each chunk that arrives moves the row of the present step."""

    def __init__(self, player: Player, jumps: list[float]) -> None:
        super().__init__()
        self._player, self._jumps = player, jumps

    def __copy__(self) -> Player:
        return copy(self._player)

    def number(self, step: int) -> int:
        return self._player.number(step)

    def accept(self, chunk: Held, step: int) -> None:
        before = copy(self._player).row(step)
        self._player.accept(chunk, step)
        after = copy(self._player).row(step)
        if before is not None and after is not None:
            self._jumps.append(float(np.abs(after - before).max()))

    def row(self, step: int) -> Row | None:
        row = self._player.row(step)
        self.last = self._player.last
        return row


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
    """Answers sent a second."""
    stalled: float
    """Share of the steps at which the robot had no row."""
    jump: float
    """Mean change of the present row when a chunk arrives, in units of the action."""


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
    played, jumps = Played(task.make()), list[float]()
    make_player = (PLAYERS | BOUNDS)[name][1]
    options: Options = {
        "uplink": way,
        "downlink": way,
        "thinking": task.thinking_s,
        "player": lambda: Watched(make_player(), jumps),
        "step_s": task.step_s,
    }
    if name in BOUNDS:
        options |= BOUNDS[name][2]
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
    steps, network = len(played.rewards), info["network"]
    return FlownCell(
        cell,
        task.score(played.rewards, terminated),
        network["uplink_packets"] / (steps * task.step_s),
        network["exhausted_steps"] / steps,
        float(np.mean(jumps or [0.0])),
    )


def cells(tasks: Iterable[str], seeds: int = SEEDS) -> list[Cell]:
    """Cells of each task, with this number of seeds."""
    numbers = range(1, seeds + 1)
    bounds = product(tasks, BOUNDS, (0.0,), (0.0,), numbers)
    kinds = product(tasks, PLAYERS, DELAYS_S, LOSSES, numbers)
    return [Cell(*each) for each in (*bounds, *kinds)]


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    """The bounds; and for each task a table of the mean score and packets a second, and one of
    stalls and jumps.
    """
    found: dict[tuple[Any, ...], list[FlownCell]] = {}
    for each in flights:
        found.setdefault(each.cell[:-1], []).append(each)
    shown = {}
    tasks = list(dict.fromkeys(key[0] for key in found))
    if any(key[1] in BOUNDS for key in found):
        headings = ["task", *(title for title, *_ in BOUNDS.values())]
        bounds = [
            [TASKS[task].title, *(_mean(found[task, name, 0.0, 0.0]) for name in BOUNDS)]
            for task in tasks
        ]
        shown["players bounds"] = TextTable(headings, bounds)
    for task in tasks:
        networks = list(dict.fromkeys(key[2:] for key in found if key[1] in PLAYERS))
        headings = ["delay, loss each way", *(title for title, _ in PLAYERS.values())]
        for kind, text in (("scores", _score), ("stalls", _stalls)):
            rows = []
            for delay_s, loss in networks:
                row = [f"{1e3 * delay_s:g} ms, {loss:.0%}"]
                row += [text(found[task, name, delay_s, loss]) for name in PLAYERS]
                rows.append(row)
            shown[f"players {task} {kind}"] = TextTable(headings, rows)
    return shown


def _mean(flown: Sequence[FlownCell]) -> str:
    """Mean score with half of its 95 % interval."""
    middle, half = interval([each.score for each in flown])
    assert middle is not None
    digits = 2 if abs(middle) < 10 else 0
    return f"{middle:.{digits}f} ± {half or 0.0:.{digits}f}"


def _score(flown: Sequence[FlownCell]) -> str:
    """Mean score, and packets a second."""
    return f"{_mean(flown)}, {np.mean([each.packets_per_s for each in flown]):.1f}/s"


def _stalls(flown: Sequence[FlownCell]) -> str:
    stalled, jump = (np.mean([getattr(each, key) for each in flown]) for key in ("stalled", "jump"))
    return f"{stalled:.1%}, {jump:.2g}"


STYLES = "C7s:", "C1^--", "C3v--", "C4<--", "C0o-", "C2D-"
BOUND_STYLES = ":", "--", "-."


def _mean_score(
    flights: Sequence[FlownCell],
    task: str,
    name: str,
    delay_s: float,
    loss: float,
) -> float:
    at = task, name, delay_s, loss
    return float(np.mean([each.score for each in flights if each.cell[:4] == at]))


def draw(flights: Sequence[FlownCell], path: Path) -> None:
    """Score over the delay, a panel for each task and loss, a line for each player and bound."""
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(each.cell.task for each in flights))
    figure, panels = plt.subplots(
        len(tasks),
        len(LOSSES),
        figsize=(11, 2.8 * len(tasks)),
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for (task, loss), panel in zip(product(tasks, LOSSES), panels.flat, strict=True):
        for (name, (title, _)), style in zip(PLAYERS.items(), STYLES, strict=True):
            means = [_mean_score(flights, task, name, delay_s, loss) for delay_s in DELAYS_S]
            panel.plot(np.array(DELAYS_S) * 1e3, means, style, markersize=4, label=title)
        for (name, (title, *_)), style in zip(BOUNDS.items(), BOUND_STYLES, strict=True):
            panel.axhline(
                _mean_score(flights, task, name, 0.0, 0.0),
                color="black",
                linestyle=style,
                linewidth=1,
                label=title,
            )
        panel.set_title(f"{TASKS[task].title}, {loss:.0%} lost", fontsize=10)
        panel.grid(alpha=0.3)
    for panel in panels[-1]:
        panel.set_xlabel("delay each way [ms]")
    for panel in panels[:, 0]:
        panel.set_ylabel("score")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    with files.replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=110)
    plt.close(figure)


@dataclass(frozen=True)
class PlayersOptions:
    seeds: int = SEEDS
    """Number of seeds, from 1 on."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks to fly: pendulum, cartpole, pusht."""
    jobs: int | None = None
    """Number of flights at once; one per core unless given."""
    out: Path | None = None
    """Folder for the flights: after Ctrl-C the same command continues."""
    figure: Path | None = None
    """PNG of the scores over delay and loss."""


def main(argv: Sequence[str]) -> None:
    options = tyro.cli(PlayersOptions, args=argv, description=__doc__)
    every = cells(options.tasks, options.seeds)
    flights = study(fly_cell, every, FlownCell, {}, options.out, Flags(options.jobs))
    for title, table in tables(flights).items():
        table.show(title)
    if options.figure:
        draw(flights, options.figure)
    print(f"hash of all flights: {hashlib.sha256(msgspec.json.encode(flights)).hexdigest()[:16]}")


def document_tables(folder: Path | None, flags: Flags) -> Mapping[str, TextTable]:
    return tables(study(fly_cell, cells(TASKS), FlownCell, {}, folder, flags))


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "players"))
