"""Zones: their texts and files, distances from them, and routes around them."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import packaged, refusal
from skytether.server.missions.routes import RoutesAroundZones
from skytether.server.missions.zone_clearance import comes_near
from skytether.shared.formats.zone_files import CRS84
from skytether.shared.law.model import Array
from skytether.shared.missions import zone_texts
from skytether.shared.missions.derived import zones
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.reading import ConfigError
from two_vehicles import with_goals

BOX = "box(1, 2, -1, 1)"
U = "polygon(0, 0, 4, 0, 4, 3, 3, 3, 3, 1, 1, 1, 1, 3, 0, 3)"
"""Polygon that is open above, between x = 1 and 3."""
FENCE = "fence(-5, 5, -5, 5)"
place = st.floats(-6.0, 6.0)


def away_m(text: str, *points: tuple[float, ...]) -> list[float]:
    given = np.array(points)
    kept = zone_texts.parse(text, given.shape[1])
    found: list[float] = kept.clearance(given).min(axis=1).tolist()
    return found


@pytest.mark.parametrize(
    ("text", "point", "distance_m"),
    [
        (BOX, (0.0, 0.0), 1.0),
        (BOX, (0.0, 2.0), 2.0**0.5),
        (U, (2.0, 2.0), 1.0),
        (U, (2.0, 0.5), -0.5),
        (FENCE, (6.0, 0.0), -1.0),
        (f"{FENCE} & {BOX}", (4.0, 0.0), 1.0),
        ("fence(0, 0, 4, 0, 0, 4)", (1.0, 1.0), 1.0),
        ("corridor(2, -5, 0, 0, 0, 0, 5)", (-3.0, 0.0), 1.0),
        ("corridor(2, -5, 0, 0, 0, 0, 5)", (-3.0, 1.5), -0.5),
        ("box(1, 2, -1, 1, 0, 3)", (1.5, 0.0, 4.0), 1.0),
        ("box(1, 2, -1, 1, 0, 3)", (0.0, 0.0, 4.0), 2.0**0.5),
        ("cylinder(0, 0, 1, 0, 3)", (3.0, 0.0, 1.0), 2.0),
    ],
)
def test_distances(text: str, point: tuple[float, ...], distance_m: float) -> None:
    assert away_m(text, point)[0] == pytest.approx(distance_m, abs=0.01)


def test_a_cylinder_lies_within_its_corners() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert max(away_m("cylinder(0, 0, 1)", *map(tuple, around))) < 1e-9


@settings(max_examples=60)
@given(place, place, place, place, st.sampled_from([BOX, U, FENCE, f"{U} & {FENCE}"]))
def test_a_straight_piece_is_no_nearer_than_it_says(
    x0: float, y0: float, x1: float, y1: float, text: str
) -> None:
    kept, ends = zone_texts.parse(text, 2), np.array([[x0, y0], [x1, y1]])
    share = np.linspace(0.0, 1.0, 201)[:, None]
    points = ends[0] + share * (ends[1] - ends[0])
    least = float(kept.clearance(points).min())
    assert comes_near(kept, ends, max(least, 0.0) + 1e-6)
    assert bool(kept.in_the_way(ends, least)) == comes_near(kept, ends, least)
    gap_m = float(np.linalg.norm(ends[1] - ends[0])) / 200.0
    if least > gap_m:
        assert not comes_near(kept, ends, least - gap_m - 1e-9)


@settings(max_examples=50)
@given(
    st.lists(st.tuples(place, place, st.floats(-1.0, 6.0)), min_size=2, max_size=2),
    st.floats(0.05, 1.0),
    st.sampled_from(
        [
            "box(1, 2, -1, 1, 0, 3)",
            "cylinder(0, 0, 1, 2, 3)",
            "fence(-5, 5, -5, 5) & box(0, 1, 0, 1)",
        ]
    ),
)
def test_straight_pieces_in_space(
    ends: list[tuple[float, float, float]], room_m: float, text: str
) -> None:
    """A piece is as near as its nearest point. A piece that is not level may count as nearer, as if
    at all of its heights at once.
    """
    kept, given = zone_texts.parse(text, 3), np.array(ends)
    level = given.copy()
    level[:, 2] = given[0, 2]
    share = np.linspace(0.0, 1.0, 201)[:, None]
    for piece, is_level in ((given, False), (level, True)):
        least = float(kept.clearance(piece[0] + share * (piece[1] - piece[0])).min())
        if least < room_m - 1e-9:
            assert comes_near(kept, piece, room_m)
        elif is_level and least > room_m + float(np.linalg.norm(piece[1] - piece[0])) / 200.0:
            assert not comes_near(kept, piece, room_m)


@given(place, place, st.floats(0.05, 0.3), st.sampled_from([BOX, U, FENCE, f"{BOX} & {FENCE}"]))
def test_a_point_fulfils_its_own_half_planes(x: float, y: float, room_m: float, text: str) -> None:
    kept, point = zone_texts.parse(text, 2), np.array([[x, y]])
    if kept.clearance(point).min() < room_m:
        return
    planes = kept.planes(point, np.array([20.0]))
    rise = np.einsum("ij,ij->i", planes.normal, point[planes.at] - planes.border)
    assert rise == pytest.approx(planes.away_m)
    assert np.linalg.norm(planes.normal, axis=1) == pytest.approx(1.0)
    if text == BOX:
        corners = kept.zones[0].corners
        assert ((corners - planes.border[0]) @ planes.normal[0]).max() < 1e-9


def test_nobody_is_above_a_zone_that_reaches_to_the_sky() -> None:
    kept = zone_texts.parse("box(0, 1, 0, 1, 2, 3) & fence(-5, 5, -5, 5)", 3)
    points = np.array([[0.5, 0.5, 1.0], [0.5, 0.5, 9.0]])
    assert kept.clearance(points)[:, 0].tolist() == [1.0, 6.0]
    raised = kept.to_the_sky()
    assert raised.clearance(points)[:, 0].tolist() == [1.0, -0.5]
    assert [zone.is_fence for zone in raised.zones] == [False, True]
    assert raised.clearance(points)[:, 1].tolist() == kept.clearance(points)[:, 1].tolist()


# -- texts and files -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bix(0, 1, 0, 1)", "did you mean box"),
        ("box(1, 0, 0, 1)", "each pair ascending"),
        ("box(0, 1, 0, nan)", "box(x0, x1, y0, y1, heights…)"),
        ("box(0, 1)", "box(x0, x1, y0, y1, heights…)"),
        ("polygon(0, 0, 1, 1)", "at least 3 points"),
        ("corridor(0, 0, 0, 1, 0)", "corridor(width"),
        ("box(0, 2e6, 0, 1)", "numbers of at most 1e+06 m"),
        ("corridor(1, 0, 0, 1, 0, 0, 0)", "without a turn back"),
        ("box(0, 1, 0, 1, 0, 3)", "no heights with model.axes = 2"),
        ("box(0, 1, 0, 1) cylinder(0, 0, 1)", "zones such as"),
    ],
)
def test_what_is_no_zone_is_told(text: str, said: str) -> None:
    with pytest.raises(GrammarError) as refused:
        zone_texts.parse(text, 2)
    assert said in str(refused.value)


def parsed(text: str, axes: int = 2) -> Zones:
    return zone_texts.parse(text, axes, reading.files_of("mission.zones", text))


def geojson(features: Any, **more: Any) -> str:
    """Content of a file in metres, unless it has an origin or a member says otherwise."""
    more = {"units": "m"} | more if "origin" not in more else more
    return json.dumps({"type": "FeatureCollection", "features": features, **more})


def polygon(points: Any, **properties: Any) -> dict[str, Any]:
    shape = {"type": "Polygon", "coordinates": [points]}
    return {"type": "Feature", "properties": properties, "geometry": shape}


def test_zones_from_a_map(tmp_path: Path) -> None:
    file = tmp_path / "map.geojson"
    degree_m = 111_319.5
    square = [[10.0, 50.0], [10.001, 50.0], [10.001, 50.001], [10.0, 50.001], [10.0, 50.0]]
    field = [[-100, -100], [100, -100], [100, 100], [-100, 100]]
    hole = [[-10, -10], [10, -10], [10, 10], [-10, 10]]
    file.write_text(geojson([polygon(square, low_m=0, high_m=30)], origin=[10.0, 50.0]))
    kept = parsed(f'geojson("{file}")', 3)
    (zone,) = kept.zones
    assert zone.corners[2] == pytest.approx(
        [111.3195, degree_m * 1e-3 * np.cos(np.radians(50.0005))]
    )
    assert (zone.low_m, zone.high_m, zone.is_fence) == (0.0, 30.0, False)
    fence = polygon(field, kind="fence", name="field")
    fence["geometry"]["coordinates"].append(hole)
    mast = {"type": "Point", "coordinates": [50, 50]}
    file.write_text(geojson([fence, {"geometry": mast, "properties": {"radius_m": 5}}]))
    points = np.array([[0.0, 0.0], [20.0, 0.0], [50.0, 52.0], [200.0, 0.0]])
    inside = parsed(f"geojson({file})").clearance(points).min(axis=1)
    assert (inside > 0.0).tolist() == [False, True, False, False]


SQUARE = [[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]
BOW_TIE = [[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]
MEMBER = {"type": "Feature", "properties": None}


def shape(geometry_type: str, coordinates: Any, **properties: Any) -> str:
    geometry = {"type": geometry_type, "coordinates": coordinates}
    return geojson([MEMBER | {"properties": properties, "geometry": geometry}])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "a GeoJSON file"),
        ("[]", "FeatureCollection"),
        (geojson([]), "a GeoJSON file with a Polygon"),
        (geojson([polygon(SQUARE)], units=None), "reference.origin, the latitude and longitude"),
        (geojson([polygon(SQUARE)], units="m", origin=[10, 50]), "got both"),
        (geojson([polygon(SQUARE)], units="ft"), '"units": "m" or none, got \'ft\''),
        (geojson([polygon(SQUARE)], origin=[10]), '"origin": [longitude, latitude]'),
        (geojson([polygon(SQUARE)], origin=[50, 110]), "up to 85 degrees north"),
        (geojson([polygon(SQUARE)], origin=[10, 50]), "at most 100000 m from the origin"),
        (geojson([polygon([[0, 0], [0, 89], [1, 89]])], origin=[0, 84]), "longitude and latitude"),
        (geojson([polygon(SQUARE)], crs={"type": "name"}), "no crs: RFC 7946 uses degrees"),
        (geojson([{"geometry": None}]), "a Point with radius_m, not a None"),
        (geojson([polygon([[0, 0], [1, 1]])]), "feature 1', expected at least 3 corners"),
        (geojson([{"properties": {}}]), "feature 1', expected a feature with a geometry"),
        (shape("Polygon", [[]]), "feature 1', expected coordinates, got none"),
        (shape("Point", [], radius_m=1), "feature 1', expected coordinates of two numbers"),
        (shape("Point", [0, 0], radius=5), "the property radius_m in metres, not with radius"),
        (shape("Polygon", [SQUARE], kind=["fence"]), "keep_out or fence, got \"['fence']\""),
        (shape("Point", [0, 0], radius_m=float("inf")), "radius_m above 0, at most 1e+06"),
        (
            shape("MultiPolygon", [[SQUARE], [SQUARE]], kind="fence"),
            "feature 1', expected one polygon",
        ),
        (geojson([polygon([[0, 0, 5], [1, 1, 5], [0, 1, 5]])]), "no heights in its coordinates"),
        (geojson([polygon(SQUARE, low_m=30, high_m=0)]), "low_m below high_m, got 30 and 0"),
        (geojson([polygon([[0, 0], [True, 1], [0, 1]])]), "coordinates a number, got 'True'"),
        (geojson([polygon([[0, 0], [1e9, 1], [0, 1]])]), "at most 1e+06 m"),
        (geojson([polygon(BOW_TIE)]), "a border that does not cross itself"),
    ],
)
def test_a_wrong_map_is_told(content: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "map.geojson"
    file.write_text(content)
    with pytest.raises(GrammarError) as refused:
        parsed(f'geojson("{file}")', 2)
    assert said in str(refused.value)


def test_a_map_is_the_same_however_rfc_7946_lets_it_be_written(tmp_path: Path) -> None:
    """Rings of either winding, closed or not, with heights of 0, on both sides of 180 degrees."""
    file = tmp_path / "map.geojson"

    def corners(points: Any, origin: Any, **more: Any) -> list[list[float]]:
        file.write_text(geojson([polygon(points)], origin=origin, **more))
        (zone,) = parsed(f"geojson({file})").zones
        found: list[list[float]] = zone.corners.round(6).tolist()
        return found

    square = [[0.0, 0.0], [0.001, 0.0], [0.001, 0.001], [0.0, 0.001]]
    expected = corners(square, [0.0, 0.0])
    assert expected[1] == pytest.approx([0.0, 111.319491])
    assert corners([*square, square[0]], [0.0, 0.0]) == expected
    assert corners([[*point, 0.0] for point in square], [0, 0], crs=CRS84) == expected
    assert sorted(corners(square[::-1], [0.0, 0.0])) == sorted(expected)
    east = [[-179.9995, y] if x else [179.9995, y] for x, y in square]
    assert corners(east, [179.9995, 0.0]) == expected
    assert corners(east, [-179.9995, 0.0])[0] == pytest.approx([0.0, -111.319491])


def test_neither_winding_nor_hole_changes_where_a_vehicle_may_be(tmp_path: Path) -> None:
    file = tmp_path / "map.geojson"
    hole = [[3, 3], [6, 3], [6, 6], [3, 6], [3, 3]]
    places = np.array([[1.0, 1.0], [4.5, 4.5], [12.0, 1.0]])
    for outer, inner in ((SQUARE, hole), (SQUARE[::-1], hole), (SQUARE, hole[::-1])):
        for kind, free in (("keep_out", [False, False, True]), ("fence", [True, False, False])):
            file.write_text(shape("Polygon", [outer, inner], kind=kind))
            kept = parsed(f"geojson({file})")
            assert (kept.clearance(places).min(axis=1) > 0.0).tolist() == free


def test_a_border_that_crosses_itself_is_refused_in_a_text_as_well() -> None:
    """By the even-odd rule a vehicle would be free within a doubly enclosed region."""
    star = "polygon(0, 10, -6, -8, 9.5, 3, -9.5, 3, 6, -8)"
    with pytest.raises(GrammarError, match="does not cross itself"):
        zone_texts.parse(star, 2)
    zone_texts.parse(U, 2)


@pytest.mark.parametrize(
    ("text", "goals", "said"),
    [
        ("box(3, 5, -1, 1)", "", "none within 0.23 m of the goal (4, 0) of vehicle 1"),
        ("fence(-1, 3, -1, 5)", "", "a fence 0.23 m around the goal (4, 0) of vehicle 1"),
        ("box(9, 9.0004, 9, 9.0003)", "", "at least mission.tube_m = 0.2 m; this is 0.0004 m long"),
        ("geojson(missing.json)", "", "a file that can be read"),
        ("", "1,0,0,0\n2,0,0.5,0\n", "at most 0.5 m, as the goals of vehicles 1 and 2 at 0 s"),
    ],
)
def test_goals_that_cannot_be_reached(text: str, goals: str, said: str, tmp_path: Path) -> None:
    table = with_goals(tmp_path, goals or "1,0,0,0\n1,2,4,0\n2,0,0,4\n", zones=text)
    assert said in refusal(lambda: reading.check(table, "mission"))


@pytest.mark.parametrize(
    ("kind", "said"), [("fence", "feature 1, hole 1"), ("keep_out", "feature 1, with its holes")]
)
def test_a_goal_in_a_hole_is_refused_with_the_hole(kind: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "map.geojson"
    outer = [[-9, -9], [9, -9], [9, 9], [-9, 9]]
    hole = [[-5, -5], [5, -5], [5, 5], [-5, 5]]
    file.write_text(shape("Polygon", [outer, hole], kind=kind))
    table = with_goals(tmp_path, "1,0,0,0\n1,2,4,0\n2,0,0,4\n", zones=f'geojson("{file}")')
    assert f"{said}, expected none within" in refusal(lambda: reading.check(table, "mission"))


def test_zones_are_of_missions_alone() -> None:
    with pytest.raises(ConfigError, match=r"mission\.zones: .*expected none without a mission"):
        packaged("target", mission={"zones": BOX})


def test_a_file_lies_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text(geojson([polygon([[9, 9], [10, 9], [9, 10]])]))
    file = tmp_path / "mine.toml"
    file.write_text('extends = "swap"\n[mission]\nzones = "geojson(map.json)"\n')
    assert len(zones(reading.load(str(file))).zones) == 1


# -- routes ----------------------------------------------------------------------------------------


def length_m(way: Array) -> float:
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


@pytest.mark.parametrize(
    ("text", "goal", "least_m"),
    [
        (BOX, (3.0, 0.0), 2 * 2**0.5 + 1),
        (U, (2.0, 2.0), 4.0 + 2**0.5 + 1),
        (f"{BOX} & {FENCE}", (3.0, 0.0), 2 * 2**0.5 + 1),
    ],
)
def test_a_way_goes_round(text: str, goal: tuple[float, float], least_m: float) -> None:
    kept, begin = zone_texts.parse(text, 2), np.array([0.0, -1.0 if text == U else 0.0])
    way = np.vstack([begin, RoutesAroundZones(kept, 0.2).way(begin, np.array(goal))])
    assert len(way) > 2
    assert not comes_near(kept, way, 0.2 - 1e-6)
    assert least_m < length_m(way) < 1.5 * least_m + 1.0


def test_where_there_is_no_way() -> None:
    kept = zone_texts.parse("fence(-5, 5, -5, 5) & box(-0.5, 0.5, -5, 5)", 2)
    routes = RoutesAroundZones(kept, 0.2)
    begin, goal = np.array([-3.0, 0.0]), np.array([3.0, 0.0])
    assert routes.way(begin, goal).tolist() == [[3.0, 0.0]]
    assert not routes.reaches(begin, goal)
    assert RoutesAroundZones(Zones(), 0.2).reaches(begin, goal)


def placemark(*parts: str, name: str = "roof") -> str:
    return f"<Placemark><name>{name}</name>{''.join(parts)}</Placemark>"


def polygon_of(*rings: str) -> str:
    kinds = ["outerBoundaryIs", *["innerBoundaryIs"] * (len(rings) - 1)]
    borders = [
        f"<{kind}><LinearRing><coordinates>{ring}</coordinates></LinearRing></{kind}>"
        for kind, ring in zip(kinds, rings, strict=True)
    ]
    return f"<Polygon>{''.join(borders)}</Polygon>"


OUTER = "8,47,0 8.01,47,0 8.01,47.01,0 8,47.01,0 8,47,0"
INNER = "8.002,47.002 8.004,47.002 8.004,47.004"


def kml(tmp_path: Path, text: str, kind: str = "") -> Zones:
    file = tmp_path / "area.kml"
    file.write_text(
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{text}</Document></kml>'
    )
    (read,) = reading.files_of("mission.zones", f'kml("{file}")')
    return zone_texts.parse(f'kml("{file}"{kind})', 2, (read._replace(origin=(47.0, 8.0)),))


def test_polygons_of_a_kml_file_are_kept_out_of_or_stayed_within(tmp_path: Path) -> None:
    text = placemark(polygon_of(OUTER, INNER)) + placemark(polygon_of(INNER), name="pond")
    out = kml(tmp_path, text)
    assert [(each.name, each.is_fence, len(each.corners)) for each in out.zones] == [
        ("area.kml: roof", False, 4),
        ("area.kml: pond", False, 3),
    ]
    assert out.zones[0].corners[2] == pytest.approx([1113.2, 759.1], abs=0.2)
    within = kml(tmp_path, placemark(polygon_of(OUTER, INNER)), ", fence")
    assert [(each.is_fence, len(each.corners)) for each in within.zones] == [(True, 4), (False, 3)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a KML file with a Polygon in a Placemark"),
        ("<open", "a KML file ("),
        (placemark("<Point><coordinates>8,47</coordinates></Point>"), "a Polygon, not a Point"),
        (placemark(polygon_of("8,47,30 8.1,47,30 8,47.1,30")), "without heights, got 8,47,30"),
        (placemark(polygon_of("8,47 8.1,47 east,47.1")), "east"),
        (placemark(polygon_of(OUTER.replace("8.01", "9.9"))), "of at most 100000 m"),
        (placemark("<Polygon/>"), "a Polygon with an outerBoundaryIs"),
        (placemark(polygon_of(OUTER)) + "<NetworkLink/>", "without links"),
        ("<Placemark>" * 9000 + "</Placemark>" * 9000, "no Placemark within another"),
        (placemark("<Polygon>" * 9000 + "</Polygon>" * 9000), "no Polygon within another"),
    ],
)
def test_a_kml_file_that_has_no_zones_is_refused(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(GrammarError, match=re.escape(said)):
        kml(tmp_path, text)


def test_several_holes_in_one_boundary_of_a_kml_file_are_kept_out_of(tmp_path: Path) -> None:
    rings = polygon_of(OUTER, INNER, INNER).replace("</innerBoundaryIs><innerBoundaryIs>", "")
    zones = kml(tmp_path, placemark(rings), ", fence").zones
    assert [each.is_fence for each in zones] == [True, False, False]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_of_a_kml_file_are_not_expanded(encoding: str, tmp_path: Path) -> None:
    file = tmp_path / "bomb.kml"
    file.write_text('<!DOCTYPE k [<!ENTITY a "aaaaaaaa">]><kml>&a;</kml>', encoding)
    read = reading.files_of("mission.zones", f'kml("{file}")')
    with pytest.raises(GrammarError, match="without a document type"):
        zone_texts.parse(f'kml("{file}")', 2, read)


def geofence(tmp_path: Path, **fence: Any) -> Zones:
    file = tmp_path / "site.plan"
    home = {"plannedHomePosition": [47.0, 8.0, 400.0]}
    file.write_text(json.dumps({"fileType": "Plan", "mission": home, "geoFence": fence}))
    return zone_texts.parse(
        f'plan("{file}")', 2, reading.files_of("mission.zones", f'plan("{file}")')
    )


def test_a_geofence_of_a_plan_is_stayed_within_and_kept_out_of(tmp_path: Path) -> None:
    corners = [[47.0, 8.0], [47.0, 8.01], [47.01, 8.01]]
    circle = {"center": [47.001, 8.001], "radius": 20.0}
    found = geofence(
        tmp_path,
        polygons=[{"inclusion": True, "polygon": corners}],
        circles=[{"inclusion": inclusion, "circle": circle} for inclusion in (True, False)],
    )
    assert [zone.is_fence for zone in found.zones] == [True, True, False]
    centre = np.array([[111.3, 75.9]])
    within, around = (
        np.linalg.norm(zone.corners - centre, axis=1).max() for zone in found.zones[1:]
    )
    assert within == pytest.approx(20.0, abs=0.2)
    assert around == pytest.approx(20.0 / np.cos(np.pi / 24), abs=0.2)


@pytest.mark.parametrize(
    ("fence", "said"),
    [
        ({"version": 3}, "a geofence of version 2, got 3"),
        ({}, "a plan with a geofence"),
        ({"version": 1, "polygon": [[47, 8], [47, 8.1], [47.1, 8]]}, "a geofence of version 2"),
        ({"polygons": 5}, "a geofence of version 2"),
        ({"polygons": [{"polygon": []}]}, "inclusion, and corners or a centre and radius"),
        ({"circles": [{"inclusion": True, "circle": {"center": [47, 8], "radius": 0}}]}, "above 0"),
        ({"polygons": [{"inclusion": True, "polygon": [[47, 8], [47, 10]]}]}, "of at most"),
    ],
)
def test_a_geofence_that_cannot_be_kept_is_refused(
    fence: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(GrammarError, match=said):
        geofence(tmp_path, **fence)
