"""`gym.networked`: environments whose agent is far away."""

import copy
import hashlib
import math
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from numpy.typing import NDArray

from skytether.gym import NOTHING_SENT, ORACLE, Chunk, Networked, NetworkedVector, Newest, Queue
from skytether.policy.form import form_of
from skytether.policy.pace import LOSS_FIRST
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
        shown = (
            observation.tobytes(),
            reward,
            info["network"]["uplink_packets"],
            info["network"]["lost"],
        )
        digest.update(
            repr(
                (shown, info["network"]["coming"].tobytes(), info["network"]["delay_steps"])
            ).encode()
        )
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
        assert observation[0] == info["network"]["step"] == max(0, number - 2)
        assert info["network"]["age_s"] == pytest.approx(0.1 * min(number, 2))
    assert world.played == [0, 0, 0, 0, 1, 2, 3, 4]


def test_the_world_goes_on_while_the_agent_thinks() -> None:
    world = Counting()
    env = Networked(world, thinking=0.35)
    env.reset(seed=1)
    observation, reward, _, _, info = env.step(rows(*range(100, 110)))
    assert (observation[0], reward, info["network"]["steps"]) == (4.0, 4.0, 4)
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
        assert info["network"]["exhausted_steps"] == 2


def test_each_packet_costs_its_price_and_nothing_costs_nothing() -> None:
    env = Networked(Counting(), price=0.25, uplink="loss(1)")
    env.reset(seed=1)
    assert env.step(None)[1] == 1.0
    _, reward, _, _, info = env.step(rows(1.0, 2.0))  # with as much parity, as it is urgent
    assert reward == 0.5
    assert (
        info["network"]["uplink_packets"],
        info["network"]["lost"],
        info["network"]["acknowledged"],
    ) == (2, 2, 0)


def test_the_agent_learns_the_delay_and_what_the_robot_plays_meanwhile() -> None:
    """With a constant delay the committed rows are exactly those that are played."""
    world = Counting()
    env = Networked(world, uplink="constant(0.3)", downlink="constant(0.2)", thinking=0.1)
    _, info = env.reset(seed=1)
    rng, promised = np.random.default_rng(2), dict[int, float]()
    for number in range(60):
        network = info["network"]
        committed = network["committed"][: network["committed_rows"]]
        fresh = rng.uniform(-1.0, 1.0, (12 - len(committed), 1))
        if number > 20:
            assert len(committed) == network["delay_steps"] == 6
            for step, row in enumerate(committed, start=network["step"]):
                assert promised.setdefault(step, float(row[0])) == float(row[0])
        _, _, _, _, info = env.step(np.concatenate([committed, fresh]))
    assert info["network"]["acknowledged"] == info["network"]["generation"] - 5
    assert {step: world.played[step] for step in promised if step < 60} == {
        step: row for step, row in promised.items() if step < 60
    }


def test_a_corrupted_packet_is_ignored() -> None:
    world = Counting()
    env = Networked(world, uplink="corrupt(1)", downlink="corrupt(1)")
    env.reset(seed=1)
    for _ in range(20):
        observation, _, _, _, info = env.step(np.array([3.0]))
    assert (observation[0], info["network"]["acknowledged"], info["network"]["lost"]) == (0.0, 0, 0)
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
        lost.append(info["network"]["lost"])
        env.reset()
    assert len(set(lost)) > 1


def test_two_players_meet_the_same_network() -> None:
    def losses(**options: Any) -> list[int]:
        env = pendulum(**BAD, **options)
        env.reset(seed=3)
        return [env.step(np.zeros(1))[4]["network"]["lost"] for _ in range(100)]

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
        answers.append(info["network"]["answer"])
        steps.append(info["network"]["steps"])
    assert steps == [1, 3] * 10
    played = world.played.copy()
    again = Networked(world, thinking="measured", uplink="loss(30%)")
    again.reset(seed=1)
    for answer in answers:
        again.step(answer)
    assert world.played == played


