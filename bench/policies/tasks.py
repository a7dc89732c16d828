"""Tasks of the benchmark: a robot that is advanced by the clock, and its policy.

Each action has a last column, the *serial number* of its row, by which a robot tells a row that the
policy has computed from the hold action, which repeats a row.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from bench import tasks

Rows = NDArray[np.float64]
PLACE = np.array([0.0, 40.7])
"""Centre of the block's area in the frame of the block [px]."""
NO_ROWS = np.zeros((0, 1))
SIDE, SCALE = 96, 512 / 96
"""Width and height of an image of PushT [px], and pixels of the arena for each of its pixels."""
PUSHER, BLOCK = np.array([65.0, 105.0, 225.0]), np.array([119.0, 136.0, 153.0])
"""Colours of the pusher and of the block."""
NEAR, FAINT = 90.0, 0.4
"""Difference of colours at which the likeness is 0, and likeness below which a pixel counts as
noise of JPEG."""
REACH = 95.0
"""Largest distance of a pixel of the block from its centre [px]."""


@dataclass(frozen=True)
class Task:
    name: str
    base: Any
    """Environment and planner, see `bench.tasks`."""
    thinking_s: float
    """Computation time of the policy [s]."""
    seconds: float
    """Duration of a run [s]."""
    played: int = 2
    """Number of rows that a program with openpi's client executes of each answer."""
    calls: int = 2
    """Number of rows that the program executes of each answer of `policy join`."""
    spare_rows: int | None = None
    """`policy join` sends an observation if fewer rows than this will remain when its chunk
    arrives; None: it sends every observation."""
    cameras: int = 0
    handling_s: float = 0.0
    """Time that sockets and images take between observation and chunk, which runs in virtual time
    add [s]."""

    @property
    def step_s(self) -> float:
        return float(self.base.step_s)

    @property
    def deadline_s(self) -> float:
        """Deadline of a call [s]: the program misses no step while it waits."""
        return 0.8 * self.step_s

    @property
    def when(self) -> str:
        """Option `--when` of `policy join`."""
        return "always" if self.spare_rows is None else f"needed({self.spare_rows})"

    @property
    def rows(self) -> int:
        """Number of rows of an action chunk."""
        return int(self.base.rows)

    @property
    def is_cost(self) -> bool:
        """Whether the score is a cost: lower is better."""
        return isinstance(self.base, tasks.Pendulum)

    def make(self) -> "Robot":
        if self.is_cost:
            return Robot(Seen(self.base.make(), self.cameras))
        import gym_pusht  # noqa: F401 - registers the environment

        name, options = "gym_pusht/PushT-v0", {"obs_type": "pixels", "disable_env_checker": True}
        return Robot(Images(gymnasium.make(name, **options)))  # type: ignore[arg-type]

    def plan(self, observation: dict[str, Any], committed: Rows) -> Rows:
        if self.is_cost:
            return np.asarray(self.base.plan(observation["state"], committed))
        return np.asarray(self.base.plan(pose(observation["image"]), committed))

    def score(self, robot: "Robot", seconds: float) -> float:
        """Mean cost of a step, or mean coverage of the goal, which is 1 once the task is solved."""
        if self.is_cost:
            return -float(np.mean(robot.rewards))
        steps = round(seconds / self.step_s)
        rewards = robot.rewards[:steps]
        return (sum(rewards) + (steps - len(rewards)) * robot.is_over) / steps


TASKS = {
    task.name: task
    for task in (
        Task("pendulum", tasks.Pendulum(), 0.02, 10.0),
        Task("pusht", tasks.PushT(), 0.05, 20.0, played=8, calls=1, spare_rows=8),
        # Chunks of 1.6 s: a chunk of 0.8 s ends before the next, of a policy that takes 300 ms.
        Task("cameras, 86 ms", tasks.Pendulum(32), 0.086, 10.0, cameras=2, handling_s=0.008),
        Task("cameras, 300 ms", tasks.Pendulum(32), 0.3, 10.0, cameras=2, handling_s=0.008),
    )
}


