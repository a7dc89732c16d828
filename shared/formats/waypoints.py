"""Waypoints of Mission Planner and QGroundControl (`QGC WPL 110`): the mission of one vehicle.

Each line is an item: its index, whether it is the current one, frame, command, four parameters,
latitude, longitude, altitude, and whether to continue automatically. Item 0 is home. Items are
flown like the items of a plan (`plans.along`), at `reference.speed_mps` until an item changes the
speed.
"""

from typing import Any

import numpy as np

from skytether.shared.formats import Tracks, bounded, plans
from skytether.shared.formats.geographic import Origin, check_origin

HEAD = "QGC WPL 110"
COLUMNS = 12
Item = dict[str, Any]


def tracks(content: bytes, axes: int, origin: Origin | None, speed_mps: float) -> Tracks:
    first, *items = _items(content)
    if (first["command"], first["frame"]) != (plans.WAYPOINT, 0):
        got = f"MAV_CMD {first['command']} of frame {first['frame']}"
        raise ValueError(f"line 2: expected home, a waypoint above the sea (0 1 0 16), got {got}")
    latitude, longitude, altitude_m = first["params"][4:]
    home: Origin = ()
    if latitude or longitude:
        form = "line 2: expected latitude and longitude of home"
        home = *check_origin(latitude, longitude, form), altitude_m
    altitude = (*(origin or home)[2:], *home[2:], None)[0]
    placed = plans.Home(origin or home, altitude)
    start = np.zeros(3)
    if home:
        start[:2] = placed.local(latitude, longitude)
    times_s, points_m = plans.along(items, start, placed, speed_mps, "reference.speed_mps")
    return {1: (times_s, points_m[:, :axes])}


def axes_of(_: bytes) -> int:
    return 3


def _items(content: bytes) -> list[Item]:
    """Items of a file, home first; raises ValueError if a line is invalid."""
    bounded.check_lines({"": content})
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError("expected text in UTF-8") from None
    if not lines or lines[0].strip() != HEAD:
        raise ValueError(f"line 1: expected {HEAD}, got {lines[0].strip()[:40] if lines else ''!r}")
    items = list[Item]()
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            items.append(_item(number, line, len(items)))
        if len(items) > plans.ITEMS_MAX:
            raise ValueError(f"expected at most {plans.ITEMS_MAX} items")
    if len(items) < 2:
        raise ValueError("expected home and at least one item after it")
    return items


def _item(number: int, line: str, index: int) -> Item:
    words = line.split(maxsplit=COLUMNS)
    try:
        own, _, frame, command = (int(float(word)) for word in words[:4])
        params = [float(word) for word in words[4:-1]]
    except (ValueError, OverflowError):
        own, params = -1, []
    if len(params) != COLUMNS - 5 or own != index:
        shown = " ".join(words)[:80]
        raise ValueError(f"line {number}: expected item {index} in 12 columns, got {shown!r}")
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params}
