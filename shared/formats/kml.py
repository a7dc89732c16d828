"""KML and KMZ: paths of one or several vehicles.

Each `gx:Track`, or `gx:MultiTrack` with all its tracks, is a vehicle's path with times; in a file
without tracks each `LineString` is a path, followed at `reference.speed_mps`. Heights are used if
they are above the sea (`absolute`); KML's default is a path on the ground, without heights.
"""

from array import array
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from skytether.shared.formats import Tracks
from skytether.shared.formats.bounded import POINTS_MAX
from skytether.shared.formats.geographic import Origin, above_sea
from skytether.shared.formats.timing import Line, moment_ns, together
from skytether.shared.formats.zone_files import kml_root
from skytether.shared.law.model import Array

CLAMPED = "clampToGround"


class Path(NamedTuple):
    name: str
    mode: str
    """Reference of the heights: KML's altitudeMode."""
    places: Array
    """Longitude, latitude [degrees] and height [m]; shape (n, 3)."""
    times_ns: NDArray[np.int64] | None


def tracks(content: bytes, axes: int, origin: Origin | None, speed_mps: float) -> Tracks:
    paths = _paths(content)
    wrong = next((path for path in paths if path.mode != "absolute"), None)
    if axes == 3 and wrong:
        flat = ", or model.axes = 2" if wrong.mode == CLAMPED else ""
        expected = f"expected heights above the sea (absolute){flat}, got {wrong.mode[:40]}"
        raise ValueError(f"{wrong.name}: {expected}")
    lines = (Line(path.name, above_sea(path.places, axes, origin), path.times_ns) for path in paths)
    return together(lines, speed_mps)


def axes_of(content: bytes) -> int:
    return 2 if any(path.mode == CLAMPED for path in _paths(content)) else 3


@lru_cache(maxsize=1)
def _paths(content: bytes) -> tuple[Path, ...]:
    """Paths of a file; raises ValueError if the file has none, or a path is invalid."""
    try:
        root = kml_root(content)
    except ValueError as error:
        raise ValueError(f"expected {error}") from None
    paths = tuple(_found(root, "Track", "MultiTrack")) or tuple(_found(root, "LineString"))
    if not paths:
        raise ValueError("expected a KML file with a LineString or a gx:Track")
    if sum(len(path.places) for path in paths) > POINTS_MAX:
        raise ValueError(f"expected at most {POINTS_MAX} points")
    return paths


def _found(root: Element, *kinds: str) -> Iterator[Path]:
    within, number = set[int](), 0
    for element in root.iter():
        tag = _tag(element)
        if tag not in kinds or id(element) in within:
            continue
        number += 1
        name = f"{tag} {number}"
        try:
            if tag == "LineString":
                yield _line(name, element)
            else:
                own = [each for each in element if _tag(each) == "Track"] or [element]
                within.update(map(id, own))
                yield _track(name, own)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None


def _line(name: str, line: Element) -> Path:
    text = next((each.text or "" for each in line if _tag(each) == "coordinates"), "")
    words, numbers = text.split(maxsplit=POINTS_MAX), array("d")
    if len(words) > POINTS_MAX:
        raise ValueError(f"expected at most {POINTS_MAX} points")
    for word in words:
        _append(numbers, word.split(","))
    return Path(name, _mode(line), _shaped(numbers), None)


def _track(name: str, tracks: list[Element]) -> Path:
    numbers, times = array("d"), list[int]()
    for track in tracks:
        whens = [each.text or "" for each in track if _tag(each) == "when"]
        coords = [each.text or "" for each in track if _tag(each) == "coord"]
        if len(whens) != len(coords):
            raise ValueError(f"expected a time per place, got {len(whens)} for {len(coords)}")
        for when, coord in zip(whens, coords, strict=True):
            if coord.strip():  # an empty entry: an unknown place
                _append(numbers, coord.split())
                times.append(moment_ns(when))
    return Path(name, _mode(tracks[0]), _shaped(numbers), np.array(times, dtype=np.int64))


def _append(numbers: "array[float]", words: list[str]) -> None:
    if len(words) not in (2, 3):
        raise ValueError(f"expected longitude, latitude and height, got {','.join(words)[:80]!r}")
    numbers.extend([*map(float, words), 0.0][:3])


def _shaped(numbers: "array[float]") -> Array:
    if not numbers:
        raise ValueError("expected coordinates, got none")
    return np.array(numbers).reshape(-1, 3)


def _mode(element: Element) -> str:
    own = (each.text or "" for each in element if _tag(each) == "altitudeMode")
    return next(own, CLAMPED).strip()


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]
