"""Tracks from files of other programs."""

import importlib
import io
import json
import sys
import zipfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

from helpers import ran
from skytether.cli import fleet
from skytether.shared import formats
from skytether.shared.base.extras import ExtraMissing
from skytether.shared.formats import tracks, ulog, zone_files
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import File

ORIGIN = (47.0, 8.0)
DEGREE_M = 111_319.49
"""Length of a degree of latitude [m]."""
NORTH = 47.0 + 100.0 / DEGREE_M
"""Latitude 100 m north of the origin [degrees]."""


def read(content: bytes | str, axes: int = 3, origin: Sequence[float] = (), **more: Any) -> Any:
    """Times and points of each vehicle of a file, as lists."""
    content = content.encode() if isinstance(content, str) else content
    found = tracks.tracks(content, axes, tuple(origin), **more)
    return {number: (at_s.tolist(), at.tolist()) for number, (at_s, at) in found.items()}


def close(*points: Sequence[float]) -> Any:
    return [pytest.approx(point, abs=0.02) for point in points]


def refusal(content: bytes | str, axes: int = 3, origin: Sequence[float] = (47.0, 8.0, 0.0)) -> str:
    with pytest.raises(ValueError, match=r"\S") as refused:
        read(content, axes, origin)
    return str(refused.value)


def zipped(**files: Any) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name.replace("__", "/").replace("_", "."), text)
    return content.getvalue()


# -- the table of formats --------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted({name for name, *_ in formats.FORMATS}))
def test_each_format_has_a_module(name: str) -> None:
    module = importlib.import_module(f"skytether.shared.formats.{name}")
    assert callable(module.tracks)
    assert callable(module.axes_of)


def test_a_flight_without_a_file_loads_no_format() -> None:
    code = """
import sys
from skytether.shared.scenario import reading

reading.load("demo").make_reference()
print([name for name in sys.modules if name.startswith("skytether.shared.formats.")])
"""
    shown = ran(sys.executable, "-P", "-c", code)
    assert (shown.stdout, shown.stderr) == ("[]\n", "")


# -- waypoints -------------------------------------------------------------------------------------


def waypoints(*items: str, home: str = "47 8 400") -> str:
    lines = [
        f"0\t1\t0\t16\t0 0 0 0 {home} 1",
        *(f"{n} 0 {each} 1" for n, each in enumerate(items, 1)),
    ]
    return "\r\n".join(["QGC WPL 110", *lines, ""])


def test_waypoints_are_flown_from_home_at_the_scenarios_speed() -> None:
    text = waypoints(
        "3 22 0 0 0 0 0 0 20",
        f"3 16 2 0 0 0 {NORTH} 8 20",
        "2 178 1 10 0 0 0 0 0",
        "3 20 0 0 0 0 0 0 0",
    )
    times_s, points_m = read(text, speed_mps=5.0)[1]
    assert times_s == pytest.approx([0.0, 20.0, 22.0, 32.0], abs=0.01)
    over, north = [0, 0, 20], [100, 0, 20]
    assert points_m == close(over, north, north, over)


def test_waypoints_above_the_sea_are_above_home_or_the_origin() -> None:
    text = waypoints(f"0 16 0 0 0 0 {NORTH} 8 430")
    assert read(text)[1][1][-1] == close([100, 0, 30])[0]
    assert read(text, origin=(NORTH, 8.0, 425.0))[1][1] == close([-100, 0, 0], [0, 0, 5])


