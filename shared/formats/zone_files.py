"""Zones in GeoJSON and KML files."""

import math
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any
from xml.etree import ElementTree

import numpy as np

from skytether.shared.formats import bounded
from skytether.shared.formats.geographic import (
    METRES_MAX,
    Origin,
    check_origin,
    coordinates,
    local,
    number,
    within,
)
from skytether.shared.law.model import Array
from skytether.shared.missions.zones import CORNERS_MAX, Zone, around, ring
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import File

CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
"""Only accepted value of a GeoJSON file's member `crs`: it names the coordinates of RFC 7946."""
Frame = Callable[[Any], Array]
"""Function from a list of coordinates to metres north and east of the origin; shape (n, 2)."""
RING = "LinearRing"
SHAPES = ("Polygon", "Point", "LineString", RING, "Track", "Model")
"""Geometries that a placemark of a KML file may have."""
_NOWHERE: Array = np.zeros((0, 2))


def geojson(file: File) -> list[Zone]:
    """Zones in a GeoJSON file, see docs/together.md."""
    try:
        collection = bounded.json_of(file.content)
    except ValueError as error:
        raise ValueError(f"a GeoJSON file ({error})") from None
    zones: list[Zone] = []
    corners = 0
    for zone in _features(file.name.rpartition("/")[2], collection, file.origin):
        zones.append(zone)
        corners += len(zone.corners)
        if corners > CORNERS_MAX:  # bounded first, because checking a ring takes quadratic time
            raise ValueError(f"a GeoJSON file of at most {CORNERS_MAX} corners")
    if not zones:
        raise ValueError("a GeoJSON file with a Polygon, a MultiPolygon or a Point in it")
    return zones


def kml(file: File, *, is_fence: bool) -> list[Zone]:
    """Zones of the polygons in a KML file. A hole in a fence is a zone to keep out of.

    Raises:
        ValueError: the file is not KML.
        GrammarError: a placemark is invalid; the message names it and the expected form.
    """
    root = kml_root(file.content)
    zones, name, corners = list[Zone](), file.name.rpartition("/")[2], 0
    for i, placemark in enumerate(_below(root, "Placemark")):
        title = f"{name}: {_text(placemark, 'name') or f'placemark {i + 1}'}"
        try:
            for zone in _placemark(title, placemark, file.origin, is_fence=is_fence):
                zones.append(zone)
                corners += len(zone.corners)
                if corners > CORNERS_MAX:
                    raise ValueError(f"a KML file of at most {CORNERS_MAX} corners up to here")
        except ValueError as error:
            raise GrammarError(title, str(error)) from None
    if not zones:
        raise ValueError("a KML file with a Polygon in a Placemark")
    return zones


def kml_root(content: bytes) -> ElementTree.Element:
    """Root of a KML file, or of the KML file in a KMZ; raises ValueError for any other content."""
    if bounded.is_zip(content):
        content, *_ = bounded.members(content, _is_kml, "a KML file").values()
    try:
        root = bounded.xml_of(content)
    except ValueError as error:
        raise ValueError(f"a KML file {error}") from None
    if next(_tagged(root, "NetworkLink"), None) is not None:
        raise ValueError("a KML file without links to other files")
    return root


def _is_kml(name: str) -> bool:
    return name.lower().endswith(".kml")


def _placemark(
    name: str, placemark: ElementTree.Element, origin: Origin, *, is_fence: bool
) -> Iterator[Zone]:
    other = next((each for each in SHAPES[1:] for _ in _bare(placemark, each)), "")
    if other:
        raise ValueError(f"a Polygon, not a {other}")
    for polygon in _below(placemark, "Polygon"):
        for kind in ("outerBoundaryIs", "innerBoundaryIs") if is_fence else ("outerBoundaryIs",):
            # Google Earth writes several holes into one innerBoundaryIs.
            rings = [each for border in _below(polygon, kind) for each in _below(border, RING)]
            if not rings and kind == "outerBoundaryIs":
                raise ValueError("a Polygon with an outerBoundaryIs")
            for each in rings:
                corners = ring(local(_coordinates(_text(each, "coordinates")), origin))
                within_it = is_fence and kind == "outerBoundaryIs"
                yield Zone(name, corners, is_fence=within_it)


def _bare(placemark: ElementTree.Element, kind: str) -> Iterator[ElementTree.Element]:
    """Geometries of one kind in a placemark, except the rings of its polygons."""
    rings = {id(each) for polygon in _below(placemark, "Polygon") for each in polygon.iter()}
    return (each for each in _below(placemark, kind) if id(each) not in rings)


def _coordinates(text: str) -> Array:
    """Longitudes and latitudes in a KML text such as `8.54,47.39,0 8.55,47.39,0`."""
    points = [point.split(",") for point in text.split(maxsplit=CORNERS_MAX + 1)]
    if len(points) > CORNERS_MAX + 1:
        raise ValueError(f"a Polygon of at most {CORNERS_MAX} corners")
    for point in points:
        if len(point) not in (2, 3) or float((point[2:] or ["0"])[0]):
            raise ValueError(f"longitude,latitude without heights, got {','.join(point)[:80]}")
    return coordinates([[float(each) for each in point[:2]] for point in points])


