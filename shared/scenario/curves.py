"""Smooth closed curves as desired trajectories: entries of the table `REFERENCES`. The table's
other entries are in `points` and `targets`.

Each function makes a desired trajectory (`shared.scenario.reference`) from the scenario's keys, as
a shape of a plug-in does.
"""

import numpy as np

from skytether.shared.scenario.reference import Reference, planar
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario

reference = REFERENCES
"""Decorator of a shape. A shape is a function that takes the `Scenario` and the shape's own
numbers, and returns a `Reference`."""


def circle(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Circle around the origin, counter-clockwise, starting at (radius, 0)."""
    w = 2.0 * np.pi / period_s
    return planar(
        lambda t: (radius_m * np.cos(w * t), -radius_m * w * np.sin(w * t)),
        lambda t: (radius_m * np.sin(w * t), radius_m * w * np.cos(w * t)),
        axes,
        altitude_m,
    )


def figure_eight(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Gerono's lemniscate: 2 radii wide, 1 radius high, starting at its crossing point."""
    w = 2.0 * np.pi / period_s
    return planar(
        lambda t: (radius_m * np.sin(w * t), radius_m * w * np.cos(w * t)),
        lambda t: (0.5 * radius_m * np.sin(2.0 * w * t), radius_m * w * np.cos(2.0 * w * t)),
        axes,
        altitude_m,
    )


@reference(name="circle")
def flown_circle(scenario: Scenario) -> Reference:
    """Circle of `radius_m` around the origin, counter-clockwise, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return circle(config.radius_m, config.period_s, axes, config.altitude_m)


@reference(name="figure-eight")
def flown_figure_eight(scenario: Scenario) -> Reference:
    """Lemniscate, 2 `radius_m` wide and `radius_m` high, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return figure_eight(config.radius_m, config.period_s, axes, config.altitude_m)
