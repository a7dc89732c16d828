"""Texts of zones: functions of the table `ZONES`, which a scenario combines with &.

    box(x0, x1, y0, y1) & cylinder(x, y, radius) & polygon(x, y, x, y, x, y, …)
    fence(x0, x1, y0, y1) & fence(x, y, x, y, x, y, …) & corridor(width, x, y, x, y, …)
    geojson(file) & kml(file) & plan(file)

Numbers are metres. `box` and `cylinder` may end with two more numbers, the lowest and the highest
altitude; otherwise they have no vertical limits. Vehicles keep out of `box`, `cylinder` and
`polygon`, and stay within every `fence` and `corridor`. A cylinder becomes a polygon of 24 corners
around the cylinder. `zone_files` reads the files.
"""

import math
from collections.abc import Sequence

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.missions.zones import CORNERS_MAX, Zone, Zones, around, ring
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.reference import FAR_M
from skytether.shared.scenario.registry import Files
from skytether.shared.scenario.rooms import ZONES


def parse(text: str, axes: int, files: Files = ()) -> Zones:
    """Parse a text of zones; an empty text has no zones.

    Args:
        axes: number of axes of the flight.
        files: files that the text names, with their contents.

    Raises:
        GrammarError: a part of the text is invalid.
    """
    zones: list[Zone] = []
    for call in ZONES.calls(text):
        try:
            if any(not isinstance(each, str) and abs(each) > FAR_M for each in call.values):
                raise ValueError(f"numbers of at most {FAR_M:g} m")
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
        raise ValueError("box(x0, x1, y0, y1), or with z0, z1: each pair ascending")
    return [_between(_corners(x0, x1, y0, y1), heights)]


@ZONES
def cylinder(x: float, y: float, radius: float, *heights: float) -> list[Zone]:
    """Cylinder to keep out of, without vertical limits or between two altitudes."""
    if radius <= 0.0:
        raise ValueError("cylinder(x, y, radius) with a radius above 0")
    return [_between(around(x, y, radius), heights)]


def _between(corners: Array, heights: Sequence[float]) -> Zone:
    if len(heights) not in (0, 2) or not all(map(float.__lt__, heights[::2], heights[1::2])):
        raise ValueError("two ascending heights at the end, or none")
    low, high = heights or (-math.inf, math.inf)
    return Zone("", corners, low, high)


@ZONES
def polygon(*corners: float) -> list[Zone]:
    """Polygon to keep out of: x, y of each corner."""
    return [Zone("", ring(_points(corners, 3, "polygon")))]


@ZONES
def fence(*corners: float) -> list[Zone]:
    """Polygon to stay within: x, y of each corner, or x0, x1, y0, y1 of a rectangle."""
    if len(corners) != 4:
        return [Zone("", ring(_points(corners, 3, "fence")), is_fence=True)]
    x0, x1, y0, y1 = corners
    if not (x0 < x1 and y0 < y1):
        raise ValueError("fence(x0, x1, y0, y1) with ascending pairs, or at least 3 corners")
    return [Zone("", _corners(x0, x1, y0, y1), is_fence=True)]


@ZONES
def corridor(width: float, *middle: float) -> list[Zone]:
    """Corridor to stay within: its width, and x, y of each point of its centre line."""
    points = _points(middle, 2, "corridor")
    way = np.diff(points, axis=0)
    long = np.linalg.norm(way, axis=1, keepdims=True)
    if width <= 0.0 or (long < 1e-6).any():
        raise ValueError(
            "corridor(width, x, y, x, y, …) with a width above 0, and successive points that differ"
        )
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / long
    # Mitre joints: the edges of two successive segments meet on the bisector of their angle.
    ends = np.concatenate([across[:1], across[:-1] + across[1:], across[-1:]])
    square = (ends**2).sum(axis=1, keepdims=True)
    if (square[1:-1] < 0.1).any():
        raise ValueError("a corridor without a turn back on itself")
    ends[1:-1] *= 2.0 / square[1:-1]
    sides = [points + sign * width / 2.0 * ends for sign in (1.0, -1.0)]
    return [Zone("", np.concatenate([sides[0], sides[1][::-1]]), is_fence=True)]


def _corners(x0: float, x1: float, y0: float, y1: float) -> Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _points(given: Sequence[float], least: int, name: str) -> Array:
    if len(given) % 2 or len(given) < 2 * least:
        raise ValueError(f"{name} with at least {least} points: x, y, x, y, …")
    return np.array(given).reshape(-1, 2)