def test_a_vector_environment_has_a_network_for_all_and_a_fate_for_each() -> None:
    vector: Any = SyncVectorEnv([lambda: Counting(7), lambda: Counting(12)])
    env = NetworkedVector(vector, uplink="constant(0.1)", downlink="constant(0.1)", price=0.25)
    observations, _ = env.reset(seed=1)
    assert observations.tolist() == [[0.0], [0.0]]
    for number in range(1, 7):
        observations, reward, *_ = env.step([None, np.array([float(number)])])
        assert observations.tolist() == [[number - 1.0], [number - 1.0]]
        assert reward.tolist() == [1.0, 0.5]
    _, _, terminated, _, info = env.step([None, rows(1.0, 2.0)])
    assert terminated.tolist() == [True, False]
    assert info["network"]["uplink_packets"].tolist() == [14, 14]  # 7 answers, with parity
    observations, *_ = env.step([np.ones(1), None])  # the first robot's next episode begins
    assert observations.tolist() == [[0.0], [7.0]]
    observations, _, _, _, info = env.step([None, None])
    assert (info["network"]["acknowledged"][0], info["network"]["generation"][0]) == (0, 0)
    assert vector.envs[0].played == [0.0]


@pytest.mark.parametrize("actions", [None, 1.0, [None], np.zeros((3, 1))])
def test_a_vector_takes_one_answer_for_each_robot(actions: Any) -> None:
    env = NetworkedVector(SyncVectorEnv([Counting, Counting]))
    env.reset(seed=1)
    with pytest.raises(ValueError, match="actions: got"):
        env.step(actions)


def test_answers_of_an_agent_leave_in_the_order_in_which_it_made_them() -> None:
    """A robot's end cuts the thinking time of both short; the second answer takes none."""
    env = NetworkedVector(SyncVectorEnv([lambda: Counting(3), Counting]))
    env.reset(seed=1)
    env.step([None, Chunk(rows(1.0), thought_ns=900_000_000)])
    env.step([None, Chunk(rows(2.0), thought_ns=0)])
    seen = [env.step([None, None])[4]["network"]["acknowledged"][1] for _ in range(10)]
    assert seen == sorted(seen)
    assert seen[-1] == 2


def test_an_ended_episode_sends_nothing_more() -> None:
    size = 2_000_000
    vector = SyncVectorEnv([lambda: Counting(3), lambda: Counting(4)])
    env = NetworkedVector(vector, downlink="rate(50000)", compress=lambda _: size)
    env.reset(seed=1)
    late = Chunk(rows(1.0), thought_ns=900_000_000)
    env.step([late, late])
    size = 0
    env.step([None, None])
    before = env.step([None, None])[4]["network"]
    for _ in range(10):
        after = env.step([None, None])[4]["network"]
    assert after["uplink_packets"][0] == 0
    assert after["downlink_bytes"][0] - before["downlink_bytes"][0] < 10_000


def test_robots_on_one_link_share_its_rate() -> None:
    """Answers to two robots queue for a rate that carries those to one."""

    def queued(count: int) -> float:
        vector = gymnasium.vector.SyncVectorEnv([Counting] * count)
        env = NetworkedVector(vector, uplink="rate(4000)")
        env.reset(seed=1)
        for _ in range(30):
            info = env.step([rows(1.0)] * count)[4]
        return float(info["network"]["generation"][0] - info["network"]["acknowledged"][0])

    assert queued(1) <= 1.0
    assert queued(2) > 3.0


def test_a_robot_that_executes_several_rows_of_each_answer_observes_once_for_them() -> None:
    env = Networked(Counting(), rows=3)
    env.reset(seed=1)
    seen = {env.step(rows(*range(9)))[-1]["network"]["step"] for _ in range(30)}
    assert sorted(seen) == list(range(0, 31, 3))


