"""Tracks from tables and files of other programs."""

import io
import json
import os
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skytether.shared.base.errors import ConfigError
from skytether.shared.formats import tracks
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.reference import Reference

ORIGIN = (47.0, 8.0)
DEGREE_M = 111_319.49
"""Length of a degree of latitude [m]."""


def sample(desired: Reference, at_s: float) -> tuple[list[float], list[float]]:
    state = desired(np.array(at_s))
    return state[:, 0].tolist(), state[:, 1].tolist()


def zipped(**files: str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name.replace("_", " ") + ".csv", text)
    return content.getvalue()


def test_file_is_flown_in_straight_lines() -> None:
    desired = tracks.path(b"note,t,x,y,z\na,0,1,2,3\nb,2,5,2,1\nc,3,5,0,1\n", 3)
    assert sample(desired, 0.5) == ([2.0, 2.0, 2.5], [2.0, 0.0, -1.0])
    assert sample(desired, 2.5) == ([5.0, 1.0, 1.0], [0.0, -2.0, 0.0])
    assert sample(desired, 3.0) == ([5.0, 0.0, 1.0], [0.0, 0.0, 0.0])


def test_file_for_space_can_be_flown_in_the_plane() -> None:
    desired = tracks.path(b"t,x,y,z\n0,0,0,9\n1,2,4,9\n", 2)
    assert sample(desired, 0.5) == ([1.0, 2.0], [2.0, 4.0])


COLUMNS = (
    "line 1: expected the columns t, x, y; or t, lat, lon; or Time [msec], x [m], y [m]; or "
    "t, px, py; got "
)
BAD_FILES = [
    ("", COLUMNS + "nothing"),
    # Empty lines count too: the line named is the one that an editor shows.
    ("t,x,y\n0,0,0\n\n\n1,one,1\n", "line 5: expected 3 finite numbers, got 1, one, 1"),
    ("t,x,y\n0,0,0\n1,1\n", "line 3: expected 3 finite numbers, got 1, 1, nothing"),
    ("t,x,y\n0.1,0,0\n1,1,1\n", "line 2: expected t = 0 as the first time, got 0.1"),
    ("t,x,y\n0,0,0\n1,1,1\n1,2,2\n", "line 4: expected t above 1, got 1"),
    ("t,x,y\n", "expected at least one line of numbers"),
    ("t,x,y\n0,0,0\n", "expected at least two points"),
    ("t,x,y,vehicle\n0,0,0,1\n1,0,0,1.5\n", "line 3: vehicle: expected numbers from 1 to 65535"),
    (
        "t,x,y,vehicle\n0,0,0,1\n0,0,3,2\n",
        "expected one vehicle, got 2; with reference.shape = mission or show it is flown",
    ),
    (
        "t,lat,lon\n0,47,8\n1,47,8\n",
        (
            "reference.origin, the latitude and longitude of the "
            "scenario's origin: the file's coordinates are degrees"
        ),
    ),
    (
        "duration,x^0\n1,0\n",
        (
            "line 1: expected the columns duration, x^0, x^1, x^2, x^3, x^4, x^5, "
            "x^6, x^7, y^0, y^1, y^2, y^3, y^4, y^5, y^6, y^7, got 'duration', 'x^0'"
        ),
    ),
    ("t,x,y\n0,0,0\n1,nan,1\n", "line 3: expected 3 finite numbers, got 1, nan, 1"),
    ("t,x,y\n0,0,0\n1,1e999,1\n", "line 3: expected 3 finite numbers, got 1, 1e999, 1"),
]


def test_a_header_may_have_spaces_and_a_byte_order_mark() -> None:
    flown = tracks.path(b"\xef\xbb\xbft , x , y \n0,0,0\n1,2,4\n", 2)
    assert sample(flown, 0.5) == ([1.0, 2.0], [2.0, 4.0])


def test_text_in_another_encoding_is_named_with_its_line() -> None:
    with pytest.raises(ValueError, match=r"^line 2: expected text in UTF-8$"):
        tracks.path(b"t,x,y\n0,0,\xff\n", 2)


@pytest.mark.parametrize(("text", "message"), BAD_FILES)
def test_bad_file_says_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        tracks.path(text.encode(), 2)


