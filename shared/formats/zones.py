"""Zones of a mission from files."""

from typing import Literal

from skytether.shared.formats import plans, zone_files
from skytether.shared.missions.zones import Zone
from skytether.shared.scenario.registry import File
from skytether.shared.scenario.rooms import ZONES


@ZONES
def geojson(file: File) -> list[Zone]:
    """Zones in a GeoJSON file, see docs/together.md."""
    return zone_files.geojson(file)


@ZONES
def kml(file: File, kind: Literal["keep_out", "fence"] = "keep_out") -> list[Zone]:
    """Polygons of a KML file, all to keep out of (keep_out), or all to stay within (fence)."""
    return zone_files.kml(file, is_fence=kind == "fence")


@ZONES
def plan(file: File) -> list[Zone]:
    """Geofence of a QGroundControl plan: inclusions to stay within, exclusions to keep out of."""
    return plans.fences(file)
