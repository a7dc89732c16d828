"""Recordings: what is written comes back to the last bit, from a whole file and from a torn one."""

import csv
import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from shared import config
from shared.config import Scenario
from shared.feed import Figures, Opened, Rows, Said, described
from shared.record import PACKET_COLUMNS, client_columns, plan_columns, server_columns
from shared.summary import summarise
from shell import command
from sim import flight
from sim.flight import Flight
from skytether import recorder
from skytether.export import export
from skytether.fly import fly
from skytether.recorder import Live
from skytether.recover import recover as recover_command
from skytether.report import report
from view import recovery
from view.frames import of_flight
from view.recording import VEHICLES_MAX, Recorded, Recording, RecordingError
from view.recovery import recover
from view.rows import Table

PARTS = ("client", "server", "plan", "netem")
SCENARIO = msgspec.structs.replace(config.load("demo"), duration=6.0, settle=3.0)


@cache
def flown() -> Flight:
    """A short flight."""
    return flight.fly(SCENARIO)


def record(path: Path, scenario: Scenario = SCENARIO, of: Flight | None = None) -> Path:
    """A recording of a flight in virtual time."""
    of = of or flown()
    summary = summarise(scenario, "demo", of.client, of.server, of.netem)
    assert recorder.write(path, scenario, "demo", of, summary) is None
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of the short flight; not to be changed."""
    return record(tmp_path_factory.mktemp("recording") / "flight.mcap")


def refusal(argv: list[str], of: Any, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and the one line of a command."""
    code = command.main(of, argv, "it")
    (line,) = capsys.readouterr().err.splitlines()
    return code, line


# --- What is written comes back.


def test_a_flight_comes_back_to_the_last_bit(recording: Path) -> None:
    """Every part, the frames with their times, the scenario and the summary."""
    with Recorded(recording) as recorded:
        parts, frames = recorded.parts(), list(recorded.frames())
        assert (recorded.name, recorded.scenario) == ("demo", SCENARIO)
        assert recorded.summary == summarise(
            SCENARIO, "demo", flown().client, flown().server, flown().netem
        )
    for part in PARTS:
        assert parts[part].dtype == getattr(flown(), part).dtype
        assert parts[part].tobytes() == getattr(flown(), part).tobytes()
    back = Flight(parts["client"], parts["server"], parts["netem"])
    assert back.trace_hash() == flown().trace_hash()
    assert frames == list(of_flight(SCENARIO, "demo", flown()))


def test_frames_of_a_flight_are_in_the_order_of_their_times() -> None:
    """From 0 on; a step's row has the time at which the step began."""
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
    """Each of two vehicles, whose rows alternate, has topics of its own."""
    scenario = config.check(
        config.to_table(SCENARIO) | {"model": {"axes": 3}, "duration": 2.0, "settle": 0.0}
    )
    two = flight.fly(scenario, vehicles=2)
    file = io.BytesIO()
    about = recorder._about(scenario, "fleet", began=None, offset_ns=0, secure=False)
    recording = Recording(file, scenario, about)
    for _, process, frame in of_flight(scenario, "fleet", two):
        recording.add(process, frame)
    recording.finish(None)
    topics = topics_of(file)
    assert {"/vehicle/1/flown", "/vehicle/2/flown", "/vehicle/2/scene/vehicle"} <= topics.keys()
    assert topics["/vehicle/1/flown"] == topics["/vehicle/2/flown"]


def topics_of(file: Any) -> dict[str, int]:
    """Number of messages on each topic of a file."""
    file.seek(0)
    summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts[number] for number, channel in summary.channels.items()}


COLUMNS = [client_columns(2), client_columns(3), server_columns(2), plan_columns(3, 4)]
COLUMNS += [PACKET_COLUMNS]


@given(st.sampled_from(COLUMNS), st.binary(min_size=1, max_size=64), st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_any_bits_of_a_row_come_back(columns: np.dtype[np.void], bits: bytes, count: int) -> None:
    """Numbers that JSON has none for as well: NaN of every kind, and infinity."""
    several = (bits * columns.itemsize)[: columns.itemsize] * count
    rows = np.frombuffer(several, columns).copy()
    for name in columns.names or ():
        if columns[name].base.kind == "b":
            rows[name] = rows[name].view("u1") & 1
    table = Table(columns)
    messages = [msgspec.json.decode(msgspec.json.encode(each)) for each in table.messages(rows)]
    assert table.rows(messages).tobytes() == rows.tobytes()
    for message in messages:
        assert fault(message, table.schema()) == ""


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (np.nan, None),
        (-np.nan, ["position_x_m=000000000000f8ff"]),
        (-np.inf, ["position_x_m=000000000000f0ff"]),
    ],
)
def test_what_json_has_no_number_for_is_left_out(number: float, said: list[str] | None) -> None:
    """What a reader is to take for NaN is not there; all else that is not finite says its bits."""
    rows = np.zeros(1, client_columns(2))
    rows["state"][0, 0, 0] = number
    (message,) = Table(rows.dtype).messages(rows)
    assert "position_x_m" not in message
    assert message.get("not_finite") == said
    assert message["position_y_m"] == 0.0