def _below(element: ElementTree.Element, tag: str) -> Iterator[ElementTree.Element]:
    """Elements with a tag, of any namespace, below an element.

    Raises:
        ValueError: elements with this tag are nested, so that searches would take quadratic time.
    """
    for found in _tagged(element, tag):
        if next(islice(_tagged(found, tag), 1, None), None) is not None:
            raise ValueError(f"no {tag} within another")
        yield found


def _tagged(element: ElementTree.Element, tag: str) -> Iterator[ElementTree.Element]:
    return (each for each in element.iter() if str(each.tag).rpartition("}")[2] == tag)


def _text(element: ElementTree.Element, tag: str) -> str:
    return next(((each.text or "").strip() for each in _below(element, tag)), "")


def _features(file: str, collection: Any, origin: Origin) -> Iterator[Zone]:
    """Zones of a FeatureCollection.

    Coordinates are degrees as in RFC 7946; the scenario's origin is `reference.origin`, or the
    collection's member `origin` (longitude and latitude). With a member `"units": "m"` the
    coordinates are metres. Properties of a feature may be `kind` ("keep_out" or "fence"), `low_m`,
    `high_m`, and `radius_m` for a Point.

    Raises:
        ValueError: the collection is invalid, or too large.
        GrammarError: a feature is invalid; the message names it and the expected form.
    """
    whole = isinstance(collection, dict) and collection.get("type") == "FeatureCollection"
    if not (whole and isinstance(collection.get("features"), list)):
        raise ValueError("a GeoJSON file with a FeatureCollection")
    placed, corners = _frame(collection, origin), 0
    for i, feature in enumerate(collection["features"]):
        try:
            for zone in _feature(file, i, feature, placed):
                yield zone
                corners += len(zone.corners)
                if corners > CORNERS_MAX:
                    return  # too many corners: `geojson` raises the error
        except (KeyError, TypeError, AttributeError, IndexError, ValueError) as error:
            said = isinstance(error, ValueError)
            expected = str(error) if said else "a feature with a geometry, as in RFC 7946"
            raise GrammarError(f"{file}: feature {i + 1}", expected) from None


def _frame(collection: dict[str, Any], given: Origin) -> Frame:
    """Function from coordinates to metres north and east of the scenario's origin.

    Args:
        given: `reference.origin`, which takes precedence over the collection's member.

    Raises:
        ValueError: the unit or the origin of the coordinates is missing or invalid.
    """
    crs, units, origin = collection.get("crs"), collection.get("units"), collection.get("origin")
    if crs not in (None, CRS84):
        raise ValueError(f"no crs: RFC 7946 uses degrees of WGS 84, got {str(crs)[:80]}")
    if units not in (None, "m"):
        raise ValueError(f'"units": "m" or none, got {str(units)[:80]!r}')
    if units is not None and origin is not None:
        raise ValueError('a member "origin" for degrees or "units": "m" for metres, got both')
    if units is not None:
        return lambda points: within(coordinates(points), METRES_MAX)
    if given or origin is None:
        return lambda points: local(coordinates(points), given)
    if not (isinstance(origin, list) and len(origin) == 2):
        raise ValueError('"origin": [longitude, latitude]')
    own = check_origin(origin[1], origin[0], '"origin": [longitude, latitude]')
    return lambda points: local(coordinates(points), own)


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
    low = number(properties.get("low_m", -math.inf), "low_m")
    high = number(properties.get("high_m", math.inf), "high_m")
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
        radius = number(properties["radius_m"], "radius_m")
        if not 0.0 < radius <= METRES_MAX:
            raise ValueError(f"radius_m above 0, at most {METRES_MAX:g}")
        yield zone._replace(corners=around(x, y, radius), is_fence=is_fence)
        return
    parts = [coordinates] if kind == "Polygon" else coordinates
    if is_fence and len(parts) > 1:
        raise ValueError("one polygon: no vehicle can stay within several separate fences")
    if not (isinstance(parts, list) and parts and all(parts)):
        raise ValueError("coordinates, got none")
    for rings in parts:
        # A hole in a fence is a zone to keep out of. Holes in other zones are ignored: no vehicle
        # can enter them.
        if len(rings) > 1 and not is_fence:
            zone = zone._replace(name=f"{zone.name}, with its holes")
        for hole, points in enumerate(rings if is_fence else rings[:1]):
            if len(points) > CORNERS_MAX + 1:
                raise ValueError(f"a Polygon of at most {CORNERS_MAX} corners")
            corners = ring(placed(points))
            name = f"{zone.name}, hole {hole}" if hole else zone.name
            yield zone._replace(name=name, corners=corners, is_fence=is_fence and not hole)
