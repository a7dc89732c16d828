"""Gymnasium environments behind a bad network: `Networked`, and `NetworkedVector` for many robots.

Robot and environment are at one end, the agent at the other. Time is virtual: step k of the
environment begins k · `step_s` after the episode's start, and nothing sleeps. At each step a robot
receives the packets that have arrived, executes the step's action, and reports the next
observation. A call of `step` passes one answer of the agent, which is sent after the agent's
thinking time. The call simulates all steps of that time, at least one.

With `thinking = "measured"` the thinking time is the real time between two calls. The module reads
no other clock.
"""

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from numbers import Integral, Real
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Tuple
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from skytether.gym.remote import ROWS_MAX, Network, Remote
from skytether.gym.spaces import Space, idle_of, no_rows, observed, size_of, to_action, to_rows
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments, impairments_of
from skytether.netem.impairments.draws import SLOT_NS
from skytether.netem.link import QUEUE_BYTES_MAX
from skytether.policy.form import PART_BYTES_MAX, PART_HEAD_BYTES
from skytether.policy.players import Batched, Chunk, Clocked, Player, Row
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import seconds_to_ns

if TYPE_CHECKING:
    _VectorWrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    _VectorWrapper = VectorWrapper  # generic only since gymnasium 1.4

MTU = PART_BYTES_MAX + PART_HEAD_BYTES
"""Largest UDP payload of a datagram of `skytether policy` [B]."""
KEY = "network"
"""Key of `info` with all entries about the network."""
Answer = Any
"""Answer of an agent: one action; an array of actions for successive steps along the first axis,
from the step of the newest observation on; a `Chunk` of actions; or None, which sends nothing."""
Exhausted = Literal["hold", "zero"] | Callable[[Any, Any], Any]
"""Rule after the last received action: repeat that action ("hold"), execute `idle` ("zero"), or
call a function that returns an action from the robot's observation and its last action (None before
the first action)."""
Compress = Callable[[Any], bytes | int]
"""Function that returns an observation's compressed bytes, or the number of these bytes."""


class Options(TypedDict, total=False):
    """Options of `Networked` and `NetworkedVector`."""

    uplink: str
    """Impairments from agent to robot (`skytether list impairments`)."""
    downlink: str
    """Impairments from robot to agent."""
    thinking: float | str
    """Thinking time of an answer: a number [s], a distribution such as "gamma(20ms, 80ms, 30ms)",
    or "measured": the real time until `step` is called."""
    price: float
    """Cost of each datagram with an answer or its parity, subtracted from the reward."""
    seed: int
    """Seed of the network. `reset(seed=…)` restarts the network's random numbers from both seeds; a
    `reset` without a seed draws new random numbers for the next episode."""
    exhausted: Exhausted
    """Rule for the robot after the last received action: "hold" repeats that action, "zero"
    executes `idle`, a function chooses an action."""
    idle: Any
    """Action that the robot executes before the first action arrives and, if `exhausted` is "zero",
    after the last; by default zeros, or the action nearest to zeros."""
    player: Callable[[], Player]
    """Function that makes a `Player`, the robot's rule for choosing actions, for each episode."""
    rows: int
    """Number of actions that the robot executes of each answer, which later chunks do not change,
    and after which it reports an observation; `--rows` of `skytether policy join`."""
    step_s: float | None
    """Length of a step [s]; None: 1 / `render_fps` of the environment."""
    clock_ns: Callable[[], int]
    """Function that returns the time [ns]; used if `thinking` is "measured"."""
    mtu: int
    """Largest UDP payload of a datagram [B], without 28 B of headers. An observation or answer is
    sent in one or several datagrams and parity, see `skytether.policy.form`."""
    compress: Compress | None
    """Function that returns an observation's compressed bytes, or the number of these bytes. Only
    their number matters: the agent sees the observation itself."""
    shown_rows: int
    """Number of rows in `coming` and `committed` of `info["network"]`."""


ORACLE: Options = {"uplink": "none", "downlink": "none", "thinking": 0.0, "price": 0.0}
"""Options that give an upper bound of a policy's return: no delay, no loss, no price."""
NOTHING_SENT: Options = {"uplink": "loss(1)", "price": 0.0}
"""Options that give a lower bound of a policy's return: no answer arrives."""


