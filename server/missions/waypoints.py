"""Waypoint selection: a waypoint is the vehicle's goal, a point on its route around zones, or a
point to the right of this route.

A stuck vehicle also flies around resting vehicles for a while. Its waypoints turn further and
further to the right, finally to random directions, so that vehicles that meet can pass.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from skytether.server.missions.routes import RoutesAroundZones
from skytether.server.missions.vehicle_motions import VehicleMotions
from skytether.shared.law.model import Array
from skytether.shared.missions.zones import Zone, Zones

WAYPOINT_M = 3.0
"""Largest distance of a waypoint that is not on the route [m]."""
AHEAD_M = 1.5
"""Distance from a vehicle to its waypoint, along the route around zones [m]."""
TURN, TURN_MAX, TURN_BACK = 0.5, 2.8, 0.8
"""Angles by which waypoints of a stuck vehicle turn to the right [rad]: step, largest angle before
random directions, and step back when the vehicle moves."""
DETOUR_M, DETOUR_S = 5.0, 20.0
"""Distance within which a stuck vehicle avoids resting vehicles [m], and time of avoidance [s]."""
CLOSED_M = 0.6
"""Distance ahead of a vehicle at which its route is closed [m]; three tubes if that is more."""
AROUND = np.stack([np.cos(np.pi * np.arange(8) / 4.0), np.sin(np.pi * np.arange(8) / 4.0)], axis=1)
"""Corners of an octagon of radius 1 around the origin; shape (8, 2)."""
TRIES = 5
"""Number of directions in which a waypoint is tried for each plan."""


class Waypoints:
    """Waypoints of the vehicles of a mission.

    Args:
        tube_m: least distance of motions from zones [m].
        apart_m: least distance of motions from each other [m].
        detour_steps: number of steps for which a stuck vehicle flies around others.
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
        self._zones, self.routes = zones, RoutesAroundZones(zones, self._tube_m)

    def candidates(
        self,
        vehicle: VehicleMotions,
        k: int,
        place: Array,
        goal: Array,
        resting_places: Callable[[], Sequence[Array]],
    ) -> Iterator[Array]:
        """Waypoints to try in turn: on the route to the goal, then to the right of it.

        Args:
            place: position at the beginning of the plan [m]; shape (axes,).
            resting_places: function that returns the positions of other vehicles at rest [m].
        """
        way = self._ways_of(vehicle, k).way(place, goal)
        if not vehicle.turned_rad:
            if len(way) > 1:
                yield _along(place, way, AHEAD_M)
            yield way[0]
            vehicle.turned_rad = TURN
            # All these waypoints failed, so for `detour_steps` routes also avoid resting vehicles.
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

    def _ways_of(self, vehicle: VehicleMotions, k: int) -> RoutesAroundZones:
        uses_detour = k < vehicle.detour_until or vehicle.closed
        return vehicle.detour if vehicle.detour and uses_detour else self.routes

    def close_way(self, vehicle: VehicleMotions, k: int, place: Array, goal: Array) -> bool:
        """Close the route ahead of a vehicle until its goal changes; False if there is no other
        route.

        Routes keep `tube_m` from zones, and motions keep more: between two zones there may be
        space for a route but not for a motion.
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
    ) -> RoutesAroundZones:
        """Routes around zones, around closed positions, and around nearby vehicles that rest
        elsewhere than at the goal.
        """
        zones, keep_m = list(self._zones.zones), self._apart_m - self._tube_m
        for at in resting:
            near_m = float(np.linalg.norm(at - place))
            if near_m < DETOUR_M and np.linalg.norm(at - goal) > self._apart_m:
                radius_m = min(keep_m, near_m - self._tube_m)
                zones.append(_octagon("a vehicle", at, radius_m, place))
        for at in closed:
            near_m = min(float(np.linalg.norm(at - end)) for end in (place, goal))
            if near_m > 2.0 * self._tube_m:
                radius_m = min(self._closed_m, near_m) - self._tube_m
                zones.append(_octagon("a closed place", at, radius_m, place))
        return RoutesAroundZones(Zones(zones), self._tube_m)


def _octagon(name: str, at: Array, radius_m: float, seen_from: Array) -> Zone:
    """Octagon around a circle; a side faces `seen_from`, because a corner would be too close."""
    half = np.pi / len(AROUND)
    x, y = seen_from[:2] - at[:2]
    c, s = np.cos(np.arctan2(y, x) + half), np.sin(np.arctan2(y, x) + half)
    corners = AROUND @ np.array([[c, s], [-s, c]])
    return Zone(name, at[:2] + radius_m / np.cos(half) * corners)


def _along(place: Array, way: Array, far_m: float) -> Array:
    for corner in way:
        step_m = float(np.linalg.norm(corner - place))
        if step_m >= far_m:
            break
        place, far_m = corner, far_m - step_m
    else:
        return place
    point: Array = place + far_m / step_m * (corner - place)
    return point
