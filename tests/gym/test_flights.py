"""`gym.flights`: Skytether's flights as environments."""

import copy
import math
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from skytether.gym.flights import Crowd, Target
from skytether.shared.base.errors import ConfigError

SHORT = {"duration": 3.0, "settle": 0.0}


def flown(env: Any, seed: int, decide: Any) -> tuple[float, int]:
    """Mean reward of a flight, and its packets."""
    observation, info = env.reset(seed=seed)
    rewards, over = list[float](), False
    while not over:
        observation, reward, terminated, truncated, info = env.step(decide(observation))
        over = terminated or truncated
        rewards.append(reward)
    return float(np.mean(rewards)), info["packets"]


def test_the_agent_is_the_trigger() -> None:
    """A threshold saves packets over always, and is closer than never; equal seeds fly equally."""
    env = gymnasium.make("skytether/Target-v0", price=0.0, keys={"duration": 12.0, "settle": 0.0})
    always, most = flown(env, 1, lambda _: 1)
    needed, some = flown(env, 1, lambda seen: int(seen[0] > 2.5 or seen[4]))
    never, least = flown(env, 1, lambda _: 0)
    assert least < some < most / 2
    assert never < needed
    assert abs(needed - always) < 0.5 * abs(always)
    assert flown(env, 1, lambda seen: int(seen[0] > 2.5 or seen[4])) == (needed, some)


def test_a_packet_costs_its_price() -> None:
    free, paid = (
        gymnasium.make("skytether/Target-v0", price=price, keys=SHORT) for price in (0.0, 0.5)
    )
    (one, packets), (other, again) = flown(free, 2, lambda _: 1), flown(paid, 2, lambda _: 1)
    assert packets == again
    assert (one - other) * 60 == pytest.approx(0.5 * packets)


@pytest.mark.parametrize("made", [Target, Crowd])
def test_an_impossible_price_or_kind_of_action_is_refused(made: Any) -> None:
    with pytest.raises(ConfigError, match="price: got nan"):
        made(price=math.nan)
    with pytest.raises(ConfigError, match="action: got 'sned'"):
        Target(action="sned")


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(ResetNeeded):
        Target(keys=SHORT).step(1)
    with pytest.raises(ResetNeeded):
        Crowd(2, keys=SHORT).step({})


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_an_environment_can_be_copied_before_a_flight_and_not_in_it(copied: Any) -> None:
    env = Target(keys=SHORT)
    copied(env)
    env.reset(seed=1)
    with pytest.raises(TypeError, match="a flight cannot be copied"):
        copied(env)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("action", ["send", "threshold"])
def test_gymnasiums_own_checker_is_content(action: str) -> None:
    env = gymnasium.make("skytether/Target-v0", action=action, keys=SHORT)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
def test_pettingzoos_own_checkers_are_content() -> None:
    pytest.importorskip("pygame", reason="PettingZoo's checkers import its own games")
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    parallel_api_test(Crowd(3, keys=SHORT), num_cycles=80)
    parallel_seed_test(lambda: Crowd(2, keys=SHORT))
