"""Shows of Skybrush (`.skyc`): a zip of JSON, with a trajectory for each vehicle.

`show.json` lists the vehicles. A trajectory, in `show.json` or in a file named there by `$ref`, has
`takeoffTime` [s] and points [time after take-off [s], place [m], control points [m]]: from the
previous point, the vehicle flies along the Bézier curve of the control points, or straight if there
are none. Until its take-off the vehicle waits at its first point.

Coordinates are used without conversion. Source: `show/trajectory.py` of Skybrush's server.
"""

from math import comb
from typing import Any

import numpy as np

from skytether.shared.formats import Tracks, bounded
from skytether.shared.formats.bounded import POINTS_MAX, SAMPLE_S
from skytether.shared.formats.geographic import Origin
from skytether.shared.law.model import Array

SHOW = "show.json"
CONTROLS_MAX = 6
"""Largest number of control points of a curve: Skybrush uses degrees up to 7."""
WRONG = (KeyError, TypeError, AttributeError, IndexError)
"""Exceptions that Python raises if a file does not have the structure of a show."""


def tracks(content: bytes, axes: int, _: Origin | None, __: float) -> Tracks:
    files = bounded.members(content, lambda name: name.endswith(".json"), "JSON files")
    found, left = Tracks(), POINTS_MAX
    for number, drone in enumerate(_drones(files), start=1):
        try:
            times_s, points_m = _track(_trajectory(files, drone), left)
        except ValueError as error:
            raise ValueError(f"drone {number}: {error}") from None
        except (*WRONG, OverflowError):
            expected = "a trajectory of version 1 with points: time, place, control points"
            raise ValueError(f"drone {number}: expected {expected}") from None
        left -= len(times_s)
        found[number] = times_s, points_m[:, :axes]
    return found


def axes_of(_: bytes) -> int:
    return 3


def _drones(files: dict[str, bytes]) -> list[Any]:
    try:
        show = bounded.json_of(files[SHOW])
        drones = show["swarm"]["drones"]
        if show["version"] != 1 or not (isinstance(drones, list) and drones):
            raise KeyError
    except ValueError as error:
        raise ValueError(f"{SHOW}: expected {error}") from None
    except WRONG:
        raise ValueError(f"expected a {SHOW} of version 1 with swarm.drones") from None
    return drones


def _trajectory(files: dict[str, bytes], drone: Any) -> dict[str, Any]:
    """Trajectory of a drone, from the show's file or from a separate file."""
    trajectory = drone["settings"]["trajectory"]
    if "$ref" in trajectory:
        name = trajectory["$ref"].partition("#")[0].removeprefix("./")
        if name not in files:
            raise ValueError(f"expected a file {name[:80]!r} in the zip")
        trajectory = bounded.json_of(files[name])
    if not isinstance(trajectory, dict) or trajectory.get("version") != 1:
        raise KeyError
    return trajectory


def _track(trajectory: dict[str, Any], most: int) -> tuple[Array, Array]:
    """Times [s; shape (n,)] and points [m; shape (n, 3)] of a trajectory."""
    begin_s = float(trajectory.get("takeoffTime") or 0.0)
    keys = trajectory["points"]
    before_s, before, _ = keys[0]
    times, points = [np.array([begin_s + before_s])], [_places([before])]
    for at_s, place, controls in keys[1:]:
        if not before_s < at_s:
            raise ValueError(f"expected a time above {before_s:g} s, got {at_s:g} s")
        if len(controls) > CONTROLS_MAX:
            raise ValueError(f"expected at most {CONTROLS_MAX} control points")
        steps = int(np.ceil((at_s - before_s) / SAMPLE_S)) if controls else 1
        most -= steps
        if most < 0:
            raise ValueError(f"expected at most {POINTS_MAX} points of all drones")
        share = np.linspace(0.0, 1.0, steps + 1)[1:]
        times.append(begin_s + before_s + share * (at_s - before_s))
        points.append(_bezier(_places([before, *controls, place]), share))
        before_s, before = at_s, place
    times_s, points_m = np.concatenate(times), np.concatenate(points)
    if times_s[0] > 0.0:
        times_s = np.concatenate([[0.0], times_s])
        points_m = np.concatenate([points_m[:1], points_m])
    if not (times_s[0] == 0.0 and (np.diff(times_s) > 0.0).all() and times_s[-1] < np.inf):
        raise ValueError("expected finite times from 0 on")
    return times_s, points_m


def _places(points: list[Any]) -> Array:
    places = np.array(points, dtype=np.float64)
    if places.shape != (len(points), 3):
        raise KeyError
    return places


def _bezier(controls: Array, share: Array) -> Array:
    """Points of a Bézier curve at shares of its duration; shape (len(share), 3)."""
    degree = len(controls) - 1
    powers = np.arange(degree + 1)
    factors = np.array([comb(degree, each) for each in powers])
    weights = factors * share[:, None] ** powers * (1.0 - share[:, None]) ** (degree - powers)
    return weights @ controls
