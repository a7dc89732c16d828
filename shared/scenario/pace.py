"""Check whether a desired trajectory is faster than the vehicle can fly.

A vehicle's largest speed on an axis is u_max times its gain. On a faster trajectory, such as one
from a table in millimetres, the vehicle falls behind at full speed.
"""

from typing import NamedTuple

import numpy as np

from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.reference import SAMPLED_S
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

STEPS_MAX = 100_000
"""Largest number of steps that are checked before a flight."""
TINY = 1e-9


class TooFast(NamedTuple):
    """First step at which a desired trajectory is faster than the vehicle can fly."""

    at_s: float
    """Time of the step, from the flight's start [s]."""
    speed_mps: float
    """Desired speed on the axis on which the vehicle's largest speed is exceeded most [m/s]."""
    most_mps: float
    """Largest speed of the vehicle on the axis of `speed_mps` [m/s]."""


def is_known(scenario: Scenario) -> bool:
    """Whether the desired trajectory is known before the flight. It is unknown for a live point, a
    target and a mission.
    """
    return scenario.reference.shape not in ("live", "target") and not scenario.keeps_apart


def excess(scenario: Scenario, velocity: Array) -> Array:
    """Ratio of the desired speed to the vehicle's largest speed, on each axis; shape (n, axes).

    `velocity` is the desired velocity [m/s]; shape (n, axes).
    """
    ratio: Array = np.abs(velocity) / (scenario.u_max * scenario.model_gain)
    return ratio


def is_too_fast(scenario: Scenario, velocity: Array) -> Flags:
    """Whether a desired velocity exceeds the vehicle's largest speed on any axis; shape (n,)."""
    over: Flags = np.any(excess(scenario, velocity) > 1.0 + TINY, axis=1)
    return over


def first_too_fast(scenario: Scenario) -> TooFast | None:
    """First step at which the desired trajectory is faster than the vehicle can fly; None if there
    is no such step, or if the trajectory is not known before the flight.
    """
    if not is_known(scenario):
        return None
    times_s = np.arange(min(scenario.steps, STEPS_MAX) + 1) * scenario.control.dt
    if not REFERENCES[REFERENCES.one(scenario.reference.shape).name].is_ours:
        times_s = SAMPLED_S[scenario.duration >= SAMPLED_S]  # the sampling times of `sampled`
    velocity = scenario.make_reference()(times_s)[..., 1]
    over = is_too_fast(scenario, velocity)
    if not over.any():
        return None
    step = int(over.argmax())
    axis = int(excess(scenario, velocity[step : step + 1])[0].argmax())
    most_mps = float((scenario.u_max * scenario.model_gain)[axis])
    return TooFast(float(times_s[step]), float(abs(velocity[step, axis])), most_mps)
