"""Gymnasium environments behind a bad network: `Networked`, and `NetworkedVector` for many.

Robot and environment are at one end, the agent at the other. Time is virtual: step k of the
environment begins k · `step_s` after the episode's start, and nothing sleeps. At its time a robot
hears what has arrived, plays the row of the step, and reports the next observation. A call of
`step` is one answer of the agent: it leaves after the agent's thinking time, and the world goes on
until then, for at least one step.

With `thinking = "measured"` the time between two calls is charged. That is the only clock that is
read here.
"""

from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any, Literal, TypedDict, Unpack

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from skytether.gym.players import Chunk, Clocked, Player, Row
from skytether.gym.remote import ROWS_MAX, Network, Remote
from skytether.netem.fate import Fates
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.scenario import reading
from skytether.shared.scenario.air.draws import SLOT_NS
from skytether.shared.scenario.air.path import Path, path
from skytether.shared.scenario.grammar import GrammarError

Answer = NDArray[Any] | Chunk | None
"""An action, rows of actions from the step of the observation shown on, a `Chunk`, or nothing."""
Exhausted = Literal["hold", "zero"] | Callable[[NDArray[Any], Row | None], Any]
"""Rule when rows have run out: the last row again, zeros, or a function of the robot's present
observation and the last row (None before the first), which returns an action."""


class Options(TypedDict, total=False):
    """Options of `Networked` and `NetworkedVector`."""

    uplink: str
    """Impairments from agent to robot (`skytether impairments`)."""
    downlink: str
    """Impairments from robot to agent."""
    thinking: float | str
    """Time that an answer takes [s], a distribution of it such as "gamma(20ms, 80ms, 30ms)", or
    "measured": the time that passes until `step` is called."""
    price: float
    """Cost of a packet with an answer, subtracted from the reward."""
    seed: int
    """Seed of the network. `reset(seed=…)` starts its random numbers anew, others with another
    seed; each further `reset` draws those of the next episode."""
    exhausted: Exhausted
    """What the robot plays when rows have run out: "hold", "zero", or a function."""
    player: Callable[[], Player]
    """Makes the robot's rule for the row to play, for each episode."""
    step_s: float | None
    """Length of a step [s]; None: by the environment's `render_fps`."""
    clock_ns: Callable[[], int]
    """Clock for "measured" [ns]."""


