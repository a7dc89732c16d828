"""Missions: timed goals or timed paths (a show) of several vehicles, kept apart by the server.

A mission is also the reference of a vehicle: the vehicle's present goal with velocity 0, or in a
show the present point and velocity of the vehicle's path.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import count, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law.model import Array
from skytether.shared.scenario.grammar import GrammarError, calls
from skytether.shared.scenario.points import timed_path
from skytether.shared.scenario.reference import FAR_M, OfFleet, Reference

SWAP_AT_S = 2.0
"""Time at which vehicles that swap places depart [s]."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Azimuth between consecutive points of a Fibonacci sphere [rad]."""
TINY_MPS = 1e-6
"""Tolerance of speeds [m/s]."""
PLACES_AT_ONCE = 1_000_000
"""Number of positions of a show that are compared at once; the bound limits memory."""
CROWDED = 32
"""Number of simultaneous stays in neighbouring cells above which two of them must be too near to
each other."""


class Mission(OfFleet):
    """Timed goals of all vehicles, and the reference of one vehicle.

    A vehicle starts at its first goal. A vehicle without goals stays at the origin.

    Args:
        goals: by number of the vehicle, rising times [s; shape (n,)] and the goal from each time on
            [m; shape (n, axes)].
        axes: number of axes.
        vehicle: number of the vehicle whose reference this is.
        is_show: whether vehicles follow straight lines from goal to goal, each reached at its time.
    """

    def __init__(
        self,
        goals: Mapping[int, tuple[Array, Array]],
        axes: int,
        vehicle: int,
        *,
        is_show: bool = False,
    ) -> None:
        self._goals, self._axes, self.is_show = goals, axes, is_show
        self._times_s, self._points_m = goals.get(vehicle, (np.zeros(1), np.zeros((1, axes))))
        self._times: list[float] = self._times_s.tolist()
        moves = is_show and len(self._times) > 1
        self._path = timed_path(self._times_s, self._points_m) if moves else None

    @property
    def vehicles(self) -> tuple[int, ...]:
        return tuple(self._goals)

    @property
    def places(self) -> Array:
        return np.concatenate([points_m for _, points_m in self._goals.values()])

    @property
    def in_step(self) -> bool:
        """Whether all vehicles have goals at the same times."""
        times_s = [times_s for times_s, _ in self._goals.values()]
        return all(np.array_equal(each, times_s[0]) for each in times_s)

    @property
    def lasts_s(self) -> float:
        return max(float(times_s[-1]) for times_s, _ in self._goals.values())

    def of(self, vehicle: int) -> "Mission":
        return Mission(self._goals, self._axes, vehicle, is_show=self.is_show)

    def goals(self, vehicle: int) -> Array:
        return self._goals[vehicle][1]

    def __call__(self, t: NDArray[Any]) -> Array:
        if self._path:
            return self._path(t)
        t = np.asarray(t, dtype=np.float64)
        if not t.ndim:  # called once per step of a vehicle, and faster without arrays
            state = np.zeros((self._axes, 2))
            state[:, 0] = self._points_m[max(bisect_right(self._times, float(t)) - 1, 0)]
            return state
        state = np.zeros((*t.shape, self._axes, 2))
        at = self._times_s.searchsorted(t, side="right") - 1
        state[..., 0] = self._points_m[np.maximum(at, 0)]
        return state

    def nearest(self, apart_m: float, height: float) -> tuple[int, int, float, float] | None:
        """First two vehicles whose goals, or paths, are nearer than `apart_m` at the same time.

        Args:
            apart_m: distance [m].
            height: factor on distances along the third axis.

        Returns:
            numbers of the two vehicles, time [s] and distance [m]; None if no two are too near.
        """
        if self.is_show:
            return _nearest_on_paths(self._goals, apart_m, height)
        stays = _Stays.of(self._goals, height)
        pair = stays.nearest(apart_m)
        if pair is None:
            return None
        one, other = sorted(stays.vehicles[list(pair)].tolist())
        return one, other, float(stays.begin_s[list(pair)].max()), stays.distance_m(*pair)

    def count_places(self) -> int:
        """Number of positions that `nearest` compares in a show."""
        times_s = np.concatenate([times_s for times_s, _ in self._goals.values()])
        return len(np.unique(times_s)) * len(self._goals)

    def too_fast(self, most_mps: Array) -> tuple[int, float, int, float] | None:
        """First vehicle of a show that is faster than a vehicle can fly.

        Args:
            most_mps: largest speed on each axis [m/s]; shape (axes,).

        Returns:
            number of the vehicle, time [s], axis and speed [m/s]; None if there is no such vehicle.
        """
        for vehicle, (times_s, points_m) in self._goals.items():
            with np.errstate(over="ignore"):
                speeds_mps = np.abs(np.diff(points_m, axis=0)) / np.diff(times_s)[:, None]
            over = np.argwhere(speeds_mps > most_mps + TINY_MPS)
            if len(over):
                k, axis = over[0].tolist()
                return vehicle, float(times_s[k]), axis, float(speeds_mps[k, axis])
        return None

    def allocated(self) -> "Mission":
        """Mission with the goals of each time allocated to vehicles by linear assignment.

        The allocation minimises the sum of the squared distances to the next goals, so that paths
        cross less. The mission must be `in_step`.
        """
        from scipy.optimize import linear_sum_assignment  # clients have no scipy

        times_s = next(iter(self._goals.values()))[0]
        wanted = np.stack([points_m for _, points_m in self._goals.values()], axis=1)
        assigned = wanted[:1]
        for goals in wanted[1:]:
            cost = ((assigned[-1][:, None] - goals[None]) ** 2).sum(axis=2)
            assigned = np.append(assigned, goals[None, linear_sum_assignment(cost)[1]], axis=0)
        allocated = {vehicle: (times_s, assigned[:, i]) for i, vehicle in enumerate(self._goals)}
        return Mission(allocated, self._axes, 1)


