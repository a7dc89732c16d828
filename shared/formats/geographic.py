"""Coordinates of the globe: longitudes and latitudes, and metres from a scenario's origin."""

import math
from typing import Any

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import NORTH_MAX

EARTH_M = 6_378_137.0
"""Equatorial radius of the earth, WGS 84 [m]."""
METRES_MAX, DEGREES_MAX_M = 1e6, 1e5
"""Largest distance from the origin on each axis, for coordinates in metres and in degrees [m]. The
limit for degrees is smaller because degrees are projected onto a plane."""
Origin = tuple[float, ...]
"""Latitude and longitude of a scenario's origin [degrees], and, if known, its altitude above the
sea [m]; empty if the origin is unknown."""


def check_origin(latitude: Any, longitude: Any, form: str) -> Origin:
    """Origin from two members of a file; raises ValueError if they are not a latitude and a
    longitude.

    Args:
        form: expected form of the members in the file, for the message.
    """
    origin = number(latitude), number(longitude)
    if not (abs(origin[0]) <= NORTH_MAX and abs(origin[1]) <= 180.0):
        raise ValueError(f"{form}, up to {NORTH_MAX:g} degrees north or south")
    return origin


def number(given: Any, key: str = "origin") -> float:
    """Value of a member as a number; raises ValueError for any other value, and for NaN and
    booleans.
    """
    try:
        if isinstance(given, bool) or not isinstance(given, int | float) or math.isnan(given):
            raise ValueError(f"{key} a number, got {str(given)[:80]!r}")
        return float(given)
    except OverflowError:  # a whole number of more than 308 digits
        raise ValueError(f"{key} a smaller number") from None


def coordinates(points: Any) -> Array:
    """Coordinates as in the file; shape (n, 2). Raises ValueError if they are invalid or have
    heights.
    """
    if not (isinstance(points, list) and points):
        raise ValueError("coordinates, got none")
    for point in points:
        if not (isinstance(point, list) and len(point) in (2, 3)):
            raise ValueError(f"coordinates of two numbers, got {str(point)[:80]}")
        if any(number(each, "coordinates") for each in point[2:]):
            raise ValueError("no heights in its coordinates, but properties low_m and high_m")
    return np.array([[number(each, "coordinates") for each in point[:2]] for point in points])


def local(degrees: Array, origin: Origin) -> Array:
    """Metres north and east of the origin, from longitude and latitude [degrees]; shape (n, 2).

    The length of a degree of longitude is taken at the mean of the point's and the origin's
    latitude, as in ArduPilot.

    Raises:
        ValueError: a coordinate is out of range, or the origin is not known.
    """
    if not origin:
        raise ValueError(
            "reference.origin, the latitude and longitude of the scenario's origin: the file's "
            "coordinates are degrees"
        )
    north, east = origin[:2]
    longitude, latitude = degrees.T
    if not ((np.abs(longitude) <= 180.0).all() and (np.abs(latitude) <= NORTH_MAX).all()):
        raise ValueError("coordinates of longitude and latitude")
    away = np.mod(longitude - east + 180.0, 360.0) - 180.0  # correct across the antimeridian
    degree = math.radians(1.0) * EARTH_M
    scale = np.cos(np.radians((latitude + north) / 2.0))
    return within(
        np.stack([degree * (latitude - north), degree * scale * away], axis=1), DEGREES_MAX_M
    )


def within(places: Array, most_m: float) -> Array:
    if not (np.abs(places) <= most_m).all():
        raise ValueError(f"coordinates of at most {most_m:g} m from the origin")
    return places


def above_sea(places: Array, axes: int, origin: Origin | None, home: Origin = ()) -> Array:
    """Metres from the origin, from places with altitudes above the sea; shape (n, axes).

    Args:
        places: longitude and latitude [degrees], and altitude [m]; shape (n, 3).
        axes: number of axes to return; with 2 the altitudes are ignored.
        origin: the scenario's origin; (): not given; None: none is needed.
        home: origin and altitude from the file, used if the scenario has none.

    Raises:
        ValueError: a coordinate is out of range, or origin or altitude are not known.
    """
    if origin is None:
        longitude, latitude, altitude_m = places[0].tolist()
        origin = latitude, longitude, altitude_m
    flat = local(places[:, :2], origin or home)
    if axes < 3:
        return flat
    altitude = (*origin[2:], *home[2:])
    if not altitude:
        raise ValueError(
            "reference.origin = [latitude, longitude, altitude], with the altitude of the "
            "scenario's origin, because the file's altitudes are above the sea"
        )
    return np.concatenate([flat, places[:, 2:] - altitude[0]], axis=1)
