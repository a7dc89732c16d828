"""Yielding: vehicles at rest move aside for a vehicle that cannot pass them.

A vehicle without progress towards its goal for a while asks the first vehicle that rests at its own
goal on the path to yield. The asked vehicle flies to a position off the path, waits there until the
other has passed, and flies back. Only the goal of the asked vehicle changes: its motions are
planned, checked and sent like any other motion.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from skytether.server.missions.routes import RoutesAroundZones
from skytether.server.missions.zone_clearance import comes_near
from skytether.shared.law.model import Array
from skytether.shared.missions.zones import Zones

YIELD_S = 30.0
"""Longest time for which a vehicle yields [s]."""
AHEAD_M = 4.0
"""Length of the path ahead on which vehicles are asked to yield [m]."""
DIRECTIONS = 12
"""Number of directions in which a position for yielding is searched."""
FURTHER = (1.2, 1.8, 2.7, 4.0)
"""Distances from a vehicle's goal at which positions for yielding are searched, divided by the
distance to keep between vehicles."""

NO_NEARER_M = 1e-4
"""Tolerance: distance by which a vehicle that is too near may still come nearer [m]."""


class Yielding(NamedTuple):
    place: Array
    """Temporary goal [m]; shape (axes,)."""
    asker: int
    """Row of the vehicle that asked, and gets the right of way."""
    until: int
    """Step of the common time grid at which the vehicle flies back even if it was not passed."""


def first_on(way: Array, places: Array, apart_m: float) -> int | None:
    """Index of the first position to which a path comes too near, or None.

    A position that is too near to the start of the path counts only if the path approaches it.

    Args:
        way: the path: start, corners and end [m]; shape (n, axes).
        places: the positions [m]; shape (m, axes).
        apart_m: distance between vehicles [m].
    """
    passed_m, kept_m = 0.0, _kept_distance(places, way[0], apart_m)
    for corner, next_corner in pairwise(way):
        if passed_m > AHEAD_M:
            break
        near = np.flatnonzero(distance_from_way(places, np.stack([corner, next_corner])) < kept_m)
        if len(near):
            return int(near[np.linalg.norm(places[near] - corner, axis=1).argmin()])
        passed_m += float(np.linalg.norm(next_corner - corner))
    return None


def _kept_distance(places: Array, at: Array, apart_m: float) -> Array:
    """Distances to keep between a vehicle at `at` and vehicles at some positions [m]; shape (n,).

    The distance is `apart_m`, which plans keep. A vehicle that is nearer already may stay, but not
    come nearer.
    """
    distance: Array = np.minimum(apart_m, np.linalg.norm(places - at, axis=1) - NO_NEARER_M)
    return distance


def distance_from_way(places: Array, way: Array) -> Array:
    """Distances of positions (n, axes) from a path (corners, axes) [m]; shape (n,)."""
    starts, along = way[:-1], np.diff(way, axis=0)
    from_start = places[:, None] - starts
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip((from_start * along).sum(axis=2) / length, 0.0, 1.0)
    off: Array = np.linalg.norm(from_start - share[..., None] * along, axis=2)
    return off.min(axis=1)


def place_to_yield(
    home: Array,
    way: Array,
    others: Array,
    apart_m: float,
    scale: Array,
    zones: Zones,
    routes: RoutesAroundZones,
    clearance_m: float,
) -> Array | None:
    """Position beside a path, within reach of a vehicle at `home`; None if there is none.

    Args:
        home: position at which the vehicle rests [m]; shape (axes,).
        way: path of the passing vehicle, from its position [m]; shape (n, axes).
        others: present or future resting positions of the other vehicles [m]; shape (m, axes).
        apart_m: distance between vehicles [m].
        scale: factor on each coordinate in distances between vehicles; shape (axes,).
        clearance_m: distance from zones [m].
    """
    turn = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    (from_asker_m,) = _kept_distance(home[None] * scale, way[0] * scale, apart_m)
    around = np.zeros((DIRECTIONS, len(home)))
    around[:, 0], around[:, 1] = np.cos(turn), np.sin(turn)
    for further in FURTHER:
        places = home + further * apart_m * around
        off_m = distance_from_way(places * scale, way * scale)
        for i in np.argsort(-off_m, kind="stable"):
            if off_m[i] < apart_m:
                break
            candidate = places[i]
            near_m = np.linalg.norm((others - candidate) * scale, axis=1).min(initial=np.inf)
            if near_m < apart_m or comes_near(zones, np.stack([candidate, candidate]), clearance_m):
                continue
            leaving = np.concatenate([home[None], routes.way(home, candidate)])
            is_free = distance_from_way(way[:1] * scale, leaving * scale)[0] > from_asker_m
            if is_free and routes.reaches(home, candidate):
                return candidate
    return None
