"""Recordings: exact to the last bit, from complete and from damaged files."""

import csv
import io
import json
import re
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from fuzz.recordings import frames_of, put, records, written
from skytether.cli import page_process, recorder
from skytether.cli.export import export
from skytether.cli.fly import fly
from skytether.cli.join import join
from skytether.cli.recorder import Live
from skytether.cli.report import report
from skytether.figures.tables import to_csv
from skytether.shared.base.errors import RecordingError
from skytether.shared.events.aboard import AutopilotText
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import NetworkConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import Figures, Opened, Rows, described, pack
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    Record,
    client_columns,
    plan_columns,
    server_columns,
)
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shell.commandline import command
from skytether.shell.processes.log import Log
from skytether.sim import flight
from skytether.view.frames import Timed, of_flight
from skytether.view.recordings import container, recorded
from skytether.view.recordings import report as view_report
from skytether.view.recordings.recorded import read
from skytether.view.recordings.recording import VEHICLES_MAX, Recording
from skytether.view.rows import RowTable, planned
from virtual_loop import AtJoin

PARTS = ("client", "server", "plan", "netem")
SCENARIO = msgspec.structs.replace(reading.load("demo"), duration=6.0, settle=3.0)


@cache
def flown() -> Record:
    return flight.fly(SCENARIO)


def record(path: Path, scenario: Scenario = SCENARIO, of: Record | None = None) -> Path:
    of = of or flown()
    rows = of.client, of.server, of.netem
    summary = summarise(scenario, "demo", *rows, figures=of.figures)
    assert recorder.write(path, scenario, "demo", of, summary) is None
    return path


def write_frames(
    file: Any,
    frames: Iterable[Timed],
    *,
    scenario: Scenario = SCENARIO,
    chunk: int | None = None,
    end: bool = True,
) -> None:
    """Record frames, so many in a chunk, with or without the end of a file."""
    about = recorder._about(scenario, "demo", began=None, offset_ns=0, secure=False)
    made = Recording(file, scenario, about)
    for number, (_, process, frame) in enumerate(frames):
        made.add(process, frame)
        if chunk and number % chunk == 0:
            made.flush()
    if end:
        made.finish(None)
    else:
        made.flush()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recording") / "flight.mcap")


def summary_of(of: Record) -> Summary:
    rows = of.client, of.server, of.netem
    return summarise(SCENARIO, "demo", *rows, figures=of.figures)


def is_named(record: Any, name: str) -> bool:
    """Whether a record of a file is an attachment of this name."""
    return isinstance(record, Attachment) and record.name.startswith(name)


