"""Missions: goals of several vehicles, which the server keeps apart on their ways.

A mission is the reference of each of its vehicles: the goal from each time on, at rest.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law.model import Array
from skytether.shared.scenario.calls import calls
from skytether.shared.scenario.policies import PolicyError
from skytether.shared.scenario.reference import FAR_M, Reference, read_table

SWAP_AT_S = 2.0
"""Time at which vehicles that swap places leave [s]."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Angle by which points that are spread evenly over a sphere turn from one to the next [rad]."""
TIMES_MAX = 500
"""Largest number of times at which goals are checked for being too near to each other."""


class Mission:
    """Goals of several vehicles, each from a time on: the reference of one of them.

    A vehicle begins at its first goal. One that the mission does not know stays at the origin.

    Args:
        goals: times, rising [s; shape (n,)], and goals from then on [m; shape (n, axes)], of each
            vehicle by its number.
        vehicle: number of the one whose reference it is.
    """

    def __init__(self, goals: Mapping[int, tuple[Array, Array]], axes: int, vehicle: int) -> None:
        self._goals, self._axes = goals, axes
        self._times_s, self._points_m = goals.get(vehicle, (np.zeros(1), np.zeros((1, axes))))
        self._times: list[float] = self._times_s.tolist()

    @property
    def vehicles(self) -> tuple[int, ...]:
        """Numbers of the vehicles that have goals."""
        return tuple(self._goals)

    @property
    def places(self) -> Array:
        """All goals of all vehicles [m]; shape (n, axes)."""
        return np.concatenate([points_m for _, points_m in self._goals.values()])

    @property
    def in_step(self) -> bool:
        """Whether all vehicles have goals at the same times."""
        times_s = [times_s for times_s, _ in self._goals.values()]
        return all(np.array_equal(each, times_s[0]) for each in times_s)

    @property
    def lasts_s(self) -> float:
        """Time of the last goal [s]."""
        return max(float(times_s[-1]) for times_s, _ in self._goals.values())

    def of(self, vehicle: int) -> "Mission":
        """The reference of another vehicle."""
        return Mission(self._goals, self._axes, vehicle)

    def goals(self, vehicle: int) -> Array:
        """Goals of a vehicle [m]; shape (n, axes)."""
        return self._goals[vehicle][1]

    def __call__(self, t: NDArray[Any]) -> Array:
        """Goals at times [s]; see `Reference`."""
        t = np.asarray(t, dtype=np.float64)
        if not t.ndim:  # of one vehicle at each step: no search in arrays
            state = np.zeros((self._axes, 2))
            state[:, 0] = self._points_m[max(bisect_right(self._times, float(t)) - 1, 0)]
            return state
        state = np.zeros((*t.shape, self._axes, 2))
        at = self._times_s.searchsorted(t, side="right") - 1
        state[..., 0] = self._points_m[np.maximum(at, 0)]
        return state

    def nearest(self, apart_m: float, height: float) -> tuple[int, int, float, float] | None:
        """Two vehicles whose goals are nearer than apart_m at one time; None where none are.

        Args:
            apart_m: distance [m].
            height: by what distances along the third axis are multiplied.

        Returns:
            their numbers, when that is [s], and the distance [m].
        """
        times_s = np.unique(np.concatenate([times_s for times_s, _ in self._goals.values()]))
        times_s = times_s[:: -(-len(times_s) // TIMES_MAX)]
        places = np.stack([self.of(each)(times_s)[..., 0] for each in self._goals])
        places[..., 2:] *= height
        for i, at_s in enumerate(times_s):
            here = places[:, i]
            away = np.linalg.norm(here[:, None] - here[None], axis=2)
            np.fill_diagonal(away, np.inf)
            one, other = np.unravel_index(int(away.argmin()), away.shape)
            if away[one, other] < apart_m:
                numbers = self.vehicles
                return numbers[one], numbers[other], float(at_s), float(away[one, other])
        return None

    def allocated(self) -> "Mission":
        """A mission whose goals of one time are given to the vehicles that are nearest to them.

        At each time the sum of the squares of all distances is the least (linear assignment), so
        ways cross less. The mission must be `in_step`.
        """
        from scipy.optimize import linear_sum_assignment  # a client does without scipy

        times_s = next(iter(self._goals.values()))[0]
        wanted = np.stack([points_m for _, points_m in self._goals.values()], axis=1)
        given = wanted[:1]
        for goals in wanted[1:]:
            cost = ((given[-1][:, None] - goals[None]) ** 2).sum(axis=2)
            given = np.append(given, goals[None, linear_sum_assignment(cost)[1]], axis=0)
        shared = {vehicle: (times_s, given[:, i]) for i, vehicle in enumerate(self._goals)}
        return Mission(shared, self._axes, 1)


class Guided:
    """References of a mission's vehicles, whose goals can be given in flight.

    Args:
        references: the reference of a vehicle, by its number.
        goals: goals that are given [m], by vehicle.
    """

    def __init__(self, references: Callable[[int], Reference], goals: Mapping[int, Array]) -> None:
        self._references, self.goals = references, goals

    def of(self, vehicle: int) -> Reference:
        """The reference of a vehicle, whose goal may change; where it begins it does not."""
        made = self._references(vehicle)

        def reference(t: NDArray[Any]) -> Array:
            state = made(t)
            if vehicle in self.goals:
                state[np.asarray(t) > 0.0, :, 0] = self.goals[vehicle]
            return state

        return reference


def given(text: str, axes: int) -> dict[int, Array]:
    """Goals [m] by vehicle that a text names.

    Raises:
        PolicyError: with the part of it that is wrong.
    """
    goals = {}
    form = "goal(vehicle, x, y)" if axes == 2 else "goal(vehicle, x, y, z)"
    for name, arguments in calls(text, f"goals such as {form!r}"):
        written = name if arguments is None else f"{name}({arguments})"
        try:
            vehicle, *place = map(float, (arguments or "").split(","))
        except ValueError:
            raise PolicyError(written, form) from None
        if name != "goal" or len(place) != axes or not vehicle.is_integer():
            raise PolicyError(written, form)
        if not max(map(abs, place)) <= FAR_M:
            raise PolicyError(written, f"a place within {FAR_M:g} m of the origin")
        goals[int(vehicle)] = np.array(place)
    return goals


def written(goals: Mapping[int, Array]) -> str:
    """The text that names these goals."""
    return " & ".join(
        f"goal({vehicle}, {', '.join(f'{at:.6g}' for at in place)})"
        for vehicle, place in goals.items()
    )


def swap(vehicles: int, radius_m: float, axes: int, altitude_m: float = 0.0) -> Mission:
    """Places on a circle, from which each vehicle goes to the one opposite."""
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
    """Places on a sphere, from which each vehicle goes to the one opposite.

    Vehicles with odd numbers begin on the upper half, spread evenly by the golden angle, and the
    vehicle with the next number begins opposite to each.
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


def mission(path: Path, axes: int) -> Mission:
    """Goals from a table with the columns vehicle, t [s], x, y, z [m] (as many as there are axes).

    Raises:
        OSError: see `reference.read`.
        ValueError: with what is wrong, and in which line.
    """
    rows = read_table(path, ["vehicle", "t", "x", "y", "z"][: axes + 2])
    numbers = rows[:, 0].astype(np.int64)
    if not len(rows) or (numbers != rows[:, 0]).any() or numbers.min() < 1:
        raise ValueError("column vehicle: expected numbers from 1")
    goals = {}
    for number in np.unique(numbers).tolist():
        own = rows[numbers == number]
        if own[0, 1] != 0.0 or (np.diff(own[:, 1]) <= 0.0).any():
            raise ValueError(f"vehicle {number}: column t must start at 0 and rise")
        goals[number] = own[:, 1], own[:, 2:]
    if (np.abs(rows[:, 2:]) > FAR_M).any():
        raise ValueError(f"expected at most {FAR_M:g} m from the origin")
    return Mission(goals, axes, 1)