# --- Schemas.


def fault(message: Any, schema: Mapping[str, Any]) -> str:
    """What is wrong with a message by its schema, as far as ours use JSON schema."""
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
    """What Foxglove and Lichtblick cannot read in a schema."""
    if schema.get("type") not in {"object", "array", "number", "integer", "string", "boolean"}:
        return f"type {schema.get('type')!r}"
    if schema["type"] == "array":
        nested = schema["items"]["type"] == "array"
        return "a list in a list" if nested else undrawable(schema["items"])
    return next(filter(None, map(undrawable, schema.get("properties", {}).values())), "")


def test_every_message_is_as_its_schema_says(recording: Path) -> None:
    """Every schema is one that Foxglove and Lichtblick can read."""
    with recording.open("rb") as file:
        seen = set()
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
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
        ("/opened", "skytether.Opened"),
        ("/figures/netem", "skytether.Figures"),
    } <= seen


def messages_on(path: Path, topic: str) -> list[dict[str, Any]]:
    """Messages on a topic."""
    with path.open("rb") as file:
        return [
            json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topic)
        ]


def test_the_scene_is_where_the_flight_was(recording: Path) -> None:
    """The vehicle at its position, its plan from there on, each a line through positions."""
    rows = flown().client
    poses = messages_on(recording, "/vehicle/1/pose")
    x = [pose["pose"]["position"]["x"] for pose in poses]
    assert x == rows["state"][:, 0, 0].tolist()
    plan, *_ = messages_on(recording, "/vehicle/1/scene/plan")
    (line,) = plan["entities"][0]["lines"]
    begins = flown().plan[0]["state"][:, 0]
    assert (line["points"][0]["x"], line["points"][0]["y"]) == tuple(begins)
    assert len(line["points"]) == flown().plan["inputs"].shape[2] + 1


def test_of_many_vehicles_only_the_first_are_drawn() -> None:
    """The rows of the others are recorded all the same."""
    file, columns = io.BytesIO(), client_columns(2)
    about = recorder._about(SCENARIO, "demo", began=None, offset_ns=0, secure=False)
    recording = Recording(file, SCENARIO, about)
    rows = np.zeros(VEHICLES_MAX + 1, columns)
    rows["vehicle"] = np.arange(1, VEHICLES_MAX + 2)
    recording.add("client", opened(columns))
    recording.add("client", Rows(part="client", time_ns=1, rows=rows.tobytes()))
    recording.finish(None)
    topics = topics_of(file)
    assert f"/vehicle/{VEHICLES_MAX}/pose" in topics
    assert f"/vehicle/{VEHICLES_MAX + 1}/pose" not in topics
    assert f"/vehicle/{VEHICLES_MAX + 1}/flown" in topics


def opened(columns: np.dtype[np.void], part: str = "client") -> Opened:
    """First frame of a feed with one part."""
    toml = config.to_toml(SCENARIO).decode()
    known = described({part: columns})
    return Opened(process=part, name="demo", scenario=toml, parts=known, wall_ns=0, time_ns=0)


