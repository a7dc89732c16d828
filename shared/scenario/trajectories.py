"""Circle and points as desired trajectories: entries of the table `REFERENCES`, which has others
from `curves` and `targets`.

Each makes a trajectory (`shared.scenario.reference`) from the keys of the scenario, as a plug-in's
shape does.
"""

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.scenario import reference as curves
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

reference = REFERENCES
"""Decorator of a shape: a function of the `Scenario` and its own numbers, returning a
`Reference`."""


def points(scenario: Scenario) -> Array:
    return np.array(scenario.reference.points_m, dtype=np.float64)


@reference
def circle(scenario: Scenario) -> Reference:
    """Circle of `radius_m` around the origin, counter-clockwise, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return curves.circle(config.radius_m, config.period_s, axes, config.altitude_m)


@reference
def hover(scenario: Scenario) -> Reference:
    """Rest at the point in `points_m`."""
    return curves.hover(points(scenario)[0])


@reference
def live(scenario: Scenario) -> Reference:
    """Point that is moved in flight, starting at the point in `points_m` or the origin."""
    given = points(scenario)
    return curves.hover(given[0] if len(given) else np.zeros(scenario.model.axes))