def test_waypoints_without_home_need_the_origin() -> None:
    text = waypoints(f"3 16 0 0 0 0 {NORTH} 8 30", home="0 0 0")
    assert "reference.origin" in refusal(text, origin=())
    assert read(text, origin=ORIGIN)[1][1] == close([0, 0, 0], [100, 0, 30])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("QGC WPL 120\n", "line 1: expected QGC WPL 110"),
        (waypoints(), "at least one item"),
        (waypoints("3 16 0 0 0 0 47 8"), "line 3: expected item 1 in 12 columns"),
        (waypoints("3 16 0 0 0 0 47 8 high"), "line 3: expected item 1"),
        (waypoints("3 16 0 0 0 0 47 8 30", "3 177 1 9 0 0 0 0 0"), "mission item 2: "),
        (waypoints("10 16 0 0 0 0 47 8 30"), "mission item 1: .* frame 10"),
        (waypoints("3 1e999 0 0 0 0 47 8 30"), "line 3: expected item 1"),
        (waypoints("3 16 0 0 0 0 47 8 nan"), "mission item 1: altitude"),
        (waypoints("3 16 0 0 0 0 47 8 30").replace("\t16", "\t22"), "line 2: expected home"),
        (waypoints(home="91 8 0") + "1 0 3 16 0 0 0 0 47 8 1 1", "line 2"),
    ],
)
def test_waypoints_that_cannot_be_flown_are_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        read(text)


# -- GPX -------------------------------------------------------------------------------------------


def gpx(*paths: str) -> str:
    return f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">{"".join(paths)}</gpx>'


def point(latitude: float, height: str = "", time: str = "", kind: str = "trkpt") -> str:
    inner = f"<ele>{height}</ele>" * bool(height) + f"<time>{time}</time>" * bool(time)
    return f'<{kind} lat="{latitude}" lon="8">{inner}</{kind}>'


def test_a_gpx_track_is_flown_at_its_times() -> None:
    begin, end = (
        point(47.0, "400", "2026-01-01T00:00:00Z"),
        point(NORTH, "402", "2026-01-01T01:00:20.5+01:00"),
    )
    text = gpx(f"<trk><trkseg>{begin}</trkseg><trkseg>{begin}{end}</trkseg></trk>")
    times_s, points_m = read(text, origin=(*ORIGIN, 399.0))[1]
    assert times_s == [0.0, 20.5]
    assert points_m == close([0, 0, 1], [100, 0, 3])
    assert "reference.origin" in refusal(text, origin=ORIGIN)
    assert read(text, 2, ORIGIN)[1][1] == close([0, 0], [100, 0])
    assert tracks.axes_of(text.encode()) == 3
    assert tracks.lasts_s(text.encode(), 3) == 20.5


def test_a_gpx_route_is_flown_at_the_scenarios_speed() -> None:
    places = point(47.0, kind="rtept"), point(47.0, kind="rtept"), point(NORTH, kind="rtept")
    text = gpx('<wpt lat="1" lon="1"/>', f"<rte>{''.join(places)}</rte>")
    times_s, points_m = read(text, 2, ORIGIN, speed_mps=4.0)[1]
    assert times_s == pytest.approx([0.0, 25.0], abs=0.01)
    assert points_m == close([0, 0], [100, 0])
    assert tracks.axes_of(text.encode()) == 2
    assert "height" in refusal(text)


def test_vehicles_of_a_gpx_file_have_one_clock() -> None:
    early, late = (
        f"<trk><trkseg>{point(47.0, time=f'2026-01-01T00:00:{at}Z')}</trkseg></trk>"
        for at in ("03", "10")
    )
    found = read(gpx(late, early), 2, ORIGIN)
    assert [found[number][0] for number in (1, 2)] == [[0.0, 7.0], [0.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (gpx(), "a track or a route"),
        ("<html/>", "a track or a route"),
        ("<gpx><trk>", "a GPX file"),
        (gpx("<trk><trkseg><trkpt lat='47'/></trkseg></trk>"), "trk 1, point 1: expected 'lon'"),
        (gpx(f"<trk>{point(47, '0')}{point(91, '0')}</trk>"), "latitude"),
        (gpx(f"<trk>{point(47, '0', 'noon')}</trk>"), "trk 1, point 1: expected a time"),
        (gpx(f"<trk>{point(47, '0', '2026-13-01T00:00:00Z')}</trk>"), "trk 1, point 1: "),
        (
            gpx(f"<trk>{point(47, '0', '2026-01-01T00:00:00Z')}{point(47, '0')}</trk>"),
            "a time at each",
        ),
        (
            gpx(
                f"<trk>{''.join(point(47, '0', f'2026-01-01T00:00:0{at}Z') for at in '574')}</trk>"
            ),
            "trk 1, point 3: expected a time after",
        ),
        (gpx(f"<trk>{point(47, 'inf')}</trk>"), "from the origin"),
        ("<!DOCTYPE g [<!ENTITY a 'b'>]>" + gpx("&a;"), "document type"),
    ],
)
def test_a_gpx_file_that_cannot_be_flown_is_refused(text: str, said: str) -> None:
    assert said in refusal(text)