# --- Torn files.


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with many chunks and no end."""
    path = tmp_path_factory.mktemp("torn") / "torn.mcap"
    about = recorder._about(SCENARIO, "demo", began=None, offset_ns=0, secure=False)
    with path.open("wb") as file:
        recording = Recording(file, SCENARIO, about)
        for i, (_, process, frame) in enumerate(of_flight(SCENARIO, "demo", flown())):
            recording.add(process, frame)
            if i % 12 == 0:
                recording.flush()
        recording.flush()
    return path


@cache
def chunks(path: Path) -> list[tuple[int, int]]:
    """Where each chunk of a torn file ends [B], and number of messages up to there."""
    found, count, content = [], 0, path.read_bytes()
    stream = io.BytesIO(content)
    try:
        for each in StreamReader(stream, emit_chunks=True).records:
            if isinstance(each, Chunk):
                count += sum(isinstance(record, Message) for record in breakup_chunk(each))
                found.append((stream.tell(), count))
    except EndOfFile:
        pass
    return found


def test_a_torn_recording_is_refused_and_told_how_to_mend(torn: Path) -> None:
    """It has no end."""
    with pytest.raises(RecordingError, match=f"it has no end.*skytether recover {torn}"):
        Recorded(torn)


def test_a_recovered_recording_has_all_that_was_whole(torn: Path, tmp_path: Path) -> None:
    """Here everything, with the summary that the flight had; other readers open it as well."""
    out = tmp_path / "mended.mcap"
    kept = recover(torn, out)
    assert kept.bytes == kept.of_bytes == torn.stat().st_size
    with Recorded(out) as recorded:
        assert recorded.parts()["client"].tobytes() == flown().client.tobytes()
        assert recorded.summary == summarise(
            SCENARIO, "demo", flown().client, flown().server, flown().netem
        )
    with out.open("rb") as file:
        assert sum(topics_of(file).values()) == kept.messages == chunks(torn)[-1][1]
        assert (
            sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == kept.messages
        )


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_cut_anywhere_no_whole_chunk_is_lost(
    data: st.DataObject, torn: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """At a byte of the whole file, or near the end of a chunk, where it matters most."""
    size = torn.stat().st_size
    ends = [end for end, _ in chunks(torn)]
    near = st.builds(lambda end, off: end + off, st.sampled_from(ends), st.integers(-3, 3))
    cut = min(data.draw(st.integers(0, size) | near), size)
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    path.write_bytes(torn.read_bytes()[:cut])
    expected = max((count for end, count in chunks(torn) if end <= cut), default=0)
    out = path.with_name("out.mcap")
    try:
        kept = recover(path, out)
    except RecordingError:
        assert expected == 0
        assert not out.exists()
    else:
        assert kept.messages == expected
        with Recorded(out) as recorded:
            assert len(recorded.parts().get("client", ())) <= len(flown().client)
    assert {each.name for each in path.parent.iterdir()} <= {"cut.mcap", "out.mcap"}


@given(at=st.integers(0, 2**20), by=st.integers(1, 255))
@settings(max_examples=80, deadline=None)
def test_a_damaged_byte_costs_a_chunk_or_a_line(
    at: int, by: int, torn: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Never a traceback: what is damaged is left out, or the file is refused."""
    content = bytearray(torn.read_bytes())
    content[at % len(content)] ^= by
    path = tmp_path_factory.mktemp("damaged") / "damaged.mcap"
    path.write_bytes(content)
    out = path.with_name("out.mcap")
    try:
        kept = recover(path, out)
    except RecordingError:
        return
    assert kept.messages <= chunks(torn)[-1][1]
    with Recorded(out) as recorded:
        list(recorded.frames())


def test_a_changed_scenario_is_not_believed(torn: Path, tmp_path: Path) -> None:
    """Its checksum is held against it as well, and without a scenario there is no recording."""
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    path.write_bytes(torn.read_bytes().replace(b"seed = 1\n", b"seed = 2\n", 1))
    assert path.read_bytes() != torn.read_bytes()
    with pytest.raises(RecordingError, match="nothing is whole of it"):
        recover(path, out)


def test_without_its_checksum_a_changed_number_would_be_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed digit is a digit, too: only the checksum knows. The chunk is lost instead."""
    monkeypatch.setattr("view.recording.Writer", partial(Writer, compression=CompressionType.NONE))
    whole = record(tmp_path / "whole.mcap").read_bytes()
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    path.write_bytes(whole.replace(b'"step":7,', b'"step":9,', 1))

    def steps() -> list[int]:
        recover(path, out)
        return recorded_steps(out)[:8]

    assert {7, 9}.isdisjoint(steps())
    monkeypatch.setattr(
        recovery, "breakup_chunk", lambda chunk, **_: breakup_chunk(chunk, validate_crc=False)
    )
    assert steps() == [0, 1, 2, 3, 4, 5, 6, 9]


KILLED = """
import sys, time
from pathlib import Path
import numpy as np
from shared import config
from shared.feed import Opened, Rows, described
from shared.record import client_columns
from skytether.recorder import Live
scenario, columns = config.load("demo"), client_columns(2)
path, feeds = Path(sys.argv[1]), {"client": Path("nobody")}
live = Live(path, feeds, scenario, "demo", secure=False, tell=print)
row, begin_ns = np.zeros(1, columns), time.monotonic_ns()
row["vehicle"] = 1
live._take("client", Opened(process="client", name="demo", scenario="", wall_ns=0, time_ns=begin_ns,
                            parts=described({"client": columns})))
