"""Zones that vehicles of a mission keep out of, or stay within.

    box(x0, x1, y0, y1) & cylinder(x, y, radius) & polygon(x, y, x, y, x, y, …)
    fence(x0, x1, y0, y1) & fence(x, y, x, y, x, y, …) & corridor(width, x, y, x, y, …)
    geojson(file)

Numbers are metres; zones are joined by & (`shared.scenario.grammar`). `box` and `cylinder` may end
with two more numbers, the lowest and the highest altitude; otherwise they have no vertical limits.
Vehicles keep out of `box`, `cylinder` and `polygon`, and stay within every `fence` and `corridor`.
Every zone is a polygon between two altitudes; a cylinder becomes a polygon of 24 corners around it.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.outlines import Outlines, is_near
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import ZONES, File, Files

ROUND = 24
CORNERS_MAX = 1000
EARTH_M = 6_378_137.0
"""Equatorial radius of the earth, WGS 84 [m]."""
METRES_MAX, DEGREES_MAX_M = 1e6, 1e5
"""Largest distance from the origin on each axis, for coordinates in metres and in degrees [m]. The
latter is less because degrees are projected onto a plane."""
NORTH_MAX = 85.0
CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
"""The only value of the member `crs` that is accepted: the coordinates of RFC 7946."""
Frame = Callable[[Any], Array]
"""Function from a list of coordinates to metres east and north of the origin; shape (n, 2)."""
_NOWHERE: Array = np.zeros((0, 2))


class Zone(NamedTuple):
    name: str
    """Text of the zone in the scenario, or file and name of a feature."""
    corners: Array
    """Corners in order along the border [m]; shape (n, 2)."""
    low_m: float = -math.inf
    high_m: float = math.inf
    is_fence: bool = False
    """True if vehicles stay within the zone, False if they keep out of it."""


class Planes(NamedTuple):
    """Half-planes that keep points out of zones: normal · x ≥ normal · border + distance."""

    at: Indices
    """Index of the point that each half-plane is for; shape (n,)."""
    normal: Array
    """Unit vector from the zone's border to the point; shape (n, axes)."""
    border: Array
    """Nearest point of the border [m]; shape (n, axes)."""
    away_m: Array
    """Distance of the point from the border [m]; shape (n,)."""