# -- KML -------------------------------------------------------------------------------------------


def kml(*parts: str) -> str:
    return (
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark>{"".join(parts)}</Placemark></kml>'
    )


def line(coordinates: str, mode: str = "absolute") -> str:
    own = f"<altitudeMode>{mode}</altitudeMode><coordinates>{coordinates}</coordinates>"
    return f"<LineString>{own}</LineString>"


def track(*points: tuple[str, str]) -> str:
    whens = "".join(f"<when>{when}</when>" for when, _ in points)
    coords = "".join(f"<gx:coord xmlns:gx='g'>{coord}</gx:coord>" for _, coord in points)
    return f"<Track><altitudeMode>absolute</altitudeMode>{whens}{coords}</Track>"


def test_a_line_of_a_kml_file_is_flown_at_the_scenarios_speed() -> None:
    text = kml(line(f"8,47,400\n 8,{NORTH},400 8,{NORTH},430"))
    times_s, points_m = read(text, origin=(*ORIGIN, 400.0), speed_mps=10.0)[1]
    assert times_s == pytest.approx([0.0, 10.0, 13.0], abs=0.01)
    assert points_m == close([0, 0, 0], [100, 0, 0], [100, 0, 30])
    packed = zipped(doc_kml=text, files__photo_png=b"\x89")
    assert read(packed, origin=(*ORIGIN, 400.0), speed_mps=10.0)[1][0] == times_s


def test_tracks_of_a_kml_file_are_flown_at_their_times() -> None:
    first = track(("2026-01-01T00:00:00Z", "8 47 400"), ("2026-01-01T00:00:02Z", ""))
    second = track(("2026-01-01T00:00:09Z", f"8 {NORTH} 410"))
    text = kml(f"<MultiTrack>{first}{second}</MultiTrack>", second, line("8,47 8,47.1"))
    found = read(text, origin=(*ORIGIN, 400.0))
    assert found[1][0] == [0.0, 9.0]
    assert found[1][1] == close([0, 0, 0], [100, 0, 10])
    assert found[2][0] == [0.0, 9.0]
    assert len(found) == 2


def test_a_kml_path_on_the_ground_has_two_axes() -> None:
    text = kml(line(f"8,47 8,{NORTH}").replace("<altitudeMode>absolute</altitudeMode>", ""))
    assert tracks.axes_of(text.encode()) == 2
    assert read(text, 2, ORIGIN)[1][1] == close([0, 0], [100, 0])
    assert "clampToGround" in refusal(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (kml(), "a LineString or a gx:Track"),
        (kml(line("8,47,30 8,47.001,30", "relativeToGround")), "got relativeToGround"),
        (kml(line("")), "LineString 1: expected coordinates"),
        (kml(line("8,47,1 8")), "LineString 1: expected longitude, latitude"),
        (kml(line("8,47,1 east,47,1")), "LineString 1: "),
        (kml(track(("soon", "8 47 1"))), "Track 1: expected a time"),
        (
            kml(
                track(("2026-01-01T00:00:00Z", "8 47 1"))
                .replace("<when>", "<w>")
                .replace("</when>", "</w>")
            ),
            "a time per place",
        ),
        (kml(line("8,47,1 8,47,2")).replace("</kml>", "<NetworkLink/></kml>"), "without links"),
        ("<!DOCTYPE k [<!ENTITY a 'b'>]>" + kml("&a;"), "document type"),
    ],
)
def test_a_kml_file_that_cannot_be_flown_is_refused(text: str, said: str) -> None:
    assert said in refusal(text)


