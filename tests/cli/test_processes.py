"""Child processes: their events, and their last lines."""

import asyncio
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import msgspec
import numpy as np
import pytest

from skytether.cli.fly import _tell
from skytether.cli.processes import Child, _read, feeds_in, record_of, started
from skytether.shared.events.flight import (
    Finished,
    FlowOpened,
    Flying,
    ModeChanged,
    RecordIncomplete,
    SessionEnded,
)
from skytether.shared.events.processes import Counted, Listening, Measured, NoFailsafe, Plaintext
from skytether.shared.scenario.reading import load
from skytether.shared.telemetry.record import PACKET_COLUMNS, Recorder, server_columns
from skytether.shell.commandline.command import CommandError, flight_warnings
from skytether.shell.processes.log import LogLine
from warm import Process


@pytest.mark.realtime
async def test_a_child_is_known_by_its_events() -> None:
    """One of two servers, at an address that others reach, for a scenario without a failsafe."""
    heard: list[LogLine] = []
    argv = ("paper", "--bind", "0.0.0.0:0", "--insecure", "--metrics", "0.0.0.0:0")
    async with started("server 2", *argv, on_event=heard.append) as server:
        host, port = server.address
        assert (host, port > 0) == ("0.0.0.0", True)
    kinds = [Listening, Plaintext, Measured, NoFailsafe, Counted]
    assert [type(line.event) for line in heard] == kinds
    assert {line.process for line in heard} == {"server 2"}
    assert [getattr(line.event, "local", None) for line in heard[1:3]] == [False, False]
    assert server.process.returncode == 0
    assert server.last_words() == f"server 2: {NoFailsafe()}"


def test_a_scenario_without_a_failsafe_is_warned_of() -> None:
    assert flight_warnings(load("paper")) == [NoFailsafe()]
    assert flight_warnings(load("demo")) == []


@pytest.mark.long
@pytest.mark.realtime
def test_a_vehicle_without_a_failsafe_is_warned_of_and_netem_flies_none(
    start: Callable[..., Process],
) -> None:
    for name, expected in (("client", True), ("netem", False)):
        process = start(name, "paper", "--server", "127.0.0.1:9", "--log", "json")
        process.address()
        process.end()
        assert (NoFailsafe() in process.events()) is expected


@pytest.mark.realtime
@pytest.mark.ipv6
async def test_a_child_may_listen_on_ipv6() -> None:
    argv = ("demo", "--bind", "[::1]:0", "--server", "[::1]:9")
    async with started("netem", *argv) as netem:
        assert netem.address[0] == "::1"


async def test_a_child_that_cannot_start_says_why() -> None:
    with pytest.raises(CommandError, match=r"netem: papr: no such scenario; did you mean paper\?"):
        async with started("netem", "papr"):
            pass


@pytest.mark.realtime
async def test_a_child_that_is_killed_is_said_to_be() -> None:
    async with started("netem", "demo", "--bind", "127.0.0.1:0") as netem:
        os.kill(netem.process.pid, signal.SIGKILL)
        assert await netem.process.wait() == -signal.SIGKILL
    assert netem.last_words() == "netem: ended by a signal: Killed"


@pytest.mark.realtime
async def test_a_child_whose_record_is_incomplete_has_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # Python would leave a truncated .pyc
    heard: list[LogLine] = []
    file = str(tmp_path / "netem")
    argv = ("demo", "--bind", "127.0.0.1:0", "--record", file)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        async with started("netem", *argv, on_event=heard.append) as netem:
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    event = RecordIncomplete(file=file, reason="File too large")
    assert event in [line.event for line in heard]
    assert (netem.fell_short, netem.failed, netem.process.returncode) == (True, False, 1)
    assert netem.last_words() == f"netem: {file}: File too large: 0 of 0 rows are recorded"


