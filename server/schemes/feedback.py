"""Gain of the feedback around a horizon of inputs.

The feedback uses position and velocity only, u = -K x. It does not use the previous input, which
depends on the packets that arrived; so the weight S (`shared.scenario.gain`) is added to R.
"""

import numpy as np

from skytether.shared.law.model import Array, Model
from skytether.shared.scenario.gain import converged_gain
from skytether.shared.scenario.schema import ControlConfig, Scenario


def feedback_gain(scenario: Scenario) -> Array:
    """Gain K of the feedback around a horizon, on position [1/s] and velocity; shape (axes, 2)."""
    model, control = scenario.terms().model, scenario.control
    if not control.feedback:
        return np.zeros_like(model.B)
    return stationary_gain(model, control)


def stationary_gain(model: Model, control: ControlConfig) -> Array:
    """Gain K of the feedback around a horizon, on position [1/s] and velocity; shape (axes, 2).

    The weight S of the change of the input is added to R.
    """
    weight = control.input_weight + control.change_weight
    gain = converged_gain(model.A.tobytes(), model.B.tobytes(), control.state_weight, weight, 0.0)
    return gain[:, :2]