def test_zones_of_a_kmz_file_are_read() -> None:
    ring = "<LinearRing><coordinates>8,47 8.001,47 8.001,47.001</coordinates></LinearRing>"
    text = kml(f"<Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon>")
    for content in (text.encode(), zipped(doc_kml=text)):
        (zone,) = zone_files.kml(File("it", content, ORIGIN), is_fence=False)
        assert len(zone.corners) == 3


# -- shows of Skybrush -----------------------------------------------------------------------------


def drone(*points: Any, **more: Any) -> dict[str, Any]:
    return {"settings": {"trajectory": {"version": 1, "points": points, **more}}}


def skyc(*drones: Any, version: int = 1, **files: Any) -> bytes:
    return zipped(show_json=json.dumps({"version": version, "swarm": {"drones": drones}}), **files)


def test_a_show_is_flown_along_its_curves() -> None:
    """x = 3 · 8 s² (1 - s) + 8 s³, with the share s of the time."""
    curve = drone([0, [0, 0, 0], []], [4, [8, 0, 0], [[0, 0, 0], [8, 4, 2]]], [6, [8, 0, 5], []])
    times_s, points_m = read(skyc(curve))[1]
    share = np.array(times_s[:81]) / 4.0
    assert times_s == pytest.approx([*np.arange(81) * 0.05, 6.0])
    assert np.array(points_m[:81])[:, 0] == pytest.approx(
        24 * share**2 * (1 - share) + 8 * share**3
    )
    assert points_m[80:] == close([8, 0, 0], [8, 0, 5])


def test_a_vehicle_of_a_show_waits_for_its_take_off() -> None:
    own = drone([0, [1, 2, 0], []], [2, [1, 2, 3], []], takeoffTime=5)["settings"]["trajectory"]
    named = {"settings": {"trajectory": {"$ref": "./drones/a.json#"}}}
    found = read(skyc(drone([0, [4, 0, 0], []]), named, drones__a_json=json.dumps(own)))
    assert found[2] == ([0.0, 5.0, 7.0], [[1, 2, 0], [1, 2, 0], [1, 2, 3]])
    assert found[1] == ([0.0], [[4, 0, 0]])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (skyc(), "show.json of version 1"),
        (skyc(drone([0, [0, 0, 0], []]), version=2), "show.json of version 1"),
        (zipped(show_json="{"), "show.json: expected"),
        (skyc(drone([0, [0, 0, 0], []]), {}), "drone 2: expected a trajectory"),
        (skyc(drone([0, [0, 0], []])), "drone 1: expected a trajectory"),
        (skyc(drone([0, [0, 0, "up"], []])), "drone 1: "),
        (skyc(drone()), "drone 1: expected a trajectory"),
        (skyc(drone([0, [0, 0, 0], []], version=2)), "drone 1: expected a trajectory"),
        (skyc(drone([0, [0, 0, 0], []], [0, [0, 0, 1], []])), "drone 1: expected a time above 0 s"),
        (skyc(drone([1e999, [0, 0, 0], []])), "drone 1: expected finite times"),
        (skyc(drone([0, [0, 0, 0], []], [1e999, [0, 0, 1], []])), "drone 1: expected finite times"),
        (skyc(drone([0, [0, 0, 0], []], [1e6, [0, 0, 1], [[0, 0, 0]]])), "at most 1000000 points"),
        (skyc(drone([0, [0, 0, 0], []], [1, [0, 0, 1], [[0, 0, 0]] * 7])), "control points"),
        (skyc({"settings": {"trajectory": {"$ref": "../other.json"}}}), "drone 1: expected a file"),
        (skyc(drone([0, [0, 0, 1e9], []])), "from the origin"),
    ],
)
def test_a_show_that_cannot_be_flown_is_refused(content: bytes, said: str) -> None:
    assert said in refusal(content)


