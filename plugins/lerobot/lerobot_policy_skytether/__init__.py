"""LeRobot policy that is computed on another machine: `--policy.type=skytether`.

LeRobot imports this package because of its name, and finds three objects by their names (see
`lerobot/policies/factory.py`): the configuration, `SkytetherConfig`, the policy, `SkytetherPolicy`,
and the function that makes the processors, `make_skytether_pre_post_processors`.
"""

import logging
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import (
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)

from skytether import policy

logger = logging.getLogger(__name__)


@PreTrainedConfig.register_subclass("skytether")
@dataclass
class SkytetherConfig(PreTrainedConfig):
    """Options of `policy.Robot`, given as `--policy.server=gpu.example:47010` and so on."""

    server: str = ""
    actions: str = ""
    """"absolute" or "delta"; required."""
    rows: int = 10
    """Number of rows that are executed of each answer."""
    deadline: float = 0.02
    """Longest time for which the control loop waits for an answer, except for the first [s]."""
    hold: float = 1.0
    keys: str | None = None
    robot: int = 1
    resize: int | None = None
    device: str | None = "cpu"

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def validate_features(self) -> None:
        pass

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError("this policy cannot be trained")

    get_scheduler_preset = get_optimizer_preset


def observed(batch: dict[str, Any]) -> dict[str, Any]:
    """Observation of one robot as it is sent: arrays without the batch axis, images as uint8."""
    observation = {key: batch[key] for key in ("task", "robot_type") if batch.get(key)}
    for key, value in batch.items():
        if key.startswith("observation.") and isinstance(value, torch.Tensor):
            (array,) = value.cpu().numpy()
            if "image" in key:
                array = array.transpose(1, 2, 0)
                if array.shape[2] == 3:  # LeRobot has divided colours by 255, but not depths
                    array = np.rint(array * 255).astype(np.uint8)
            observation[key] = array
    return observation


class SkytetherPolicy(PreTrainedPolicy):
    """Policy whose actions are the answers of `policy.Robot.infer`."""

    config_class = SkytetherConfig
    name = "skytether"
    _action_queue_attrs = ("_rows",)

    def __init__(self, config: SkytetherConfig, **_: Any) -> None:
        super().__init__(config)
        self._rows: deque[torch.Tensor] = deque()
        names = ("actions", "rows", "deadline", "hold", "keys", "robot", "resize")
        options = {name: getattr(config, name) for name in names}
        self._robot = policy.Robot(config.server, **options, on_event=logger.info)
        self._robot.__enter__()  # LeRobot does not close policies; this ends with the process

    @classmethod
    def from_pretrained(cls, *_: Any, config: SkytetherConfig, **__: Any) -> "SkytetherPolicy":
        return cls(config)

    def reset(self) -> None:
        """Begin an episode: no row of an earlier chunk is executed."""
        self._rows.clear()
        self._robot.reset()

    def select_action(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        """Next action, shape (1, action).

        Raises:
            PolicyError: no action is available; LeRobot ends the rollout.
        """
        if not self._rows:
            rows = self._robot.infer(observed(batch))["actions"][: self.config.rows]
            self._rows.extend(torch.from_numpy(np.array(rows, np.float32)))
        return self._rows.popleft()[None]

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError("this policy only selects actions")

    predict_action_chunk = forward = get_optim_params = _refuse


def make_skytether_pre_post_processors(*_: Any, **__: Any) -> tuple[Any, Any]:
    """Processors without steps: those of the policy run at the policy end."""
    return PolicyProcessorPipeline(steps=[]), PolicyProcessorPipeline(
        steps=[],
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
