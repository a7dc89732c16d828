"""Inner bounds of a fence: the stated bounds, moved inwards by margins.

A desired trajectory must stay within the inner bounds. Wind and model errors then do not move the
vehicle over the stated bounds, see `client.fence`.
"""

import math

from skytether.shared.fence.keys import FenceConfig
from skytether.shared.scenario.schema import Scenario

SLOW_STEPS = 2
"""Difference of the time constants: T of `client.fence` minus the vehicle's [steps]."""
ERROR_S = 0.06
"""Margin for all model errors together, divided by the vehicle's largest speed [s]."""
WEAK = 1.25
"""Factor on the margin for wind, for a vehicle whose gain is 20 % below the model's."""
LATER_S = 0.1
"""Largest time by which the vehicle's dead time may exceed the model's dead time [s]."""


def margins(scenario: Scenario) -> list[float]:
    """Margin of the bounds on each axis, and as last item the margin of `fence.radius_m` [m]."""
    terms, fence, dt = scenario.terms(), scenario.section(FenceConfig), scenario.control.dt
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


def inner_bounds(scenario: Scenario) -> tuple[list[float], list[float], float]:
    """Inner bounds: lowest and highest position on each axis, and largest distance from home [m].

    A bound that the fence lacks is infinite.
    """
    fence, (*drawn, around) = scenario.section(FenceConfig), margins(scenario)
    axes = len(drawn)
    low = [each + m for each, m in zip(fence.low_m, drawn, strict=False)] or [-math.inf] * axes
    high = [each - m for each, m in zip(fence.high_m, drawn, strict=False)] or [math.inf] * axes
    return low, high, (fence.radius_m - around if fence.radius_m else math.inf)