class _Far:
    """Common part of `Networked` and `NetworkedVector`: an agent, and `count` remote robots."""

    def __init__(
        self,
        action: Space,
        observation: Space,
        metadata: dict[str, Any],
        count: int,
        *,
        uplink: str = "none",
        downlink: str = "none",
        thinking: float | str = 0.0,
        price: float = 0.0,
        seed: int = 1,
        exhausted: Exhausted = "hold",
        idle: Any = None,
        player: Callable[[], Player] = Clocked,
        rows: int = 1,
        step_s: float | None = None,
        clock_ns: Callable[[], int] = perf_counter_ns,
        mtu: int = MTU,
        compress: Compress | None = None,
        shown_rows: int = 64,
    ) -> None:
        if exhausted not in ("hold", "zero") and not callable(exhausted):
            raise ConfigError(
                f"exhausted: got {exhausted!r}, expected 'hold', 'zero' or a function"
            )
        for name, each in (("player", player), ("clock_ns", clock_ns), ("compress", compress)):
            if not callable(each) and (name, each) != ("compress", None):
                raise ConfigError(f"{name}: got {each!r}, expected a function")
        if not isinstance(player(), Player):
            raise ConfigError(f"player: got {player!r}, expected a function that makes a Player")
        if step_s is None:
            if not metadata.get("render_fps"):
                raise ConfigError(
                    "step_s: got None and an env without render_fps, expected seconds"
                )
            step_s = 1.0 / metadata["render_fps"]
        self.price = number("price", price, 0.0, math.inf)
        self.step_ns = seconds_to_ns(number("step_s", step_s, 1e-3, 86_400.0))
        self.seed = _whole("seed", seed, 0, 2**63 - 1)
        self._mtu = _whole("mtu", mtu, 2 * PART_HEAD_BYTES, 65_507)
        self._shown = _whole("shown_rows", shown_rows, 1, 4096)
        self.ways = impairments_of("uplink", uplink), impairments_of("downlink", downlink)
        self.thinking = None if thinking == "measured" else _thinking(thinking)
        self.count, self.space, self._observation = count, action, observation
        self._none = no_rows(action)
        try:
            self._idle = self._one(idle_of(action) if idle is None else idle, "idle")
        except ValueError as error:
            raise ConfigError(str(error)) from None
        if _whole("rows", rows, 1, ROWS_MAX) > 1:
            player = partial(Batched, player, rows)
        self._exhausted, self._player, self._compress = exhausted, player, compress
        self._clock_ns, self._returned_ns = clock_ns, 0
        self._episode = 0
        self._network_seed = seed
        self._present: list[Any] = []
        self.remote: Remote | None = None
        self._thoughts: Fates

    def restart(self, seed: int | None, observations: Sequence[Any]) -> None:
        """Begin an episode of all robots; with a seed, the first episode of that seed."""
        self._episode += 1
        if seed is not None:
            self._network_seed = int(stream(self.seed, "network", seed).integers(2**32))
            self._episode = 0
        mixed = int(stream(self._network_seed, "episode", self._episode).integers(2**32))
        network = Network(*self.ways, mixed, self._mtu)
        self.remote = Remote(
            network, self._player, self.step_ns, self._none, self._shown, self._fill
        )
        if self.thinking is not None:
            self._thoughts = Fates(self.thinking, mixed, "thinking", 0)
        self.begin(range(self.count), observations)

    def begun(self) -> Remote:
        """Robots and network; raises ResetNeeded before the first episode."""
        if self.remote is None:
            raise ResetNeeded("step: called before reset, which gives the first observation")
        return self.remote

    def begin(self, robots: Sequence[int], observations: Sequence[Any]) -> None:
        seen = [observed(self._observation, each) for each in observations]
        self._present = list(self._present) or seen
        for index, observation in zip(robots, seen, strict=True):
            self._present[index] = observation
        self.begun().begin(seen, robots)

    def chunk(self, answer: Answer, thought_ns: int) -> Chunk:
        """Convert an answer to rows of the action's dtype, with its thinking time.

        Raises:
            ValueError: rows are not actions of the space, or too many, or a number is invalid.
        """
        first, given = None, answer
        if isinstance(answer, Chunk):
            given = answer.rows
            if answer.first is not None:
                first = _whole("first", answer.first, -(2**62), 2**62, ValueError)
            if answer.thought_ns is not None:
                thought_ns = _whole("thought_ns", answer.thought_ns, 0, 2**62, ValueError)
        if given is None:
            return Chunk(self._none, first, thought_ns)
        rows = to_rows(self.space, given, "action")
        if len(rows) > ROWS_MAX:
            raise ValueError(f"action: got {len(rows)} rows, expected at most {ROWS_MAX}")
        rows.setflags(write=False)  # the robot uses these rows without a copy
        return Chunk(rows, first, thought_ns)

    def thought_ns(self, *, is_nothing: bool) -> int:
        """Thinking time of an answer [ns], measured or drawn; a drawn time without answer is 0."""
        if self.thinking is None:
            return self._clock_ns() - self._returned_ns
        if is_nothing:
            return 0
        return self._thoughts.at(self.begun().now_ns // SLOT_NS).delay_ns

    def played(self) -> list[Any]:
        """Action that each robot executes at the present step."""
        rows = self.begun().rows()
        return [
            to_action(self.space, self._rule(i) if row is None else self._row(row))
            for i, row in enumerate(rows)
        ]

    def _row(self, played: Row) -> Row:
        """Check the row that a player returned; raises ValueError if the row is not one action."""
        kind = np.shape(played), getattr(played, "dtype", None)
        if kind == (self._idle.shape, self._idle.dtype):
            return played
        return self._one(played, "row of the player")

    def _one(self, given: Any, name: str) -> Row:
        """Row of one action; raises ValueError if `given` is not one action."""
        (row, *others) = to_rows(self.space, given, name)
        if others:
            raise ValueError(f"{name}: got {1 + len(others)} actions, expected one")
        return row

    def _fill(self, last: Row | None) -> Row | None:
        if callable(self._exhausted):
            return None
        return self._idle if last is None or self._exhausted == "zero" else last

    def _rule(self, index: int) -> Row:
        last = self.begun().last(index)
        if callable(self._exhausted):
            action = None if last is None else to_action(self.space, last)
            return self._one(self._exhausted(deepcopy(self._present[index]), action), "exhausted")
        fill = self._fill(last)
        assert fill is not None
        return fill

    def advance(self, observations: Sequence[Any]) -> None:
        self._present = [observed(self._observation, each) for each in observations]
        self.begun().advance(self._present, [self._size(each) for each in self._present])

    def _size(self, observation: Any) -> int:
        """Size of an observation when sent, compressed if `compress` is given [B]."""
        if self._compress is None:
            return size_of(observation)
        sent = self._compress(observation)
        size = len(sent) if isinstance(sent, bytes | bytearray | memoryview) else sent
        return _whole("compress", size, 0, QUEUE_BYTES_MAX)

    def returns(self) -> None:
        """Record when `step` or `reset` returns: the thinking time is measured from then on."""
        if self.thinking is None:
            self._returned_ns = self._clock_ns()


class Networked(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Environment whose agent is at the other end of a network, and pays for its packets.

        env = Networked(gymnasium.make("Pendulum-v1"), uplink="constant(50ms) & loss(10%)")

    `reset` returns the first observation without delay. Later the agent sees the newest observation
    that has arrived. The agent answers with an action, with actions for successive steps from that
    observation on, with a `Chunk`, or with None, which sends nothing. `info["network"]` describes
    the packets and the robot's actions, see docs/gym.md; all other entries are the environment's.
    The reward is the sum over the simulated steps, minus `price` for each datagram of the answer.
    The end of an episode is reported without delay.

    Args:
        env: environment whose actions are of Box, Discrete, MultiBinary, MultiDiscrete or Text,
            alone or within Dict or Tuple; its observations may be of any space.
        options: see `Options`.

    Raises:
        ConfigError: an argument is invalid.
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
        info = _joined(info, self._far.begun().info(0))
        self._far.returns()
        return observation, info

    def step(self, action: Answer) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        far, remote = self._far, self._far.begun()
        answer = far.chunk(action, far.thought_ns(is_nothing=action is None))
        assert answer.thought_ns is not None
        free_ns, reward = remote.now_ns + answer.thought_ns, 0.0
        if len(answer.rows):
            reward -= far.price * remote.answer(0, answer, free_ns)
        rewards, infos = list[float](), list[dict[str, Any]]()
        while True:
            (played,) = far.played()
            observation, gained, terminated, truncated, info = self.env.step(played)
            reward += float(gained)
            rewards.append(float(gained))
            infos.append(dict(info))
            far.advance([observation])
            if terminated or truncated or remote.now_ns >= free_ns:
                break
        passed = {"answer": answer, "steps": len(infos), "rewards": rewards, "infos": infos}
        info = _joined(info, remote.info(0) | passed)
        far.returns()
        return deepcopy(remote.report(0).observation), reward, terminated, truncated, info


class NetworkedVector(_VectorWrapper):
    """`Networked` for a vector environment; its robots share both directions of the network.

    One agent answers all robots at once, with one thinking time for all answers. `step` takes a
    list with one answer for each robot, or actions of the environment's own `action_space`. `step`
    returns early if a robot's episode ends; the next call starts that robot's next episode, as the
    environment does.

    Args:
        env: vector environment that starts a new episode in the step after an end (gymnasium's
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
        self._far.restart(seed, self._each(observations))
        info = _joined(info, self._infos())
        self._far.returns()
        return observations, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        far, remote, count = self._far, self._far.begun(), self.num_envs
        answers = self._answers(actions)
        thought_ns = far.thought_ns(is_nothing=all(each is None for each in answers))
        chunks = [far.chunk(each, thought_ns) for each in answers]
        free_ns = remote.now_ns + max(each.thought_ns or 0 for each in chunks)
        reward = np.zeros(count)
        for index, chunk in enumerate(chunks):
            if len(chunk.rows) and not self._ended[index]:
                reward[index] -= far.price * remote.answer(index, chunk, free_ns)
        rewards, infos = [], []
        while True:
            played = _batch(self.single_action_space, far.played())
            observations, gained, terminated, truncated, info = self.env.step(played)
            reward += gained
            rewards.append(np.array(gained))
            infos.append(dict(info))
            each = self._each(observations)
            far.advance(each)
            began = np.flatnonzero(self._ended)
            far.begin(began.tolist(), [each[index] for index in began])
            self._ended = terminated | truncated
            if self._ended.any() or remote.now_ns >= free_ns:
                break
        passed = {"answer": chunks, "steps": len(infos), "infos": infos}
        info = _joined(info, self._infos() | passed | {"rewards": np.stack(rewards, axis=1)})
        far.returns()
        seen = [remote.report(index).observation for index in range(count)]
        return (_batch(self.single_observation_space, seen), reward, terminated, truncated, info)

    def _answers(self, actions: Any) -> list[Answer]:
        """Split the argument of `step` into one answer for each robot."""
        space = self.single_action_space
        if isinstance(actions, dict) or (isinstance(space, Tuple) and isinstance(actions, tuple)):
            answers = list(iterate(self.action_space, actions))
        elif isinstance(actions, Sequence | np.ndarray):
            answers = list(actions)
        else:
            raise ValueError(f"actions: got {type(actions).__name__}, expected a list of answers")
        if len(answers) != self.num_envs:
            expected = f"one for each of {self.num_envs} robots"
            raise ValueError(f"actions: got {len(answers)}, expected {expected}")
        return answers

    def _each(self, observations: Any) -> list[Any]:
        return list(iterate(self.observation_space, observations))

    def _infos(self) -> dict[str, Any]:
        """Entries of `info["network"]` for all robots, as arrays with one row per robot."""
        each = [self._far.begun().info(index) for index in range(self.num_envs)]
        return {name: np.array([one[name] for one in each]) for name in each[0]}


def _batch(space: Space, each: Sequence[Any]) -> Any:
    """Stack actions or observations for a vector environment."""
    empty: Any = create_empty_array(space, len(each))
    return concatenate(space, each, empty)


def _joined(info: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    if KEY in info:
        raise ConfigError(f"env: got {KEY!r} in its own info, expected an env without a network")
    return info | {KEY: own}


def number(key: str, value: Any, low: float, high: float) -> float:
    """Check a user's number; raises ConfigError if the number is not from `low` to `high`."""
    if not isinstance(value, Real) or not low <= float(value) <= high or value == math.inf:
        expected = f"a finite number from {low:g}" + (f" to {high:g}" if high < math.inf else "")
        raise ConfigError(f"{key}: got {value!r}, expected {expected}")
    return float(value)


def _whole(key: str, value: Any, low: int, high: int, kind: type[Exception] = ConfigError) -> int:
    if not isinstance(value, Integral) or not low <= int(value) <= high:
        raise kind(f"{key}: got {value!r}, expected a whole number from {low} to {high}")
    return int(value)


def _thinking(given: float | str) -> Impairments:
    """Impairments for drawing thinking times; raises ConfigError unless they are delays only."""
    text = given if isinstance(given, str) else f"constant({float(given)!r})"
    delays = impairments_of("thinking", text)
    if delays.queue or any(each.kind != "delay" for _, each in delays.parts) or delays.loss:
        expected = "seconds, delays such as 'gamma(20ms, 80ms, 30ms)', or 'measured'"
        raise ConfigError(f"thinking: got {given!r}, expected {expected}")
    return delays
