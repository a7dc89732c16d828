"""Waypoint selection: a vehicle's goal, a point on the way around zones, or one to the right of it.

A stuck vehicle also flies around vehicles at rest for a while, and its waypoints turn ever further
to the right, at last into directions that are drawn: so vehicles that meet pass each other.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from skytether.server.missions.routes import Routes
from skytether.server.missions.vehicle_motions import VehicleMotions
from skytether.shared.law.model import Array
from skytether.shared.scenario.zones import Zone, Zones

WAYPOINT_M = 3.0
"""Distance of a waypoint to the right of the way [m]."""
AHEAD_M = 1.5
"""Distance of a waypoint ahead on a way around zones [m]."""
TURN, TURN_MAX, TURN_BACK = 0.5, 2.8, 0.8
"""Angles to the right by which waypoints of a stuck vehicle turn: step, largest before directions
are drawn, and step back once it moves [rad]."""
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


class Waypoints:
    """Waypoints of the vehicles of a mission.

    Args:
        zones: where vehicles may not be.
        tube_m: distance that motions keep from zones [m].
        apart_m: distance that motions keep from each other [m].
        detour_steps: steps for which a vehicle that was stuck goes around others.
        rng: directions are drawn from it.
    """

    def __init__(
        self,
        zones: Zones,
        tube_m: float,
        apart_m: float,
        detour_steps: int,
        rng: np.random.Generator,
    ) -> None:
        self._tube_m, self._apart_m = tube_m, apart_m
        self._detour_steps, self._rng = detour_steps, rng
        self._closed_m = max(CLOSED_M, 3.0 * tube_m)
        self.change_zones(zones)

    def change_zones(self, zones: Zones) -> None:
        """Replace the zones that ways lead around."""
        self._zones, self.routes = zones, Routes(zones, self._tube_m)

    def candidates(
        self,
        vehicle: VehicleMotions,
        k: int,
        place: Array,
        goal: Array,
        resting_places: Callable[[], Sequence[Array]],
    ) -> Iterator[Array]:
        """Waypoints to be tried in turn: on the way to the goal, its next corner, and to the right
        of that.

        Args:
            vehicle: the vehicle.
            k: its step.
            place: where its plan begins [m]; shape (axes,).
            goal: shape (axes,).
            resting_places: returns the places at which others rest [m]; shape (axes,) each.
        """
        way = self._ways_of(vehicle, k).way(place, goal)
        if not vehicle.turned_rad:
            if len(way) > 1:
                yield _along(place, way, AHEAD_M)
            yield way[0]
            vehicle.turned_rad = TURN
            # Stuck: from now on, for a while, around vehicles that rest on the way, too.
            vehicle.detour = self._detour(place, goal, resting_places(), vehicle.closed)
            vehicle.detour_until = k + self._detour_steps
            way = vehicle.detour.way(place, goal)
            yield _along(place, way, AHEAD_M)
        ahead = way[0, :2] - place[:2]
        distance_m = float(np.linalg.norm(ahead))
        ahead = ahead / distance_m if distance_m > 1e-9 else np.array([1.0, 0.0])
        goal_m = float(np.linalg.norm(goal - place))
        reach_m = WAYPOINT_M if len(way) > 1 else min(goal_m, WAYPOINT_M)
        for _ in range(TRIES):
            c, s = np.cos(-vehicle.turned_rad), np.sin(-vehicle.turned_rad)
            waypoint = place.copy()
            waypoint[:2] += reach_m * np.array(
                [c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]]
            )
            yield waypoint
            vehicle.turned_rad += TURN
            if vehicle.turned_rad > TURN_MAX:
                vehicle.turned_rad = float(self._rng.uniform(TURN_BACK, 2.0 * np.pi))

    def _ways_of(self, vehicle: VehicleMotions, k: int) -> Routes:
        """Ways that a vehicle takes at a step: around what it was stuck at, or around zones."""
        is_taken = k < vehicle.detour_until or vehicle.closed
        return vehicle.detour if vehicle.detour and is_taken else self.routes

    def close_way(self, vehicle: VehicleMotions, k: int, place: Array, goal: Array) -> bool:
        """Take the way ahead of a vehicle for closed, until it has another goal, if there is
        another way; whether there is.

        Ways keep `tube_m` from zones, and motions a margin more: between two zones there may be
        space for a way and not for a motion.

        Args:
            vehicle: the vehicle.
            k: its step.
            place: where its plan begins [m]; shape (axes,).
            goal: shape (axes,).
        """
        way = self._ways_of(vehicle, k).way(place, goal)
        ahead = _along(place, way, self._closed_m)
        detour = self._detour(place, goal, (), (*vehicle.closed, ahead))
        if not detour.reaches(place, goal):
            return False
        vehicle.closed.append(ahead)
        vehicle.detour = detour
        return True

    def _detour(
        self, place: Array, goal: Array, resting: Iterable[Array], closed: Iterable[Array]
    ) -> Routes:
        """Ways around zones, closed places, and the vehicles that rest near a place, but for those
        at the goal.
        """
        zones, keep_m = list(self._zones.zones), self._apart_m - self._tube_m
        for at in resting:
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
    """Point of a way at a distance ahead on it, or its end."""
    for corner in way:
        step_m = float(np.linalg.norm(corner - place))
        if step_m >= far_m:
            break
        place, far_m = corner, far_m - step_m
    else:
        return place
    there: Array = place + far_m / step_m * (corner - place)
    return there