def test_observations_larger_than_a_rate_carries_arrive_one_after_the_other() -> None:
    """Sent at once, all of them lose datagrams in the queue, and none arrives."""
    env = Networked(Counting(), downlink="rate(50000)", compress=lambda _: 20_000)
    env.reset(seed=1)
    seen = [env.step(rows(1.0))[-1]["network"] for _ in range(200)]
    assert len({each["step"] for each in seen}) > 20  # the rate carries 50
    assert max(each["age_s"] for each in seen[50:]) < 3.0
    assert seen[-1]["downlink_bytes"] < 20.0 * 55_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uplink": "lose(0.1)"}, "uplink: got 'lose"),
        ({"thinking": "loss(0.5)"}, "thinking: got 'loss"),
        ({"thinking": -1.0}, "thinking: got 'constant"),
        ({"exhausted": "stop"}, "exhausted: got 'stop'"),
        ({"step_s": 0.0}, "step_s: got 0"),
        ({"step_s": math.inf}, "step_s: got inf"),
        ({"price": math.nan}, "price: got nan, expected a finite number from 0"),
        ({"price": "a lot"}, "price: got 'a lot'"),
        ({"seed": 1.5}, "seed: got 1.5, expected a whole number"),
        ({"uplink": None}, "uplink: got None"),
        ({"mtu": 0}, "mtu: got 0"),
        ({"shown_rows": 0}, "shown_rows: got 0"),
        ({"player": 3}, "player: got 3"),
        ({"player": dict}, "player: got <class 'dict'>"),
        ({"compress": 0.1}, "compress: got 0.1"),
        ({"idle": np.zeros(2)}, "idle: got the shape"),
        ({"idle": math.nan}, "idle: got"),
    ],
)
def test_an_impossible_argument_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Networked(Counting(), **options)


def test_an_action_space_without_rows_is_named() -> None:
    class Of(Counting):
        action_space = gymnasium.spaces.Sequence(gymnasium.spaces.Discrete(2))  # type: ignore[assignment]

    with pytest.raises(ConfigError, match="action space Sequence"):
        Networked(Of())


def test_an_environment_without_a_length_of_step_needs_one() -> None:
    class Timeless(Counting):
        metadata = {}  # noqa: RUF012 - gymnasium's own form

    with pytest.raises(ConfigError, match="step_s: got None"):
        Networked(Timeless())


@pytest.mark.parametrize("given", [{"first": 1.5}, {"thought_ns": math.nan}, {"thought_ns": -1}])
def test_a_chunk_with_an_impossible_number_is_refused(given: dict[str, Any]) -> None:
    env = Networked(Counting())
    env.reset(seed=1)
    with pytest.raises(ValueError, match=next(iter(given))):
        env.step(Chunk(rows(1.0), **given))


@pytest.mark.parametrize("answer", [np.zeros(2), np.zeros((3, 2)), np.array([math.nan])])
def test_an_answer_of_another_shape_or_without_finite_numbers_is_refused(answer: Any) -> None:
    env = Networked(Counting())
    env.reset(seed=1)
    with pytest.raises(ValueError, match="action: got"):
        env.step(answer)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasiums_own_checker_is_content() -> None:
    check_env(pendulum(thinking=0.02, **BAD), skip_render_check=True)


def late(seed: int = 1, **options: Any) -> Networked:
    """Networked Pendulum whose delays differ from packet to packet."""
    options = {"uplink": "uniform(0.05, 0.25) & loss(20%)", "seed": seed} | options
    return pendulum(**options)


def shapes(info: dict[str, Any]) -> dict[str, Any]:
    return {name: np.shape(info["network"][name]) for name in ("coming", "committed", "age_s")}


@pytest.mark.parametrize("make", [SyncVectorEnv, AsyncVectorEnv])
def test_a_vector_of_networked_environments_is_each_of_them(make: Any) -> None:
    """Delays differ, and with them the number of rows; their arrays have one shape."""
    vector = make([lambda: late(1, thinking=0.12), lambda: late(2), lambda: late(3)])
    singles = [late(1, thinking=0.12), late(2), late(3)]
    vector.reset(seed=[4, 5, 6])
    for seed, single in enumerate(singles, start=4):
        single.reset(seed=seed)
    rng = np.random.default_rng(1)
    for _ in range(60):
        actions = rng.uniform(-2.0, 2.0, (3, 1)).astype(np.float32)
        observations, rewards, *_, info = vector.step(actions)
        assert shapes(info) == {"coming": (3, 64, 1), "committed": (3, 64, 1), "age_s": (3,)}
        for index, single in enumerate(singles):
            observation, reward, *_, own = single.step(actions[index])
            assert (observations[index] == observation).all()
            assert rewards[index] == pytest.approx(reward)
            network = own["network"]
            for name in ("committed", "committed_rows", "coming_rows", "delay_steps", "lost"):
                assert (info["network"][name][index] == network[name]).all()
            assert info["network"]["rewards"][index] == network["rewards"]
    vector.close()