class Robot(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment whose actions have a serial number; it does not move before the first row."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        space = env.action_space
        assert isinstance(space, Box)
        low, high = (np.append(bound, end) for bound, end in ((space.low, 0), (space.high, 1e4)))
        self.action_space = Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.rewards: list[float] = []
        self.is_over = False
        self.longest_freeze = 0
        """Largest number of successive steps without a row of the policy."""
        self._frozen, self._serial = 0, 0.0

    def reset(self, **options: Any) -> Any:
        self.seen, info = self.env.reset(**options)
        return self.seen, info

    def step(self, action: Any) -> Any:
        serial = float(action[-1])
        if self.is_over or (serial == 0.0 and not self.rewards):
            return self.seen, 0.0, False, False, {}
        self._frozen = self._frozen + 1 if serial == self._serial else 0
        self._serial = serial
        self.longest_freeze = max(self.longest_freeze, self._frozen)
        self.seen, reward, self.is_over, _, info = self.env.step(np.asarray(action[:-1], float))
        self.rewards.append(float(reward))
        return self.seen, reward, False, False, info


class Policy:
    """Policy of a task; it keeps the rows `committed` of an observation that has them."""

    def __init__(self, task: Task) -> None:
        self._task, self._chunks = task, 0

    def __call__(self, observation: dict[str, Any]) -> dict[str, Any]:
        committed = np.asarray(observation.get("committed", ()), float)[: self._task.rows]
        rows = self._task.plan(observation, committed[:, :-1] if len(committed) else NO_ROWS)
        self._chunks = self._chunks % 4096 + 1
        serials = self._chunks + np.arange(len(rows)) / 64  # as float32 without rounding
        actions = np.column_stack([rows, serials]).astype(np.float32)
        if len(committed):
            actions[: len(committed)] = committed
        return {"actions": actions, "number": observation.get("number", 0)}


class Seen(gymnasium.ObservationWrapper[Any, Any, Any]):
    """State, and images of cameras, which move with the state."""

    def __init__(self, env: gymnasium.Env[Any, Any], cameras: int) -> None:
        super().__init__(env)
        rng = np.random.default_rng(1)
        coarse = rng.integers(0, 256, (cameras, 15, 15, 3))
        fine = np.kron(coarse, np.ones((1, 16, 16, 1))) + rng.normal(0, 1.5, (cameras, 240, 240, 3))
        self._scenes = np.clip(fine, 0, 255)[:, 5:229, 7:231].astype(np.uint8)
        self.observation_space = Dict(
            {"state": env.observation_space}
            | {f"image_{i}": Box(0, 255, (224, 224, 3), np.uint8) for i in range(cameras)}
        )

    def observation(self, observation: Any) -> dict[str, Any]:
        by = round(100 * float(observation[1]))
        images = {f"image_{i}": np.roll(each, by, 0) for i, each in enumerate(self._scenes)}
        return {"state": observation, **images}


class Images(gymnasium.ObservationWrapper[Any, Any, Any]):
    """The image alone, as a dict."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = Dict({"image": env.observation_space})

    def observation(self, observation: Any) -> dict[str, Any]:
        return {"image": observation}


def pose(image: NDArray[np.uint8]) -> Rows:
    """Pusher, block and the block's angle, from an image of PushT by its colours; shape (5,).

    The block's axis is the principal axis of its pixels, and points to its longer side: the stem.
    """
    pixels = image.astype(float)
    place, _ = _moments(_likeness(pixels, PUSHER))
    weights = _likeness(pixels, BLOCK)
    for _ in range(2):  # edges of other things have the colour of the block, too
        weights = weights * (np.hypot(*_moments(weights)[1].transpose(2, 0, 1)) < REACH)
    centre, offsets = _moments(weights)
    spread = (offsets * weights[:, :, None]).reshape(-1, 2).T @ offsets.reshape(-1, 2)
    axis = np.linalg.eigh(spread)[1][:, 1]
    if (weights * (offsets @ axis) ** 3).sum() < 0:
        axis = -axis
    angle = float(np.arctan2(-axis[0], axis[1]))
    return np.array([*place, *(centre - PLACE[1] * axis), angle % (2 * np.pi)])


def _likeness(pixels: Rows, colour: Rows) -> Rows:
    likeness = 1.0 - np.abs(pixels - colour).max(axis=2) / NEAR
    return np.clip((likeness - FAINT) / (1.0 - FAINT), 0.0, 1.0)


def _moments(weights: Rows) -> tuple[Rows, Rows]:
    """Weighted centre [px of the arena], and offset of each pixel from it; shape (96, 96, 2)."""
    middle = (np.arange(SIDE) + 0.5) * SCALE
    places = np.stack(np.meshgrid(middle, middle), axis=2)
    centre = (weights[:, :, None] * places).sum(axis=(0, 1)) / max(weights.sum(), 1e-9)
    return centre, places - centre
