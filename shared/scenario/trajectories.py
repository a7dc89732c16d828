"""Shapes of the desired trajectory that come with Skytether: entries of the table `REFERENCES`.

Each makes its trajectory (`shared.scenario.reference`) of the scenario's keys. A plug-in's shape is
an entry like these.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario import mission as missions
from skytether.shared.scenario import reference as curves
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

reference = REFERENCES
"""Decorator of a shape: a function of the `Scenario` and its numbers that gives a `Reference`."""


def _points(scenario: Scenario) -> Array:
    """Waypoints of the scenario [m]; shape (n, axes)."""
    return np.array(scenario.reference.points_m, dtype=np.float64)


@reference
def circle(scenario: Scenario) -> Reference:
    """Circle of `radius_m` around the origin, counter-clockwise, one round in `period_s`."""
    wanted, axes = scenario.reference, scenario.model.axes
    return curves.circle(wanted.radius_m, wanted.period_s, axes, wanted.altitude_m)


@reference(name="figure-eight")
def figure_eight(scenario: Scenario) -> Reference:
    """Lemniscate, 2 `radius_m` wide and 1 high, one round in `period_s`."""
    wanted, axes = scenario.reference, scenario.model.axes
    return curves.figure_eight(wanted.radius_m, wanted.period_s, axes, wanted.altitude_m)


@reference
def square(scenario: Scenario) -> Reference:
    """Square with corners at ±`radius_m`, one round in `period_s`."""
    wanted, axes = scenario.reference, scenario.model.axes
    return curves.square(wanted.radius_m, wanted.period_s, axes, wanted.altitude_m)


@reference
def waypoints(scenario: Scenario) -> Reference:
    """Path through `points_m` at `speed_mps`, round and round with `loop`."""
    wanted = scenario.reference
    return curves.waypoints(_points(scenario), wanted.speed_mps, loop=wanted.loop)


@reference
def hover(scenario: Scenario) -> Reference:
    """Rest at the one point of `points_m`."""
    return curves.hover(_points(scenario)[0])


@reference
def csv(scenario: Scenario) -> Reference:
    """Path from the table in `file`, with the columns t, x, y (and z)."""
    return curves.from_csv(scenario.table, scenario.model.axes)


@reference
def target(scenario: Scenario) -> Reference:
    """Random walk that only the server sees, of `agility`, within `speed_mps` and `radius_m`."""
    wanted = scenario.reference
    return curves.target(
        stream(scenario.seed, "target"),
        scenario.model.axes,
        agility=wanted.agility,
        speed_mps=wanted.speed_mps,
        radius_m=wanted.radius_m,
        turn_every_s=wanted.turn_every_s,
    )


@reference
def live(scenario: Scenario) -> Reference:
    """Point that is moved while it flies, from the one of `points_m` or the origin on."""
    points = _points(scenario)
    return curves.hover(points[0] if len(points) else np.zeros(scenario.model.axes))


@reference
def swap(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: places on a circle of `radius_m`, of which each vehicle goes to the one opposite."""
    wanted = scenario.reference
    return missions.swap(vehicles, wanted.radius_m, scenario.model.axes, wanted.altitude_m)


@reference
def sphere(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: places on a sphere of `radius_m`; each vehicle goes to the one opposite."""
    wanted = scenario.reference
    return missions.sphere(vehicles, wanted.radius_m, wanted.altitude_m)


@reference
def mission(scenario: Scenario) -> Reference:
    """Mission: goals from the table in `file`, with the columns vehicle, t, x, y (and z)."""
    return missions.mission(scenario.table, scenario.model.axes)