def test_a_vector_environment_of_stable_baselines_trains_on_it() -> None:
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    ppo = pytest.importorskip("stable_baselines3").PPO
    for make in (vectors.DummyVecEnv, vectors.SubprocVecEnv):
        vector = make([lambda: late(1, thinking=0.12), lambda: late(2)])
        ppo("MlpPolicy", vector, n_steps=32, batch_size=32, n_epochs=1, seed=1).learn(128)
        *_, infos = vector.step(np.zeros((2, 1), np.float32))
        assert infos[0]["network"]["committed"].shape == (64, 1)
        vector.close()


class Telling(Counting):
    """Environment whose own info has the names of the network's."""

    def step(self, action: Any) -> Any:
        *outcome, _ = super().step(action)
        number = len(self.played)
        return *outcome, {"lost": -number, "step": f"step {number}", "is_success": number == 2}


def test_the_environments_own_info_is_untouched_and_that_of_all_steps_is_there() -> None:
    env = Networked(Telling(), thinking=0.25, price=0.25)
    assert list(env.reset(seed=1)[1]) == ["network"]
    _, reward, _, _, info = env.step(np.zeros(1))
    network = info.pop("network")
    assert info == {"lost": -3, "step": "step 3", "is_success": False}
    assert (network["lost"], network["step"], network["steps"]) == (0, 3, 3)
    assert (reward, network["rewards"]) == (2.5, [1.0, 1.0, 1.0])
    assert [each["is_success"] for each in network["infos"]] == [False, True, False]


def test_a_vector_has_rewards_and_infos_of_all_steps_too() -> None:
    env = NetworkedVector(SyncVectorEnv([Telling, Telling]), thinking=0.25)
    env.reset(seed=1)
    *_, info = env.step(np.zeros((2, 1)))
    network = info["network"]
    assert info["lost"].tolist() == [-3, -3]
    assert network["rewards"].tolist() == [[1.0, 1.0, 1.0]] * 2
    assert [each["is_success"].tolist() for each in network["infos"]] == [
        *([False, False], [True, True], [False, False])
    ]


def test_an_environment_behind_two_networks_is_refused() -> None:
    with pytest.raises(ConfigError, match="env: got 'network' in its own info"):
        Networked(Networked(Counting())).reset(seed=1)


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(ResetNeeded):
        Networked(Counting()).step(np.zeros(1))
    with pytest.raises(ResetNeeded):
        NetworkedVector(SyncVectorEnv([Counting])).step(np.zeros((1, 1)))


def test_an_observation_or_a_function_that_returns_another_shape_is_refused_at_once() -> None:
    class Wide(Counting):
        def step(self, action: Any) -> Any:
            return np.zeros(2), *super().step(action)[1:]

    env = Networked(Wide())
    env.reset(seed=1)
    with pytest.raises(ValueError, match="observation: got the shape"):
        env.step(np.zeros(1))
    for wrong, message in ((np.zeros(3), "the shape"), (np.array([math.nan]), "nan")):
        env = Networked(Counting(), exhausted=lambda *_, wrong=wrong: wrong)
        env.reset(seed=1)
        with pytest.raises(ValueError, match=f"exhausted: got {message}"):
            env.step(None)
    env = Networked(Counting(), compress=lambda _: 0.5)  # type: ignore[arg-type,return-value]
    env.reset(seed=1)
    with pytest.raises(ConfigError, match=r"compress: got 0\.5"):
        env.step(None)


def test_the_agents_array_may_be_used_again_and_the_environment_cannot_change_the_rows() -> None:
    world = Counting()
    env = Networked(world, uplink="constant(0.1)")
    env.reset(seed=1)
    chunk = rows(1.0, 2.0, 3.0)
    *_, info = env.step(chunk)
    chunk[:] = 9.0
    env.step(None)
    env.step(None)
    assert world.played == [0.0, 2.0, 3.0]
    assert not info["network"]["answer"].rows.flags.writeable


IMPAIRED = (
    "gamma(20ms, 100ms, 40ms) & loss(20%) & rate(9000) & duplicate(10%) & corrupt(5%) & ordered",
    "lognormal(0, 0.05, 0.02) & gilbert_elliott(0.1, 0.5) & outages(9, 0.2) & outage(2, 0.5)",
)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("way", IMPAIRED)
def test_a_copy_in_mid_flight_goes_on_in_the_same_way(copied: Any, way: str) -> None:
    env = pendulum(uplink=way, downlink=way, thinking="gamma(10ms, 60ms, 20ms)", player=Queue)
    env.reset(seed=1)
    for number in range(30):
        env.step(np.full((6, 1), number / 30))
    other = copied(env)
    for _ in range(60):
        (one, *_, info), (two, *_, again) = (e.step(np.full((6, 1), 0.1)) for e in (env, other))
        assert (one == two).all()
        assert (info["network"]["coming"] == again["network"]["coming"]).all()
        assert info["network"]["lost"] == again["network"]["lost"]


