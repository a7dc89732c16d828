"""Checks of missions: goals that are too near to each other, for any number of vehicles."""

from itertools import combinations

import numpy as np
import pytest

from skytether.shared.formats.tracks import tracks
from skytether.shared.law.model import Array
from skytether.shared.missions.mission import Mission

Goals = dict[int, tuple[Array, Array]]
MANY = 2_000


def each_with_each(goals: Goals, apart_m: float, height: float) -> tuple[float, float] | None:
    """First time and distance of goals that are too near, by comparing all at all times."""
    times = np.unique(np.concatenate([times_s for times_s, _ in goals.values()]))
    all_ = Mission(goals, 3, 1)
    for at_s in times.tolist():
        places = [all_.of(number)(np.array(at_s))[:, 0] * [1.0, 1.0, height] for number in goals]
        away = min((np.linalg.norm(a - b) for a, b in combinations(places, 2)), default=np.inf)
        if away < apart_m:
            return at_s, float(away)
    return None


def drawn(rng: np.random.Generator, below: int) -> Goals:
    """Goals of fewer than so many vehicles, one to four each, in whole seconds."""
    goals: Goals = {}
    for number in range(1, int(rng.integers(2, below))):
        times_s = np.append(0.0, np.sort(rng.choice(10, rng.integers(0, 4), replace=False) + 1))
        goals[number] = times_s, rng.uniform(-3.0, 3.0, (len(times_s), 3))
    return goals


@pytest.mark.parametrize("seed", range(4))
def test_the_first_two_that_are_too_near_are_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        goals = drawn(rng, 9)
        apart_m, height = rng.uniform(0.1, 1.5), rng.choice([1.0, 0.5, 0.0])
        found = Mission(goals, 3, 1).nearest(apart_m, height)
        assert (found and found[2:]) == pytest.approx(each_with_each(goals, apart_m, height))


def test_vehicles_that_take_turns_at_a_place_are_not_too_near() -> None:
    turns: Goals = {
        1: (np.array([0.0, 5.0]), np.array([[0.0, 0.0], [9.0, 9.0]])),
        2: (np.array([0.0, 5.0]), np.array([[5.0, 5.0], [0.0, 0.0]])),
    }
    assert Mission(turns, 2, 1).nearest(1.0, 1.0) is None
    turns[2] = np.array([0.0, 4.0]), turns[2][1]
    assert Mission(turns, 2, 1).nearest(1.0, 1.0) == (1, 2, 4.0, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_paths_that_come_too_near_are_found_between_their_points(seed: int) -> None:
    rng, grid_s = np.random.default_rng(seed), np.linspace(0.0, 12.0, 2401)
    for _ in range(10):
        goals = drawn(rng, 6)
        apart_m, height = rng.uniform(0.1, 1.5), rng.choice([1.0, 0.5, 0.0])
        show = Mission(goals, 3, 1, is_show=True)
        places = [show.of(n)(grid_s)[..., 0] * [1.0, 1.0, height] for n in goals]
        away_m = [np.linalg.norm(a - b, axis=1) for a, b in combinations(places, 2)]
        least_m = float(np.min(away_m, initial=np.inf))
        found = show.nearest(apart_m, height)
        # On the grid a path is at most 2 · 3 √3 · 2 m/s · 2.5 ms from where it is nearest.
        assert (found is not None) == (least_m < apart_m) or abs(least_m - apart_m) < 0.06
        if found:
            one, other, at_s, found_m = found
            a, b = (show.of(n)(np.array(at_s))[:, 0] * [1.0, 1.0, height] for n in (one, other))
            assert np.linalg.norm(a - b) == pytest.approx(found_m, abs=1e-9)
            early = grid_s < at_s - 1.0
            assert not any((each[early] < apart_m).any() for each in away_m) or found_m < apart_m


def grid(vehicles: int) -> Array:
    return np.stack(np.divmod(np.arange(vehicles), round(vehicles**0.5)), axis=1).astype(float)


def test_many_vehicles_are_checked_in_proportion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distances are measured within neighbouring cells alone: some per vehicle, not all pairs."""
    measured = 0
    norm = np.linalg.norm

    def counted(between: Array, axis: int | None = None) -> Array:
        nonlocal measured
        measured += len(between)
        return norm(between, axis=axis)

    monkeypatch.setattr(np.linalg, "norm", counted)
    lines = [f"{i + 1},{t},{x},{y}" for i, (x, y) in enumerate(grid(MANY)) for t in (0, 5)]
    table = "\n".join(["vehicle,t,x,y", *lines]).encode()
    read = Mission(tracks(table, 2), 2, 1)
    assert read.nearest(0.99, 1.0) is None
    assert read.nearest(1.01, 1.0) == (1, 2, 0.0, 1.0)
    heap = Mission({i + 1: (np.zeros(1), np.zeros((1, 2))) for i in range(MANY)}, 2, 1)
    assert heap.nearest(0.5, 1.0) == (1, 2, 0.0, 0.0)
    times_s, home = np.array([0.0, 1.0, 2.0]), 5.0 + grid(MANY)
    in_turn: Goals = {
        i + 1: (times_s + np.array([0.0, i, i]), np.array([at, [0.0, 0.0], at]))
        for i, at in enumerate(home)
    }
    assert Mission(in_turn, 2, 1).nearest(0.99, 1.0) is None
    assert MANY < measured < 100 * MANY


def test_numbers_of_vehicles_are_those_that_fly() -> None:
    """Numbers have two bytes on the wire."""
    for number in (0, 65_536, 1.5):
        with pytest.raises(ValueError, match="line 2: vehicle: expected numbers"):
            tracks(f"vehicle,t,x,y\n{number},0,0,0\n".encode(), 2)
