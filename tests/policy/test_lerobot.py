"""Plug-in for LeRobot: with LeRobot if `lerobot-rollout` is on the PATH, and with a stand-in.

The stand-in shows only that the plug-in and `policy.Robot` fit together.
"""

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np
import pytest

import skytether
from bench.lerobots import PLUGIN, ROLLOUT, ROOT, Trial
from policy_lab import process
from robot import free_port

with_lerobot = [
    pytest.mark.skipif(ROLLOUT is None, reason="needs `lerobot-rollout`"),
    pytest.mark.realtime,
    pytest.mark.long,
]


class Tensor(np.ndarray):
    """What the plug-in needs of a tensor of PyTorch."""

    def cpu(self) -> Self:
        return self

    def numpy(self) -> np.ndarray:
        return np.asarray(self)


class Stand:
    """Configuration, policy or processor of LeRobot."""

    def __init__(self, config: Any = None) -> None:
        self.config = config

    @staticmethod
    def register_subclass(_: str) -> Any:
        return lambda config: config


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Any:
    names = {
        "torch": {"Tensor": Tensor, "from_numpy": lambda array: array.view(Tensor)},
        "lerobot": {},
        "lerobot.configs": {"PreTrainedConfig": Stand},
        "lerobot.policies": {},
        "lerobot.policies.pretrained": {"PreTrainedPolicy": Stand},
        "lerobot.processor": dict.fromkeys(
            (
                "PolicyProcessorPipeline",
                "policy_action_to_transition",
                "transition_to_policy_action",
            ),
            Stand,
        ),
    }
    for name, content in names.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(ROOT / "plugins" / "lerobot"))
    yield import_module("lerobot_policy_skytether")
    sys.modules.pop("lerobot_policy_skytether")


SERVES = """
import time
import numpy as np
from skytether import policy

def infer(seen):
    image = seen["observation.images.top"]
    assert (image.dtype, image.shape, seen["task"]) == (np.uint8, (32, 48, 3), "go on")
    time.sleep(0.5)
    assert image.max() - image.min() < 3
    return seen["observation.state"][0] + np.arange(10.0)[:, None] + image.max() // 100

print("listening on 127.0.0.1:{port}, soon", flush=True)
policy.serve(infer, bind="127.0.0.1:{port}")
"""


def batch(position: float) -> dict[str, Any]:
    """Observation, as LeRobot gives it to a policy."""
    return {
        "observation.state": np.array([[position]], np.float32).view(Tensor),
        "observation.images.top": np.full((1, 3, 32, 48), 50 / 255, np.float32).view(Tensor),
        "task": "go on",
        "robot_type": "",
    }


@pytest.mark.realtime
def test_the_plug_in_executes_rows_of_the_policy_and_none_after_a_reset(
    plugin: Any, tmp_path: Path
) -> None:
    script = tmp_path / "serves.py"
    script.write_text(SERVES.format(port=free_port()))
    with process(sys.executable, "-P", str(script)) as server:
        config = plugin.SkytetherConfig()
        config.server, config.actions, config.rows, config.deadline = server, "absolute", 2, 0.001
        policy = plugin.SkytetherPolicy.from_pretrained(None, config=config, revision=None)
        policy.reset()
        # The first call waits for the policy, the second does not.
        selected = [policy.select_action(batch(at)) for at in (0.0, 50.0, 100.0)]
        policy.reset()
        selected.append(policy.select_action(batch(200.0)))
        policy._robot.__exit__()
    assert [action.tolist() for action in selected] == [[[0.0]], [[1.0]], [[2.0]], [[200.0]]]
    assert selected[0].dtype == np.float32


class TestWithLerobot:
    pytestmark = with_lerobot

    def test_a_rollout_executes_the_same_actions_as_with_the_policy_aboard(
        self, tmp_path: Path
    ) -> None:
        trial, port = Trial(tmp_path), free_port()
        local = trial.rollout(f"--policy.path={trial.policy}", "--duration=3")
        assert local.wait() == 0, trial.log.read_text()
        aboard = [action.joints for action in trial.recorded()]
        with trial.served(PLUGIN, port):
            options = ("--policy.deadline=30", "--duration=3")
            remote = trial.run(PLUGIN, f"127.0.0.1:{port}", *options)
            assert remote.wait() == 0, trial.log.read_text()
        count = min(len(aboard), len(trial.recorded()))
        assert count > 20
        assert [action.joints for action in trial.recorded()][:count] == aboard[:count]

    def test_after_an_outage_and_the_hold_time_the_rollout_ends(self, tmp_path: Path) -> None:
        trial, port = Trial(tmp_path), free_port()
        with (
            trial.served(PLUGIN, port),
            skytether.bad_network("constant(20ms)", to=("127.0.0.1", port)) as network,
        ):
            robot = trial.run(PLUGIN, "{}:{}".format(*network.address))
            trial.first_s(robot)
            network.set("loss(100%)")
            assert robot.wait() == 1
        assert "PolicyError: no action from the policy" in trial.log.read_text()
        *_, before, last = [action.joints for action in trial.recorded()]
        assert before == last

    def test_real_time_chunking_is_refused_before_the_robot_is_connected(
        self, tmp_path: Path
    ) -> None:
        trial = Trial(tmp_path)
        robot = trial.run(PLUGIN, "127.0.0.1:9", "--inference.type=rtc")
        assert robot.wait() == 1
        assert "RTC inference is not supported" in trial.log.read_text()
        assert not trial.actions.exists()