def refusal(argv: list[str], of: Any, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = command.main(of, argv, "it")
    (line,) = capsys.readouterr().err.splitlines()
    return code, line


def refused(path: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    tables, page = str(folder / "tables"), str(folder / "page.html")
    refusals = [
        refusal([str(path), "--csv", tables], export, capsys),
        refusal([str(path), "--html", page], report, capsys),
    ]
    assert [code for code, _ in refusals] == [2, 2]
    return [line for _, line in refusals]


# --- Round trips.


def test_a_flight_comes_back_to_the_last_bit(recording: Path) -> None:
    back = read(recording)
    assert (back.about.scenario, back.scenario, back.lost_bytes) == ("demo", SCENARIO, None)
    assert back.summary == summary_of(flown())
    for part in PARTS:
        assert back.parts[part].dtype == getattr(flown(), part).dtype
        assert back.parts[part].tobytes() == getattr(flown(), part).tobytes()
    assert back.frames == list(of_flight(SCENARIO, "demo", flown()))
    (attached,) = (each for each in records(recording.read_bytes()) if is_named(each, "summary"))
    assert json.loads(attached.data) == msgspec.to_builtins(back.summary)


def test_a_network_that_nobody_could_fly_over_is_recorded(tmp_path: Path) -> None:
    slow = msgspec.structs.replace(SCENARIO, network=NetworkConfig(uplink="constant(100)"))
    assert read(record(tmp_path / "slow.mcap", slow, flown())).scenario == slow


def test_frames_of_a_flight_are_in_the_order_of_their_times() -> None:
    frames = list(of_flight(SCENARIO, "demo", flown()))
    times_ns = [time_ns for time_ns, _, _ in frames]
    assert times_ns == sorted(times_ns)
    assert times_ns[0] == 0
    steps = [
        time_ns
        for time_ns, _, frame in frames
        if isinstance(frame, Rows) and frame.part == "client"
    ]
    assert set(np.diff(steps)) == {SCENARIO.dt_ns}


def test_a_fleet_in_space_comes_back() -> None:
    scenario = reading.check(
        reading.to_table(SCENARIO) | {"model": {"axes": 3}, "duration": 2.0, "settle": 0.0}
    )
    two = flight.fly(scenario, vehicles=2)
    file = io.BytesIO()
    write_frames(file, of_flight(scenario, "fleet", two), scenario=scenario)
    topics = topics_of(file)
    assert {"/vehicle/1/flown", "/vehicle/2/flown", "/vehicle/2/scene/vehicle"} <= topics.keys()
    assert topics["/vehicle/1/flown"] == topics["/vehicle/2/flown"]


def topics_of(file: Any) -> dict[str, int]:
    file.seek(0)
    summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts[number] for number, channel in summary.channels.items()}


COLUMNS = [client_columns(2), client_columns(3), server_columns(2, "committed"), plan_columns(3, 4)]
COLUMNS += [PACKET_COLUMNS]


@given(st.sampled_from(COLUMNS), st.binary(min_size=1, max_size=64), st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_any_bits_of_a_row_become_a_message_of_its_schema(
    columns: np.dtype[np.void], bits: bytes, count: int
) -> None:
    """Values without a number in JSON are left out: NaN of every kind, and infinity."""
    several = (bits * columns.itemsize)[: columns.itemsize] * count
    rows = np.frombuffer(several, columns).copy()
    for name in columns.names or ():
        if columns[name].base.kind == "b":
            rows[name] = rows[name].view("u1") & 1
    table = RowTable(columns)
    messages = [msgspec.json.decode(msgspec.json.encode(each)) for each in table.messages(rows)]
    assert len(messages) == count
    for message in messages:
        assert fault(message, table.schema) == ""


@pytest.mark.parametrize("number", [np.nan, -np.nan, np.inf, -np.inf])
def test_what_json_has_no_number_for_is_left_out(number: float) -> None:
    rows = np.zeros(1, client_columns(2))
    rows["state"][0, 0, 0] = number
    (message,) = RowTable(rows.dtype).messages(rows)
    assert "position_x_m" not in message
    assert message["position_y_m"] == 0.0


# --- Schemas.


def fault(message: Any, schema: Mapping[str, Any]) -> str:
    """First mismatch of a message with its schema, for the parts of JSON schema in use."""
    match schema["type"]:
        case "object":
            if not isinstance(message, dict):
                return f"{message!r} is no object"
            known = schema["properties"]
            return next(
                filter(None, (fault(message[k], known[k]) for k in message.keys() & known)), ""
            )
        case "array":
            items = schema["items"]
            return next(filter(None, (fault(each, items) for each in message)), "")
        case kind:
            kinds = {"number": (int, float), "integer": int, "string": str, "boolean": bool}
            is_bool = isinstance(message, bool)
            good = isinstance(message, kinds[kind]) and is_bool == (kind == "boolean")
            return "" if good else f"{message!r} is no {kind}"


def undrawable(schema: Mapping[str, Any]) -> str:
    """Parts of a schema that Foxglove and Lichtblick cannot read."""
    if schema.get("type") not in {"object", "array", "number", "integer", "string", "boolean"}:
        return f"type {schema.get('type')!r}"
    if schema["type"] == "array":
        nested = schema["items"]["type"] == "array"
        return "a list in a list" if nested else undrawable(schema["items"])
    return next(filter(None, map(undrawable, schema.get("properties", {}).values())), "")


def test_every_message_is_as_its_schema_says(recording: Path) -> None:
    with recording.open("rb") as file:
        seen = set()
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema is None:
                topic = channel.topic.removeprefix("/copy" if channel.metadata else "")
                assert topic == "/recording" or topic.startswith("/feed/")
                assert channel.message_encoding == "msgpack"
                continue
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            known = json.loads(schema.data)
            assert undrawable(known) == ""
            assert known["title"] == schema.name
            assert fault(json.loads(message.data), known) == "", channel.topic
            seen.add((channel.topic, schema.name))
    assert {
        ("/vehicle/1/pose", "foxglove.PoseInFrame"),
        ("/vehicle/1/transform", "foxglove.FrameTransform"),
        ("/vehicle/1/scene/vehicle", "foxglove.SceneUpdate"),
        ("/vehicle/1/scene/plan", "foxglove.SceneUpdate"),
        ("/vehicle/1/scene/reference", "foxglove.SceneUpdate"),
        ("/vehicle/1/scene/trajectory", "foxglove.SceneUpdate"),
        ("/events", "foxglove.Log"),
        ("/said", "skytether.Said"),
        ("/figures/netem", "skytether.Figures"),
    } <= seen


def messages_on(path: Path, topic: str) -> list[dict[str, Any]]:
    with path.open("rb") as file:
        return [
            json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topic)
        ]


def test_the_scene_is_where_the_flight_was(recording: Path) -> None:
    rows = flown().client
    poses = messages_on(recording, "/vehicle/1/pose")
    x = [pose["pose"]["position"]["x"] for pose in poses]
    assert x == rows["state"][:, 0, 0].tolist()
    plan, *_ = messages_on(recording, "/vehicle/1/scene/plan")
    (line,) = plan["entities"][0]["lines"]
    begins = flown().plan[0]["state"][:, 0]
    assert (line["points"][0]["x"], line["points"][0]["y"]) == tuple(begins)
    assert len(line["points"]) == flown().plan["inputs"].shape[2] + 1


def test_a_plan_is_drawn_where_its_inputs_and_the_disturbance_lead() -> None:
    """Eq. (1)-(3) in closed form: 0.5 m/s against 0.2 m/s on x, 0.1 m/s with 0.3 m/s on y."""
    row = np.zeros(1, plan_columns(2, 40))[0]
    row["state"] = [[3.0, -1.0], [0.0, 0.5]]
    row["inputs"] = np.array([[0.5], [0.1]])
    row["disturbance"] = [-0.2, 0.3]
    time_s = SCENARIO.control.dt * np.arange(41)
    lines = [(3.0, -1.0, 0.3), (0.0, 0.5, 0.4)]
    paths = [
        p + u * time_s + (v - u) * tau * (1.0 - np.exp(-time_s / tau))
        for (p, v, u), tau in zip(lines, SCENARIO.tau_s, strict=True)
    ]
    np.testing.assert_allclose(planned(SCENARIO, row), np.transpose(paths), atol=1e-9)


def test_rows_are_read_in_the_order_in_which_they_were_made(tmp_path: Path) -> None:
    """Also if a clock was set back between them; frames are in the order of their times."""
    path, columns = tmp_path / "back.mcap", client_columns(2)
    frames = [opened(columns)]
    for step, time_ns in enumerate((300, 100, 200)):
        frames.append(msgspec.structs.replace(row_at(step), time_ns=time_ns))
    with path.open("wb") as file:
        write_frames(file, ((0, "client", frame) for frame in frames))
    back = read(path)
    assert back.parts["client"]["step"].tolist() == [0, 1, 2]
    assert back.times_ns["client"].tolist() == [300, 100, 200]
    assert [frame for _, _, frame in back.frames] == [frames[0], *frames[2:], frames[1]]


def test_of_many_vehicles_only_the_first_are_drawn() -> None:
    file, columns = io.BytesIO(), client_columns(2)
    rows = np.zeros(VEHICLES_MAX + 1, columns)
    rows["vehicle"] = np.arange(1, VEHICLES_MAX + 2)
    each = opened(columns), Rows(part="client", time_ns=1, rows=rows.tobytes())
    write_frames(file, ((0, "client", frame) for frame in each))
    topics = topics_of(file)
    assert f"/vehicle/{VEHICLES_MAX}/pose" in topics
    assert f"/vehicle/{VEHICLES_MAX + 1}/pose" not in topics
    assert f"/vehicle/{VEHICLES_MAX + 1}/flown" in topics


def opened(columns: np.dtype[np.void], part: str = "client") -> Opened:
    toml = reading.to_toml(SCENARIO).decode()
    known = described({part: columns})
    return Opened(process=part, name="demo", scenario=toml, parts=known, wall_ns=0, time_ns=0)


# --- Torn files.


def write_in_chunks(path: Path, frames: int, *, end: bool) -> Path:
    with path.open("wb") as file:
        write_frames(file, of_flight(SCENARIO, "demo", flown()), chunk=frames, end=end)
    return path


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_in_chunks(tmp_path_factory.mktemp("torn") / "torn.mcap", 12, end=False)


@cache
def ends(path: Path) -> list[tuple[int, int]]:
    """End of each whole record of a truncated file [B], and number of frames up to there."""
    stream, feeds, count = io.BytesIO(path.read_bytes()), set[int](), 0
    found = [(len(container.MAGIC), 0)]
    with suppress(EndOfFile):
        for each in StreamReader(stream, emit_chunks=True).records:
            for record in breakup_chunk(each) if isinstance(each, Chunk) else ():
                if isinstance(record, Channel) and record.topic.startswith("/feed/"):
                    feeds.add(record.id)
                count += isinstance(record, Message) and record.channel_id in feeds
            found.append((stream.tell(), count))
    return found


def test_a_torn_recording_is_read_and_commands_say_so(
    torn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    back = read(torn)
    assert back.lost_bytes == 0
    assert back.parts["client"].tobytes() == flown().client.tobytes()
    assert back.summary == summary_of(flown())
    assert command.main(export, [str(torn), "--csv", str(tmp_path)], "export") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{torn}: the recording has no end, as after a killed flight: 0 bytes")


def test_joined_alone_a_torn_recording_has_an_end_for_other_programs(
    torn: Path, tmp_path: Path
) -> None:
    out = tmp_path / "whole.mcap"
    assert command.main(join, [str(torn), "--record", str(out)], "join") == 0
    assert read(out).lost_bytes is None
    assert read(out).frames == read(torn).frames
    with out.open("rb") as file:
        counts = topics_of(file)
        assert counts["/vehicle/1/flown"] == len(flown().client)
        read_by_others = make_reader(file, validate_crcs=True).iter_messages()
        assert sum(counts.values()) == sum(1 for _ in read_by_others)
    assert any(is_named(each, "summary.json") for each in records(out.read_bytes()))


def check_cut(torn: Path, cut: int, path: Path) -> None:
    """Of a file that is cut at a byte, all whole chunks are read."""
    path.write_bytes(torn.read_bytes()[:cut])
    whole, expected = max((each for each in ends(torn) if each[0] <= cut), default=(0, 0))
    try:
        back = read(path)
    except RecordingError:
        assert expected == 0
    else:
        assert back.frames == frames_in(torn)[:expected]
        assert back.lost_bytes == cut - whole


def test_of_a_cut_recording_no_whole_chunk_is_lost(torn: Path, tmp_path: Path) -> None:
    for end, _ in (ends(torn)[0], ends(torn)[4], ends(torn)[-1]):
        for cut in (end - 1, end, end + 1):
            check_cut(torn, min(cut, torn.stat().st_size), tmp_path / "cut.mcap")


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_cut_anywhere_no_whole_chunk_is_lost(
    data: st.DataObject, torn: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """At any byte of the whole file, or near the end of a chunk, where it matters most."""
    size = torn.stat().st_size
    near = st.builds(lambda end, off: end[0] + off, st.sampled_from(ends(torn)), st.integers(-3, 3))
    cut = min(data.draw(st.integers(0, size) | near), size)
    check_cut(torn, cut, tmp_path_factory.mktemp("cut") / "cut.mcap")


@pytest.fixture(scope="module")
def chunked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_in_chunks(tmp_path_factory.mktemp("chunked") / "chunked.mcap", 200, end=True)


def believed(file: Path, at: int, by: int, path: Path) -> int:
    """Number of frames that are read of a file with a damaged byte, all of them right."""
    content = bytearray(file.read_bytes())
    content[at % len(content)] ^= by
    path.write_bytes(content)
    try:
        back = read(path)
    except RecordingError:
        return 0
    rest = iter(frames_in(file))
    assert all(frame in rest for frame in back.frames)  # in their order
    assert back.damaged_bytes or back.lost_bytes is not None or next(rest, None) is None
    return len(back.frames)


@cache
def frames_in(file: Path) -> list[Timed]:
    return read(file).frames


def test_a_damaged_byte_is_never_believed(chunked: Path, torn: Path, tmp_path: Path) -> None:
    """What is not damaged is read."""
    path = tmp_path / "damaged.mcap"
    assert believed(torn, 3, 8, path) == 0
    chunks = [each for each in pairwise(ends(torn)) if each[0][1] < each[1][1]]
    for (before, count), (after, whole) in (chunks[1], chunks[-1]):
        for at in (before + 1, before + 9, before + 33, before + 60):
            # Its length, and times that nobody reads.
            assert believed(torn, at, 1 << at % 8, path) >= count
        left = believed(torn, (before + after) // 2, 1, path)
        # The second chunk has the columns of the server's rows, of which there is a copy.
        is_copied = before == chunks[1][0][0]
        assert left == len(frames_in(torn)) - (0 if is_copied else whole - count)
    found = [
        believed(chunked, round(share * chunked.stat().st_size), 8, path)
        for share in (0.1, 0.3, 0.5, 0.7)
    ]
    assert min(found[1:]) >= len(frames_in(chunked)) - 200
    for at in (-9, -60):
        believed(chunked, at, 8, path)


@cache
def chunks_of(file: Path) -> list[tuple[int, int, int]]:
    """Begin and end of each record outside of chunks [B], and how many frames are lost with it."""
    begins, first = [at for at, _ in ends(file)], ends(file)[0]
    counts = [count for _, count in ends(file)]
    assert first == (len(container.MAGIC), 0)
    opened = sum(isinstance(frame, Opened) for *_, frame in frames_in(file))
    lost = [b - a if b > opened else 0 for a, b in pairwise(counts)]
    return list(zip(begins, begins[1:], lost, strict=False))


@given(data=st.data(), by=st.integers(1, 255))
@settings(max_examples=60, deadline=None)
def test_with_a_damaged_byte_anywhere_only_its_own_chunk_is_lost(
    data: st.DataObject,
    by: int,
    chunked: Path,
    torn: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """What is damaged may be the head of a record, its content, or what a reader needs first."""
    file = data.draw(st.sampled_from([chunked, torn]))
    begin, end, lost = data.draw(st.sampled_from(chunks_of(file)))
    at = data.draw(st.integers(begin, min(begin + 60, end - 1)) | st.integers(begin, end - 1))
    path = tmp_path_factory.mktemp("damaged") / "damaged.mcap"
    assert believed(file, at, by, path) >= len(frames_in(file)) - lost


@pytest.mark.long
@given(at=st.integers(0, 2**20), by=st.integers(1, 255))
@settings(max_examples=60, deadline=None)
def test_no_damaged_byte_anywhere_is_believed(
    at: int, by: int, chunked: Path, torn: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "damaged.mcap"
    for file in (chunked, torn):
        believed(file, at, by, path)


def test_without_its_checksum_a_changed_number_would_be_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "skytether.shared.formats.foxglove.Writer",
        partial(Writer, compression=CompressionType.NONE),
    )
    path = record(tmp_path / "it.mcap")
    row = flown().client[7].tobytes()
    changed = flown().client[7:8].copy()
    changed["step"] = 9
    path.write_bytes(path.read_bytes().replace(row, changed.tobytes(), 1))
    assert read(path).damaged_bytes > len(row)
    first, *_ = recorded_steps(path)
    assert first > 9
    assert recorded_steps(path) == flown().client["step"][first:].tolist()
    monkeypatch.setattr(container, "breakup_chunk", lambda chunk, **_: breakup_chunk(chunk))
    assert recorded_steps(path)[:9] == [0, 1, 2, 3, 4, 5, 6, 9, 8]


class Closed:
    """Stand-in for the event that ends the flushing: time-outs, of which the second one is last."""

    def __init__(self) -> None:
        self.waited_s: list[float] = []

    def wait(self, timeout_s: float) -> bool:
        self.waited_s.append(timeout_s)
        return len(self.waited_s) > 1


def test_without_its_flush_a_recorder_would_lose_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows reach the file soon, even if no more follow."""
    monkeypatch.setattr(recorder, "Subscriber", Feeds)
    path, feeds = tmp_path / "live.mcap", {"client": tmp_path / "nobody"}
    with monkeypatch.context() as patch:
        patch.setattr(recorder.threading, "Thread", AtJoin)
        live = Live(path, feeds, SCENARIO, "demo", secure=False, tell=lambda _: None)
    for frame in (opened(client_columns(2)), row_at(0)):
        live._take("client", frame)
    assert [type(frame) for *_, frame in read(path).frames] == [Opened]
    patch.setattr(live, "_closed", Closed())
    live._flush()
    assert live._closed.waited_s == [recorder.FLUSH_S] * 2  # type: ignore[attr-defined]
    patch.undo()
    assert recorder.FLUSH_S < 1.0
    assert len(read(path).frames) == 2
    live._lost("client")
    live.finish()


# --- A flight over UDP.


class Feeds:
    """Stand-in for `Subscriber` with frames from the test."""

    def __init__(self, paths: object, take: Any, lost: Any) -> None:  # noqa: ARG002
        self.take, self.lost = take, lost
        Feeds.newest = self

    newest: "Feeds"

    def close(self) -> None:
        """Nothing to close."""


@pytest.fixture
def live(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Live, Feeds, list[str]]]:
    monkeypatch.setattr(recorder, "Subscriber", Feeds)
    complaints: list[str] = []
    made = Live(
        tmp_path / "live.mcap",
        {"client": tmp_path / "nobody"},
        SCENARIO,
        "demo",
        secure=False,
        tell=lambda event: complaints.append(str(event)),
    )
    yield made, Feeds.newest, complaints
    Feeds.newest.lost("client")
    made.finish()


def row_at(step: int) -> Rows:
    row = np.zeros(1, client_columns(2))
    row["vehicle"], row["step"] = 1, step
    return Rows(part="client", time_ns=step, rows=row.tobytes())


def recorded_steps(path: Path) -> list[int]:
    parts = read(path).parts
    return [int(step) for step in parts["client"]["step"]] if "client" in parts else []


def test_a_feed_that_begins_anew_is_recorded_once(
    live: tuple[Live, Feeds, list[str]], tmp_path: Path
) -> None:
    """It repeats its last frames, and none was missed."""
    made, feeds, complaints = live
    for frame in (opened(client_columns(2)), row_at(1), row_at(2)):
        feeds.take("client", frame)
    feeds.lost("client")
    for frame in (opened(client_columns(2)), row_at(1), row_at(2), row_at(3)):
        feeds.take("client", frame)
    feeds.lost("client")
    assert made.finish() is None
    assert recorded_steps(tmp_path / "live.mcap") == [1, 2, 3]
    assert complaints == []


def test_a_feed_that_begins_anew_would_be_recorded_twice(
    live: tuple[Live, Feeds, list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ablation: earlier frames are not recognised."""
    monkeypatch.setattr(recorder._Source, "is_new", lambda *_: True)
    made, feeds, _ = live
    for _ in range(2):
        for frame in (opened(client_columns(2)), row_at(1)):
            feeds.take("client", frame)
        feeds.lost("client")
    made.finish()
    assert recorded_steps(tmp_path / "live.mcap") == [1, 1]


def test_a_gap_in_a_feed_is_told_once(live: tuple[Live, Feeds, list[str]], tmp_path: Path) -> None:
    made, feeds, complaints = live
    for begin in (1, 3, 5):
        for frame in (opened(client_columns(2)), row_at(begin)):
            feeds.take("client", frame)
        feeds.lost("client")
    said = f"{tmp_path / 'live.mcap'}: the recorder could not keep up with client"
    assert made.finish() == said
    assert complaints == [f"{said}: the record is incomplete, the flight continues"]
    assert recorded_steps(tmp_path / "live.mcap") == [1, 3, 5]


def test_rows_that_never_came_are_missed_at_the_end(live: tuple[Live, Feeds, list[str]]) -> None:
    made, feeds, _ = live
    for frame in (opened(client_columns(2)), row_at(0)):
        feeds.take("client", frame)
    feeds.lost("client")
    missing = made.finish(None, flown())
    assert missing is not None
    assert f"1 of {len(flown().client)} rows of client" in missing


def test_a_disk_that_fills_up_costs_the_recording_alone(
    live: tuple[Live, Feeds, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, feeds, complaints = live

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    feeds.take("client", opened(client_columns(2)))
    monkeypatch.setattr(recorder.Recording, "add", full)
    monkeypatch.setattr(recorder.Recording, "flush", full)
    for step in range(3):
        feeds.take("client", row_at(step))
    feeds.lost("client")
    fault_ = made.finish()
    assert fault_ is not None
    assert fault_.endswith("live.mcap: No space left on device")
    assert len(complaints) == 1


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_over_udp_is_recorded_from_its_first_step_on(tmp_path: Path) -> None:
    path, summary = tmp_path / "flight.mcap", tmp_path / "summary.json"
    flags = ["--duration", "3", "--settle", "0", "--json", str(summary), "--record", str(path)]
    flags += ["--network.uplink", "loss(0.1)", "--network.downlink", "loss(0.1)"]
    assert command.main(fly, ["demo", *flags], "fly") == 0
    back = read(path)
    shown = json.loads(summary.read_text())
    assert back.parts["client"]["step"][0] == 0
    assert len(back.parts["client"]) == shown["steps"] > 0
    assert len(back.parts["netem"]) == shown["uplink_packets"] + shown["downlink_packets"]
    assert len(back.parts["plan"])
    assert msgspec.to_builtins(back.summary) == shown
    events = [type(event).__name__ for *_, event in back.events()]
    counted = {process for _, process, frame in back.frames if isinstance(frame, Figures)}
    assert {"Listening", "Flying", "Finished"} <= set(events)
    assert counted == {"server", "netem", "client"}


# --- Exports.


def test_tables_have_plain_columns_with_units(recording: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    flags = ["--csv", str(tmp_path / "csv"), "--parquet", str(tmp_path / "parquet")]
    assert command.main(export, [str(recording), *flags], "export") == 0
    assert {file.name for file in (tmp_path / "csv").iterdir()} == {
        f"{part}.csv" for part in (*PARTS, "events")
    }
    with (tmp_path / "csv" / "client.csv").open() as file:
        rows = list(csv.DictReader(file))
    client = flown().client
    assert [float(row["position_x_m"]) for row in rows] == client["state"][:, 0, 0].tolist()
    assert {row["mode"] for row in rows} >= {"sync", "track"}
    table = parquet.read_table(tmp_path / "parquet" / "client.parquet")
    assert table.column_names == list(rows[0])
    assert table["velocity_y_mps"].to_pylist() == client["state"][:, 1, 1].tolist()
    plan = parquet.read_table(tmp_path / "parquet" / "plan.parquet")
    assert plan["input_x_mps_3"].to_pylist() == flown().plan["inputs"][:, 0, 3].tolist()


def exported(recording: Path, folder: Path, part: str) -> list[dict[str, str]]:
    assert command.main(export, [str(recording), "--csv", str(folder)], "export") == 0
    with (folder / f"{part}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_what_is_not_known_is_empty_and_times_are_in_ms(recording: Path, tmp_path: Path) -> None:
    client = flown().client
    rows = exported(recording, tmp_path, "client")
    assert client["in_force"][0] == client["age_ns"][0] == -1
    for row, in_force, age_ns in zip(rows, client["in_force"], client["age_ns"], strict=True):
        assert row["in_force"] == ("" if in_force < 0 else str(in_force))
        assert row["age_ms"] == ("" if age_ns < 0 else str(age_ns / 1e6))
    server = exported(recording, tmp_path, "server")
    assert {row["solve_ms"] for row in server} == {""}  # virtual time measures none
    netem = exported(recording, tmp_path, "netem")
    assert [float(row["delay_ms"]) * 1e6 for row in netem] == flown().netem["delay_ns"].tolist()
    parquet = pytest.importorskip("pyarrow.parquet")
    assert command.main(export, [str(recording), "--parquet", str(tmp_path)], "export") == 0
    table = parquet.read_table(tmp_path / "client.parquet")
    assert table["in_force"].to_pylist()[0] is None
    assert table["in_force"].to_pylist()[-1] == client["in_force"][-1]


def test_a_table_says_how_far_off_the_vehicle_was(recording: Path, tmp_path: Path) -> None:
    rows = exported(recording, tmp_path, "client")
    summary = read(recording).summary
    assert summary is not None
    settled = np.array([float(row["error_m"]) for row in rows])
    settled = settled[flown().client["step"] * SCENARIO.control.dt >= SCENARIO.settle]
    assert np.sqrt((settled**2).mean()) == pytest.approx(summary.rmse_xy)
    assert settled.max() == pytest.approx(summary.error_max)


def test_no_text_of_a_table_is_a_formula() -> None:
    """A spreadsheet would compute it; numbers stay numbers, as text too."""
    texts = ["=1+1", "+1 m", "-x", "@SUM(1)", "\t=1", "a\r=1", "a=b", "-1.5", "+2", "-inf", ""]
    written = to_csv(["text", "number"], [(text, -1.5) for text in texts])
    assert to_csv(["=1+1"], []) == "'=1+1\n"
    assert [row["text"] for row in csv.DictReader(io.StringIO(written, newline=""))] == [
        *("'=1+1", "'+1 m", "'-x", "'@SUM(1)", "\\t=1", "a\\r=1", "a=b", "-1.5", "+2", "-inf", "")
    ]
    assert {row["number"] for row in csv.DictReader(io.StringIO(written, newline=""))} == {"-1.5"}


def test_no_text_of_a_table_or_a_line_is_obeyed_by_a_terminal(
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:
    """Escape sequences would clear the screen: texts come from files and peers."""
    text = "\x1b[2J\x07\u202e\x9bm"
    safe = r"\x1b[2J\x07\u202e\x9bm"
    assert to_csv(["text"], [[text]]) == f"text\n{safe}\n"
    page_process.say(f"{text}\nnext")
    with closing(Log("server", "text")) as log:
        log.say(AutopilotText(vehicle=1, severity=2, text=text))
    written = capfdbinary.readouterr()
    assert written.err.decode() == f"{safe}\nnext\n"
    assert safe in written.out.decode()
    assert b"\x1b" not in written.out


@pytest.mark.usefixtures("unpainted")
def test_a_report_is_one_page_that_needs_nothing_else(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    assert command.main(report, [str(recording), "--html", str(out)], "report") == 0
    page = out.read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "://" not in page.replace("data:", "")
    for shown in ("RMSE x, y, xy [m]", "session open, flying", "[network]", "seed 1"):
        assert shown in page
    lost = flown().figures["netem"]["uplink"]["lost"]
    assert f"uplink lost {lost}" in page[page.index("dropped by netem") :]


# --- Refusals.


def other_mcap(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda path: path.mkdir(), "it is not a plain file"),
        (lambda path: path.write_bytes(b""), "it is empty"),
        (lambda path: path.write_text("time,x\n"), "it is not an MCAP file"),
        (other_mcap, "it is not a recording of Skytether"),
        (lambda path: path, "cannot be read: No such file or directory"),
    ],
    ids=["folder", "empty", "csv", "other", "missing"],
)
def test_what_is_no_recording_is_refused_in_a_line(
    made: Any, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "it.mcap"
    made(path)
    before = set(tmp_path.iterdir())
    for line in refused(path, tmp_path, capsys):
        assert line.startswith(f"it: {path}: {said}")
    assert set(tmp_path.iterdir()) == before


# --- Manipulated recordings.


def changed(path: Path, out: Path, change: Callable[[list[Any]], object]) -> Path:
    """Recording with changed records, and all checksums right."""
    found = records(path.read_bytes())
    change(found)
    out.write_bytes(written(found))
    return out


def nest(found: list[Any]) -> None:
    at, _ = flown_rows(found)[3]
    found[at] = replace(found[at], data=b"\x91" * 100_000)


def rename_in_event(found: list[Any]) -> None:
    at, frame = next(iter(frames_of(found, "Said").items()))
    put(found, at, frame | {"event": {"type": "ServerFull", "room": 2}})


def flown_rows(found: list[Any]) -> list[tuple[int, dict[str, Any]]]:
    return [(i, each) for i, each in frames_of(found, "Rows").items() if each["part"] == "client"]


def widen(found: list[Any]) -> None:
    for at, begun in frames_of(found, "Opened").items():
        if "client" in begun["parts"]:
            columns = [*json.loads(begun["parts"]["client"]), ["more_mps", "<f8", [2, 50_000]]]
            put(found, at, begun | {"parts": {"client": json.dumps(columns)}})


def write_in(found: list[Any], column: str, value: float) -> None:
    at, frame = flown_rows(found)[3]
    rows = np.frombuffer(frame["rows"], client_columns(2)).copy()
    rows[column] = value
    put(found, at, frame | {"rows": rows.tobytes()})


def cut_row(found: list[Any]) -> None:
    at, frame = flown_rows(found)[3]
    put(found, at, frame | {"rows": frame["rows"][:9]})


def forget(found: list[Any]) -> None:
    del found[
        next(i for i, each in frames_of(found, "Opened").items() if each["process"] == "client")
    ]


def date(found: list[Any], time_ns: int) -> None:
    at, frame = flown_rows(found)[3]
    put(found, at, frame | {"time_ns": time_ns})


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (nest, "got no frame"),
        (rename_in_event, "it is of another version, or damaged: got no frame: Object missing"),
        (widen, "expected at most 4096 B"),
        (cut_row, "got 9 B, expected rows of"),
        (forget, "client has no part 'client'"),
        (partial(date, time_ns=2**61), "ns after the first"),
        (partial(date, time_ns=2**63), "a frame has the impossible time 9223372036854775808 ns"),
        (partial(date, time_ns=-1), "rows of client before its first frame"),
        (partial(write_in, column="step", value=600_000_000), "client: step: got 600000000"),
        (partial(write_in, column="step", value=2**40), "client: step: got 1099511627776"),
        (partial(write_in, column="mode", value=200), "client: mode: got 200"),
        (partial(write_in, column="state", value=1e308), "client: state: got 1e+308"),
    ],
    ids=[
        *(
            "nested",
            "event of another version",
            "wide",
            "half",
            "not begun",
            "late",
            "2**63",
            "early",
        ),
        *("step 6e8", "step 2**40", "mode", "speed"),
    ],
)
def test_what_no_flight_says_is_refused(
    change: Any, why: str, recording: Path, tmp_path: Path
) -> None:
    path = changed(recording, tmp_path / "it.mcap", change)
    with pytest.raises(RecordingError, match=re.escape(why)):
        read(path)


def chunk_starts(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [each.chunk_start_offset for each in summary.chunk_indexes]


def with_chunk(recording: Path, chunk: Chunk, path: Path) -> Path:
    """Recording with an additional chunk."""
    builder = RecordBuilder()
    chunk.write(builder)
    content, at = recording.read_bytes(), chunk_starts(recording)[4]
    path.write_bytes(content[:at] + builder.end() + content[at:])
    return path


@cache
def bomb() -> bytes:
    return zstandard.compress(bytes(2**27))


@pytest.mark.parametrize("size", [2**27, 1000])
@pytest.mark.parametrize("lies", [False, True])
def test_a_chunk_that_is_far_larger_inside_is_not_opened(
    size: int, lies: bool, recording: Path, tmp_path: Path
) -> None:
    """Whether the chunk states its size, its compressed frame does, or that states a false one."""
    frame = bomb()
    if lies:
        frame = b"\x28\xb5\x2f\xfd\xe0" + (2**40).to_bytes(8, "little") + frame[9:]
    chunk = Chunk("zstd", frame, 2**60, 0, 0, size)
    path = with_chunk(recording, chunk, tmp_path / "it.mcap")
    tracemalloc.start()
    with pytest.raises(RecordingError, match="a chunk"):
        read(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 2**26


def test_more_messages_than_there_is_an_index_for_are_not_made(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message of few bytes takes hundreds in memory, so the number of messages is bounded."""
    monkeypatch.setattr(container, "SPARE_MESSAGES", 10)
    size = recording.stat().st_size
    builder = RecordBuilder()
    Message(3, 0, pack(Figures(time_ns=0, figures={})), 0, 0).write(builder)
    inside = builder.end() * (20 + size // container.INDEXED_BYTES)
    chunk = Chunk("zstd", zstandard.compress(inside), 2**60, 0, 0, len(inside))
    with pytest.raises(RecordingError, match="more messages than fit into its size"):
        read(with_chunk(recording, chunk, tmp_path / "it.mcap"))


def test_figures_of_a_damaged_recording_are_checked(recording: Path, tmp_path: Path) -> None:
    """Summaries count drops from them, long after the file was read."""

    def say_more(found: list[Any]) -> None:
        at, frame = next(iter(frames_of(found, "Figures").items()))
        put(found, at, frame | {"figures": {"dropped": {"forged": "many"}}})

    with pytest.raises(RecordingError, match="it is damaged: Expected `int`, got `str`"):
        read(changed(recording, tmp_path / "it.mcap", say_more))


def test_packets_are_drawn_of_a_flight_that_began_before_all_time() -> None:
    """The step of a damaged first row may put the start beyond a 64-bit number."""
    from matplotlib.figure import Figure

    flown = flight.fly(msgspec.structs.replace(SCENARIO, duration=1.0, settle=0.0))
    parts = flown.client, flown.server, flown.netem
    for epoch_ns in (0, -(2**80), 2**80):
        axes = Figure().subplots()
        view_report._packets(axes, view_report.ReportedFlight(SCENARIO, *parts, epoch_ns))
        assert len(axes.patches) == 2


def test_a_process_that_begins_thousands_of_times_is_checked_once(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each check of a scenario takes milliseconds, and a file may contain very many."""

    def repeat(found: list[Any]) -> None:
        found += [found[next(iter(frames_of(found, "Opened")))]] * 2000

    checked: list[str] = []
    monkeypatch.setattr(
        recorded, "check", lambda _, source, **__: checked.append(source) or SCENARIO
    )
    recorded._check_begun.cache_clear()
    back = read(changed(recording, tmp_path / "it.mcap", repeat))
    assert sum(isinstance(frame, Opened) for *_, frame in back.frames) == 2003
    assert checked.count("the scenario of a process") == 1
