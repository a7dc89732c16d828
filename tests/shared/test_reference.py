"""References: positions, velocities, periods, and files."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from skytether.shared.scenario import curves, points, reference, targets
from skytether.shared.scenario.reading import check

quick = settings(max_examples=30)

SLOPE_S = 1e-5
"""Half width of a central difference [s]."""
ROUTE = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 6.0], [-1.0, 6.0]])
"""Legs of 5, 2 and 4 m, and √37 m back."""


def sample(desired: reference.Reference, t: float) -> tuple[list[float], list[float]]:
    state = desired(np.array(t))
    return state[:, 0].tolist(), state[:, 1].tolist()


@pytest.mark.parametrize(
    ("t", "position", "velocity"),
    [
        (0.0, (2.0, 0.0), (0.0, 1.0)),
        (np.pi, (0.0, 2.0), (-1.0, 0.0)),
        (2 * np.pi, (-2.0, 0.0), (0.0, -1.0)),
        (3 * np.pi, (0.0, -2.0), (1.0, 0.0)),
    ],
)
def test_circle_runs_counter_clockwise(
    t: float, position: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    p, v = sample(curves.circle(2.0, 4 * np.pi, 2), t)
    assert p == pytest.approx(position, abs=1e-12)
    assert v == pytest.approx(velocity, abs=1e-12)


@pytest.mark.parametrize(
    ("eighths", "position"),
    [
        (0, (0.0, 0.0)),
        (1, (3.0 * np.sqrt(0.5), 1.5)),
        (2, (3.0, 0.0)),
        (3, (3.0 * np.sqrt(0.5), -1.5)),
        (4, (0.0, 0.0)),
        (6, (-3.0, 0.0)),
    ],
)
def test_figure_eight_passes_its_crossing_and_its_ends(
    eighths: int, position: tuple[float, ...]
) -> None:
    p, _ = sample(curves.figure_eight(3.0, 16.0, 2), 2.0 * eighths)
    assert p == pytest.approx(position, abs=1e-12)


Closed = Callable[..., reference.Reference]
CLOSED: list[Closed] = [curves.circle, curves.figure_eight]


@quick
@given(st.floats(0.0, 100.0), st.integers(1, 4), st.sampled_from(CLOSED))
def test_closed_curves_repeat_every_period(t: float, rounds: int, shape: Closed) -> None:
    desired = shape(1.5, 14.2, 2)
    np.testing.assert_allclose(
        desired(np.array(t + 14.2 * rounds)), desired(np.array(t)), rtol=0, atol=1e-11
    )


@quick
@given(st.floats(0.0, 60.0), st.sampled_from(CLOSED), st.sampled_from([2, 3]))
def test_velocity_is_the_slope_of_a_smooth_curve(t: float, shape: Closed, axes: int) -> None:
    """E6: the velocity that the controller uses is the derivative of the position."""
    desired = shape(1.5, 14.2, axes, 0.7)
    before, after = desired(np.array([t - SLOPE_S, t + SLOPE_S]))[..., 0]
    slope = (after - before) / (2 * SLOPE_S)
    np.testing.assert_allclose(desired(np.array(t))[:, 1], slope, rtol=0, atol=1e-8)


@quick
@given(st.floats(0.0, 40.0), st.booleans())
def test_velocity_is_the_slope_between_waypoints(t: float, loop: bool) -> None:
    desired = points.waypoints(ROUTE, 2.0, loop=loop)
    corners = np.cumsum([0.0, 5.0, 2.0, 4.0, np.sqrt(37.0)]) / 2.0
    phase = t % corners[-1] if loop else t
    assume(np.abs(phase - corners).min() > 2 * SLOPE_S)
    before, after = desired(np.array([t - SLOPE_S, t + SLOPE_S]))[..., 0]
    slope = (after - before) / (2 * SLOPE_S)
    np.testing.assert_allclose(desired(np.array(t))[:, 1], slope, rtol=0, atol=1e-8)


def test_plane_curves_fly_level_in_space() -> None:
    for desired in (
        curves.circle(1.0, 10.0, 3, 2.5),
        curves.figure_eight(1.0, 10.0, 3, 2.5),
        points.square(1.0, 10.0, 3, 2.5),
    ):
        up = desired(np.linspace(0.0, 25.0, 101))[:, 2]
        np.testing.assert_array_equal(up, np.tile([2.5, 0.0], (101, 1)))


def test_square_turns_at_its_corners() -> None:
    """Radius 2 m in 16 s: a corner every 4 s, at 1 m/s, counter-clockwise."""
    desired = points.square(2.0, 16.0, 2)
    corners = [[2.0, -2.0], [2.0, 2.0], [-2.0, 2.0], [-2.0, -2.0], [2.0, -2.0]]
    ways = [[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]]
    states = desired(4.0 * np.arange(5))
    np.testing.assert_allclose(states[..., 0], corners, atol=1e-12)
    np.testing.assert_allclose(states[..., 1], ways, atol=1e-12)


@quick
@given(st.floats(0.0, 100.0))
def test_square_keeps_to_its_edge_at_one_speed(t: float) -> None:
    p, v = sample(points.square(1.5, 12.0, 2), t)
    assert max(np.abs(p)) == pytest.approx(1.5)
    assert np.linalg.norm(v) == pytest.approx(1.0)


def test_waypoints_are_passed_at_constant_speed_from_rest_to_rest() -> None:
    desired = points.waypoints(ROUTE, 2.0)
    assert sample(desired, -1.0) == ([0.0, 0.0], [0.0, 0.0])
    assert sample(desired, 0.0) == ([0.0, 0.0], pytest.approx([1.2, 1.6]))
    assert sample(desired, 1.25) == (pytest.approx([1.5, 2.0]), pytest.approx([1.2, 1.6]))
    assert sample(desired, 3.0) == (pytest.approx([3.0, 5.0]), [0.0, 2.0])
    assert sample(desired, 4.5) == (pytest.approx([1.0, 6.0]), [-2.0, 0.0])
    for t in (5.5, 5.6, 1000.0):
        assert sample(desired, t) == ([-1.0, 6.0], [0.0, 0.0])


def test_looped_waypoints_fly_home_and_on() -> None:
    desired = points.waypoints(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]), 1.0, loop=True)
    assert sample(desired, 9.5) == (pytest.approx([1.5, 2.0]), pytest.approx([-0.6, -0.8]))
    assert sample(desired, 12.0) == ([0.0, 0.0], [1.0, 0.0])
    assert sample(desired, 13.0) == (pytest.approx([1.0, 0.0]), [1.0, 0.0])


def test_hover_stays_where_it_is() -> None:
    states = points.hover(np.array([1.0, -2.0, 3.0]))(np.array([0.0, 1.0, 1e6]))
    np.testing.assert_array_equal(states[..., 0], [[1.0, -2.0, 3.0]] * 3)
    np.testing.assert_array_equal(states[..., 1], np.zeros((3, 3)))


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(
    "table",
    [
        {"shape": "circle"},
        {"shape": "figure-eight"},
        {"shape": "square"},
        {"shape": "waypoints", "points_m": [[0, 0, 0], [1, 2, 2]]},
        {"shape": "hover", "points_m": [[1, 2, 3]]},
        {"shape": "target"},
    ],
)
def test_array_of_times_is_its_single_times(table: dict[str, object], axes: int) -> None:
    if "points_m" in table:
        table = table | {"points_m": [point[:axes] for point in table["points_m"]]}
    desired = check({"model": {"axes": axes}, "reference": table}, "test").make_reference()
    times = np.array([[0.0, 0.3, 2.9], [14.2, 17.0, 100.0]])
    singles = [[desired(np.array(t)) for t in row] for row in times]
    np.testing.assert_array_equal(desired(times), singles)


def test_a_target_stays_within_its_bounds_and_comes_back_the_way_it_went() -> None:
    """At any time in the future; an hour of its motion is random, then it repeats backwards."""
    rng = np.random.default_rng(1)
    desired = targets.target(rng, 2, agility=0.5, speed_mps=0.8, radius_m=2.0)
    times = np.arange(0.0, 200.0, 0.01)
    states = desired(times)
    assert np.abs(states[..., 0]).max() == pytest.approx(2.0, abs=0.01)
    assert np.abs(states[..., 1]).max() == pytest.approx(0.8, abs=0.01)
    travelled = np.abs(np.diff(states[..., 0], axis=0)).max() / 0.01
    assert travelled <= 0.8 + 1e-9
    back = desired(2.0 * targets.TURN_S - times)
    np.testing.assert_allclose(back[..., 0], states[..., 0], atol=1e-6)
    np.testing.assert_allclose(back[1:, :, 1], -states[1:, :, 1], atol=1e-6)
    again = desired(times + 1e6 * targets.TURN_S)
    np.testing.assert_allclose(again[..., 0], states[..., 0], atol=1e-5)
    assert desired(np.array(9e9)).shape == (2, 2)  # without allocating memory up to that time


def test_a_target_that_turns_now_and_then_flies_straight_in_between() -> None:
    """The mean square change of its velocity equals that of a target that turns all the time."""
    far: dict[str, Any] = {"agility": 0.3, "speed_mps": 1e3, "radius_m": 1e6}
    desired = targets.target(np.random.default_rng(1), 2, **far, turn_every_s=4.0)
    grid_s = np.arange(0.0, 3000.0, targets.GRID_S)
    changes = np.diff(desired(grid_s)[..., 1], axis=0)
    turned = (changes != 0.0).any(axis=1)
    assert turned.sum() == pytest.approx(3000.0 / 4.0, rel=0.1)
    assert (changes[turned] != 0.0).all()  # on both axes at once
    assert (changes**2).sum() / (2 * 3000.0) == pytest.approx(0.3**2, rel=0.1)