class Camera(Counting):
    """Environment that observes a picture with its step in each pixel, and a place."""

    observation_space = Dict(  # type: ignore[assignment]
        {"pixels": Box(0, 255, (480, 640, 3), np.uint8), "place": Box(-1.0, 1.0, (2,), np.float32)}
    )

    def observed(self) -> dict[str, Any]:
        pixels = np.full((480, 640, 3), len(self.played), np.uint8)
        return {"pixels": pixels, "place": np.zeros(2, np.float32)}

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        return self.observed(), {}

    def step(self, action: Any) -> Any:
        outcome = super().step(action)[1:]
        return self.observed(), *outcome


def test_a_picture_is_as_many_datagrams_as_it_takes_and_parity_follows_the_loss() -> None:
    env = Networked(Camera(), downlink="loss(10%)")
    env.reset(seed=1)
    form = form_of(480 * 640 * 3 + 8 + 74, LOSS_FIRST)
    assert (form.blocks, form.data) == (5, 165)
    seen = list[int]()
    for number in range(1, 21):
        observation, *_, info = env.step(np.zeros(1))
        seen.append(int(observation["pixels"].max()))
        if number == 1:
            packets = form.blocks * (form.data + form.parity)
            assert info["network"]["downlink_packets"] == packets
            assert info["network"]["downlink_bytes"] == packets * (form.length + 40 + 28)
    assert seen[0] == 0
    assert seen[10:] == list(range(11, 21))


def test_a_picture_in_several_datagrams_waits_for_the_last_of_them() -> None:
    env = Networked(Camera(), downlink="uniform(0, 300ms)")
    env.reset(seed=1)
    ages = [env.step(np.zeros(1))[4]["network"]["age_s"] for _ in range(12)]
    assert ages[3:] == pytest.approx([0.3] * 9)


@pytest.mark.parametrize("compress", [lambda _: 30_000, lambda _: bytes(30_000)])
def test_a_compressed_picture_counts_as_what_it_is_sent_as(compress: Any) -> None:
    env = Networked(Camera(), compress=compress)
    env.reset(seed=1)
    observation, *_, info = env.step(np.zeros(1))
    assert observation["pixels"].min() == 1
    form = form_of(30_000 + 74, LOSS_FIRST)
    packets = form.data + form.parity
    assert info["network"]["downlink_packets"] == packets
    assert info["network"]["downlink_bytes"] == packets * (form.length + 40 + 28)


def test_each_datagram_of_an_answer_costs_its_price() -> None:
    env = Networked(Counting(), price=0.25, mtu=100)
    env.reset(seed=1)
    _, reward, _, _, info = env.step(np.zeros((50, 1)))
    packets = 2 * 8  # 460 B in parts of at most 60 B, and as many of parity
    assert info["network"]["uplink_packets"] == packets
    assert reward == 1.0 - packets * 0.25
    assert info["network"]["acknowledged"] == 1


@pytest.mark.parametrize(("corrupted", "last"), [("corrupt(1%)", 3), ("corrupt(60%)", 0)])
def test_a_flipped_bit_costs_a_datagram_which_parity_may_restore(corrupted: str, last: int) -> None:
    env = Networked(Camera(), downlink=corrupted, compress=lambda _: 1_500_000)
    env.reset(seed=1)
    for _ in range(3):
        observation, *_ = env.step(np.zeros(1))
    assert observation["pixels"].max() == last


class Choosing(Counting):
    """Environment that chooses one of seven, the last of which is to wait."""

    action_space = Discrete(7)  # type: ignore[assignment]

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        return super().step([action])