class _Stays(NamedTuple):
    """Stays of all vehicles at goals. A stay lasts from its goal's time to the next goal's time."""

    vehicles: NDArray[np.int64]
    begin_s: Array
    end_s: Array
    places_m: Array
    """Goal of each stay, heights scaled [m]; shape (n, axes)."""

    @classmethod
    def of(cls, goals: Mapping[int, tuple[Array, Array]], height: float) -> "_Stays":
        counts = [len(times_s) for times_s, _ in goals.values()]
        begin_s = np.concatenate([times_s for times_s, _ in goals.values()])
        ends_s = [np.append(times_s[1:], np.inf) for times_s, _ in goals.values()]
        places_m = np.concatenate([points_m for _, points_m in goals.values()])
        places_m[:, 2:] *= height
        order = np.argsort(begin_s, kind="stable")
        vehicles = np.repeat(np.array(list(goals)), counts)
        return cls(vehicles[order], begin_s[order], np.concatenate(ends_s)[order], places_m[order])

    def distance_m(self, one: int, other: int) -> float:
        return float(np.linalg.norm(self.places_m[one] - self.places_m[other]))

    def nearest(self, apart_m: float) -> tuple[int, int] | None:
        """First two simultaneous stays nearer than `apart_m`; None if no two stays are so near.

        Stays are sorted into a grid with cells of `apart_m`, and by time within a cell. A stay is
        compared only with stays that begin before it ends, in its own and the neighbouring cells.
        So the time needed is proportional to the number of stays, unless many are too near.
        """
        cells = np.floor(self.places_m / apart_m)
        index, levels = np.empty(cells.shape, np.int64), []
        for axis, column in enumerate(cells.T):
            level, index[:, axis] = np.unique(column, return_inverse=True)
            levels.append(level)
        shape = [len(level) for level in levels]
        # Stays are sorted by begin, so the index of a stay is also its rank.
        until = np.searchsorted(self.begin_s, self.end_s)
        own = np.ravel_multi_index(tuple(index.T), shape)
        occupied, cell = np.unique(own, return_inverse=True)
        key = np.sort(cell * len(cell) + np.arange(len(cell)))
        pairs: list[tuple[float, float, int, int]] = []
        for offset in product((-1, 0, 1), repeat=len(shape)):
            around, is_occupied = _neighbours(cells + offset, levels, shape, occupied)
            stays = np.flatnonzero(is_occupied)
            first = np.searchsorted(key, around * len(cell) + stays + 1)
            behind = np.searchsorted(key, around * len(cell) + until[stays])
            pairs += self._pairs(stays, first, behind, key % len(cell), apart_m)
        return min(pairs)[2:] if pairs else None

    def _pairs(
        self,
        stays: NDArray[np.int64],
        first: NDArray[np.int64],
        behind: NDArray[np.int64],
        others: NDArray[np.int64],
        apart_m: float,
    ) -> list[tuple[float, float, int, int]]:
        """Times, distances and indices of pairs of stays that are too near.

        Each iteration compares all stays with their next candidates and keeps the earliest pair.

        Args:
            stays: stays to compare with later stays; shape (m,).
            first: index in `others` of the first candidate; shape (m,).
            behind: index in `others` after the last candidate; shape (m,).
            others: stays sorted by cell and time; shape (n,).
            apart_m: distance [m].
        """
        pairs: list[tuple[float, float, int, int]] = []
        for turn in count():
            remaining = first + turn < behind
            if not remaining.any() or (pairs and turn > CROWDED):
                return pairs
            stays, first, behind = stays[remaining], first[remaining], behind[remaining]
            with_ = others[first + turn]
            away_m = np.linalg.norm(self.places_m[stays] - self.places_m[with_], axis=1)
            near = (away_m < apart_m) & (self.vehicles[stays] != self.vehicles[with_])
            if near.any():
                at = np.flatnonzero(near)
                one = at[np.lexsort((away_m[at], self.begin_s[with_[at]]))[0]]
                number = int(with_[one])
                at_s, distance_m = float(self.begin_s[number]), float(away_m[one])
                pairs.append((at_s, distance_m, int(stays[one]), number))
        raise AssertionError  # not reached, because `count` is endless


