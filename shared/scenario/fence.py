"""The bounds of a fence as they are drawn in, for the vehicle and for whoever checks a trajectory.

A vehicle that is led up to these is not blown, or carried by an error of its model, over those that
the scenario states: see `client.fence`.
"""

import math

from skytether.shared.law.model import ALTITUDE
from skytether.shared.scenario.schema import FenceConfig, Scenario

SLOW_STEPS = 2
"""Steps by which T of the fence is longer than the vehicle's time constant."""
ERROR_S = 0.06
"""Time by which the model's errors together may lead the vehicle on at its largest speed [s]."""
WEAK = 1.25
"""Factor by which wind leads a vehicle further if its gain is a fifth less than the model's."""
LATER_S = 0.1
"""Time by which the vehicle's dead time may be longer than the model's [s]."""


def is_home_inside(fence: FenceConfig) -> bool:
    """Whether a vehicle that returns to where it took off stays inside in the plane."""
    low = all(each <= 0.0 for each in fence.low_m[:ALTITUDE])
    return low and all(each >= 0.0 for each in fence.high_m[:ALTITUDE])


def margins(scenario: Scenario) -> list[float]:
    """Distance m by which the bounds of each axis are drawn in, and last that from home [m]."""
    terms, fence, dt = scenario.terms(), scenario.fence, scenario.control.dt
    fastest = fence.speed_mps or math.inf
    blown = [
        WEAK * fence.wind_mps * (tau + SLOW_STEPS * dt + late + LATER_S + dt)
        for tau, late in zip(terms.tau_s, terms.dead_time_s, strict=True)
    ]
    speeds = [*terms.u_max, math.hypot(*terms.u_max)]
    return [
        ERROR_S * min(speed, fastest) + by_wind
        for speed, by_wind in zip(speeds, [*blown, max(blown)], strict=True)
    ]


def inner(scenario: Scenario) -> tuple[list[float], list[float], float]:
    """Lowest and highest position of each axis, and distance from home, up to which it is led [m].

    They are infinite where the fence has no such bound.
    """
    fence, (*drawn, around) = scenario.fence, margins(scenario)
    axes = len(drawn)
    low = [each + m for each, m in zip(fence.low_m, drawn, strict=False)] or [-math.inf] * axes
    high = [each - m for each, m in zip(fence.high_m, drawn, strict=False)] or [math.inf] * axes
    return low, high, (fence.radius_m - around if fence.radius_m else math.inf)
