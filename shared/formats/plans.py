"""Plans of QGroundControl (`.plan`): the geofence as zones, and the mission as a timed route.

Coordinates are degrees; the scenario's origin is `reference.origin`, or else the planned home.
Altitudes above home count as altitudes above the origin.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from skytether.shared.formats import bounded
from skytether.shared.formats.geographic import (
    METRES_MAX,
    Origin,
    check_origin,
    local,
    number,
    within,
)
from skytether.shared.law.model import Array
from skytether.shared.missions.zones import CORNERS_MAX, ROUND, Zone, around, ring
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import File

WAYPOINT, LOITER_TIME, RETURN, LAND, TAKEOFF, DELAY, SPEED = 16, 19, 20, 21, 22, 93, 178
"""MAV_CMD of the items that are flown."""
STILL = frozenset((195, 197, 201, 203, 204, 205, 206, 214, 530, 531, 532, 2000, 2001, 2500, 2501))
"""MAV_CMD of items that do not move the vehicle: cameras and gimbals."""
ITEMS_MAX = 10_000
"""Largest number of items of a mission."""
LONG_S = 1e6
"""Longest duration of an item [s]."""
FRAMES = {0: "above the sea", 3: "above home"}
"""Supported MAV_FRAME values, and what an item's altitude is measured from."""
MODE_FRAMES = {1: 3, 2: 0, 3: 0, 4: 10}
"""MAV_FRAME that QGroundControl gives an item, by its AltitudeMode: above home, above the sea,
above the terrain (sent as above the sea), and above the autopilot's own terrain data."""
MULTICOPTERS, ROVERS = (None, 0, 2, 3, 4, 13, 14, 15, 29, 35), (10, 11)
"""MAV_TYPE of vehicles that can stop anywhere: aircraft (None: type not given), and vehicles on the
ground or on water."""
SCAN, SCANS = "TransectStyleComplexItem", ("survey", "CorridorScan")
"""Member that has a complex item's simple items, and types of complex items with this member."""
VERSIONS = {"plan": (1,), "mission": (2,), "geofence": (2,), SCAN: (1, 2)}
"""Supported versions of a plan's parts; a part without a version counts as supported."""
WRONG = (KeyError, TypeError, AttributeError, IndexError)
"""Exceptions that Python raises if a file does not have the structure of a plan."""


class Home(NamedTuple):
    """Origin of a plan's coordinates."""

    origin: Origin
    altitude_m: float | None
    """Altitude above the sea of the origin, or else of the planned home [m]; None: unknown."""

    def local(self, latitude: Any, longitude: Any) -> Array:
        """Position north and east of the origin [m]; shape (2,)."""
        place = np.array([[number(longitude, "longitude"), number(latitude, "latitude")]])
        return local(place, self.origin)[0]


def fences(file: File) -> list[Zone]:
    """Zones of a plan's geofence.

    Raises:
        ValueError: the file is not a plan, or has no geofence.
        GrammarError: a part is invalid; the message names it and the expected form.
    """
    plan, home = _plan(file.content, file.origin)
    name, zones = file.name.rpartition("/")[2], list[Zone]()
    for kind, parts in _fence(plan).items():
        for i, part in enumerate(parts):
            title = f"{name}: {kind[:-1]} {i + 1} of the geofence"
            try:
                is_fence = bool(part["inclusion"])
                corners = (_polygon if kind == "polygons" else _circle)(part, home)
            except ValueError as error:
                raise GrammarError(title, str(error)) from None
            except WRONG:
                raise GrammarError(title, "inclusion, and corners or a centre and radius") from None
            zones.append(Zone(title, corners, is_fence=is_fence))
            if sum(len(zone.corners) for zone in zones) > CORNERS_MAX:
                raise ValueError(f"a geofence of at most {CORNERS_MAX} corners")
    if not zones:
        raise ValueError("a plan with a geofence")
    return zones


def _polygon(part: Any, home: Home) -> Array:
    points = part["polygon"]
    if len(points) > CORNERS_MAX + 1:
        raise ValueError(f"at most {CORNERS_MAX} corners")
    return ring(np.array([home.local(*point) for point in points]))


def _circle(part: Any, home: Home) -> Array:
    """Corners of a polygon around an exclusion circle, or within an inclusion circle."""
    centre = home.local(*part["circle"]["center"])
    radius = number(part["circle"]["radius"], "radius")
    if not 0.0 < radius <= METRES_MAX:
        raise ValueError(f"radius above 0, at most {METRES_MAX:g}")
    x, y = centre.tolist()
    if part["inclusion"]:
        radius *= math.cos(math.pi / ROUND)
    return around(x, y, radius)


