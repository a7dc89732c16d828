"""Files of others that would take much time or memory: refused before the work."""

import io
import json
import zipfile

import pytest

from skytether.shared.formats import bounded, plans, recorded, tracks, zone_files
from skytether.shared.missions.zones import CORNERS_MAX
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import File

COMMAS = b"," * bounded.COLUMNS_MAX


def zipped(content: bytes, name: str = "a.csv") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return file.getvalue()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (b"t,x,y\n0,0,0\n" + b"\n" * bounded.LINES_MAX, "lines"),
        (b"t,x,y\n0,0,0\n\n" + b"\r" * (bounded.LINES_MAX + 1), "lines"),
        (b"t,x,y\n0,0,0" + COMMAS, "line 2: .*columns"),
        (b"t,x,y" + COMMAS + b"\n0,0,0", "line 1: .*columns"),
        (b't,x,y,note\n0,0,0,"a\nb"\n', "line 2: .*row"),
    ],
    ids=["newlines", "returns", "wide", "wide header", "quotes"],
)
def test_a_table_beyond_a_bound_is_refused_in_a_zip_too(table: bytes, said: str) -> None:
    for content in (table, zipped(table)):
        with pytest.raises(ValueError, match=said):
            tracks.tracks(content, 2)


def test_a_zip_of_too_many_files_is_refused_before_it_is_listed() -> None:
    entries = b"PK\1\2" * (bounded.MEMBERS_MAX + 1)
    with pytest.raises(ValueError, match="of at most 65535 files"):
        tracks.tracks(b"PK" + entries, 2)


def test_a_delay_in_a_line_of_many_cells_is_refused() -> None:
    content = b"time_s,delay_s\n0,0.1\n1,0.1" + b"," * recorded.CELLS_MAX
    with pytest.raises(ValueError, match="columns"):
        recorded.recorded_in(File("it", content), "auto")


RING = [[8.0, 47.0]] * (CORNERS_MAX + 1) + [["east", 47.0]]
"""A ring of too many corners, the last of which is none."""


def test_a_ring_of_too_many_corners_is_refused_before_its_corners_are_read() -> None:
    shape = {"type": "Polygon", "coordinates": [RING]}
    features = {"type": "FeatureCollection", "features": [{"geometry": shape}]}
    ring = " ".join(f"{x},{y}" for x, y in RING)
    border = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing>"
    kml = f"<kml><Placemark><Polygon>{border}</outerBoundaryIs></Polygon></Placemark></kml>"
    fence = {"polygons": [{"inclusion": True, "polygon": RING}]}
    mission = {"plannedHomePosition": [47.0, 8.0, 0.0]}
    plan = {"fileType": "Plan", "mission": mission, "geoFence": fence}
    for read, text in (
        (zone_files.geojson, json.dumps(features)),
        (lambda file: zone_files.kml(file, is_fence=True), kml),
        (plans.fences, json.dumps(plan)),
    ):
        with pytest.raises(GrammarError, match=f"at most {CORNERS_MAX} corners"):
            read(File("it", text.encode(), (47.0, 8.0)))  # type: ignore[no-untyped-call]


def test_a_ring_that_returns_to_its_first_corner_is_never_cut() -> None:
    """A geofence of 2000 corners was read as its first half, if that half was closed."""
    ring = [*RING[:-1], [8.1, 47.0], [8.1, 47.1]]
    fence = {"polygons": [{"inclusion": True, "polygon": ring}]}
    mission = {"plannedHomePosition": [8.0, 47.0, 0.0]}
    text = json.dumps({"fileType": "Plan", "mission": mission, "geoFence": fence})
    with pytest.raises(GrammarError, match="corners"):
        plans.fences(File("it", text.encode()))


def test_json_of_too_many_parts_is_refused() -> None:
    assert bounded.json_of(b"[[], {}]") == [[], {}]
    with pytest.raises(ValueError, match="lists and objects"):
        bounded.json_of(b"[" * (bounded.PARTS_MAX + 1))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"<a>" + b"<b/>" * bounded.ELEMENTS_MAX + b"</a>", "elements"),
        (b"<a b='" + b"c" * (bounded.TAG_BYTES_MAX + 2 * bounded.CHUNK_BYTES) + b"'/>", "tags"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "document type"),
        (b"<a>&b;</a>", "undefined entity"),
    ],
    ids=["elements", "tag", "document type", "entity"],
)
def test_xml_beyond_a_bound_is_refused(text: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bounded.xml_of(text)


def test_long_texts_of_xml_are_read() -> None:
    text = b"8,47 " * 500_000
    assert bounded.xml_of(b"<a>" + text + b"</a>").text == text.decode()
