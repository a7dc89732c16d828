"""Tasks with scripted policies, for benchmarks of policies that are far from their robot.

A policy predicts its action chunk by a model that does not include the disturbances.
"""

from collections.abc import Sequence
from math import cos, sin
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bench import push_t

Rows = NDArray[np.float64]


class Pendulum:
    """Pendulum-v1 with gusts, swung up by its energy, and held by a linear law."""

    title, step_s, thinking_s, steps = "Pendulum-v1", 0.05, 0.05, 200
    tolerance = 0.4

    def __init__(self, rows: int = 16) -> None:
        self.rows = rows

    def make(self) -> gymnasium.Env[Any, Any]:
        return Gusts(gymnasium.make("Pendulum-v1"), 0.1)

    def plan(self, observation: Rows, committed: Rows) -> Rows:
        angle, rate = float(np.arctan2(observation[1], observation[0])), float(observation[2])
        planned = []
        for i in range(self.rows):
            if i < len(committed):
                torque = float(committed[i, 0])
            elif abs(angle) < 0.5 and abs(rate) < 3.0:
                torque = -8.0 * angle - 1.8 * rate
            else:
                torque = -0.15 * rate * (0.5 * rate * rate + 15.0 * (cos(angle) - 1.0))
            torque = min(max(torque, -2.0), 2.0)
            rate = min(max(rate + (15.0 * sin(angle) + 3.0 * torque) * 0.05, -8.0), 8.0)
            angle = (angle + rate * 0.05 + np.pi) % (2.0 * np.pi) - np.pi
            planned.append([torque])
        return np.array(planned)

    def score(self, rewards: Sequence[float], ended: bool) -> float:  # noqa: ARG002
        return float(sum(rewards))


class PushT:
    """gym-pusht; the score is the mean coverage of the goal over 300 steps, 1 once it is solved."""

    title, step_s, thinking_s, rows, steps = "PushT", 0.1, 0.1, 16, 300
    tolerance = 12.0

    def make(self) -> gymnasium.Env[Any, Any]:
        import gym_pusht  # noqa: F401 - registers the environment

        return gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True)

    def plan(self, observation: Rows, committed: Rows) -> Rows:
        return push_t.plan(observation, committed, self.rows)

    def score(self, rewards: Sequence[float], ended: bool) -> float:
        # gym-pusht adds areas in an order that differs from run to run, and so their last digits.
        return round((sum(rewards) + (self.steps - len(rewards)) * ended) / self.steps, 12)


class Gusts(gymnasium.ActionWrapper[Any, Any, Any]):
    """Adds a normal disturbance to each action."""

    def __init__(self, env: gymnasium.Env[Any, Any], sd: float) -> None:
        super().__init__(env)
        self._sd = sd

    def action(self, action: Any) -> Any:
        return action + self._sd * self.np_random.standard_normal(action.shape)