def has_fence(content: bytes) -> bool:
    """Whether a plan has a geofence; raises ValueError if the file is not a plan."""
    plan, _ = _expected(content, ())
    return any(_fence(plan).values())


def _fence(plan: dict[str, Any]) -> dict[str, list[Any]]:
    """Parts of a plan's geofence, by kind; raises ValueError if it is invalid."""
    fence = plan.get("geoFence") or {}
    if isinstance(fence, dict) and "polygon" not in fence:
        _check_version("geofence", fence)
    kinds: dict[str, Any] = dict.fromkeys(("polygons", "circles"))
    if isinstance(fence, dict) and "polygon" not in fence:
        kinds = {kind: fence.get(kind) or [] for kind in kinds}
    if not all(isinstance(each, list) for each in kinds.values()):
        raise ValueError("a geofence of version 2: lists of polygons and circles")
    return kinds


def route(content: bytes, axes: int, origin: Origin) -> tuple[Array, Array]:
    """Mission of a plan for one vehicle: times [s; shape (n,)] and places [m; shape (n, axes)].

    The vehicle flies straight from place to place, at the plan's speed, and waits at items with a
    hold time. It starts above the planned home at the altitude of the plan's take-off, as after an
    autopilot's own take-off, and ends above the place where it would land. A plan that begins with
    another item starts on the ground; a later take-off is straight up.

    Raises:
        ValueError: the file is not a plan, or an item cannot be flown; the message names it.
    """
    plan, home = _expected(content, origin)
    mission = plan["mission"]
    if not (isinstance(items := mission.get("items"), list) and items):
        raise ValueError("expected a plan with mission items")
    key = _speed_key(mission.get("vehicleType"))
    speed_mps = number(mission.get(key, 0.0), key)
    start = np.append(home.local(*mission["plannedHomePosition"][:2]), 0.0)
    times_s, places_m = along(_items(items), start, home, speed_mps, key)
    return times_s, places_m[:, :axes]


def along(
    items: Iterable[Any], start: Array, home: Home, speed_mps: float, key: str
) -> tuple[Array, Array]:
    """Times [s; shape (n,)] and places [m; shape (n, 3)] along the items of a mission.

    Args:
        items: simple items, as in a plan.
        start: place of the first take-off, which is vertical [m]; shape (3,).
        speed_mps: speed until an item changes it; `key`: name of the speed in messages.

    Raises:
        ValueError: an item cannot be flown; the message names it.
    """
    times, places = [0.0], [start]
    for count, item in enumerate(items, start=1):
        try:
            if count > ITEMS_MAX:
                raise ValueError(f"expected at most {ITEMS_MAX} items")
            _check_kind(item)
            command, params = int(item["command"]), [*item["params"], *[None] * 7][:7]
            if command in STILL:
                continue
            if command == SPEED:
                speed_mps = _speed(params, speed_mps)
                continue
            hold_s = _hold_s(command, params)
            place = _place(command, item, params, places[-1], start, home)
        except ValueError as error:
            raise ValueError(f"mission item {count}: {error}") from None
        except (*WRONG, OverflowError):
            raise ValueError(f"mission item {count}: expected a command and its params") from None
        if command == TAKEOFF and all(np.array_equal(at, start) for at in places):
            places = [np.append(start[:2], place[2]) for _ in places]
        above = np.append(places[-1][:2], place[2])
        for at in (above, place) if command == TAKEOFF else (place,):
            away_m = float(np.linalg.norm(at - places[-1]))
            if away_m and not 0.0 < speed_mps <= 1e3:
                raise ValueError(f"mission item {count}: expected {key} above 0, got {speed_mps:g}")
            if away_m:
                times.append(times[-1] + away_m / speed_mps)
                places.append(at)
        if hold_s > 0.0:
            times.append(times[-1] + hold_s)
            places.append(place)
    return np.array(times), np.array(places)


def _speed_key(kind: Any) -> str:
    """Key of a plan's speed, by the MAV_TYPE of the plan's vehicle; `kind` None: type not given."""
    if kind in MULTICOPTERS:
        return "hoverSpeed"
    if kind in ROVERS:
        return "cruiseSpeed"
    expected = "a vehicle that can stop at each place, such as a multicopter or a rover"
    raise ValueError(f"vehicleType: expected {expected}, got MAV_TYPE {str(kind)[:40]}")


def _items(items: list[Any]) -> Iterator[Any]:
    """Items of a mission; a survey or corridor scan is replaced by its simple items."""
    for item in items:
        scan = item.get(SCAN) if isinstance(item, dict) else None
        inner = scan.get("Items") if isinstance(scan, dict) else None
        is_known = isinstance(scan, dict) and scan.get("version", 1) in VERSIONS[SCAN]
        yield from inner if is_known and isinstance(inner, list) and inner else [item]