def _neighbours(
    cells: Array, levels: Sequence[Array], shape: Sequence[int], occupied: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Look up n cells in the sorted list of occupied cells.

    Returns:
        indices in the list of the m cells that are in it; and whether each of the n cells is in it.
    """
    is_occupied = np.ones(len(cells), dtype=bool)
    index = np.empty(cells.shape, np.int64)
    for axis, level in enumerate(levels):
        index[:, axis] = np.minimum(np.searchsorted(level, cells[:, axis]), len(level) - 1)
        is_occupied &= level[index[:, axis]] == cells[:, axis]
    code = np.ravel_multi_index(tuple(index[is_occupied].T), tuple(shape))
    at = np.minimum(np.searchsorted(occupied, code), len(occupied) - 1)
    hit = occupied[at] == code
    is_occupied[is_occupied] = hit
    return at[hit], is_occupied


def _nearest_on_paths(
    goals: Mapping[int, tuple[Array, Array]], apart_m: float, height: float
) -> tuple[int, int, float, float] | None:
    """First two vehicles of a show nearer than `apart_m` to each other, see `Mission.nearest`.

    The times of all goals are merged; each vehicle flies straight between two successive times.
    """
    numbers = list(goals)
    times_s = np.unique(np.concatenate([own_s for own_s, _ in goals.values()]))
    at_once = max(PLACES_AT_ONCE // len(numbers), 1)
    for first in range(0, len(times_s), at_once):
        chunk_s = times_s[first : first + at_once + 1]
        nearest = _nearest_during(numbers, goals, chunk_s, apart_m, height)
        if nearest:
            return nearest
    return None


def _nearest_during(
    numbers: Sequence[int],
    goals: Mapping[int, tuple[Array, Array]],
    times_s: Array,
    apart_m: float,
    height: float,
) -> tuple[int, int, float, float] | None:
    """First two vehicles nearer than `apart_m` during `times_s`, which include all goals' times."""
    places = np.stack(
        [
            np.stack([np.interp(times_s, own_s, along) for along in points_m.T], axis=1)
            for own_s, points_m in goals.values()
        ],
        axis=1,
    )
    places[..., 2:] *= height
    for k, (begin, end) in enumerate(zip(places, [*places[1:], places[-1]], strict=True)):
        moved, middle = end - begin, 0.5 * (begin + end)
        reach_m = apart_m + float(np.linalg.norm(moved, axis=1).max())
        # Vehicles are sorted by x. Each is compared with the vehicles after it up to `reach_m`.
        order = np.argsort(middle[:, 0])
        x, rank = middle[order, 0], np.arange(len(order))
        counts = np.searchsorted(x, x + reach_m, side="right") - rank - 1
        one = np.repeat(rank, counts)
        other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(counts) - counts, counts)
        one, other = order[one], order[other]
        off, way = begin[one] - begin[other], moved[one] - moved[other]
        along = -(off * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-18)
        share = np.clip(along, 0.0, 1.0)
        away_m = np.linalg.norm(off + share[:, None] * way, axis=1)
        if (away_m < apart_m).any():
            i = int(away_m.argmin())
            length_s = times_s[min(k + 1, len(times_s) - 1)] - times_s[k]
            pair = sorted((numbers[one[i]], numbers[other[i]]))
            return *pair, float(times_s[k] + share[i] * length_s), float(away_m[i])
    return None