def test_file_that_is_no_table_is_refused_in_words() -> None:
    """Somebody's JSON in one long line."""
    with pytest.raises(ValueError, match=r"^line 2: field larger than field limit"):
        tracks.path(b"t,x,y\n" + b"9" * 200_000 + b"\n", 2)


def only(found: tracks.Tracks) -> tuple[list[float], Array]:
    (number,) = found
    assert number == 1
    return found[1][0].tolist(), found[1][1]


def test_a_skybrush_table_is_in_milliseconds() -> None:
    text = "Time [msec],x [m],y [m],z [m],Red,Green,Blue\n0,1,2,0,255,0,0\n500,1,2,3.5,0,0,255\n"
    times_s, points_m = only(tracks.tracks(text.encode(), 3))
    assert times_s == [0.0, 0.5]
    assert points_m.tolist() == [[1.0, 2.0, 0.0], [1.0, 2.0, 3.5]]


def test_a_mavsdk_table_is_north_east_down() -> None:
    text = "idx,t,px,py,pz,vx,vy,vz,yaw\n0,0,5,-2,0,0,0,0,0\n1,0.5,6,-2,-10,0,0,0,0\n"
    _, points_m = only(tracks.tracks(text.encode(), 3))
    assert points_m.tolist() == [[5.0, -2.0, 0.0], [6.0, -2.0, 10.0]]


def test_a_table_of_the_globe_is_metres_from_the_origin() -> None:
    text = "t,lat,lon,alt\n0,47,8,0\n9,47.001,8.001,30\n"
    _, points_m = only(tracks.tracks(text.encode(), 3, ORIGIN))
    east_m = 0.001 * DEGREE_M * np.cos(np.radians(47.0005))
    assert points_m[0].tolist() == [0.0, 0.0, 0.0]
    assert points_m[1] == pytest.approx([0.001 * DEGREE_M, east_m, 30.0], abs=0.01)


def test_altitudes_above_the_sea_are_metres_above_the_origins_altitude() -> None:
    text = b"t,lat,lon,alt\n0,47,8,488\n9,47,8,490\n"
    _, points_m = only(tracks.tracks(text, 3, (*ORIGIN, 480.0)))
    assert points_m[:, 2].tolist() == [8.0, 10.0]
    flat = tracks.tracks(text, 2, ORIGIN)
    assert flat[1][1].tolist() == [[0.0, 0.0], [0.0, 0.0]]
    with pytest.raises(ValueError, match="alt: expected metres from 0 on, got 488 and more"):
        tracks.tracks(text, 3, ORIGIN)


def polynomials(*pieces: tuple[float, list[float], list[float]]) -> bytes:
    names = [f"{axis}^{power}" for axis in "xyz" for power in range(8)]
    rows = [
        [length_s, *x, *[0.0] * (8 - len(x)), *y, *[0.0] * (8 - len(y)), *[0.0] * 8]
        for length_s, x, y in pieces
    ]
    lines = [",".join(["duration", *names]), *(",".join(map(str, row)) for row in rows)]
    return "\n".join(lines).encode()