while True:
    row["step"] += 1
    now_ns = time.monotonic_ns()
    live._take("client", Rows(part="client", time_ns=now_ns, rows=row.tobytes()))
    print(now_ns - begin_ns, flush=True)
    time.sleep(0.002)
"""


def test_a_killed_recorder_loses_less_than_a_second(tmp_path: Path) -> None:
    """It was told something for two seconds; what is left is a recording that any reader opens."""
    path = tmp_path / "killed.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told_ns = next(int(line) for line in process.stdout if int(line) > 2_000_000_000)
        process.send_signal(signal.SIGKILL)
        told_ns = max([told_ns, *(int(line) for line in process.stdout if line.endswith("\n"))])
    with pytest.raises(RecordingError, match="no end"):
        Recorded(path)
    assert command.main(recover_command, [str(path)], "recover") == 0
    with Recorded(path) as recorded:
        *_, (last_ns, _, _) = recorded.frames()
        assert recorded.summary is not None
        assert recorded.summary.steps == len(recorded.parts()["client"])
    assert told_ns - last_ns < 1_000_000_000


@pytest.mark.parametrize(("flush_s", "kept"), [(0.01, 2), (1000.0, 0)])
def test_without_its_flush_a_recorder_would_lose_all(
    flush_s: float, kept: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it was told is in the file soon, though no more comes."""
    monkeypatch.setattr(recorder, "Subscriber", Feeds)
    monkeypatch.setattr(recorder, "FLUSH_S", flush_s)
    path, feeds = tmp_path / "live.mcap", {"client": tmp_path / "nobody"}
    live = Live(path, feeds, SCENARIO, "demo", secure=False, tell=lambda _: None)
    for frame in (opened(client_columns(2)), row_at(0)):
        live._take("client", frame)
    deadline_s = time.monotonic() + (30.0 if kept else 0.1)
    found = -1
    while found < kept and time.monotonic() < deadline_s:
        found = recover(path, tmp_path / "mended.mcap").messages
    live._lost("client")
    live.finish()
    assert min(found, 2) == kept


# --- A flight over UDP.


class Feeds:
    """Stands in for `Subscriber`: the frames are given by hand."""

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
    """A recorder of one feed, what it reads, and what it has told."""
    monkeypatch.setattr(recorder, "Subscriber", Feeds)
    told: list[str] = []
    made = Live(
        tmp_path / "live.mcap",
        {"client": tmp_path / "nobody"},
        SCENARIO,
        "demo",
        secure=False,
        tell=lambda event: told.append(str(event)),
    )
    yield made, Feeds.newest, told
    Feeds.newest.lost("client")
    made.finish()


def row_at(step: int) -> Rows:
    """Frame with a row of a step."""
    row = np.zeros(1, client_columns(2))
    row["vehicle"], row["step"] = 1, step
    return Rows(part="client", time_ns=step, rows=row.tobytes())


def recorded_steps(path: Path) -> list[int]:
    """Steps of which a recording has rows."""
    with Recorded(path) as recorded:
        parts = recorded.parts()
    return [int(step) for step in parts["client"]["step"]] if "client" in parts else []


def test_a_feed_that_begins_anew_is_recorded_once(
    live: tuple[Live, Feeds, list[str]], tmp_path: Path
) -> None:
    """It repeats its last frames, and nothing was missed."""
    made, feeds, told = live
    for frame in (opened(client_columns(2)), row_at(1), row_at(2)):
        feeds.take("client", frame)
    feeds.lost("client")
    for frame in (opened(client_columns(2)), row_at(1), row_at(2), row_at(3)):
        feeds.take("client", frame)
    feeds.lost("client")
    assert made.finish() is None
    assert recorded_steps(tmp_path / "live.mcap") == [1, 2, 3]
    assert told == []


