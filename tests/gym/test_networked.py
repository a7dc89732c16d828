"""`gym.networked`: environments whose agent is far away."""

import hashlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from skytether.gym import Chunk, Networked, NetworkedVector, Newest
from skytether.shared.base.errors import ConfigError

BAD = {
    "uplink": "gamma(20ms, 100ms, 40ms) & loss(20%)",
    "downlink": "gamma(20ms, 100ms, 40ms) & loss(20%) & duplicate(10%)",
}


class Counting(gymnasium.Env[Any, Any]):
    """Environment whose observation is its step, and which notes what is played."""

    observation_space = gymnasium.spaces.Box(0.0, 1e6, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1e6, 1e6, (1,), np.float64)
    metadata = {"render_fps": 10}  # noqa: RUF012 - gymnasium's own form

    def __init__(self, steps: int = 1000) -> None:
        self.steps, self.played = steps, list[float]()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002
        super().reset(seed=seed)
        self.played.clear()
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self.played.append(float(action[0]))
        over = len(self.played) == self.steps
        return np.array([float(len(self.played))]), 1.0, over, False, {}


def rows(*values: float) -> NDArray[np.float64]:
    return np.array(values)[:, None]


def pendulum(**options: Any) -> Networked:
    return Networked(gymnasium.make("Pendulum-v1"), step_s=0.05, **options)


def flown(env: Networked, seed: int = 5) -> str:
    """Digest of all that an episode shows."""
    digest = hashlib.sha256()
    observation, info = env.reset(seed=seed)
    over = False
    while not over:
        plan = np.outer(np.linspace(1.0, 0.0, 6), [np.tanh(observation[2])])
        observation, reward, terminated, truncated, info = env.step(plan)
        over = terminated or truncated
        shown = observation.tobytes(), reward, info["uplink_packets"], info["lost"]
        digest.update(repr((shown, info["coming"].tobytes(), info["delay_steps"])).encode())
    return digest.hexdigest()


def test_without_a_network_the_environment_is_as_it_was() -> None:
    bare, env = gymnasium.make("Pendulum-v1"), pendulum()
    seen, (expected, _) = env.reset(seed=1)[0], bare.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(200):
        assert (seen == expected).all()
        action = rng.uniform(-2.0, 2.0, 1).astype(np.float32)
        seen, *outcome, _ = env.step(action)
        expected, *wanted, _ = bare.step(action)
        assert outcome == wanted


def test_each_direction_takes_its_delay_and_the_agent_its_time() -> None:
    """0.2 s there, 0.1 s of thought, 0.3 s back, in steps of 0.1 s."""
    world = Counting()
    env = Networked(world, uplink="constant(0.3)", downlink="constant(0.2)", thinking=0.1)
    env.reset(seed=1)
    for number in range(1, 9):
        observation, _, _, _, info = env.step(np.array([float(number)]))
        assert observation[0] == info["step"] == max(0, number - 2)
        assert info["age_s"] == pytest.approx(0.1 * min(number, 2))
    assert world.played == [0, 0, 0, 0, 1, 2, 3, 4]


def test_the_world_goes_on_while_the_agent_thinks() -> None:
    world = Counting()
    env = Networked(world, thinking=0.35)
    env.reset(seed=1)
    observation, reward, _, _, info = env.step(rows(*range(100, 110)))
    assert (observation[0], reward, info["steps"]) == (4.0, 4.0, 4)
    env.step(None)
    assert world.played == [0, 0, 0, 0, 104]


def test_rows_run_out_by_the_stated_rule() -> None:
    def double(observation: Any, last: Any) -> Any:
        return observation + (0.0 if last is None else last)

    for rule, played in (("hold", [7, 7, 7]), ("zero", [7, 0, 0]), (double, [7, 8, 9])):
        world = Counting()
        env = Networked(world, exhausted=rule)  # type: ignore[arg-type]
        env.reset(seed=1)
        env.step(np.array([7.0]))
        env.step(None)
        _, _, _, _, info = env.step(None)
        assert world.played == played
        assert info["exhausted_steps"] == 2


def test_each_packet_costs_its_price_and_nothing_costs_nothing() -> None:
    env = Networked(Counting(), price=0.25, uplink="loss(1)")
    env.reset(seed=1)
    assert env.step(None)[1] == 1.0
    _, reward, _, _, info = env.step(rows(1.0, 2.0))
    assert reward == 0.75
    assert (info["uplink_packets"], info["lost"], info["acknowledged"]) == (1, 1, 0)


def test_the_agent_learns_the_delay_and_what_the_robot_plays_meanwhile() -> None:
    """With a constant delay the committed rows are exactly those that are played."""
    world = Counting()
    env = Networked(world, uplink="constant(0.3)", downlink="constant(0.2)", thinking=0.1)
    _, info = env.reset(seed=1)
    rng, promised = np.random.default_rng(2), dict[int, float]()
    for number in range(60):
        committed = info["committed"]
        fresh = rng.uniform(-1.0, 1.0, (12 - len(committed), 1))
        if number > 20:
            assert len(committed) == info["delay_steps"] == 6
            for step, row in enumerate(committed, start=info["step"]):
                assert promised.setdefault(step, float(row[0])) == float(row[0])
        _, _, _, _, info = env.step(np.concatenate([committed, fresh]))
    assert info["acknowledged"] == info["generation"] - 5
    assert {step: world.played[step] for step in promised if step < 60} == {
        step: row for step, row in promised.items() if step < 60
    }