def test_a_crazyswarm_table_is_flown_along_its_polynomials() -> None:
    """x = t² for 2 s, then 4 + 4 t for 1 s; y = t³ and then rest at 8."""
    text = polynomials((2.0, [0, 0, 1], [0, 0, 0, 1]), (1.0, [4, 4], [8]))
    times_s, points_m = only(tracks.tracks(text, 3))
    assert times_s == pytest.approx(np.arange(61) / 20)
    first = np.arange(41) / 20
    assert points_m[:41, 0] == pytest.approx(first**2)
    assert points_m[:41, 1] == pytest.approx(first**3)
    assert points_m[-1] == pytest.approx([8.0, 8.0, 0.0])
    position, velocity = sample(tracks.path(text, 2), 2.52)
    assert position == pytest.approx([6.08, 8.0])
    assert velocity == pytest.approx([4.0, 0.0])


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        ([(0.0, [1.0], [1.0])], "line 2: duration: expected more than 0"),
        ([(1.0, [1.0], [1.0]), (-1.0, [1.0], [1.0])], "line 3: duration: expected more than 0"),
        ([(1e9, [1.0], [1.0])], "duration: expected at most 50000 s together"),
        (
            [(100.0, [0, 0, 0, 0, 0, 0, 0, 1e300], [0.0])],
            "expected at most 1e+06 m from the origin",
        ),
    ],
)
def test_polynomials_that_cannot_be_flown_are_refused(pieces: Any, said: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        tracks.tracks(polynomials(*pieces), 3)


def test_a_zip_has_a_vehicle_a_file_in_the_order_of_their_numbers() -> None:
    files = {f"Drone_{n}": f"t,x,y\n0,{n},0\n1,{n},1\n" for n in (10, 2, 1)}
    found = tracks.tracks(zipped(**files), 2)
    assert {number: points[0, 0] for number, (_, points) in found.items()} == {1: 1, 2: 2, 3: 10}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (zipped(), "expected CSV files, at most 65535 with 64 MB together, got 0"),
        (zipped(a="t,x,y\n1,0,0\n"), "a.csv: line 2: expected t = 0 as the first time, got 1"),
        (zipped(a="vehicle,t,x,y\n1,0,0,0\n2,0,9,0\n"), "a.csv: expected one vehicle a file"),
        (b"PK\x03\x04nothing", "expected a zip that can be read (File is not a zip file)"),
        (zipped(a="t,x,y\n" + "0,0,0\n" * 11_000_000), "got 1"),
    ],
    ids=["empty", "late", "two", "torn", "bomb"],
)
def test_a_zip_that_cannot_be_flown_is_refused(content: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=f"{re.escape(said)}$"):
        tracks.tracks(content, 2)


def test_a_folder_is_read_like_a_zip(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / f"cf{number}.csv").write_text(f"t,x,y\n0,{3 * number},0\n9,{3 * number},2\n")
    (tmp_path / "notes.txt").write_text("no table")
    it = tmp_path / "it.toml"
    it.write_text('extends = "swap"\nreference.shape = "show"\nreference.file = "."\n')
    scenario = reading.load(str(it))
    assert scenario.make_reference(2)(np.array(4.5))[:, 0].tolist() == [6.0, 1.0]
    assert scenario.terms() == reading.load(str(it)).terms()


def item(command: int, *params: Any, frame: int = 3) -> dict[str, Any]:
    filled = [*params, *[0] * (7 - len(params))]
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": filled}


def plan(*items: Any, **mission: Any) -> bytes:
    own = {"plannedHomePosition": [*ORIGIN, 400.0], "hoverSpeed": 5, "items": items, **mission}
    return json.dumps({"fileType": "Plan", "mission": own}).encode()


@pytest.mark.parametrize("origin", [[47.0], [120.0, 8.0], [47.0, 200.0], [47.0, 8.0, 4.0, 1.0]])
def test_an_origin_that_is_no_place_is_refused_by_its_key(origin: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"reference\.origin: got .* expected latitude and long"):
        reading.check({"reference": {"origin": origin}}, "it")


def scan(items: Any, **within: Any) -> dict[str, Any]:
    """Survey of a plan, with its simple items."""
    own = {"Items": items, **within}
    return {"type": "ComplexItem", "complexItemType": "survey", "TransectStyleComplexItem": own}


NORTH = 47.0 + 100.0 / DEGREE_M
"""Latitude 100 m north of the origin [degrees]."""


def test_a_plan_is_flown_from_place_to_place_at_its_speed() -> None:
    survey = scan([item(16, 0, 0, 0, 0, 47.0, 8.0, 20), item(206, 9)], version=2)
    flown = plan(
        item(22, 0, 0, 0, None, 0, 0, 20),
        item(16, 3, 0, 0, None, NORTH, 8.0, 420, frame=0),
        item(178, 1, 10, -1),
        survey,
        item(20),
    )
    times_s, points_m = only(tracks.tracks(flown, 3))
    assert times_s == pytest.approx([0.0, 20.0, 23.0, 33.0], abs=0.01)
    over, north = [0, 0, 20], [100, 0, 20]
    assert points_m == pytest.approx(np.array([over, north, north, over]), abs=0.01)


