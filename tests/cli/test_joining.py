"""Recordings of processes started by hand, joined into one flight."""

import signal
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from skytether.cli import recorder
from skytether.cli.export import export
from skytether.cli.join import join
from skytether.cli.report import report
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import ends, feed
from skytether.shared.telemetry.feed import Frame, Opened, Rows
from skytether.shared.telemetry.record import PACKET_COLUMNS, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shell.commandline import command
from skytether.sim import flight
from skytether.view.frames import of_flight
from skytether.view.recordings.recorded import read
from skytether.view.recordings.recording import Recording
from warm import Process

SCENARIO = msgspec.structs.replace(reading.load("demo"), duration=5.0, settle=3.0)
OFFSETS_NS = {"client": 10**18, "server": 10**18 + 7 * 10**9, "netem": 10**18 - 3 * 10**9}
"""Time of day minus the clock of each process's computer [ns]."""
AT_ONCE = ("--settle", "0", "--network.uplink", "loss(0.1)", "--network.downlink", "loss(0.1)")
"""Network without delay, over which the first plan arrives at once."""


@pytest.fixture(scope="module")
def flown() -> Record:
    return flight.fly(SCENARIO)


def recorded_by(process: str, folder: Path, flown: Record, scenario: Scenario = SCENARIO) -> Path:
    """Recording of one process, on its own clock."""
    path, off_ns = folder / f"{process}.mcap", OFFSETS_NS[process]
    about = recorder._about(scenario, "demo", began=None, offset_ns=off_ns, secure=False)
    late_ns = OFFSETS_NS["client"] - off_ns
    with path.open("wb") as file:
        recording = Recording(file, scenario, about)
        for _, of, frame in of_flight(scenario, "demo", flown):
            if of == process:
                recording.add(process, moved(frame, late_ns))
        recording.finish(None)
    return path


def moved(frame: Frame, late_ns: int) -> Frame:
    frame = msgspec.structs.replace(frame, time_ns=frame.time_ns + late_ns)
    if isinstance(frame, Rows) and frame.part == "netem":
        rows = np.frombuffer(frame.rows, PACKET_COLUMNS).copy()
        rows["arrived_ns"] += late_ns
        return msgspec.structs.replace(frame, rows=rows.tobytes())
    return frame


def together(paths: Sequence[Path], out: Path) -> int:
    return command.main(join, [*map(str, paths), "--record", str(out)], "join")


def test_three_recordings_become_the_flight(flown: Record, tmp_path: Path) -> None:
    paths = [recorded_by(process, tmp_path, flown) for process in OFFSETS_NS]
    out = tmp_path / "flight.mcap"
    assert together(paths, out) == 0
    joined = read(out)
    rows = flown.client, flown.server, flown.netem
    assert joined.summary == summarise(SCENARIO, "demo", *rows, figures=flown.figures)
    for part in ("client", "server", "plan", "netem"):
        assert joined.parts[part].tobytes() == getattr(flown, part).tobytes()
    times_ns = [time_ns for time_ns, *_ in joined.frames]
    assert times_ns == sorted(times_ns)


def test_packets_at_the_ends_get_the_times_of_the_client(flown: Record, tmp_path: Path) -> None:
    paths = [recorded_by(process, tmp_path, flown) for process in OFFSETS_NS]
    about, columns = read(paths[1]).about, {ends.PART: ends.COLUMNS}
    rows = np.array([(0, 0, 0, 0, 0, 0, 70, 50)], ends.COLUMNS)
    opened = Opened(
        process="server",
        name="demo",
        scenario=reading.to_toml(SCENARIO).decode(),
        parts=feed.described(columns),
        wall_ns=0,
        time_ns=0,
    )
    with (tmp_path / "ends.mcap").open("wb") as file:
        recording = Recording(file, SCENARIO, about)
        recording.add("server", opened)
        recording.add("server", Rows(part=ends.PART, time_ns=70, rows=rows.tobytes()))
        recording.finish(None)
    assert together([paths[0], tmp_path / "ends.mcap"], tmp_path / "flight.mcap") == 0
    joined = read(tmp_path / "flight.mcap")
    (row,) = joined.parts[ends.PART]
    late_ns = about.offset_ns - joined.about.offset_ns
    assert (row["time_ns"], row["due_ns"]) == (70 + late_ns, 50 + late_ns)


