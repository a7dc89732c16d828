"""GPX: tracks, or else routes, of one or several vehicles.

Each `trk`, with all its segments, is a vehicle; in a file without tracks each `rte` is a vehicle. A
path without times is followed at `reference.speed_mps`. Heights (`ele`) are above the sea. Single
waypoints (`wpt`) are ignored.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from skytether.shared.formats import Tracks, bounded
from skytether.shared.formats.geographic import Origin, above_sea
from skytether.shared.formats.timing import Line, moment_ns, together
from skytether.shared.law.model import Array


class Path(NamedTuple):
    name: str
    places: Array
    """Longitude and latitude [degrees], and altitude above the sea [m], or NaN; shape (n, 3)."""
    times_ns: NDArray[np.int64] | None


def tracks(content: bytes, axes: int, origin: Origin | None, speed_mps: float) -> Tracks:
    paths = _paths(content)
    flat = next((path.name for path in paths if np.isnan(path.places).any()), "")
    if flat and axes == 3:
        raise ValueError(f"{flat}: expected a height (ele) at each point, or model.axes = 2")
    lines = (Line(path.name, above_sea(path.places, axes, origin), path.times_ns) for path in paths)
    return together(lines, speed_mps)


def axes_of(content: bytes) -> int:
    return 2 if any(np.isnan(path.places).any() for path in _paths(content)) else 3


@lru_cache(maxsize=1)
def _paths(content: bytes) -> tuple[Path, ...]:
    """Paths of a file; raises ValueError if the file has none, or a point is invalid."""
    try:
        root = bounded.xml_of(content)
    except ValueError as error:
        raise ValueError(f"expected a GPX file {error}") from None
    paths = tuple(_found(root, "trk", "trkpt")) or tuple(_found(root, "rte", "rtept"))
    if not paths:
        raise ValueError("expected a GPX file with a track or a route, or a KML file")
    return paths


def _found(root: Element, kind: str, point: str) -> Iterator[Path]:
    for number, path in enumerate((each for each in root if _tag(each) == kind), start=1):
        points = [each for each in path.iter() if _tag(each) == point]
        if points:
            yield _path(f"{kind} {number}", points)


def _path(name: str, points: list[Element]) -> Path:
    places, times = list[tuple[float, float, float]](), list[int]()
    for number, point in enumerate(points, start=1):
        try:
            own = {_tag(each): each.text or "" for each in point}
            places.append(
                (
                    float(point.attrib["lon"]),
                    float(point.attrib["lat"]),
                    float(own.get("ele", "nan")),
                )
            )
            if "time" in own:
                times.append(moment_ns(own["time"]))
        except (ValueError, KeyError) as error:
            said = f"expected {error}" if isinstance(error, KeyError) else error
            raise ValueError(f"{name}, point {number}: {said}") from None
    if 0 < len(times) < len(places):
        raise ValueError(f"{name}: expected a time at each point, or at none")
    return Path(name, np.array(places), np.array(times, dtype=np.int64) if times else None)


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]