def test_a_corrupted_packet_is_ignored() -> None:
    world = Counting()
    env = Networked(world, uplink="corrupt(1)", downlink="corrupt(1)")
    env.reset(seed=1)
    for _ in range(20):
        observation, _, _, _, info = env.step(np.array([3.0]))
    assert (observation[0], info["acknowledged"], info["lost"]) == (0.0, 0, 0)
    assert world.played == [0.0] * 20


def test_equal_seeds_give_an_equal_run_and_others_another() -> None:
    env = pendulum(thinking="gamma(10ms, 60ms, 20ms)", **BAD)
    first = flown(env)
    assert flown(env) == first
    assert flown(pendulum(thinking="gamma(10ms, 60ms, 20ms)", **BAD)) == first
    assert flown(env, seed=6) != first
    assert flown(pendulum(thinking="gamma(10ms, 60ms, 20ms)", seed=2, **BAD)) != first


def test_the_network_of_an_episode_is_another_than_that_before() -> None:
    env = Networked(Counting(), uplink="loss(50%)")
    env.reset(seed=1)
    lost = []
    for _ in range(4):
        for _ in range(40):
            info = env.step(np.zeros(1))[4]
        lost.append(info["lost"])
        env.reset()
    assert len(set(lost)) > 1


def test_two_players_meet_the_same_network() -> None:
    def losses(**options: Any) -> list[int]:
        env = pendulum(**BAD, **options)
        env.reset(seed=3)
        return [env.step(np.zeros(1))[4]["lost"] for _ in range(100)]

    assert losses() == losses(player=Newest)


def ticking(*durations_s: float) -> Callable[[], int]:
    """Clock on which each answer takes one of these times in turn."""
    times: Iterator[int] = iter(range(10**9))
    spent = [0]

    def now_ns() -> int:
        number = next(times)
        if number % 2:
            spent[0] += round(durations_s[number // 2 % len(durations_s)] * 1e9)
        return spent[0]

    return now_ns


def test_measured_thinking_is_charged_and_can_be_replayed() -> None:
    world = Counting()
    env = Networked(world, thinking="measured", clock_ns=ticking(0.05, 0.25), uplink="loss(30%)")
    env.reset(seed=1)
    answers, steps = list[Chunk](), list[int]()
    for number in range(20):
        *_, info = env.step(rows(number, number + 0.5))
        answers.append(info["answer"])
        steps.append(info["steps"])
    assert steps == [1, 3] * 10
    played = world.played.copy()
    again = Networked(world, thinking="measured", uplink="loss(30%)")
    again.reset(seed=1)
    for answer in answers:
        again.step(answer)
    assert world.played == played


def test_a_vector_environment_has_a_network_for_all_and_a_fate_for_each() -> None:
    vector = gymnasium.vector.SyncVectorEnv([lambda: Counting(7), lambda: Counting(12)])
    env = NetworkedVector(vector, uplink="constant(0.1)", downlink="constant(0.1)", price=0.5)
    observations, _ = env.reset(seed=1)
    assert observations.tolist() == [[0.0], [0.0]]
    for number in range(1, 7):
        observations, reward, *_ = env.step([None, np.array([float(number)])])
        assert observations.tolist() == [[number - 1.0], [number - 1.0]]
        assert reward.tolist() == [1.0, 0.5]
    _, _, terminated, _, info = env.step([None, rows(1.0, 2.0)])
    assert terminated.tolist() == [True, False]
    assert info["uplink_packets"] == [7, 7]
    observations, *_ = env.step([np.ones(1), None])  # the first robot's next episode begins
    assert observations.tolist() == [[0.0], [7.0]]
    observations, _, _, _, info = env.step([None, None])
    assert (info["acknowledged"][0], info["generation"][0]) == (0, 0)
    assert vector.envs[0].played == [0.0]


def test_robots_on_one_link_share_its_rate() -> None:
    """Answers to two robots queue for a rate that carries those to one."""

    def queued(count: int) -> float:
        vector = gymnasium.vector.SyncVectorEnv([Counting] * count)
        env = NetworkedVector(vector, uplink="rate(1000)")
        env.reset(seed=1)
        for _ in range(30):
            info = env.step([rows(1.0)] * count)[4]
        return float(info["generation"][0] - info["acknowledged"][0])

    assert queued(1) <= 1.0
    assert queued(2) > 3.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uplink": "lose(0.1)"}, "uplink: got 'lose"),
        ({"thinking": "loss(0.5)"}, "thinking: got 'loss"),
        ({"thinking": -1.0}, "thinking: got 'constant"),
        ({"exhausted": "stop"}, "exhausted: got 'stop'"),
        ({"step_s": 0.0}, "step_s: got 0"),
    ],
)
def test_an_impossible_argument_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Networked(Counting(), **options)
    with pytest.raises(ConfigError, match="action space Discrete"):
        Networked(gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize("answer", [np.zeros(2), np.zeros((3, 2)), np.array([math.nan])])
def test_an_answer_of_another_shape_or_without_finite_numbers_is_refused(answer: Any) -> None:
    env = Networked(Counting())
    env.reset(seed=1)
    with pytest.raises(ValueError, match="action: got"):
        env.step(answer)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasiums_own_checker_is_content() -> None:
    check_env(pendulum(thinking=0.02, **BAD), skip_render_check=True)