def test_each_process_says_what_is_its_own(flown: Record, tmp_path: Path) -> None:
    table = reading.to_table(SCENARIO)
    table["control"]["trigger"] = "always"
    server = reading.check(table)
    table = reading.to_table(SCENARIO)
    table["network"]["uplink"] = "loss(0.25)"
    netem = reading.check(table)
    scenarios = {"client": SCENARIO, "server": server, "netem": netem}
    paths = [recorded_by(name, tmp_path, flown, own) for name, own in scenarios.items()]
    assert together(paths, tmp_path / "flight.mcap") == 0
    joined = read(tmp_path / "flight.mcap").scenario
    assert joined.control.trigger == "always"
    assert joined.network.uplink == "loss(0.25)"
    assert joined.vehicle == SCENARIO.vehicle


def test_the_netem_of_a_path_leaves_the_paths_of_the_vehicle(flown: Record, tmp_path: Path) -> None:
    table = reading.to_table(SCENARIO)
    table["network"]["paths"] = [{"uplink": "loss(0.1)"}, {"uplink": "loss(0.2)"}]
    two = reading.check(table)
    scenarios = {"client": two, "server": two, "netem": two.on_path(1)}
    paths = [recorded_by(name, tmp_path, flown, own) for name, own in scenarios.items()]
    assert together(paths, tmp_path / "flight.mcap") == 0
    assert read(tmp_path / "flight.mcap").scenario == two


def test_what_is_not_of_one_flight_is_refused(
    flown: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    client = recorded_by("client", tmp_path, flown)
    table = reading.to_table(SCENARIO)
    table["link"]["age_max_s"] = 4.0
    server = recorded_by("server", tmp_path, flown, reading.check(table))
    out = tmp_path / "flight.mcap"
    assert together([client, server], out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "link.age_max_s" in line
    assert together([client, server], client) == 2
    assert not out.exists()
    capsys.readouterr()


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_by_hand_is_recorded_and_joined(
    start: Callable[..., Process], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {name: tmp_path / f"{name}.mcap" for name in OFFSETS_NS}

    def begin(name: str, *argv: str) -> Process:
        flags = ["--duration", "3", *AT_ONCE, "--record", str(files[name])]
        return start(name, "demo", *argv, *flags)

    server = begin("server", "--bind", "127.0.0.1:0")
    netem = begin("netem", "--bind", "127.0.0.1:0", "--server", server.address())
    client = begin("client", "--server", netem.address())
    assert client.ended() == 0, client.said
    for process in (server, netem):
        assert process.end(signal.SIGINT) == 0, process.said
    out = tmp_path / "flight.mcap"
    for path in files.values():
        assert command.main(export, [str(path), "--csv", str(tmp_path / path.stem)], "it") == 0
    assert command.main(report, [str(files["client"]), "--html", str(tmp_path / "c.html")], "") == 0
    assert together(list(files.values()), out) == 0
    assert command.main(report, [str(out), "--html", str(tmp_path / "page.html")], "it") == 0
    parts, summary = read(out).parts, read(out).summary
    assert set(parts) == {"client", "server", "plan", "netem", ends.PART}
    # On a busy machine the vehicle may miss steps, but no recorded row may be missing.
    last = parts["client"][-1]
    assert last["step"] + 1 == len(parts["client"]) + last["missed"]
    assert summary is not None
    assert summary.event_ratio is not None
    assert summary.uplink_packets
    capsys.readouterr()
