"""Robot of LeRobot that writes its actions to a file, and a policy with random weights for it.

`python lerobot_robot_recorded.py FOLDER` writes the policy, an ACT.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.robots import Robot, RobotConfig

SIDE, ROWS = 64, 50
JOINTS = ("a.pos", "b.pos")


@RobotConfig.register_subclass("recorded")
@dataclass
class RecordedConfig(RobotConfig):
    file: str = ""


class Recorded(Robot):
    """Each action is reached at once; the image is as bright as the number of observations."""

    config_class = RecordedConfig
    name = "recorded"
    observation_features: ClassVar = dict.fromkeys(JOINTS, float) | {"top": (SIDE, SIDE, 3)}
    action_features: ClassVar = dict.fromkeys(JOINTS, float)
    cameras: ClassVar[dict[str, Any]] = {}
    is_connected, is_calibrated = False, True

    def __init__(self, config: RecordedConfig) -> None:
        super().__init__(config)
        self._file = Path(config.file)
        self._file.write_text("")
        self._seen = 0
        self._at = dict.fromkeys(JOINTS, 0.0)

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002
        self.is_connected = True

    def calibrate(self) -> None:
        pass

    configure = calibrate

    def get_observation(self) -> dict[str, Any]:
        self._seen += 1
        return self._at | {"top": np.full((SIDE, SIDE, 3), self._seen % 256, np.uint8)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._at = {name: float(action[name]) for name in JOINTS}
        with self._file.open("a") as file:
            print(time.monotonic(), *self._at.values(), file=file)
        return action

    def disconnect(self) -> None:
        self.is_connected = False


def write_policy(folder: Path) -> None:
    torch.manual_seed(0)
    state = PolicyFeature(FeatureType.STATE, (len(JOINTS),))
    image = PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
    config = ACTConfig(
        chunk_size=ROWS,
        n_action_steps=10,
        dim_model=64,
        n_heads=2,
        dim_feedforward=128,
        n_encoder_layers=1,
        use_vae=False,
        pretrained_backbone_weights=None,
        device="cpu",
        input_features={"observation.state": state, "observation.images.top": image},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(JOINTS),))},
    )
    ACTPolicy(config).save_pretrained(folder)
    scales = {"mean": torch.zeros(2), "std": torch.ones(2)}
    colours = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)}
    stats = {"observation.state": scales, "action": scales, "observation.images.top": colours}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)


if __name__ == "__main__":
    write_policy(Path(sys.argv[1]))