def test_events_of_a_flight_stand_in_the_order_of_their_times(tmp_path: Path) -> None:
    """A process's line may arrive before an earlier one of another; the first event is time 0."""
    said = [
        LogLine(process="server", time_ns=7, event=SessionEnded(vehicle=1)),
        LogLine(process="client", time_ns=5, event=Flying(vehicle=1)),
        LogLine(process="netem", time_ns=7, event=Counted(figures={})),
    ]
    for part in ("client", "server", "netem"):
        (tmp_path / part).touch()
    record = record_of(tmp_path, load("demo"), (), said)
    assert [(each.time_ns, each.process) for each in record.events] == [
        (0, "client"),
        (2, "server"),
        (2, "netem"),
    ]


def test_the_record_has_the_packets_and_figures_of_every_path(tmp_path: Path) -> None:
    scenario = load("demo-two-links")
    for part in ("client", "server"):
        (tmp_path / part).touch()
    for path, (name, packets) in enumerate({"netem": 3, "netem 2": 5}.items()):
        with (tmp_path / name).open("wb") as file:
            Recorder(PACKET_COLUMNS, file).append(packets, path=path, arrived_ns=7)
        figures = {"uplink": {"packets": packets}, "refused": 1}
        (tmp_path / f"{name}.json").write_bytes(msgspec.json.encode(figures))
    record = record_of(tmp_path, scenario, ())
    assert record.netem["path"].tolist() == [0] * 3 + [1] * 5
    netem = record.figures["netem"]
    assert (netem["uplink"]["packets"], netem["refused"]) == (8, 2)
    assert netem["by_path"]["2"]["uplink"]["packets"] == 5
    assert feeds_in(tmp_path, scenario)["netem 2"] == tmp_path / "netem 2.feed"
    assert set(feeds_in(tmp_path, load("demo"))) == {"client", "server", "netem"}


def test_the_record_has_the_rows_of_both_servers_in_order(tmp_path: Path) -> None:
    scenario = load("demo")
    columns = server_columns(scenario.model.axes, scenario.control.scheme)
    for part in ("client", "netem", "netem 2"):
        (tmp_path / part).touch()
    for name, steps in {"server": [3, 4, 8], "server 2": [5, 6, 7]}.items():
        with (tmp_path / name).open("wb") as file:
            Recorder(columns, file).append(3, step=np.array(steps))
        (tmp_path / f"{name}.json").write_bytes(b'{"vehicles": 1}')
    (tmp_path / "server.part1.json").write_bytes(b'{"vehi')  # of one that was killed
    record = record_of(tmp_path, scenario, ())
    assert record.server["step"].tolist() == [3, 4, 5, 6, 7, 8]
    assert record.figures == {"server": {"vehicles": 1}, "server 2": {"vehicles": 1}}
    feeds = set(feeds_in(tmp_path, scenario, standby=True))
    assert feeds == {"client", "server", "server 2", "netem", "netem 2"}


DEEP = b'{"process":"client","event":' + b"[" * 50_000


@pytest.mark.parametrize(
    ("before", "last"),
    [(b"x" * 500_000, "client: ended with 1"), (DEEP, DEEP.decode())],
    ids=["long", "deep"],
)
async def test_a_line_that_cannot_be_read_hides_nothing_that_follows(
    before: bytes, last: str
) -> None:
    heard: list[LogLine] = []
    stream = asyncio.StreamReader(limit=100_000)
    line = LogLine(process="client", time_ns=5, event=Counted(figures={}))
    stream.feed_data(before + b"\n" + msgspec.json.encode(line) + b"\n")
    stream.feed_eof()
    child = Child("client", cast(asyncio.subprocess.Process, SimpleNamespace(returncode=1)))
    await _read(child, stream, heard.append)
    assert heard == [line]
    assert child.last_words() == last


def test_a_flight_shows_what_happens_to_its_server_and_nothing_else(
    capfd: pytest.CaptureFixture[str],
) -> None:
    shown = [
        ModeChanged(vehicle=1, before="track", after="brake", reason="the server is silent"),
        RecordIncomplete(file="netem", reason="No space left on device"),
    ]
    quiet = [
        Flying(vehicle=1),
        FlowOpened(flow=0, host="::1", port=1),
        Counted(figures={}),
        Finished(vehicle=1, steps=1, missed=0),
    ]
    for event in (*shown, *quiet):
        _tell(event)
    said = capfd.readouterr()
    assert said.err.splitlines() == [str(event) for event in shown]
    assert said.out == ""