# -- logs ------------------------------------------------------------------------------------------


def dataflash(*messages: tuple[str, tuple[Any, ...]]) -> bytes:
    """Log of ArduPilot with these messages."""
    kinds = {
        "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns", "<BB4s16s64s"),
        "POS": (9, "QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt", "<Qiiff"),
        "GPS": (10, "QBLLf", "TimeUS,Status,Lat,Lng,Alt", "<QBiif"),
        "ORGN": (11, "QBLLe", "TimeUS,Type,Lat,Lng,Alt", "<QBiii"),
        "MSG": (12, "QZ", "TimeUS,Message", "<Q64s"),
    }
    content = b""
    for name, (kind, codes, columns, layout) in kinds.items():
        length = 3 + len(pack(layout, *[b"" if code in "nNZ" else 0 for code in codes]))
        fields = (kind, length, name.encode(), codes.encode(), columns.encode())
        content += b"\xa3\x95\x80" + pack("<BB4s16s64s", *fields)
    for name, values in messages:
        content += b"\xa3\x95" + bytes([kinds[name][0]]) + pack(kinds[name][3], *values)
    return content


FLOWN = (
    ("ORGN", (1_000_000, 1, 470000000, 80000000, 40000)),
    ("MSG", (1_000_000, b"\xa3\x95 armed")),
    ("POS", (2_000_000, 470000000, 80000000, 400.5, 0.5)),
    ("POS", (2_500_000, round(NORTH * 1e7), 80000000, 430.0, 30.0)),
)


def test_a_dataflash_log_is_flown_as_it_was(tmp_path: Path) -> None:
    content = dataflash(*FLOWN)
    times_s, points_m = read(content)[1]
    assert times_s == [0.0, 0.5]
    assert points_m == close([0, 0, 0.5], [100, 0, 30])
    assert read(content, origin=(NORTH, 8.0, 420.0))[1][1] == close([-100, 0, -19.5], [0, 0, 10])
    file = tmp_path / "it.bin"
    file.write_bytes(content)
    theirs, places = DFReader_binary(str(file)), []
    with closing(theirs.filehandle), closing(theirs.data_map):
        while message := theirs.recv_match(type=["POS"]):
            places.append((message.TimeUS, message.Lat))
    assert places == [
        (2_000_000, pytest.approx(47.0)),
        (2_500_000, pytest.approx(NORTH)),
    ]


def test_a_damaged_dataflash_log_is_read_around_the_damage() -> None:
    begin, *messages = dataflash(*FLOWN).partition(b"\xa3\x95\x09")
    whole = begin + b"\xa3\x95\xff\0junk" + b"".join(messages)
    assert read(whole) == read(dataflash(*FLOWN))
    assert len(read(whole[:-3])[1][0]) == 1


def test_an_older_log_has_the_receivers_places() -> None:
    no_fix = ("GPS", (1_000_000, 1, 0, 0, 0.0))
    fixes = [
        ("GPS", (at, 3, 470000000, 80000000, 400.0 + at / 1e6)) for at in (2_000_000, 3_000_000)
    ]
    assert read(dataflash(no_fix, *fixes))[1] == ([0.0, 1.0], [[0, 0, 0], [0, 0, 1]])
    assert "POS" in refusal(dataflash(no_fix))


