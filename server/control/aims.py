"""Point that a vehicle aims at: its goal, a point on the way around zones, or to the right of it.

One that is stuck finds its way around vehicles at rest as well for a while, and aims ever further
round, at last in directions that are drawn: so vehicles that meet pass each other.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from skytether.server.control.known import Known
from skytether.server.control.routes import Routes
from skytether.shared.law.model import Array
from skytether.shared.scenario.zones import Zone, Zones

AIM_M = 3.0
"""Distance of what is aimed at in place of the goal [m]."""
AHEAD_M = 1.5
"""Distance ahead on a way around zones at which a vehicle aims [m]."""
TURN, TURN_MAX, TURN_BACK = 0.5, 2.8, 0.8
"""Angles to the right at which a stuck vehicle aims: step, largest before directions are drawn, and
step back once it moves [rad]."""
DETOUR_M, DETOUR_S = 5.0, 20.0
"""Distance up to which vehicles at rest are flown around by one that was stuck [m], and for how
long it does so [s]."""
CLOSED_M = 0.6
"""Least distance ahead of a vehicle at which its way is closed [m]; it is three tubes where these
are wider."""
AROUND = np.stack([np.cos(np.pi * np.arange(8) / 4.0), np.sin(np.pi * np.arange(8) / 4.0)], axis=1)
"""Corners of an octagon around 0, of radius 1; shape (8, 2)."""
TRIES = 5
"""Number of directions that are tried at a time."""


class Aims:
    """Points that the vehicles of a mission aim at.

    Args:
        zones: where they may not be.
        tube_m: distance that motions keep from zones [m].
        apart_m: distance that motions keep from each other [m].
        detours: steps for which a vehicle that was stuck goes around others.
        rng: directions are drawn from it.
    """

    def __init__(
        self, zones: Zones, tube_m: float, apart_m: float, detours: int, rng: np.random.Generator
    ) -> None:
        self._tube_m, self._apart_m, self._detours, self._rng = tube_m, apart_m, detours, rng
        self._closed_m = max(CLOSED_M, 3.0 * tube_m)
        self.change_zones(zones)

    def change_zones(self, zones: Zones) -> None:
        """Replace the zones that ways lead around."""
        self._zones, self.routes = zones, Routes(zones, self._tube_m)

    def of(
        self,
        known: Known,
        k: int,
        place: Array,
        goal: Array,
        rests: Callable[[], Sequence[Array]],
    ) -> Iterator[Array]:
        """Point to fly to: on the way to the goal, its next corner, or to the right of that.

        Args:
            known: the vehicle.
            k: its step.
            place: where its plan begins [m]; shape (axes,).
            goal: shape (axes,).
            rests: gives the places at which others rest [m]; shape (axes,) each.
        """
        way = self._ways_of(known, k).way(place, goal)
        if not known.turned:
            if len(way) > 1:
                yield _along(place, way, AHEAD_M)
            yield way[0]
            known.turned = TURN
            # Stuck: from now on, for a while, around those as well that rest on the way.
            known.detour = self._detour(place, goal, rests(), known.closed)
            known.detour_until = k + self._detours
            way = known.detour.way(place, goal)
            yield _along(place, way, AHEAD_M)
        ahead = way[0, :2] - place[:2]
        far = float(np.linalg.norm(ahead))
        ahead = ahead / far if far > 1e-9 else np.array([1.0, 0.0])
        reach_m = AIM_M if len(way) > 1 else min(float(np.linalg.norm(goal - place)), AIM_M)
        for _ in range(TRIES):
            c, s = np.cos(-known.turned), np.sin(-known.turned)
            aim = place.copy()
            aim[:2] += reach_m * np.array(
                [c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]]
            )
            yield aim
            known.turned += TURN
            if known.turned > TURN_MAX:
                known.turned = float(self._rng.uniform(TURN_BACK, 2.0 * np.pi))

    def _ways_of(self, known: Known, k: int) -> Routes:
        """Ways that a vehicle takes at a step: around what it was stuck at, or around zones."""
        is_taken = k < known.detour_until or known.closed
        return known.detour if known.detour and is_taken else self.routes

    def close(self, known: Known, k: int, place: Array, goal: Array) -> bool:
        """Take the way ahead of a vehicle for closed, until it has another goal, if there is
        another way; whether there is.

        Ways keep `tube_m` from zones, and motions a margin more: between two zones there may be
        room for a way and not for a motion.

        Args:
            known: the vehicle.
            k: its step.
            place: where its plan begins [m]; shape (axes,).
            goal: shape (axes,).
        """
        way = self._ways_of(known, k).way(place, goal)
        ahead = _along(place, way, self._closed_m)
        detour = self._detour(place, goal, (), (*known.closed, ahead))
        if not detour.reaches(place, goal):
            return False
        known.closed.append(ahead)
        known.detour = detour
        return True

    def _detour(
        self, place: Array, goal: Array, rests: Iterable[Array], closed: Iterable[Array]
    ) -> Routes:
        """Ways around zones, closed places, and the vehicles that rest near a place, but for those
        at the goal.
        """
        zones, keep_m = list(self._zones.zones), self._apart_m - self._tube_m
        for at in rests:
            near_m = float(np.linalg.norm(at - place))
            if near_m < DETOUR_M and np.linalg.norm(at - goal) > self._apart_m:
                radius_m = min(keep_m, near_m - self._tube_m)
                zones.append(_octagon("a vehicle", at, radius_m, place))
        for at in closed:
            near_m = min(float(np.linalg.norm(at - each)) for each in (place, goal))
            if near_m > 2.0 * self._tube_m:
                radius_m = min(self._closed_m, near_m) - self._tube_m
                zones.append(_octagon("a closed place", at, radius_m, place))
        return Routes(Zones(zones), self._tube_m)


def _octagon(name: str, at: Array, radius_m: float, seen_from: Array) -> Zone:
    """Octagon around a circle, one side of it facing a place: seen from there, a corner in front of
    the circle would be too near.
    """
    half = np.pi / len(AROUND)
    x, y = seen_from[:2] - at[:2]
    c, s = np.cos(np.arctan2(y, x) + half), np.sin(np.arctan2(y, x) + half)
    corners = AROUND @ np.array([[c, s], [-s, c]])
    return Zone(name, at[:2] + radius_m / np.cos(half) * corners)


def _along(place: Array, way: Array, far_m: float) -> Array:
    """Point of a way that is so far ahead on it, or its end."""
    for corner in way:
        step_m = float(np.linalg.norm(corner - place))
        if step_m >= far_m:
            break
        place, far_m = corner, far_m - step_m
    else:
        return place
    there: Array = place + far_m / step_m * (corner - place)
    return there
