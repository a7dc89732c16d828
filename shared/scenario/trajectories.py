"""Built-in shapes of the desired trajectory: entries of the table `REFERENCES`.

Each makes a trajectory (`shared.scenario.reference`) from the keys of the scenario, as a plug-in's
shape does.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array
from skytether.shared.scenario import mission as missions
from skytether.shared.scenario import reference as curves
from skytether.shared.scenario import tracks
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
def csv(scenario: Scenario) -> Reference:
    """Timed path of one vehicle from `file`, straight from point to point."""
    keys = scenario.reference
    return tracks.path(scenario.table, scenario.model.axes, keys.origin, keys.speed_mps)


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


@reference
def swap(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: vehicles on a circle of `radius_m`, each of which goes to the opposite place."""
    config = scenario.reference
    return missions.swap(vehicles, config.radius_m, scenario.model.axes, config.altitude_m)


@reference
def sphere(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: vehicles on a sphere of `radius_m`, each of which goes to the opposite place."""
    config = scenario.reference
    return missions.sphere(vehicles, config.radius_m, config.altitude_m)


@reference
def mission(scenario: Scenario) -> Reference:
    """Mission with timed goals from `file`, at each of which a vehicle rests."""
    return _mission(scenario, is_show=False)


@reference
def show(scenario: Scenario) -> Reference:
    """Mission of timed paths from `file`: each point is reached at its time, and not after it."""
    return _mission(scenario, is_show=True)


def _mission(scenario: Scenario, *, is_show: bool) -> Reference:
    axes, keys = scenario.model.axes, scenario.reference
    found = tracks.tracks(scenario.table, axes, keys.origin, keys.speed_mps)
    return missions.Mission(found, axes, 1, is_show=is_show)
