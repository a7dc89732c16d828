"""Tracks: timed points of one or several vehicles, from tables and files of other programs.

`formats` has a module for each format.
"""

from functools import lru_cache

import numpy as np

from skytether.shared import formats
from skytether.shared.formats import Tracks
from skytether.shared.formats.geographic import Origin
from skytether.shared.scenario.points import timed_path
from skytether.shared.scenario.reference import FAR_M, Reference


@lru_cache(maxsize=2)  # cached, because each vehicle's reference uses them
def tracks(content: bytes, axes: int, origin: Origin | None = (), speed_mps: float = 1.0) -> Tracks:
    """Tracks in a file, in one of the formats of `formats.FORMATS`.

    Args:
        origin: the scenario's origin; (): use the file's origin, if any; None: none is needed.
        speed_mps: speed between the places of a file without times [m/s].

    Raises:
        ValueError: the file is invalid; the message names the fault and its place.
        ExtraMissing: the format needs a package that is not installed.
    """
    found = formats.of(content).tracks(content, axes, origin, speed_mps)
    if not all((np.abs(points_m) <= FAR_M).all() for _, points_m in found.values()):
        raise ValueError(f"expected at most {FAR_M:g} m from the origin")
    return found


def path(content: bytes, axes: int, origin: Origin = (), speed_mps: float = 1.0) -> Reference:
    """Path of the single vehicle in a file, straight from point to point; see `tracks`.

    Raises:
        ValueError: the file is invalid; the message names the fault and its place.
    """
    found = tracks(content, axes, origin, speed_mps)
    if len(found) > 1:
        shapes = "with reference.shape = mission or show it is flown"
        raise ValueError(f"expected one vehicle, got {len(found)}; {shapes}")
    ((times_s, points_m),) = found.values()
    if len(times_s) < 2:
        raise ValueError("expected at least two points")
    return timed_path(times_s, points_m)


def lasts_s(content: bytes, axes: int, speed_mps: float = 1.0) -> float:
    """Time of the last point in a file, for any origin of the scenario [s].

    Raises:
        ValueError: the file is invalid; the message names the fault and its place.
    """
    found = tracks(content, axes, None, speed_mps)
    return float(max(times_s[-1] for times_s, _ in found.values()))


def axes_of(content: bytes) -> int:
    """Number of axes of a file: 3 if its points have heights, otherwise 2.

    Raises:
        ValueError: the file is invalid.
    """
    return formats.of(content).axes_of(content)