class Guided:
    """References of a mission's vehicles; their goals may be replaced in flight.

    Args:
        references: gives the reference of a vehicle by its number.
        goals: goals that replace the mission's goals [m; shape (axes,)], by vehicle.
        most: largest number of vehicles whose references are cached.
    """

    def __init__(
        self, references: Callable[[int], Reference], goals: Mapping[int, Array], most: int
    ) -> None:
        self._references, self.goals = references, goals
        self._kept = lru_cache(most)(self._of)

    def __call__(self, vehicle: int) -> Reference:
        return self._kept(vehicle)

    def _of(self, vehicle: int) -> Reference:
        """Reference of a vehicle: the mission's reference, or after time 0 the goal that replaces
        the mission's goals.
        """
        original = self._references(vehicle)

        def reference(t: NDArray[Any]) -> Array:
            state = original(t)
            if vehicle in self.goals:
                late = np.asarray(t) > 0.0
                state[late, :, 0], state[late, :, 1] = self.goals[vehicle], 0.0
            return state

        return reference


def parse_goals(text: str, axes: int) -> dict[int, Array]:
    """Goals by vehicle [m; shape (axes,)], from a text such as `goal(1, 2.5, 0) & goal(2, -1, 0)`.

    Raises:
        GrammarError: a part of the text is invalid.
    """
    goals = {}
    form = "goal(vehicle, x, y)" if axes == 2 else "goal(vehicle, x, y, z)"
    for call in calls(text, f"goals such as {form!r}"):
        numbers = [each for each in call.values if not isinstance(each, str)]
        if call.name != "goal" or any(call.keys) or len(numbers) != len(call.values):
            raise GrammarError(call.text, form)
        vehicle, *place = numbers or [0.0]
        if len(place) != axes or not float(vehicle).is_integer():
            raise GrammarError(call.text, form)
        if not max(map(abs, place)) <= FAR_M:
            raise GrammarError(call.text, f"a place within {FAR_M:g} m of the origin")
        goals[int(vehicle)] = np.array(place, dtype=np.float64)
    return goals


def format_goals(goals: Mapping[int, Array]) -> str:
    """Text of goals, which `parse_goals` reads."""
    return " & ".join(
        f"goal({vehicle}, {', '.join(f'{at:.6g}' for at in place)})"
        for vehicle, place in goals.items()
    )


def swap(vehicles: int, radius_m: float, axes: int, altitude_m: float = 0.0) -> Mission:
    """Mission in which vehicles on a circle go to the opposite place."""
    goals, times_s = {}, np.array([0.0, SWAP_AT_S])
    for number in range(1, vehicles + 1):
        angle = 2.0 * np.pi * (number - 1) / vehicles
        places = np.zeros((2, axes))
        places[0, :2] = radius_m * np.array([np.cos(angle), np.sin(angle)])
        places[1, :2] = -places[0, :2]
        places[:, 2:] = altitude_m
        goals[number] = times_s, places
    return Mission(goals, axes, 1)


def sphere(vehicles: int, radius_m: float, altitude_m: float = 0.0) -> Mission:
    """Mission in which vehicles on a sphere go to the opposite place.

    Vehicles with odd numbers start on the upper half, spread evenly by the golden angle; each even
    number starts opposite to the odd number before it.
    """
    goals, times_s = {}, np.array([0.0, SWAP_AT_S])
    pairs = -(-vehicles // 2)
    for number in range(1, vehicles + 1):
        pair = (number - 1) // 2
        up, angle = 1.0 - (pair + 0.5) / pairs, GOLDEN_ANGLE * pair
        level = np.sqrt(1.0 - up * up)
        off = radius_m * np.array([level * np.cos(angle), level * np.sin(angle), up])
        off *= 1.0 if number % 2 else -1.0
        goals[number] = times_s, np.stack([off, -off]) + np.array([0.0, 0.0, altitude_m])
    return Mission(goals, 3, 1)