def test_a_feed_that_begins_anew_would_be_recorded_twice(
    live: tuple[Live, Feeds, list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If what has come before were not known."""
    monkeypatch.setattr(recorder._Source, "is_new", lambda *_: True)
    made, feeds, _ = live
    for _ in range(2):
        for frame in (opened(client_columns(2)), row_at(1)):
            feeds.take("client", frame)
        feeds.lost("client")
    made.finish()
    assert recorded_steps(tmp_path / "live.mcap") == [1, 1]


def test_a_gap_in_a_feed_is_told_once(live: tuple[Live, Feeds, list[str]], tmp_path: Path) -> None:
    """The recorder was dropped, and what it was not sent is gone."""
    made, feeds, told = live
    for begin in (1, 3, 5):
        for frame in (opened(client_columns(2)), row_at(begin)):
            feeds.take("client", frame)
        feeds.lost("client")
    said = f"{tmp_path / 'live.mcap'}: the recorder was too slow for what client tells"
    assert made.finish() == said
    assert told == [f"{said}: the record is incomplete, the flight goes on"]
    assert recorded_steps(tmp_path / "live.mcap") == [1, 3, 5]


def test_rows_that_never_came_are_missed_at_the_end(live: tuple[Live, Feeds, list[str]]) -> None:
    """The processes' own record knows how many there are."""
    made, feeds, _ = live
    for frame in (opened(client_columns(2)), row_at(0)):
        feeds.take("client", frame)
    feeds.lost("client")
    missing = made.finish(None, flown())
    assert missing is not None
    assert missing.endswith(f"1 of {len(flown().client)} rows of client are recorded")


def test_a_disk_that_fills_up_costs_the_recording_alone(
    live: tuple[Live, Feeds, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told once, and nothing is raised."""
    made, feeds, told = live

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
    assert len(told) == 1


@pytest.mark.long
def test_a_flight_over_udp_is_recorded_from_its_first_step_on(tmp_path: Path) -> None:
    """All rows of all parts; the recording ends with the summary that is shown."""
    path, summary = tmp_path / "flight.mcap", tmp_path / "summary.json"
    flags = ["--duration", "3", "--settle", "0", "--json", str(summary), "--record", str(path)]
    flags += ["--network.uplink.delay", "none", "--network.downlink.delay", "none"]
    assert command.main(fly, ["demo", *flags], "fly") == 0
    with Recorded(path) as recorded:
        parts = recorded.parts()
        shown = json.loads(summary.read_text())
        assert parts["client"]["step"][0] == 0
        assert len(parts["client"]) == shown["steps"] > 40
        assert len(parts["netem"]) == shown["uplink_packets"] + shown["downlink_packets"]
        assert len(parts["plan"])
        assert msgspec.to_builtins(recorded.summary) == shown
        told = [
            type(frame.event).__name__ for *_, frame in recorded.frames() if isinstance(frame, Said)
        ]
        counted = {process for _, process, frame in recorded.frames() if isinstance(frame, Figures)}
    assert {"Listening", "Flying", "Finished"} <= set(told)
    assert counted == {"server", "netem", "client"}


# --- What is made of one.


def test_tables_have_plain_columns_with_units(recording: Path, tmp_path: Path) -> None:
    """CSV and Parquet alike."""
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


def test_parquet_without_pyarrow_is_one_line(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says what to install."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    code, line = refusal([str(recording), "--parquet", "tables"], export, capsys)
    assert code == 2
    assert "pyarrow is not installed" in line


def test_a_report_is_one_page_that_needs_nothing_else(recording: Path, tmp_path: Path) -> None:
    """It has both figures, the summary, the events and the scenario."""
    out = tmp_path / "report.html"
    assert command.main(report, [str(recording), "--out", str(out)], "report") == 0
    page = out.read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "://" not in page.replace("data:", "")
    for shown in ("RMSE x, y, xy [m]", "session open, flying", "[network.uplink]", "seed 1"):
        assert shown in page


# --- What is refused.


def other_mcap(path: Path) -> None:
    """A file of MCAP that is none of ours."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda path: path.mkdir(), "it is no plain file"),
        (lambda path: path.write_bytes(b""), "it is empty"),
        (lambda path: path.write_text("time,x\n"), "it is no MCAP file"),
        (other_mcap, "it is no recording of Skytether"),
        (lambda path: path, "cannot be read: No such file or directory"),
    ],
    ids=["folder", "empty", "csv", "other", "missing"],
)
def test_what_is_no_recording_is_refused_in_a_line(
    made: Any, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By each command, which names it, and leaves nothing behind."""
    path = tmp_path / "it.mcap"
    made(path)
    before = set(tmp_path.iterdir())
    for of, flags in (
        (recover_command, []),
        (export, ["--csv", str(tmp_path / "tables")]),
        (report, ["--out", str(tmp_path / "page.html")]),
    ):
        code, line = refusal([str(path), *flags], of, capsys)
        assert code == 2
        assert line.startswith(f"it: {path}: {said}")
    assert set(tmp_path.iterdir()) == before


def test_a_file_of_another_name_is_refused_before_anything_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recording ends in .mcap."""
    code, line = refusal(["demo", "--record", str(tmp_path / "flight.mp4")], fly, capsys)
    assert code == 2
    assert line.endswith("flight.mp4, expected a file that ends in .mcap")
