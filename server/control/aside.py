"""Vehicles at rest that step aside for one that cannot pass them.

A vehicle that has come no nearer to its goal for a while asks the first vehicle at rest at its own
goal that stands on its way. That one flies to a place off this way, waits there until the other has
passed, and flies back. Only its goal is another one meanwhile: what it may fly is found, checked
and sent like any other motion.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from skytether.server.control.clear import touches
from skytether.server.control.routes import Routes
from skytether.shared.law.model import Array
from skytether.shared.scenario.zones import Zones

ASIDE_S = 30.0
"""Longest time for which a vehicle is aside [s]."""
AHEAD_M = 4.0
"""Length of the way ahead on which vehicles are asked [m]."""
DIRECTIONS = 12
"""Number of directions in which there may be a place, around the goal that is left."""
FURTHER = (1.2, 1.8, 2.7, 4.0)
"""Distances of such places from that goal, in those that vehicles keep."""

NO_NEARER_M = 1e-4
"""Distance by which one that is to come no nearer may, for its motion is followed in pieces [m]."""


class Aside(NamedTuple):
    """Place of a vehicle that has stepped aside."""

    place: Array
    """Goal in place of its own [m]; shape (axes,)."""
    asker: int
    """Row of the vehicle that is to pass."""
    until: int
    """Step of all vehicles at which it goes back, whether or not that has passed."""


def first_on(way: Array, homes: Array, apart_m: float) -> int | None:
    """Index of the first of some places that a way passes too near to; None where it passes none.

    A place that is too near where the way begins is passed only if the way comes nearer to it.

    Args:
        way: where it begins, its corners and its end [m]; shape (n, axes).
        homes: the places [m]; shape (m, axes).
        apart_m: distance that vehicles keep [m].
    """
    passed_m, least_m = 0.0, _least(homes, way[0], apart_m)
    for here, there in pairwise(way):
        if passed_m > AHEAD_M:
            break
        near = np.flatnonzero(off_way(homes, np.stack([here, there])) < least_m)
        if len(near):
            return int(near[np.linalg.norm(homes[near] - here, axis=1).argmin()])
        passed_m += float(np.linalg.norm(there - here))
    return None


def _least(places: Array, at: Array, apart_m: float) -> Array:
    """Distances that are kept between vehicles at some places and one at another [m]; shape (n,).

    Plans keep a margin more than motions must: vehicles at rest may be nearer than that, and then
    they need only come no nearer.
    """
    least: Array = np.minimum(apart_m, np.linalg.norm(places - at, axis=1) - NO_NEARER_M)
    return least


def off_way(places: Array, way: Array) -> Array:
    """Distances of places from a way [m]; shape (n,), of shapes (n, axes) and (corners, axes)."""
    here, along = way[:-1], np.diff(way, axis=0)
    from_here = places[:, None] - here
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip((from_here * along).sum(axis=2) / length, 0.0, 1.0)
    off: Array = np.linalg.norm(from_here - share[..., None] * along, axis=2)
    return off.min(axis=1)


def place(
    home: Array,
    way: Array,
    others: Array,
    apart_m: float,
    scale: Array,
    zones: Zones,
    routes: Routes,
    room_m: float,
) -> Array | None:
    """The nearest place off a way that a vehicle at rest can step aside to; None where none is.

    Args:
        home: where it rests [m]; shape (axes,).
        way: of the vehicle that is to pass, from where that is [m]; shape (n, axes).
        others: where the other vehicles rest, or will [m]; shape (m, axes).
        apart_m: distance that vehicles keep [m].
        scale: by what coordinates are multiplied before distances of vehicles are taken.
        zones, routes: what is in the way, and the ways around that.
        room_m: distance that is kept from zones [m].
    """
    turn = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    (from_asker_m,) = _least(home[None] * scale, way[0] * scale, apart_m)
    around = np.zeros((DIRECTIONS, len(home)))
    around[:, 0], around[:, 1] = np.cos(turn), np.sin(turn)
    for further in FURTHER:
        found = home + further * apart_m * around
        off_m = off_way(found * scale, way * scale)
        for i in np.argsort(-off_m, kind="stable"):
            if off_m[i] < apart_m:
                break
            there = found[i]
            near_m = np.linalg.norm((others - there) * scale, axis=1).min(initial=np.inf)
            if near_m < apart_m or touches(zones, np.stack([there, there]), room_m):
                continue
            back = np.concatenate([home[None], routes.way(home, there)])
            is_free = off_way(way[:1] * scale, back * scale)[0] > from_asker_m
            if is_free and routes.reaches(home, there):
                return there
    return None
