"""Serve a LeRobot policy: `python -m lerobot_policy_skytether PATH --keys robot.keys`."""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.import_utils import register_third_party_plugins

from skytether import policy


def load(path: str, device: str | None = None) -> Callable[[dict[str, Any]], Any]:
    """Function from an observation to the actions of a LeRobot policy, for `policy.serve`.

    Args:
        path: folder of the policy, or its name on the Hugging Face Hub.
        device: device of PyTorch; None: the policy's own.
    """
    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(path)
    config.device = device or config.device
    if config.n_obs_steps > 1:  # observations are missing after packet loss
        raise SystemExit(f"{path} needs {config.n_obs_steps} consecutive observations, expected 1")
    net = get_policy_class(config.type).from_pretrained(path, config=config)
    overrides = {"device_processor": {"device": config.device}}
    before, after = make_pre_post_processors(config, path, preprocessor_overrides=overrides)
    at = torch.device(config.device)

    def infer(observation: dict[str, Any]) -> Any:
        names = observation.pop("task", None), observation.pop("robot_type", None)
        arrays = {key: np.array(value) for key, value in observation.items()}
        with torch.inference_mode(), torch.autocast(at.type, enabled=config.use_amp):
            batch = before(prepare_observation_for_inference(arrays, at, *names))
            return after(net.predict_action_chunk(batch))[0].float().cpu().numpy()

    return infer


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("path", help="folder of the policy, or its name on the Hugging Face Hub")
parser.add_argument("--bind", default="127.0.0.1:47010", help="HOST:PORT to listen on for robots")
parser.add_argument("--keys", help="file with the keys, made by `skytether keygen`")
parser.add_argument("--device", help="device of PyTorch; default: the policy's own")

if __name__ == "__main__":
    options = parser.parse_args()
    policy.serve(load(options.path, options.device), bind=options.bind, keys=options.keys)
