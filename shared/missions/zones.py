"""Zones that vehicles of a mission keep out of, or stay within: polygons between two altitudes."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.outlines import Outlines, is_near

ROUND = 24
"""Number of corners of the polygon around a circle."""
CORNERS_MAX = 1000
"""Largest number of corners of all zones together."""


class Zone(NamedTuple):
    name: str
    """Text of the zone in the scenario; for a zone from a file, the file and the feature's name."""
    corners: Array
    """Corners in order along the border [m]; shape (n, 2)."""
    low_m: float = -math.inf
    high_m: float = math.inf
    is_fence: bool = False
    """True if vehicles stay within the zone, False if they keep out of it."""


class Planes(NamedTuple):
    """Half-planes that keep points out of zones: normal · (x - border) ≥ distance to be kept."""

    at: Indices
    """Index of the point to which each half-plane belongs; shape (n,)."""
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
        """Name of the first zone nearer than `room_m` to the straight lines through points; empty
        if there is none.
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
        """Half-planes between points and the zones near these points.

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
            if zone.is_fence:  # one half-plane for each edge
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
        """Clearances in space [m], from plane clearances and altitudes; shape (n, zones)."""
        off = np.maximum(self._low - height, height - self._high)
        apart = np.where(off > 0.0, np.hypot(off, np.maximum(signed, 0.0)), np.maximum(signed, off))
        # The clearance in a fence is the distance from its nearest side, floor or ceiling.
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
    """Half-planes between points of a border and points; pairs that coincide are left out."""
    off = points - places
    away: Array = np.linalg.norm(off, axis=1)
    apart = away > 1e-9
    return Planes(at[apart], off[apart] / away[apart, None], places[apart], away[apart])


def ring(places: Array) -> Array:
    """Corners of a polygon in their given order, without a last corner equal to the first.

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


def around(x: float, y: float, radius: float) -> Array:
    """Corners of a polygon around a circle [m]; shape (ROUND, 2)."""
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    out = radius / math.cos(math.pi / ROUND)
    return np.array([x, y]) + out * np.stack([np.cos(angle), np.sin(angle)], axis=1)