class _Far:
    """What `Networked` and `NetworkedVector` share: an agent that is far from `count` robots."""

    def __init__(
        self,
        action: Any,
        observation: Any,
        metadata: dict[str, Any],
        count: int,
        *,
        uplink: str = "none",
        downlink: str = "none",
        thinking: float | str = 0.0,
        price: float = 0.0,
        seed: int = 1,
        exhausted: Exhausted = "hold",
        player: Callable[[], Player] = Clocked,
        step_s: float | None = None,
        clock_ns: Callable[[], int] = perf_counter_ns,
    ) -> None:
        for name, space in (("action", action), ("observation", observation)):
            if not isinstance(space, Box):
                raise ConfigError(f"env: got the {name} space {space}, expected a Box")
        if exhausted not in ("hold", "zero") and not callable(exhausted):
            raise ConfigError(
                f"exhausted: got {exhausted!r}, expected 'hold', 'zero' or a function"
            )
        step_s = 1.0 / metadata.get("render_fps", np.nan) if step_s is None else step_s
        if not step_s >= 1e-3:
            raise ConfigError(f"step_s: got {step_s!r}, expected at least 0.001 s")
        self.ways = _path("uplink", uplink), _path("downlink", downlink)
        self.thinking = None if thinking == "measured" else _thinking(thinking)
        self.price, self.seed, self.count = price, seed, count
        self.step_ns = seconds_to_ns(step_s)
        self.space, self._exhausted, self._player = action, exhausted, player
        self._observation = np.zeros(observation.shape, observation.dtype)
        self._zero = np.clip(np.zeros(action.shape, action.dtype), action.low, action.high)
        self._clock_ns, self._returned_ns = clock_ns, 0
        self._episode = 0
        self._network_seed = seed
        self._present: list[NDArray[Any]] = []
        self.remote: Remote
        self._thoughts: Fates

    def restart(self, seed: int | None, observations: Sequence[NDArray[Any]]) -> None:
        """Begin an episode of all robots; with a seed, that of a first episode."""
        self._episode += 1
        if seed is not None:
            self._network_seed = int(stream(self.seed, "network", seed).integers(2**32))
            self._episode = 0
        mixed = int(stream(self._network_seed, "episode", self._episode).integers(2**32))
        network = Network(*self.ways, mixed)
        zero, like = self._zero, self._observation
        self.remote = Remote(
            network, self._player, self.step_ns, zero, like, self._fill, self.count
        )
        if self.thinking is not None:
            self._thoughts = Fates(self.thinking, mixed, "thinking", 0)
        self.begin(range(self.count), observations)

    def begin(self, robots: Sequence[int], observations: Sequence[NDArray[Any]]) -> None:
        self._present = list(self._present) or list(observations)
        for index, observation in zip(robots, observations, strict=True):
            self._present[index] = observation
        self.remote.begin([np.array(each) for each in observations], robots)

    def chunk(self, answer: Answer, thought_ns: int) -> Chunk:
        """Answer as rows of the action's dtype, with the time that it took.

        Raises:
            ValueError: the rows are not finite, too many, or of another shape.
        """
        first, rows, shape = None, answer, self.space.shape
        if isinstance(answer, Chunk):
            first, rows = answer.first, answer.rows
            thought_ns = thought_ns if answer.thought_ns is None else answer.thought_ns
        rows = np.zeros((0, *shape)) if rows is None else np.asarray(rows)
        rows = np.ascontiguousarray(rows[None] if rows.shape == shape else rows, self.space.dtype)
        if rows.shape[1:] != shape or len(rows) > ROWS_MAX:
            expected = f"{shape}, or (n, *{shape}) with n of at most {ROWS_MAX}"
            raise ValueError(f"action: got the shape {rows.shape}, expected {expected}")
        if not np.isfinite(rows).all():
            raise ValueError("action: got infinity or NaN, expected finite numbers")
        return Chunk(rows, first, thought_ns)

    def thought_ns(self, *, is_nothing: bool) -> int:
        """Time that an answer took [ns]: as measured, or as drawn, 0 for nothing."""
        if self.thinking is None:
            return self._clock_ns() - self._returned_ns
        if is_nothing:
            return 0
        return self._thoughts.at(self.remote.now_ns // SLOT_NS).delay_ns

    def played(self) -> list[Row]:
        """Action of each robot at the present step."""
        rows = self.remote.rows()
        return [self._rule(i) if row is None else row for i, row in enumerate(rows)]

    def _fill(self, last: Row | None) -> Row | None:
        if callable(self._exhausted):
            return None
        return self._zero if last is None or self._exhausted == "zero" else last

    def _rule(self, index: int) -> Row:
        last = self.remote.last(index)
        if callable(self._exhausted):
            row = np.asarray(self._exhausted(self._present[index], last), self.space.dtype)
            return row.reshape(self.space.shape)
        fill = self._fill(last)
        assert fill is not None
        return fill

    def advance(self, observations: Sequence[NDArray[Any]]) -> None:
        self._present = list(observations)
        self.remote.advance([np.asarray(each, self._observation.dtype) for each in observations])

    def returns(self) -> None:
        """Note that the agent is asked now."""
        if self.thinking is None:
            self._returned_ns = self._clock_ns()


class Networked(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Environment whose agent is at the far end of a network, and pays for its packets.

        env = Networked(gymnasium.make("Pendulum-v1"), uplink="constant(50ms) & loss(10%)")

    `reset` gives the first observation at once. Then the agent sees the newest observation that
    has arrived. It answers with an action, with an array of actions for successive steps from that
    observation on, with a `Chunk`, or with None: nothing is sent. `info` says what arrived, what
    the robot holds, and what was sent, see docs/gym.md. The reward is the sum over the steps that
    have passed, minus `price` for a packet. The end of an episode is known at once.

    Args:
        env: environment with a Box of observations and one of actions.
        options: see `Options`.

    Raises:
        ConfigError: an argument is impossible.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], **options: Unpack[Options]) -> None:
        RecordConstructorArgs.__init__(self, **options)
        super().__init__(env)
        self._far = _Far(env.action_space, env.observation_space, env.metadata, 1, **options)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._far.restart(seed, [observation])
        info = info | self._far.remote.info(0)
        self._far.returns()
        return observation, info

    def step(self, action: Answer) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        far, remote = self._far, self._far.remote
        answer = far.chunk(action, far.thought_ns(is_nothing=action is None))
        assert answer.thought_ns is not None
        free_ns, before, reward = remote.now_ns + answer.thought_ns, remote.step, 0.0
        if len(answer.rows):
            remote.answer(0, answer, free_ns)
            reward -= far.price
        while True:
            (row,) = far.played()
            observation, gained, terminated, truncated, info = self.env.step(row)
            reward += float(gained)
            far.advance([observation])
            if terminated or truncated or remote.now_ns >= free_ns:
                break
        info = info | remote.info(0) | {"answer": answer, "steps": remote.step - before}
        far.returns()
        return remote.report(0).observation.copy(), reward, terminated, truncated, info