def test_a_discrete_action_is_held_or_what_waits_is_played() -> None:
    for options, played in (
        ({}, [0, 0, 3, 4, 4]),
        ({"idle": 6}, [6, 6, 3, 4, 4]),
        ({"idle": 6, "exhausted": "zero"}, [6, 6, 3, 4, 6]),
        ({"exhausted": lambda _, last: 5 if last is None else last}, [5, 5, 3, 4, 4]),
    ):
        world = Choosing()
        env = Networked(world, uplink="constant(0.2)", **options)
        env.reset(seed=1)
        env.step([1, 2, 3, 4])
        for _ in range(4):
            *_, info = env.step(None)
        assert world.played == played
        assert info["network"]["committed"].shape == (64,)


def test_what_is_committed_to_a_robot_of_discrete_actions_is_what_it_plays() -> None:
    world = Choosing()
    env = Networked(world, uplink="constant(0.3)", downlink="constant(0.2)", idle=6)
    _, info = env.reset(seed=1)
    rng, promised = np.random.default_rng(2), dict[int, int]()
    for number in range(60):
        network = info["network"]
        committed = network["committed"][: network["committed_rows"]]
        if number > 20:
            for step, row in enumerate(committed, start=network["step"]):
                promised[step] = int(row)
        *_, info = env.step([*committed, *rng.integers(0, 6, 12 - len(committed))])
    assert {step: world.played[step] for step in promised if step < 60} == {
        step: row for step, row in promised.items() if step < 60
    }


class Arm(gymnasium.Env[Any, Any]):
    """Environment whose actions and observations are dicts of several spaces."""

    action_space = Dict({"joints": Box(-1.0, 1.0, (2,), np.float32), "gripper": Discrete(3)})
    observation_space = Dict({"joints": Box(-9.0, 9.0, (2,)), "said": gymnasium.spaces.Text(9)})
    metadata = {"render_fps": 10}  # noqa: RUF012 - gymnasium's own form

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002
        super().reset(seed=seed)
        self.joints = np.zeros(2, np.float32)
        return {"joints": self.joints, "said": "hello"}, {}

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        self.joints += action["joints"]
        said = ("open", "hold", "close")[action["gripper"]]
        return {"joints": self.joints, "said": said}, 0.0, False, False, {}


def test_dicts_of_spaces_are_taken_as_they_are() -> None:
    env = Networked(Arm(), uplink="constant(0.1)", downlink="constant(0.1)")
    env.reset(seed=1)
    chunk = {"joints": np.array([[0.5, 0.0]] * 4, np.float32), "gripper": [2, 1, 0, 2]}
    said = list[str]()
    for _ in range(4):
        observation, *_, info = env.step(chunk if not said else None)
        assert observation in env.observation_space
        said.append(observation["said"])
    assert said == ["hello", "open", "hold", "open"]
    assert observation["joints"].tolist() == [1.0, 0.0]
    assert info["network"]["committed"]["gripper"][:1].tolist() == [2]
    rows = 4 * (2 * 4 + 8)
    assert info["network"]["uplink_bytes"] == 2 * (rows + 60 + 40 + 28)


def test_a_vector_of_dicts_has_answers_of_each_robot_or_a_batch_of_actions() -> None:
    env = NetworkedVector(SyncVectorEnv([Arm, Arm]))
    env.reset(seed=1)
    open_, close = ({"joints": np.ones(2, np.float32) / 2, "gripper": each} for each in (0, 2))
    observations, *_ = env.step([open_, close])
    assert observations["said"] == ("open", "close")
    batch = {"joints": np.ones((2, 2), np.float32) / 4, "gripper": np.array([1, 0])}
    observations, *_, info = env.step(batch)
    assert observations["said"] == ("hold", "open")
    assert observations["joints"].tolist() == [[0.75, 0.75]] * 2
    assert info["network"]["committed"].shape == (2, 64)


def test_the_bounds_are_the_environment_itself_and_a_robot_that_hears_nothing() -> None:
    def played(**options: Any) -> list[float]:
        world = Counting()
        env = Networked(world, **options)
        env.reset(seed=1)
        for number in range(5):
            _, reward, _, _, info = env.step(rows(number, number + 0.5))
            assert reward == info["network"]["steps"]
        return world.played

    bad = {"uplink": "loss(50%)", "downlink": "constant(0.2)", "thinking": 0.2, "price": 0.5}
    assert played(**bad | ORACLE) == [0, 1, 2, 3, 4]
    assert set(played(**bad | NOTHING_SENT)) == {0.0}
