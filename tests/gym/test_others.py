"""Environments of others behind a network; each is skipped where its package is missing."""

import contextlib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from skytether.gym import ORACLE, Networked, NetworkedVector

BAD: Any = {"uplink": "uniform(0, 200ms) & loss(10%)", "downlink": "uniform(0, 200ms) & loss(0.1%)"}
OTHERS: dict[str, tuple[str, Any, Any]] = {
    "gym_aloha": ("gym_aloha/AlohaTransferCube-v0", {"obs_type": "pixels_agent_pos"}, {}),
    "gym_pusht": ("gym_pusht/PushT-v0", {"obs_type": "pixels_agent_pos"}, {}),
    "minigrid": (
        "MiniGrid-DoorKey-6x6-v0",
        {},
        {"step_s": 0.1, "idle": 6, "exhausted": "zero"},  # 6: wait
    ),
    "mujoco": ("Hopper-v5", {}, {}),
}


@pytest.fixture(params=OTHERS)
def other(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Maker of an environment, and options for it."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    try:
        pytest.importorskip(request.param)
    except AttributeError as error:  # of PyOpenGL, on a machine without EGL
        pytest.skip(str(error))
    name, made, options = OTHERS[request.param]
    return lambda: gymnasium.make(name, disable_env_checker=True, **made), options


@pytest.mark.filterwarnings("ignore")
def test_it_is_as_it_was_without_a_network(other: Any) -> None:
    make, options = other
    bare, env = make(), Networked(make(), **options | ORACLE)
    expected, seen = bare.reset(seed=1)[0], env.reset(seed=1)[0]
    env.action_space.seed(1)
    for _ in range(8):
        np.testing.assert_equal(seen, expected)
        action = env.action_space.sample()
        seen, reward, *_ = env.step(action)
        expected, wanted, *_ = bare.step(action)
        assert reward == pytest.approx(wanted)
    for each in (bare, env):
        each.close()


@pytest.mark.filterwarnings("ignore")
def test_it_goes_on_over_a_bad_network_alone_and_as_a_vector(other: Any) -> None:
    make, options = other
    with contextlib.closing(Networked(make(), **options, **BAD)) as env:
        env.reset(seed=1)
        env.action_space.seed(1)
        for _ in range(12):
            observation, *_, info = env.step(env.action_space.sample())
            assert observation in env.observation_space
        assert info["network"]["age_s"] > 0.0
    vector = NetworkedVector(SyncVectorEnv([make, make]), **options, **BAD)
    with contextlib.closing(vector):
        vector.reset(seed=1)
        for _ in range(12):
            observations, *_, info = vector.step(vector.action_space.sample())
        assert observations in vector.observation_space
        assert info["network"]["committed"].shape[:2] == (2, 64)
