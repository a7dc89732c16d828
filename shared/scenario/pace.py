"""Pace of a desired trajectory: where it is faster than the vehicle can fly.

A vehicle's largest speed on an axis is u_max times its gain. Nothing follows a trajectory that is
faster for long, such as one whose table is in millimetres: the vehicle falls behind at full speed.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.reference import SAMPLED_S
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

STEPS_MAX = 100_000
"""Largest number of steps that are looked at before a flight."""
TINY = 1e-9
"""Relative tolerance of rounding."""


class TooFast(NamedTuple):
    """First step at which a desired trajectory is too fast."""

    at_s: float
    """Time in the flight [s]."""
    speed_mps: float
    """Desired speed along the axis that asks most [m/s]."""
    most_mps: float
    """Largest speed of the vehicle along that axis [m/s]."""


def is_known(scenario: Scenario) -> bool:
    """Whether the desired trajectory is known before the flight."""
    return scenario.reference.shape not in ("live", "target") and not scenario.is_mission


def excess(scenario: Scenario, velocity: Array) -> Array:
    """Desired speed over the vehicle's largest, on each axis.

    Args:
        scenario: gives u_max and the gain.
        velocity: desired velocity [m/s]; shape (n, axes).
    """
    ratio: Array = np.abs(velocity) / (scenario.u_max * scenario.model_gain)
    return ratio


def is_too_fast(scenario: Scenario, velocity: Array) -> Flags:
    """Whether the vehicle cannot have each desired velocity; shape (n,); see `excess`."""
    found: Flags = np.any(excess(scenario, velocity) > 1.0 + TINY, axis=1)
    return found


def first_too_fast(scenario: Scenario) -> TooFast | None:
    """First step at which the desired trajectory is too fast; None where it never is, or nobody
    knows it before the flight.
    """
    if not is_known(scenario):
        return None
    times_s = np.arange(min(scenario.steps, STEPS_MAX) + 1) * scenario.control.dt
    if not REFERENCES[REFERENCES.one(scenario.reference.shape).name].is_ours:
        times_s = SAMPLED_S[scenario.duration >= SAMPLED_S]  # where a plug-in's has been checked
    velocity = scenario.make_reference()(times_s)[..., 1]
    over = is_too_fast(scenario, velocity)
    if not over.any():
        return None
    step = int(over.argmax())
    axis = int(excess(scenario, velocity[step : step + 1])[0].argmax())
    most_mps = float((scenario.u_max * scenario.model_gain)[axis])
    return TooFast(float(times_s[step]), float(abs(velocity[step, axis])), most_mps)