def test_the_origin_of_the_scenario_counts_more_than_the_plans() -> None:
    _, points_m = only(tracks.tracks(plan(item(16, 0, 0, 0, 0, NORTH, 8.0, 9)), 3, (NORTH, 8.0)))
    assert points_m == pytest.approx(np.array([[-100, 0, 0], [0, 0, 9]]), abs=0.01)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"fileType":"Rally"}', 'a QGroundControl plan, with "fileType": "Plan"'),
        (b"{", "a QGroundControl plan ("),
        (plan(), "a plan with mission items"),
        (plan(item(16, 0, 0, 0, 0, 47, 8, 9, frame=10)), "got one of frame 10"),
        (plan(item(84, 0, 0, 0, 0, 47, 8, 9)), "mission item 1: expected a waypoint, "),
        (plan(item(16, 0, 0, 0, 0, "n", 8, 9)), "mission item 1: latitude a number, got 'n'"),
        (plan(item(16, 0, 0, 0, 0, NORTH, 8, 9), hoverSpeed=0), "hoverSpeed above 0, got 0"),
        (plan({"type": "ComplexItem", "complexItemType": "fwLandingPattern"}), "fwLandingPattern"),
        (plan(item(16), plannedHomePosition=[1]), "a plan with plannedHomePosition"),
        (plan({}).replace(b"[{}]", b"5"), "a plan with mission items"),
        (plan(item(16, 10**400)), "mission item 1: hold time a smaller number"),
        (plan({"type": "ComplexItem", "TransectStyleComplexItem": [1]}), "got None"),
        (plan(item(93, -1, 12)), "mission item 1: a hold time from 0 to 1e+06 s, got -1"),
        (plan(item(16, 0, 0, 0, 0, 47, 8, 1e999)), "mission item 1: coordinates of at most"),
        (plan(item(1e999)), "mission item 1: expected a command and its params"),
        (plan(item(178, 2, 5)), "mission item 1: expected a speed over ground or in the air"),
        (plan({"TransectStyleComplexItem": {"Items": 5}}), "expected a simple item"),
        (plan(item(20), version=1), "a mission of version 2, got 1"),
        (plan(item(20)).replace(b"{", b'{"version":2,', 1), "a plan of version 1, got 2"),
        (plan(item(20), vehicleType=1), "vehicleType: expected a vehicle that can stop"),
        (plan(item(20), vehicleType=[2]), "got MAV_TYPE [2]"),
        (plan(item(20), scan([])), "mission item 2: expected a survey with the places"),
        (plan(scan([item(206)] * 2), scan(None)), "mission item 3: expected a survey with the pla"),
        (plan(scan([item(20)], version=9)), "mission item 1: a TransectStyleComplexItem of versio"),
        (
            plan(item(16) | {"AltitudeMode": 2}),
            "mission item 1: expected frame 0 with AltitudeMode",
        ),
        (plan(item(16) | {"AltitudeMode": [2]}), "mission item 1: expected a command"),
    ],
)
def test_a_plan_that_cannot_be_flown_is_refused(content: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        tracks.tracks(content, 3)


def test_crazyswarms_tools_write_the_header_in_other_ways() -> None:
    """uav_trajectories' savecsv writes a comment, other scripts a capital letter."""
    text = polynomials((1.0, [0, 1], [0]))
    for header in (b"# duration", b"Duration"):
        _, points_m = only(tracks.tracks(text.replace(b"duration", header), 2))
        assert points_m[-1] == pytest.approx([1.0, 0.0])


def test_a_column_given_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="line 1: expected the columns t, x, y"):
        tracks.tracks(b"t,x,y,x\n0,0,0,9\n", 2)


def test_a_zip_made_by_macos_is_read_without_its_attributes() -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("show/Drone 1.csv", "t,x,y\n0,1,2\n")
        archive.writestr("__MACOSX/show/._Drone 1.csv", b"\0\5\x16\7")
    assert list(tracks.tracks(content.getvalue(), 2)) == [1]


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_zip_with_two_files_of_one_name_is_refused() -> None:
    """Only one of the two would be flown."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for x in (0, 9):
            archive.writestr("a.csv", f"t,x,y\n0,{x},0\n")
    with pytest.raises(ValueError, match="two files of the same name"):
        tracks.tracks(content.getvalue(), 2)


@pytest.mark.parametrize("compression", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_a_zip_with_another_compression_is_refused(compression: int) -> None:
    """Their decoders raise other errors, and LZMA's takes as much memory as the file says."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as archive:
        archive.writestr("a.csv", "t,x,y\n0,0,0\n" * 99)
    with pytest.raises(ValueError, match=r"^a.csv: expected the compression deflate"):
        tracks.tracks(content.getvalue()[:60] + b"x" + content.getvalue()[61:], 2)


