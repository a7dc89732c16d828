"""References through given points: rest at a point, or straight lines between points."""

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import FAR_M, FAST_MPS, Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario


def points(scenario: Scenario) -> Array:
    return np.array(scenario.reference.points_m, dtype=np.float64)


def hover(point_m: Array) -> Reference:
    point = np.asarray(point_m, dtype=np.float64)

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        state = np.zeros((*t.shape, len(point), 2))
        state[..., 0] = point
        return state

    return sample


def timed_path(times_s: Array, points_m: Array, *, loop: bool = False) -> Reference:
    """Path of straight lines between points, each reached at its time.

    Args:
        times_s: rising times, from 0 [s]; shape (n,).
        points_m: points [m]; shape (n, axes).
        loop: start again after the last point; otherwise stay there.

    Raises:
        ValueError: a point is beyond FAR_M, or a speed above FAST_MPS.
    """
    times_s, points_m = np.asarray(times_s, float), np.asarray(points_m, float)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slopes = np.diff(points_m, axis=0) / np.diff(times_s)[:, None]
    if not ((np.abs(points_m) <= FAR_M).all() and (np.abs(slopes) <= FAST_MPS).all()):
        raise ValueError(f"expected at most {FAR_M:g} m from the origin, and {FAST_MPS:g} m/s")

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        t = np.mod(t, times_s[-1]) if loop else t
        leg = np.clip(np.searchsorted(times_s, t, side="right") - 1, 0, len(slopes) - 1)
        moving = (t >= times_s[0]) & (t < times_s[-1])
        velocity = np.where(moving[..., None], slopes[leg], 0.0)
        clipped = np.clip(t, times_s[0], times_s[-1])
        position = points_m[leg] + slopes[leg] * (clipped - times_s[leg])[..., None]
        return np.stack([position, velocity], axis=-1)

    return sample


def waypoints(points_m: Array, speed_mps: float, *, loop: bool = False) -> Reference:
    """Path through points [m; shape (n, axes)] at constant speed.

    With `loop` the path returns to the first point and repeats.

    Raises:
        ValueError: see `timed_path`; or two points are too close to each other.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if loop:
        points = np.concatenate([points, points[:1]])
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return timed_path(np.concatenate([[0.0], np.cumsum(lengths_m) / speed_mps]), points, loop=loop)


def square(radius_m: float, period_s: float, axes: int, altitude_m: float = 0.0) -> Reference:
    """Square with corners (±radius, ±radius), flown counter-clockwise from (radius, -radius)."""
    corners = np.zeros((4, axes))
    corners[:, :2] = radius_m * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]])
    corners[:, 2:] = altitude_m
    return waypoints(corners, 8.0 * radius_m / period_s, loop=True)


@REFERENCES(name="square")
def flown_square(scenario: Scenario) -> Reference:
    """Square with corners at ±`radius_m`, one round in `period_s`."""
    config, axes = scenario.reference, scenario.model.axes
    return square(config.radius_m, config.period_s, axes, config.altitude_m)


@REFERENCES(name="waypoints")
def flown_waypoints(scenario: Scenario) -> Reference:
    """Path through `points_m` at `speed_mps`, repeated with `loop`."""
    config = scenario.reference
    return waypoints(points(scenario), config.speed_mps, loop=config.loop)


@REFERENCES(name="hover")
def flown_hover(scenario: Scenario) -> Reference:
    """Rest at the point in `points_m`."""
    return hover(points(scenario)[0])


@REFERENCES
def live(scenario: Scenario) -> Reference:
    """Point that is moved in flight, starting at the point in `points_m` or the origin."""
    given = points(scenario)
    return hover(given[0] if len(given) else np.zeros(scenario.model.axes))