def px4(*messages: tuple[str, tuple[Any, ...]]) -> bytes:
    """Log of PX4 with these messages."""
    kinds = {
        "vehicle_global_position": ("uint64_t timestamp;double lat;double lon;float alt;", "<Qddf"),
        "home_position": ("uint64_t timestamp;double lat;double lon;float alt;", "<Qddf"),
        "vehicle_local_position": ("uint64_t timestamp;float x;float y;float z;", "<Qfff"),
    }

    def framed(kind: str, payload: bytes) -> bytes:
        return pack("<HB", len(payload), ord(kind)) + payload

    content = b"ULog\x01\x12\x35\x01" + pack("<Q", 0)
    content += b"".join(framed("F", f"{name}:{text}".encode()) for name, (text, _) in kinds.items())
    for number, name in enumerate(kinds):
        content += framed("A", pack("<BH", 0, number) + name.encode())
    for name, values in messages:
        content += framed("D", pack("<H", list(kinds).index(name)) + pack(kinds[name][1], *values))
    return content


def test_a_ulog_is_flown_as_it_was() -> None:
    at = "vehicle_global_position"
    flown = (at, (2_000_000, 47.0, 8.0, 401.0)), (at, (3_000_000, NORTH, 8.0, 430.0))
    content = px4(("home_position", (1_000_000, 47.0, 8.0, 400.0)), *flown)
    assert read(content)[1] == ([0.0, 1.0], close([0, 0, 1], [100, 0, 30]))
    assert read(px4(*flown))[1][1] == close([0, 0, 0], [100, 0, 29])
    assert read(content, 2, (NORTH, 8.0))[1][1] == close([-100, 0], [0, 0])


def test_a_ulog_without_the_globe_is_flown_in_metres() -> None:
    own = [("vehicle_local_position", (at, 1.0, 2.0, -3.0)) for at in (1_000, 2_000)]
    assert read(px4(*own))[1] == ([0.0, 0.001], [[1, 2, 3], [1, 2, 3]])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (px4(), "vehicle_global_position or"),
        (b"ULog", "expected a ULog"),
        (px4()[:-5] + bytes(100), "expected a ULog"),
    ],
)
def test_a_ulog_without_places_is_refused(content: bytes, said: str) -> None:
    assert said in refusal(content)


def test_a_ulog_of_too_many_messages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ulog, "READS_MAX", 100)
    own = [("vehicle_local_position", (at, 1.0, 2.0, -3.0)) for at in range(100)]
    assert "at most 50 messages" in refusal(px4(*own))


def test_a_damaged_ulog_is_refused_in_bounded_time() -> None:
    """pyulog goes back by the length of a message that the file does not have."""
    whole = px4()
    definitions = whole[: whole.index(b"\0\0\0vehicle_global") - 3]
    assert "ULog" in refusal(definitions + pack("<HB", 120, 0) + b"short")


def test_the_extra_of_a_ulog_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ExtraMissing, match=r"'skytether\[ulog\]'"):
        tracks.tracks(px4() + b"x", 3)


# -- in a scenario ---------------------------------------------------------------------------------


def test_a_scenario_names_such_a_file(tmp_path: Path) -> None:
    (tmp_path / "field.waypoints").write_text(waypoints(f"3 16 0 0 0 0 {NORTH} 8 0"))
    it = tmp_path / "it.toml"
    it.write_text(
        '[reference]\nshape = "csv"\nfile = "field.waypoints"\nspeed_mps = 4.0\n[model]\naxes = 2\n'
    )
    state = reading.load(str(it)).make_reference()(np.array(12.5))
    assert state[:, 0] == pytest.approx([50.0, 0.0], abs=0.01)
    assert state[:, 1] == pytest.approx([4.0, 0.0])


def test_a_mission_lasts_as_long_as_its_speed_makes_it(tmp_path: Path) -> None:
    file = tmp_path / "field.WAYPOINTS"
    file.write_text(waypoints("3 22 0 0 0 0 0 0 20", f"3 16 0 0 0 0 {NORTH} 8 20"))
    asked = fleet._with_mission(["--mission", str(file), "--reference.speed-mps", "2"])
    lasts_s = float(asked[asked.index("--duration") + 1])
    assert lasts_s - fleet.AFTER_S == pytest.approx(50.0, abs=0.1)