def test_a_plan_begins_where_its_take_off_ends() -> None:
    """An autopilot takes off by itself, to the altitude at which the flight begins."""
    times_s, points_m = only(tracks.tracks(plan(item(22, 0, 0, 0, None, NORTH, 8.0, 20)), 3))
    assert times_s == pytest.approx([0.0, 20.0], abs=0.01)
    assert points_m == pytest.approx(np.array([[0, 0, 20], [100, 0, 20]]), abs=0.01)
    waits = plan(
        item(93, 7, frame=2),
        item(22, 0, 0, 0, None, 0, 0, 20),
        item(16, 0, 0, 0, 0, NORTH, 8.0, 30),
    )
    _, points_m = only(tracks.tracks(waits, 3))
    assert points_m == pytest.approx(np.array([[0, 0, 20], [0, 0, 20], [100, 0, 30]]), abs=0.01)


def test_a_later_take_off_is_straight_up() -> None:
    up = item(16, 0, 0, 0, 0, NORTH, 8.0, 9), item(22, 0, 0, 0, None, 47.0, 8.0, 20)
    _, points_m = only(tracks.tracks(plan(*up), 3))
    wanted = [[0, 0, 0], [100, 0, 9], [100, 0, 20], [0, 0, 20]]
    assert points_m == pytest.approx(np.array(wanted), abs=0.01)


def test_a_delay_in_a_plan_holds_the_vehicle() -> None:
    flown = plan(item(22, 0, 0, 0, 0, 0, 0, 20), item(93, 7, frame=2))
    times_s, points_m = only(tracks.tracks(flown, 3))
    assert times_s == [0.0, 7.0]
    assert points_m[:, 2].tolist() == [20.0, 20.0]


def test_a_speed_of_minus_one_leaves_the_speed_as_it_is() -> None:
    north = item(16, 0, 0, 0, 0, NORTH, 8.0, 0)
    times_s, _ = only(tracks.tracks(plan(item(178, 1, -1), north), 3))
    assert times_s == pytest.approx([0.0, 20.0])


def test_the_homes_altitude_matters_only_for_altitudes_above_the_sea() -> None:
    """QGroundControl writes null where it has no terrain data."""
    home = [*ORIGIN, None]
    over = plan(item(22, 0, 0, 0, 0, 0, 0, 20), plannedHomePosition=home)
    assert only(tracks.tracks(over, 3))[1][-1].tolist() == [0.0, 0.0, 20.0]
    above_sea = plan(item(22, 0, 0, 0, 0, 0, 0, 420, frame=0), plannedHomePosition=home)
    with pytest.raises(ValueError, match="mission item 1: an altitude above home"):
        tracks.tracks(above_sea, 3)


def test_a_rovers_plan_is_driven_at_its_cruise_speed() -> None:
    north = item(16, 0, 0, 0, 0, NORTH, 8.0, 0)
    times_s, _ = only(tracks.tracks(plan(north, vehicleType=10, version=2, cruiseSpeed=2), 3))
    assert times_s == pytest.approx([0.0, 50.0])


def test_the_origins_altitude_counts_more_than_the_homes() -> None:
    above_sea = item(16, 0, 0, 0, 0, 47.0, 8.0, 420, frame=0)
    _, points_m = only(tracks.tracks(plan(above_sea), 3, (*ORIGIN, 410.0)))
    assert points_m[-1] == pytest.approx([0.0, 0.0, 10.0])


def test_a_zip_of_flat_tables_has_two_axes() -> None:
    flat, high = "t,x,y\n0,0,0\n", "t,x,y,z\n0,0,0,1\n"
    assert tracks.axes_of(zipped(a=flat)) == 2
    assert tracks.axes_of(zipped(a=high, b=high)) == 3


def test_the_file_of_a_folder_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "cf1.csv")
    with pytest.raises(ConfigError, match=r"cf1.csv: it is not a plain file"):
        reading.files_of("reference.file", str(tmp_path))