def _check_kind(item: dict[str, Any]) -> None:
    """Raise a ValueError if an item is not simple."""
    if item.get("type") == "SimpleItem":
        return
    kind, scan = str(item.get("complexItemType"))[:40], item.get(SCAN)
    if isinstance(scan, dict):
        _check_version(SCAN, scan)
    if kind in SCANS and (not isinstance(scan, dict) or scan.get("Items") in (None, [])):
        written = "as QGroundControl writes them once it knows the terrain"
        raise ValueError(f"expected a {kind} with the places it leads to (Items), {written}")
    raise ValueError(f"expected a simple item, a survey or a corridor scan, got {kind}")


def _check_version(part: str, table: dict[str, Any]) -> None:
    """Raise a ValueError if a part of a plan has an unknown version."""
    versions = VERSIONS[part]
    if (version := table.get("version", versions[0])) not in versions:
        expected = " or ".join(map(str, versions))
        raise ValueError(f"a {part} of version {expected}, got {str(version)[:40]}")


def _hold_s(command: int, params: list[Any]) -> float:
    """Time for which an item holds the vehicle [s]."""
    if command not in (WAYPOINT, LOITER_TIME, DELAY):
        return 0.0
    hold_s = number(params[0] or 0.0, "hold time")
    if not hold_s <= LONG_S or (command == DELAY and hold_s < 0.0):
        raise ValueError(f"a hold time from 0 to {LONG_S:g} s, got {hold_s:g}")
    return hold_s


def _speed(params: list[Any], before_mps: float) -> float:
    """Speed after an item that changes it [m/s]; the values -1 and -2 do not change it."""
    if params[0] not in (0, 1):
        raise ValueError(f"expected a speed over ground or in the air, got type {params[0]}")
    speed_mps = number(params[1], "speed")
    return before_mps if speed_mps in (-1.0, -2.0) else speed_mps


def _place(
    command: int, item: Any, params: list[Any], before: Array, start: Array, home: Home
) -> Array:
    """Place to which an item leads [m]; shape (3,)."""
    place = before.copy()
    if command == RETURN:
        place[:2] = start[:2]
    if command in (RETURN, DELAY):
        return place
    if command not in (WAYPOINT, LOITER_TIME, LAND, TAKEOFF):
        expected = "a waypoint, take-off, landing, return or speed"
        raise ValueError(f"expected {expected}, got MAV_CMD {command}")
    if params[4] or params[5]:
        place[:2] = home.local(params[4], params[5])
    if command != LAND:
        frame = item.get("frame")
        if frame not in FRAMES:
            expected = " or ".join(FRAMES.values())
            raise ValueError(f"expected an altitude {expected}, got one of frame {frame}")
        if (belongs := MODE_FRAMES.get(mode := item.get("AltitudeMode"), frame)) != frame:
            raise ValueError(f"expected frame {belongs} with AltitudeMode {mode}, got {frame}")
        if frame == 0 and home.altitude_m is None:
            raise ValueError("an altitude above home: home's altitude above the sea is unknown")
        place[2] = number(params[6], "altitude") - ((home.altitude_m or 0.0) if frame == 0 else 0.0)
    return within(place, METRES_MAX)


def _expected(content: bytes, origin: Origin) -> tuple[dict[str, Any], Home]:
    """Result of `_plan`; raises its ValueError with "expected" before the message."""
    try:
        return _plan(content, origin)
    except ValueError as error:
        raise ValueError(f"expected {error}") from None


def _plan(content: bytes, origin: Origin) -> tuple[dict[str, Any], Home]:
    """A plan, and the origin of its coordinates; raises ValueError if the content is not a plan."""
    try:
        plan = bounded.json_of(content)
    except ValueError as error:
        raise ValueError(f"a QGroundControl plan ({error})") from None
    if not isinstance(plan, dict) or plan.get("fileType") != "Plan":
        raise ValueError('a QGroundControl plan, with "fileType": "Plan"')
    _check_version("plan", plan)
    if isinstance(mission := plan.get("mission"), dict):
        _check_version("mission", mission)
    try:
        latitude, longitude, altitude_m = plan["mission"]["plannedHomePosition"]
    except (*WRONG, ValueError):
        raise ValueError("a plan with plannedHomePosition: latitude, longitude, altitude") from None
    form = '"plannedHomePosition": [latitude, longitude, altitude]'
    home = check_origin(latitude, longitude, form)
    if altitude_m is not None:
        home = *home, number(altitude_m, "altitude of home")
    return plan, Home(origin or home, (*origin[2:], *home[2:], None)[0])
