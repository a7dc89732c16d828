"""A robot and a scripted policy in virtual time."""

from collections.abc import Callable
from typing import Any

import numpy as np

from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import Emulated
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address

MS = MILLISECOND_NS
OPTIONS = RobotOptions("absolute", 150 * MS, step_ns=20 * MS)


def ramp(observation: Any) -> dict[str, Any]:
    """Ten rows that go on from the position in the observation by 1 a row."""
    at = float(observation["state"][0])
    return {"actions": at + np.arange(10, dtype=np.float32)[:, None], "time": 3}


class Lab(Emulated):
    def __init__(
        self, policy: Callable[[Any], Any] = ramp, options: RobotOptions = OPTIONS, **others: Any
    ) -> None:
        self.asked: list[Any] = []
        """Observations that the policy has seen."""
        self.wire: list[tuple[Address, bytes]] = []
        """Datagrams as they left, with their receivers."""

        def asked(observation: Any) -> Any:
            self.asked.append(observation)
            return policy(observation)

        super().__init__(asked, options, metadata={"name": "scripted"}, **others)
        self.on_datagram = lambda each: self.wire.append((each.peer, each.payload))
