"""Vehicles at rest that yield to one that cannot pass them.

A vehicle that has come no nearer to its goal for a while asks the first vehicle at rest at its own
goal that stands on its way to yield. That one flies to a place off this way, waits there until the
other has passed, and flies back. Only its goal is another one meanwhile: its motions are planned,
checked and sent like any other.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from skytether.server.missions.routes import Routes
from skytether.server.missions.zone_clearance import comes_near
from skytether.shared.law.model import Array
from skytether.shared.scenario.zones import Zones

YIELD_S = 30.0
"""Longest time for which a vehicle yields [s]."""
AHEAD_M = 4.0
"""Length of the way ahead on which vehicles are asked to yield [m]."""
DIRECTIONS = 12
"""Number of directions in which a place is looked for, around the goal that is left."""
FURTHER = (1.2, 1.8, 2.7, 4.0)
"""Distances of such places from that goal, in multiples of the distance that vehicles keep."""

NO_NEARER_M = 1e-4
"""Distance by which one that is to come no nearer may, for its motion is followed in pieces [m]."""


class Yielding(NamedTuple):
    """What a vehicle that yields does."""

    place: Array
    """Goal in place of its own [m]; shape (axes,)."""
    asker: int
    """Row of the vehicle that is to pass."""
    until: int
    """Step of all vehicles at which it goes back, whether or not that has passed."""


def first_on(way: Array, places: Array, apart_m: float) -> int | None:
    """Index of the first of some places that a way passes too near to; None where it passes none.

    A place that is too near where the way begins is passed only if the way comes nearer to it.

    Args:
        way: where it begins, its corners and its end [m]; shape (n, axes).
        places: shape (m, axes) [m].
        apart_m: distance that vehicles keep [m].
    """
    passed_m, kept_m = 0.0, _kept_distance(places, way[0], apart_m)
    for here, there in pairwise(way):
        if passed_m > AHEAD_M:
            break
        near = np.flatnonzero(distance_from_way(places, np.stack([here, there])) < kept_m)
        if len(near):
            return int(near[np.linalg.norm(places[near] - here, axis=1).argmin()])
        passed_m += float(np.linalg.norm(there - here))
    return None


def _kept_distance(places: Array, at: Array, apart_m: float) -> Array:
    """Distances that are kept between vehicles at some places and one at another [m]; shape (n,).

    Plans keep a margin more than motions must: vehicles at rest may be nearer than that, and then
    they need only come no nearer.
    """
    kept: Array = np.minimum(apart_m, np.linalg.norm(places - at, axis=1) - NO_NEARER_M)
    return kept


def distance_from_way(places: Array, way: Array) -> Array:
    """Distances of places from a way [m]; shape (n,), of shapes (n, axes) and (corners, axes)."""
    here, along = way[:-1], np.diff(way, axis=0)
    from_here = places[:, None] - here
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip((from_here * along).sum(axis=2) / length, 0.0, 1.0)
    off: Array = np.linalg.norm(from_here - share[..., None] * along, axis=2)
    return off.min(axis=1)


def place_to_yield(
    home: Array,
    way: Array,
    others: Array,
    apart_m: float,
    scale: Array,
    zones: Zones,
    routes: Routes,
    clearance_m: float,
) -> Array | None:
    """The nearest place off a way to which a vehicle at rest can go; None where none is.

    Args:
        home: where it rests [m]; shape (axes,).
        way: of the vehicle that is to pass, from where that is [m]; shape (n, axes).
        others: where the other vehicles rest, or will [m]; shape (m, axes).
        apart_m: distance that vehicles keep [m].
        scale: factors of coordinates before distances of vehicles are taken; shape (axes,).
        zones, routes: what is in the way, and the ways around that.
        clearance_m: distance that is kept from zones [m].
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
            there = places[i]
            near_m = np.linalg.norm((others - there) * scale, axis=1).min(initial=np.inf)
            if near_m < apart_m or comes_near(zones, np.stack([there, there]), clearance_m):
                continue
            leaving = np.concatenate([home[None], routes.way(home, there)])
            is_free = distance_from_way(way[:1] * scale, leaving * scale)[0] > from_asker_m
            if is_free and routes.reaches(home, there):
                return there
    return None