class Zones:
    """All zones of a mission, for points with two or three axes."""

    def __init__(self, zones: Sequence[Zone] = ()) -> None:
        self.zones = tuple(zones)
        sizes = [len(zone.corners) for zone in zones]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(np.int64)
        nothing = np.zeros((0, 2))
        self._begin = np.concatenate([nothing, *(zone.corners for zone in zones)])
        ends = [np.roll(zone.corners, -1, axis=0) for zone in zones]
        self._along = np.concatenate([nothing, *ends]) - self._begin
        self._square = np.maximum((self._along**2).sum(axis=1), 1e-18)
        self._sign = np.array([1.0 if zone.is_fence else -1.0 for zone in zones])
        """Sign of the clearance inside each zone: 1 for a fence, -1 otherwise; shape (zones,)."""
        self._low = np.array([zone.low_m for zone in zones])
        self._high = np.array([zone.high_m for zone in zones])
        self.outlines = _outlines(zones)
        """Outlines of all zones, for comparison with straight line segments."""

    def __bool__(self) -> bool:
        return bool(self.zones)

    def to_the_sky(self) -> "Zones":
        """Copy in which zones to keep out of have no upper limit."""
        high = [math.inf if not zone.is_fence else zone.high_m for zone in self.zones]
        raised = zip(self.zones, high, strict=True)
        return Zones([zone._replace(high_m=high_m) for zone, high_m in raised])

    def clearance(self, points: Array) -> Array:
        """Distance of points from the forbidden side of each zone, negative on that side [m].

        Args:
            points: positions [m]; shape (n, axes).

        Returns:
            shape (n, zones).
        """
        _, away = self._nearest(points[:, :2])
        signed = self._signed(points[:, :2], away)
        if points.shape[1] < 3:
            return signed
        return self._with_height(signed, points[:, 2:])

    def in_the_way(self, points: Array, room_m: float) -> str:
        """Name of the first zone nearer than `room_m` to a path through points; empty if there is
        none.
        """
        places = [(x, y, z[0] if z else 0.0) for x, y, *z in points.tolist()]
        pieces = list(zip(places, [*places[1:], places[-1]], strict=True))
        for i, zone in enumerate(self.zones):
            for (x0, y0, z0), (x1, y1, z1) in pieces:
                low_m, high_m = min(z0, z1), max(z0, z1)
                if is_near(self.outlines, i, x0, y0, x1, y1, low_m, high_m, room_m):
                    return zone.name
        return ""

    def planes(self, points: Array, reach_m: Array) -> Planes:
        """Half-planes between points and the zones near them.

        Args:
            points: positions with positive clearance [m]; shape (n, axes).
            reach_m: distance up to which each point considers zones [m]; shape (n,).
        """
        axes, each = points.shape[1], np.arange(len(points))
        if not self.zones:
            return _facing(points[:0], points[:0], each[:0])
        parts = []
        nearest, away = self._nearest(points[:, :2])
        inside = self._inside(points[:, :2])
        for i, zone in enumerate(self.zones):
            own = slice(self._starts[i], self._starts[i] + len(zone.corners))
            if zone.is_fence:  # a half-plane for each edge
                n, edge = np.nonzero(away[:, own] < reach_m[:, None])
                places = points[n]
                places[:, :2] = nearest[n, edge + self._starts[i]]
                parts.append(_facing(points[n], places, n))
                for bound in (zone.low_m, zone.high_m) if axes > 2 else ():
                    n = np.flatnonzero(np.abs(points[:, 2] - bound) < reach_m)
                    places = points[n]
                    places[:, 2] = bound
                    parts.append(_facing(points[n], places, n))
                continue
            edge = away[:, own].argmin(axis=1) + self._starts[i]
            places = points.copy()
            places[:, :2] = np.where(inside[:, [i]], points[:, :2], nearest[each, edge])
            if axes > 2:
                places[:, 2] = np.clip(points[:, 2], zone.low_m, zone.high_m)
            n = np.flatnonzero(np.linalg.norm(points - places, axis=1) < reach_m)
            parts.append(_facing(points[n], places[n], n))
        return Planes(
            np.concatenate([part.at for part in parts]),
            np.concatenate([part.normal for part in parts]),
            np.concatenate([part.border for part in parts]),
            np.concatenate([part.away_m for part in parts]),
        )

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        """Nearest point of each edge and its distance [m]; shapes (n, edges, 2), (n, edges)."""
        off = points[:, None] - self._begin[None]
        t = np.clip(np.einsum("ijk,jk->ij", off, self._along) / self._square, 0.0, 1.0)
        nearest = self._begin + t[:, :, None] * self._along
        return nearest, np.linalg.norm(points[:, None] - nearest, axis=2)

    def _inside(self, points: Array) -> Flags:
        """Whether points are inside each polygon, by the even-odd rule; shape (n, zones)."""
        x, y = points[:, :1], points[:, 1:2]
        begin, end = self._begin, self._begin + self._along
        spans = (begin[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(self._along[:, 1] == 0.0, 1.0, self._along[:, 1])
        is_left = x < begin[:, 0] + (y - begin[:, 1]) / rise * self._along[:, 0]
        crossed = np.add.reduceat((spans & is_left).astype(np.int64), self._starts, axis=1)
        inside: Flags = crossed % 2 == 1
        return inside

    def _signed(self, points: Array, away: Array) -> Array:
        least = np.minimum.reduceat(away, self._starts, axis=1)
        return least * np.where(self._inside(points), self._sign, -self._sign)

    def _with_height(self, signed: Array, height: Array) -> Array:
        """Clearances with three axes, from those in the plane and altitudes; shape (n, zones)."""
        off = np.maximum(self._low - height, height - self._high)
        apart = np.where(off > 0.0, np.hypot(off, np.maximum(signed, 0.0)), np.maximum(signed, off))
        # Within a fence: distance from the nearest of its sides, floor and ceiling.
        within = np.minimum(signed, np.minimum(height - self._low, self._high - height))
        return np.where(self._sign > 0.0, within, apart)


def _outlines(zones: Sequence[Zone]) -> Outlines:
    """Outlines of zones; arrays of zones with fewer edges are padded with zeros."""
    counts = np.array([len(zone.corners) for zone in zones], dtype=np.float64)
    edges, boxes = np.zeros((len(zones), int(counts.max(initial=0)), 4)), np.zeros((len(zones), 6))
    for i, zone in enumerate(zones):
        corners, n = zone.corners, len(zone.corners)
        edges[i, :n, :2], edges[i, :n, 2:] = corners, np.roll(corners, -1, axis=0)
        boxes[i, 0:4:2], boxes[i, 1:4:2] = corners.min(axis=0), corners.max(axis=0)
        boxes[i, 4:] = zone.low_m, zone.high_m
    return Outlines(edges, counts, boxes, np.array([float(zone.is_fence) for zone in zones]))


def _facing(points: Array, places: Array, at: Indices) -> Planes:
    """Half-planes from border places to points; pairs that coincide are left out."""
    off = points - places
    away: Array = np.linalg.norm(off, axis=1)
    apart = away > 1e-9
    return Planes(at[apart], off[apart] / away[apart, None], places[apart], away[apart])


# -- texts and files of zones ------------------------------------------------------------------


def parse(text: str, axes: int, files: Files = ()) -> Zones:
    """Parse a text of zones; an empty text has none.

    Args:
        axes: number of axes of the flight.
        files: files that the text names, with their contents.

    Raises:
        GrammarError: a part of the text is invalid.
    """
    zones: list[Zone] = []
    for call in ZONES.calls(text):
        try:
            if any(not isinstance(each, str) and abs(each) > METRES_MAX for each in call.values):
                raise ValueError(f"numbers of at most {METRES_MAX:g} m")
            parsed: list[Zone] = ZONES.make(call, files)
        except ValueError as error:
            raise GrammarError(call.text, str(error)) from None
        zones += [zone if zone.name else zone._replace(name=call.text) for zone in parsed]
    if sum(len(zone.corners) for zone in zones) > CORNERS_MAX:
        raise GrammarError(f"{text[:40]}…", f"at most {CORNERS_MAX} corners of all zones")
    for zone in zones:
        if axes < 3 and (zone.low_m, zone.high_m) != (-math.inf, math.inf):
            raise GrammarError(zone.name, "no heights with model.axes = 2")
    return Zones(zones)


@ZONES
def box(x0: float, x1: float, y0: float, y1: float, *heights: float) -> list[Zone]:
    """Box to keep out of, without vertical limits or between two altitudes."""
    if not (x0 < x1 and y0 < y1):
        raise ValueError("box(x0, x1, y0, y1), or with z0, z1: from less to more")
    return [_between(_corners(x0, x1, y0, y1), heights)]


@ZONES
def cylinder(x: float, y: float, radius: float, *heights: float) -> list[Zone]:
    """Cylinder to keep out of, without vertical limits or between two altitudes."""
    if radius <= 0.0:
        raise ValueError("cylinder(x, y, radius) with a radius above 0")
    return [_between(_around(x, y, radius), heights)]


def _between(corners: Array, heights: Sequence[float]) -> Zone:
    if len(heights) not in (0, 2) or not all(map(float.__lt__, heights[::2], heights[1::2])):
        raise ValueError("two heights at the end, from less to more, or none")
    low, high = heights or (-math.inf, math.inf)
    return Zone("", corners, low, high)


@ZONES
def polygon(*corners: float) -> list[Zone]:
    """Polygon to keep out of: x, y of each corner."""
    return [Zone("", _ring(_points(corners, 3, "polygon")))]


@ZONES
def fence(*corners: float) -> list[Zone]:
    """Polygon to stay within: x, y of each corner, or x0, x1, y0, y1 of a rectangle."""
    if len(corners) != 4:
        return [Zone("", _ring(_points(corners, 3, "fence")), is_fence=True)]
    x0, x1, y0, y1 = corners
    if not (x0 < x1 and y0 < y1):
        raise ValueError("fence(x0, x1, y0, y1) from less to more, or at least 3 corners")
    return [Zone("", _corners(x0, x1, y0, y1), is_fence=True)]


@ZONES
def corridor(width: float, *middle: float) -> list[Zone]:
    """Corridor to stay within: its width, and x, y of each point of its centre line."""
    points = _points(middle, 2, "corridor")
    way = np.diff(points, axis=0)
    long = np.linalg.norm(way, axis=1, keepdims=True)
    if width <= 0.0 or (long < 1e-6).any():
        raise ValueError("corridor(width, x, y, x, y, …): a width, and no point twice in a row")
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / long
    # Mitre joints: the sides of two segments meet on the bisector of their angle.
    ends = np.concatenate([across[:1], across[:-1] + across[1:], across[-1:]])
    square = (ends**2).sum(axis=1, keepdims=True)
    if (square[1:-1] < 0.1).any():
        raise ValueError("a corridor without a turn back")
    ends[1:-1] *= 2.0 / square[1:-1]
    sides = [points + sign * width / 2.0 * ends for sign in (1.0, -1.0)]
    return [Zone("", np.concatenate([sides[0], sides[1][::-1]]), is_fence=True)]


@ZONES
def geojson(file: File) -> list[Zone]:
    """Zones in a GeoJSON file, see docs/together.md."""
    try:
        collection = json.loads(file.content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"a GeoJSON file ({error})") from None
    zones: list[Zone] = []
    corners = 0
    for zone in _features(file.name.rpartition("/")[2], collection):
        zones.append(zone)
        corners += len(zone.corners)
        if corners > CORNERS_MAX:  # checking a ring takes quadratic time
            raise ValueError(f"a GeoJSON file of at most {CORNERS_MAX} corners")
    if not zones:
        raise ValueError("a GeoJSON file with a Polygon, a MultiPolygon or a Point in it")
    return zones


def _features(file: str, collection: Any) -> Iterator[Zone]:
    """Zones of a FeatureCollection.

    Coordinates are degrees as in RFC 7946, and the collection's member `origin` has longitude and
    latitude of the scenario's origin. Instead, a member `"units": "m"` makes coordinates metres.
    Properties of a feature may be `kind` ("keep_out" or "fence"), `low_m`, `high_m`, and `radius_m`
    for a Point.

    Raises:
        ValueError: the collection is invalid, or too large.
        GrammarError: a feature is invalid; the message names it and the expected form.
    """
    whole = isinstance(collection, dict) and collection.get("type") == "FeatureCollection"
    if not (whole and isinstance(collection.get("features"), list)):
        raise ValueError("a GeoJSON file with a FeatureCollection")
    placed, corners = _frame(collection), 0
    for i, feature in enumerate(collection["features"]):
        try:
            for zone in _feature(file, i, feature, placed):
                yield zone
                corners += len(zone.corners)
                if corners > CORNERS_MAX:
                    return  # `geojson` raises
        except (KeyError, TypeError, AttributeError, IndexError, ValueError) as error:
            said = isinstance(error, ValueError)
            expected = str(error) if said else "a feature with a geometry, as RFC 7946 has it"
            raise GrammarError(f"{file}: feature {i + 1}", expected) from None


def _frame(collection: dict[str, Any]) -> Frame:
    """Function from coordinates to metres east and north of the scenario's origin.

    Raises:
        ValueError: the unit or the origin of the coordinates is missing or invalid.
    """
    crs, units, origin = collection.get("crs"), collection.get("units"), collection.get("origin")
    if crs not in (None, CRS84):
        raise ValueError(f"no crs, for RFC 7946 has degrees of WGS 84, got {str(crs)[:80]}")
    if units not in (None, "m"):
        raise ValueError(f'"units": "m" or none, got {str(units)[:80]!r}')
    if (units is None) == (origin is None):
        got = "neither" if origin is None else "both"
        raise ValueError(
            'a member "origin" with the longitude and latitude of the scenario\'s origin, if '
            f'coordinates are degrees, or "units": "m" if they are metres; got {got}'
        )
    if origin is None:
        return lambda points: _near(_places(points), METRES_MAX)
    if not (isinstance(origin, list) and len(origin) == 2):
        raise ValueError('"origin": [longitude, latitude]')
    east, north = map(_number, origin)
    if not (abs(east) <= 180.0 and abs(north) <= NORTH_MAX):
        raise ValueError(f'"origin": [longitude, latitude], up to {NORTH_MAX:g} degrees north')
    return lambda points: _local(_places(points), east, north)


def _feature(file: str, i: int, feature: Any, placed: Frame) -> Iterator[Zone]:
    """Zones of the feature with index i.

    Raises:
        ValueError: a value is invalid.
        KeyError, TypeError, AttributeError, IndexError: the feature does not have the structure
            of GeoJSON.
    """
    properties, geometry = feature.get("properties") or {}, feature["geometry"]
    kind = None if geometry is None else geometry["type"]
    if kind not in ("Polygon", "MultiPolygon", "Point"):
        raise ValueError(f"a Polygon, a MultiPolygon or a Point with radius_m, not a {kind}")
    low = _number(properties.get("low_m", -math.inf), "low_m")
    high = _number(properties.get("high_m", math.inf), "high_m")
    if not low < high:
        raise ValueError(f"low_m below high_m, got {low:g} and {high:g}")
    role = properties.get("kind", "keep_out")
    if role not in ("keep_out", "fence"):
        raise ValueError(f"the property kind to be keep_out or fence, got {str(role)[:80]!r}")
    is_fence = role == "fence"
    zone = Zone(f"{file}: {properties.get('name', f'feature {i + 1}')}", _NOWHERE, low, high)
    coordinates = geometry["coordinates"]
    if kind == "Point":
        ((x, y),) = placed([coordinates]).tolist()
        if "radius_m" not in properties:
            names = ", ".join(map(str, properties))[:80] or "no properties"
            raise ValueError(f"a Point with the property radius_m in metres, not with {names}")
        radius = _number(properties["radius_m"], "radius_m")
        if not 0.0 < radius <= METRES_MAX:
            raise ValueError(f"radius_m above 0, at most {METRES_MAX:g}")
        yield zone._replace(corners=_around(x, y, radius), is_fence=is_fence)
        return
    parts = [coordinates] if kind == "Polygon" else coordinates
    if is_fence and len(parts) > 1:
        raise ValueError("one polygon: no vehicle can stay within several separate fences")
    if not (isinstance(parts, list) and parts and all(parts)):
        raise ValueError("coordinates, got none")
    for rings in parts:
        # A hole in a fence is a zone to keep out of. Other holes are ignored: they cannot be
        # entered.
        if len(rings) > 1 and not is_fence:
            zone = zone._replace(name=f"{zone.name}, with its holes")
        for number, points in enumerate(rings if is_fence else rings[:1]):
            corners = _ring(placed(points))
            name = f"{zone.name}, hole {number}" if number else zone.name
            yield zone._replace(name=name, corners=corners, is_fence=is_fence and number == 0)


def _ring(places: Array) -> Array:
    """Corners of a polygon's ring, without a last point that repeats the first; of either winding.

    Raises:
        ValueError: there are fewer than 3 corners, or the border crosses itself.
    """
    if len(places) > 3 and (places[0] == places[-1]).all():
        places = places[:-1]
    if len(places) < 3:
        raise ValueError("at least 3 corners")
    if len(places) <= CORNERS_MAX and _crosses_itself(places):
        raise ValueError("a border that does not cross itself")
    return places


def _crosses_itself(corners: Array) -> bool:
    begin, end = corners, np.roll(corners, -1, axis=0)
    along = end - begin

    def side(points: Array) -> Array:
        off = points[None] - begin[:, None]
        sides: Array = np.sign(along[:, None, 0] * off[..., 1] - along[:, None, 1] * off[..., 0])
        return sides

    parted = side(begin) * side(end) < 0.0
    return bool((parted & parted.T).any())


def _number(given: Any, key: str = "origin") -> float:
    """Value of a member as a number; raises ValueError for a text, a truth value, NaN or anything
    else.
    """
    if isinstance(given, bool) or not isinstance(given, int | float) or math.isnan(given):
        raise ValueError(f"{key} a number, got {str(given)[:80]!r}")
    return float(given)


def _places(points: Any) -> Array:
    """Coordinates as in the file; shape (n, 2). Raises ValueError if they are invalid or have
    heights.
    """
    if not (isinstance(points, list) and points):
        raise ValueError("coordinates, got none")
    for point in points:
        if not (isinstance(point, list) and len(point) in (2, 3)):
            raise ValueError(f"coordinates of two numbers, got {str(point)[:80]}")
        if any(_number(each, "coordinates") for each in point[2:]):
            raise ValueError("no heights in its coordinates: they are the properties low_m, high_m")
    return np.array([[_number(each, "coordinates") for each in point[:2]] for point in points])


def _local(degrees: Array, east: float, north: float) -> Array:
    """Metres east and north of the origin, from longitude and latitude [degrees]; shape (n, 2).

    A degree of longitude has its length at the mean of the two latitudes, as in ArduPilot.

    Raises:
        ValueError: a coordinate is out of range.
    """
    longitude, latitude = degrees.T
    if not ((np.abs(longitude) <= 180.0).all() and (np.abs(latitude) <= NORTH_MAX).all()):
        raise ValueError("coordinates of longitude and latitude")
    away = np.mod(longitude - east + 180.0, 360.0) - 180.0  # works across the antimeridian
    degree = math.radians(1.0) * EARTH_M
    scale = np.cos(np.radians((latitude + north) / 2.0))
    return _near(
        np.stack([degree * scale * away, degree * (latitude - north)], axis=1), DEGREES_MAX_M
    )


def _near(places: Array, most_m: float) -> Array:
    if not (np.abs(places) <= most_m).all():
        raise ValueError(f"coordinates of at most {most_m:g} m from the origin")
    return places


def _corners(x0: float, x1: float, y0: float, y1: float) -> Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _around(x: float, y: float, radius: float) -> Array:
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    out = radius / math.cos(math.pi / ROUND)
    return np.array([x, y]) + out * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _points(given: Sequence[float], least: int, name: str) -> Array:
    if len(given) % 2 or len(given) < 2 * least:
        raise ValueError(f"{name} with at least {least} points: x, y, x, y, …")
    return np.array(given).reshape(-1, 2)
