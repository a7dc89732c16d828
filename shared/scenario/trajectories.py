"""Built-in shapes of the desired trajectory: entries of the table `REFERENCES`.

Each makes a trajectory (`shared.scenario.reference`) from the keys of the scenario, as a plug-in's
shape does.
"""

import numpy as np

from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario import reference as curves
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

reference = REFERENCES
"""Decorator of a shape: a function of the `Scenario` and its own numbers, returning a
`Reference`."""


def _points(scenario: Scenario) -> Array:
    return np.array(scenario.reference.points_m, dtype=np.float64)


@reference
def circle(scenario: Scenario) -> Reference:
    """Circle of `radius_m` around the origin, counter-clockwise, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return curves.circle(config.radius_m, config.period_s, axes, config.altitude_m)


@reference(name="figure-eight")
def figure_eight(scenario: Scenario) -> Reference:
    """Lemniscate, 2 `radius_m` wide and 1 high, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return curves.figure_eight(config.radius_m, config.period_s, axes, config.altitude_m)


@reference
def square(scenario: Scenario) -> Reference:
    """Square with corners at ±`radius_m`, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return curves.square(config.radius_m, config.period_s, axes, config.altitude_m)


@reference
def waypoints(scenario: Scenario) -> Reference:
    """Path through `points_m` at `speed_mps`, repeated with `loop`."""
    config = scenario.reference
    return curves.waypoints(_points(scenario), config.speed_mps, loop=config.loop)


@reference
def hover(scenario: Scenario) -> Reference:
    """Rest at the point in `points_m`."""
    return curves.hover(_points(scenario)[0])


@reference
def target(scenario: Scenario) -> Reference:
    """Random walk known only to the server, of `agility`, within `speed_mps` and `radius_m`."""
    config = scenario.reference
    return curves.target(
        stream(scenario.seed, "target"),
        scenario.model.axes,
        agility=config.agility,
        speed_mps=config.speed_mps,
        radius_m=config.radius_m,
        turn_every_s=config.turn_every_s,
    )


@reference
def live(scenario: Scenario) -> Reference:
    """Point that is moved in flight, starting at the point in `points_m` or the origin."""
    points = _points(scenario)
    return curves.hover(points[0] if len(points) else np.zeros(scenario.model.axes))