class NetworkedVector(VectorWrapper[Any, Any, Any, Any, Any]):
    """`Networked` for a vector environment, whose robots share both directions of the network.

    One agent answers all robots at once, so its thinking time is that of all answers together.
    `step` takes one answer for each robot, or an array of actions; it returns early at the step at
    which an episode ends, and the next call starts that robot's next one, as the environment does.

    Args:
        env: vector environment that starts an episode in the step after an end (gymnasium's
            default).
        options: see `Options`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], **options: Unpack[Options]) -> None:
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if mode != AutoresetMode.NEXT_STEP:
            raise ConfigError(f"env: got {mode}, expected {AutoresetMode.NEXT_STEP}")
        self._ended = np.zeros(env.num_envs, dtype=bool)
        action, observation = env.single_action_space, env.single_observation_space
        self._far = _Far(action, observation, env.metadata, env.num_envs, **options)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observations, info = self.env.reset(seed=seed, options=options)
        self._ended[:] = False
        self._far.restart(seed, list(observations))
        info = self._with_infos(info)
        self._far.returns()
        return observations, info

    def step(self, actions: Sequence[Answer]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        far, remote, count = self._far, self._far.remote, self.num_envs
        if len(actions) != count:
            raise ValueError(
                f"actions: got {len(actions)}, expected one for each of {count} robots"
            )
        thought_ns = far.thought_ns(is_nothing=all(each is None for each in actions))
        answers = [far.chunk(each, thought_ns) for each in actions]
        thought_ns = max(each.thought_ns or 0 for each in answers)
        free_ns, before = remote.now_ns + thought_ns, remote.step
        reward = np.zeros(count)
        for index, answer in enumerate(answers):
            if len(answer.rows) and not self._ended[index]:
                remote.answer(index, answer, free_ns)
                reward[index] -= far.price
        while True:
            observations, gained, terminated, truncated, info = self.env.step(
                np.array(far.played())
            )
            reward += gained
            far.advance(list(observations))
            began = np.flatnonzero(self._ended)
            far.begin(began.tolist(), [observations[index] for index in began])
            self._ended = terminated | truncated
            if self._ended.any() or remote.now_ns >= free_ns:
                break
        info = self._with_infos(info) | {"answer": answers, "steps": remote.step - before}
        far.returns()
        seen = np.stack([remote.report(index).observation for index in range(count)])
        return seen, reward, terminated, truncated, info

    def _with_infos(self, info: dict[str, Any]) -> dict[str, Any]:
        """Infos of all robots: a list for each name, of the network as a whole one number."""
        each = [self._far.remote.info(index) for index in range(self.num_envs)]
        return info | {name: [one[name] for one in each] for name in each[0]}


def _path(key: str, text: str) -> Path:
    try:
        return path(text, reading.files_of("network.uplink", text, key))
    except GrammarError as error:
        raise ConfigError(f"{key}: {error}") from None


def _thinking(given: float | str) -> Path:
    """Delays of answers; raises ConfigError if it loses answers or is no delay."""
    text = given if isinstance(given, str) else f"constant({given!r})"
    delays = _path("thinking", text)
    if delays.queue or any(each.kind != "delay" for _, each in delays.impairments) or delays.loss:
        expected = "seconds, delays such as 'gamma(20ms, 80ms, 30ms)', or 'measured'"
        raise ConfigError(f"thinking: got {given!r}, expected {expected}")
    return delays
