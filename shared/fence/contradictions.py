"""Contradictions of a fence: with its margins, and with the desired trajectory."""

import math
from collections.abc import Iterator

import numpy as np

from skytether.shared.fence.keys import FenceConfig
from skytether.shared.fence.margins import inner_bounds, margins
from skytether.shared.law.model import Array
from skytether.shared.scenario import reference as shapes
from skytether.shared.scenario.schema import Contradiction, Scenario

FENCED_STEPS_MAX = 100_000


def of_way(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of the fence: its interior is empty, or the desired trajectory crosses it."""
    yield from list(_no_place(scenario)) or _outside(scenario)


def _no_place(scenario: Scenario) -> Iterator[Contradiction]:
    fence = scenario.section(FenceConfig)
    low, high, radius = inner_bounds(scenario)
    drawn = max(margins(scenario))
    wind = f"fence.wind_mps = {fence.wind_mps:g}"
    fastest = scenario.u_max * scenario.model_gain
    slowest = min(*fastest.tolist(), fence.speed_mps or math.inf)
    if fence.wind_mps >= slowest:
        yield "fence.wind_mps", fence.wind_mps, f"less than {slowest:g}, the vehicle's speed"
    if any(least >= most for least, most in zip(low, high, strict=True)):
        spacing = f"more than {2 * drawn:.2g} m above fence.low_m, with {wind}"
        yield "fence.high_m", list(fence.high_m), spacing
    if radius <= 0.0:
        yield "fence.radius_m", fence.radius_m, f"more than {drawn:.2g} m, with {wind}"


def _outside(scenario: Scenario) -> Iterator[Contradiction]:
    steps = min(scenario.steps, FENCED_STEPS_MAX)
    reference, times_s = (
        scenario.unallocated_reference(),
        np.arange(steps + 1) * scenario.control.dt,
    )
    for vehicle in reference.vehicles if isinstance(reference, shapes.OfFleet) else (1,):
        states = scenario.unallocated_reference(vehicle)(times_s)
        wrong = list(_over_fence(scenario, scenario.start_m(vehicle), states))
        yield from wrong
        if wrong:
            return


def _over_fence(scenario: Scenario, home: Array, states: Array) -> Iterator[Contradiction]:
    """First contradiction of the fence with a trajectory that leaves it or is too fast."""
    fence = scenario.section(FenceConfig)
    position, speed = states[..., 0], np.linalg.norm(states[..., 1], axis=1)
    low, high, radius = inner_bounds(scenario)
    far = np.linalg.norm(position - home, axis=1)
    checks = (
        ("fence.low_m", list(fence.low_m), (position < low).any(axis=1), "lower"),
        ("fence.high_m", list(fence.high_m), (position > high).any(axis=1), "higher"),
        ("fence.radius_m", fence.radius_m, far > radius, "more"),
        ("fence.speed_mps", fence.speed_mps, speed > (fence.speed_mps or np.inf), "more"),
    )
    for key, value, over, more in checks:
        if over.any():
            at = int(over.argmax())
            where = ", ".join(f"{each:.3g}" for each in position[at])
            demanded = f"at {at * scenario.control.dt:g} s ({where}) m at {speed[at]:.3g} m/s"
            margin = f"a margin of {max(margins(scenario)):.2g} m"
            yield (
                key,
                value,
                f"{more}, because the trajectory needs {demanded}, with {margin}",
            )
            return
