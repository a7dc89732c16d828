"""Commands as a user runs them: real processes and sockets, and one line for each mistake."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

from helpers import PATIENCE_S, refused, until
from skytether.__main__ import COMMANDS, main
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Finished, Flying, ModeChanged, address_text
from skytether.shared.events.processes import Counted, Listening, Plaintext
from skytether.shared.scenario import reading
from skytether.shared.telemetry.record import client_columns
from skytether.shared.wire.protocol import Hello, encode
from skytether.shell.commandline import command
from skytether.shell.processes.log import LogLine
from warm import Command, Process, skytether

QUICK = [
    *("--network.uplink", "constant(0.03)", "--network.downlink", "constant(0.03)"),
    *("--settle", "0"),
    *("--link.heartbeat-s", "0.1", "--link.timeout-s", "0.5"),
]
"""Short link without losses, and a session that detects silence soon."""


# -- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("fly papr", "fly: papr: no such scenario; did you mean paper?"),
        ("flyy", "skytether: no command 'flyy'; did you mean fly?"),
        ("triggers", "skytether: no command 'triggers'; it is skytether list triggers"),
        ("fly demo --virtual --control sockets", "fly: --control: got --virtual"),
        ("fly demo --virtual --page 127.0.0.1:0", "fly: --page: got --virtual"),
        ("fly demo --virtual --linger", "fly: --linger: got --virtual"),
        ("set nobody armed", "set: got 'armed', expected KEY=VALUE"),
        (
            "fly demo --control.dt 0",
            "fly: demo and the command line: control.dt: got 0, expected a number >= 0.001",
        ),
        (
            "fly demo-committed --control.horizon 5",
            "fly: demo-committed and the command line: control.horizon: got 5, expected",
        ),
        ("fly --figure flight.gif", "fly: flight.gif: expected"),
        ("fly --record a.mp4", "fly: --record: got a.mp4, expected a file that ends in .mcap"),
        ("server --bind 47001", "server: --bind: got '47001', expected HOST:PORT"),
        ("server --bind ::1:47001", "server: --bind: got '::1:47001', expected HOST:PORT"),
        ("client --server [1::2::3]:4", "client: --server: got '[1::2::3]:4', expected HOST:PORT"),
        ("client --server [::1]:65536", "client: --server: got '[::1]:65536', expected HOST:PORT"),
        ("client --path ::1=g:1", "client: --path: got '::1=g:1', expected LOCAL=HOST:PORT"),
        ("client --path =g:1 --path =g:1", "client: --path: got '=g:1' twice, expected it once"),
        (
            "client " + " ".join(f"--path =g:{port}" for port in range(5)),
            "client: --path: got 5, expected 1 to 4",
        ),
        ("client --path =g:1 --server g:2", "client: --path: got --server as well, expected"),
        ("client --path =g:1 --vehicles 2", "client: --vehicles: got 2 with --path, expected 1"),
        ("client --standby a:1 --vehicles 2", "client: --vehicles: got 2 with --standby, expected"),
        (
            "client --server g:1 --standby lo=g:1",
            "client: --standby: got g:1, expected another server than the first",
        ),
        (
            "client " + " ".join(f"--standby g:{port}" for port in range(5)),
            "client: --standby: got 5, expected 1 to 4",
        ),
        (
            "server --workers 2 --bind 127.0.0.1:0 --bind 127.0.0.2:0",
            "server: --bind with --workers: got 2, expected 1 to 1",
        ),
        (
            "server --bind 127.0.0.1:0 --bind 0.0.0.0:0",
            "server: 0.0.0.0:0: other machines can reach it and there are no keys",
        ),
        ("client --id -1", "client: --id: got -1, expected 0 to 65535"),
        ("netem --server nobody.invalid:1", "netem: cannot find nobody.invalid: "),
        ("list paper", "list: got paper, expected scenarios, triggers, "),
        ("fleet --vehicles 0", "fleet: --vehicles: got 0, expected 1 to 65535"),
        ("fleet --virtual --workers 2", "fleet: --workers: got --virtual as well, expected 1 in"),
        ("fleet --virtual --page 127.0.0.1:0", "fleet: --page: got --virtual as well, expected a"),
        ("fleet demo --mission swap", "fleet: --mission: got demo as well, expected"),
        ("fleet --mission x.txt", "fleet: --mission: got 'x.txt', expected swap, "),
        (f"fly {__file__}", f"fly: {__file__}: expected the name of a scenario, or a file"),
        ("fleet --mission swap --vehicles 3", "fleet: --vehicles: got 3, expected 16 on this"),
        ("server --vehicles -1", "server: --vehicles: got -1, expected 1 to 65536"),
        ("netem --tcp --flows 129", "netem: --flows: got 129, expected 1 to 128"),
        ("client --id 65530 --vehicles 10", "client: --id: got 65530 to 65539, expected 0 to 6"),
    ],
)
def test_a_mistake_is_one_clear_line(
    line: str, said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == (1 if "cannot find" in said else 2)
    (printed,) = capfd.readouterr().err.splitlines()
    assert printed.startswith(said)


@pytest.mark.parametrize(
    "address",
    [("127.0.0.1", 47000), ("netem", 0), ("::1", 47000), ("::", 1), ("fe80::1%eth0", 65535)],
)
def test_an_address_is_read_as_it_is_written(address: Address) -> None:
    assert command.address("--bind", address_text(*address)) == address


@pytest.mark.parametrize("wrong", ["--triger x", "more"])
def test_a_wrong_flag_is_explained(wrong: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "demo", *wrong.split()]) == 2
    said = capfd.readouterr().err
    assert wrong.split(maxsplit=1)[0] in said
    assert "skytether fly --help" in said


def test_a_broken_scenario_file_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('extends = "paper"\n[network.uplink]\nlos = 0.3\n')
    said = f"fly: {file}: network.uplink.los: no such key; did you mean loss?"
    assert refused(["fly", str(file)], capfd) == said


def test_a_port_in_use_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert main(["server", "--bind", f"127.0.0.1:{port}"]) == 1
    assert capfd.readouterr().err == (
        f"server: cannot listen on 127.0.0.1:{port}: Address already in use\n"
    )


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    command = f"{sys.executable} -P -m skytether list scenarios | head -c 1"
    run = subprocess.run(command, shell=True, capture_output=True, check=False)
    assert run.stderr == b""


# -- help ----------------------------------------------------------------------------------------


def test_the_front_door_names_every_command(capfd: pytest.CaptureFixture[str]) -> None:
    for argv in ([], ["--help"]):
        assert main(argv) == 0
        said = capfd.readouterr().out
        for name in COMMANDS:
            assert re.search(rf"^  {name}\b", said, re.MULTILINE)


def test_scenarios_are_listed_with_a_line_each(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "scenarios"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == reading.names()
    assert {"paper", "paper-no-compensation", "paper-every-step", "demo"} <= set(reading.names())
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", ["fly", "client"])
def test_help_shows_the_scenario_that_was_named(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main([name, "paper", "--help-keys"])
    assert exit_.value.code == 0
    said = " ".join(capfd.readouterr().out.split())
    assert f"usage: skytether {name}" in said
    assert "--control.change-weight NUMBER" in said
    assert "(default: 60.0)" in said


# -- flights -------------------------------------------------------------------------------------


def test_a_virtual_flight_writes_the_same_summary_twice(tmp_path: Path) -> None:
    files = [tmp_path / "one.json", tmp_path / "two.json"]
    for file in files:
        argv = ["fly", "paper", "--virtual", "--duration", "12", "--seed", "3"]
        assert main([*argv, "--json", str(file)]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    summary = json.loads(files[0].read_text())
    assert (summary["scenario"], summary["seed"], summary["steps"]) == ("paper", 3, 240)
    assert summary["solve_ms_p50"] is None


def test_a_flight_tells_what_was_dropped_and_why(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flight.json"
    argv = ["fly", "demo", "--virtual", "--secure", "--duration", "8", "--json", str(file)]
    network = ["--network.downlink", "constant(0.1) & duplicate(0.5) & loss(0.2)"]
    assert main([*argv, *network]) == 0
    summary = json.loads(file.read_text())
    drops = summary["drops"]
    assert drops["netem"].keys() == {"uplink lost", "downlink lost"}
    assert sum(drops["netem"].values()) == summary["lost"] > 0
    assert drops["server"].keys() == {"replayed"}
    count = drops["server"]["replayed"]
    assert re.search(rf"dropped by server +│ replayed {count} ", capfd.readouterr().out)


@pytest.fixture
def contradictory(tmp_path: Path) -> str:
    """File of a scenario whose loss of 40 % needs a longer horizon than it has."""
    file = tmp_path / "mine.toml"
    file.write_text(
        'extends = "demo-committed"\ncontrol.horizon = 12\nduration = 2.0\n'
        'network.uplink = "constant(0.1) & loss(0.4)"\nnetwork.downlink = "constant(0.1)"\n'
    )
    return str(file)


@pytest.mark.parametrize(
    "argv",
    [
        ["fly", "--virtual", "--control.horizon", "40"],
        ["fleet", "--virtual", "--vehicles", "2", "--control.horizon", "40"],
        pytest.param(
            ["sweep", "--runs", "1", "--grid", "control.horizon=30,40", "--out", "swept"],
            marks=pytest.mark.long,
        ),
        ["identify", "--scenario", "mine.toml", "--control.horizon", "40", "--repeats", "1"],
    ],
)
def test_a_flag_may_end_a_contradiction_of_the_file(
    argv: list[str],
    contradictory: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(Path(contradictory).parent)
    name, *flags = argv
    place = ["simulated"] if name == "identify" else [contradictory]
    assert main([name, *place, *flags]) == 0, capfd.readouterr().err
    assert main(["fly", contradictory, "--virtual"]) == 2
    assert "mine.toml: control.horizon: got 12" in capfd.readouterr().err


def test_a_table_in_millimetres_is_flown_with_a_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    table, file = tmp_path / "mm.csv", tmp_path / "summary.json"
    table.write_text("t,x,y\n0,0,0\n2,0,0\n12,5100,0\n")
    argv = ["fly", "demo", "--virtual", "--duration", "10", "--settle", "0", "--json", str(file)]
    argv += ["--reference.shape", "csv", "--reference.file", str(table)]
    assert main(argv) == 0
    said = capfd.readouterr()
    assert len(re.findall(r" 510 m/s at 2 s.* 1\.6 m/s", said.err)) == 1
    assert "too fast" in said.out
    assert json.loads(file.read_text())["too_fast"] == pytest.approx(0.8, abs=0.01)


def test_a_second_scenario_is_judged_as_it_is_flown(
    contradictory: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """The second scenario's longer flight leads over its own fence."""
    fenced = Path(contradictory).with_name("fenced.toml")
    fenced.write_text(
        'extends = "demo"\nduration = 2.0\nsettle = 0.0\nfence.radius_m = 6.0\n'
        'reference.shape = "waypoints"\nreference.points_m = [[0, 0], [9, 0]]\n'
    )
    assert main(["fly", str(fenced), "--virtual"]) == 0
    flown = ["fly", "demo", "--virtual", "--duration", "20", "--beside", str(fenced)]
    assert main(flown) == 2
    assert "fenced.toml: fence.radius_m: got 6.0, expected more" in capfd.readouterr().err


def test_a_flight_is_compared_with_several_others(capfd: pytest.CaptureFixture[str]) -> None:
    argv = ["fly", "demo", "--virtual", "--duration", "4", "--settle", "0"]
    assert main([*argv, "--beside", "demo-paper", "--beside", "demo-no-compensation"]) == 0
    output = capfd.readouterr().out
    (names,) = (line for line in output.splitlines() if "demo-paper" in line)
    assert re.findall(r"[\w-]+", names) == ["demo", "demo-paper", "demo-no-compensation"]
    alone = []
    for name in ("demo", "demo-paper", "demo-no-compensation"):
        assert main(["fly", name, *argv[2:]]) == 0
        alone += re.findall(r"largest error \[m\] +│ (\S+)", capfd.readouterr().out)
    (errors,) = (line for line in output.splitlines() if "largest error" in line)
    assert re.findall(r"[\d.]+", errors) == alone


@pytest.mark.realtime
def test_a_real_flight_with_one_command(tmp_path: Path) -> None:
    file = tmp_path / "real.json"
    run = skytether("fly", "demo-committed", *QUICK, "--duration", "3", "--json", str(file))
    assert run.returncode == 0, run.stderr
    summary = json.loads(file.read_text())
    assert summary["steps"] > 0
    absent = {key for key, value in summary.items() if value is None}
    assert absent == {"rmse_z", "estimate_error_m", "paths"}
    assert summary["solve_ms_p50"] > 0.0


@pytest.mark.long
@pytest.mark.realtime
def test_ctrl_c_ends_the_flight_and_still_shows_it(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "skytether", "fly", "demo", *QUICK]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as fly:
        rows_bytes = 20 * client_columns(2).itemsize
        until(lambda: sum(p.stat().st_size for p in tmp_path.glob("*/client")) >= rows_bytes)
        listed = Path(f"/proc/{fly.pid}/task/{fly.pid}/children").read_text().split()
        children = [int(pid) for pid in listed]
        assert len(children) == 3
        fly.send_signal(signal.SIGINT)
        out, err = fly.communicate(timeout=PATIENCE_S)
    assert fly.returncode == 0, err
    steps = re.search(r"steps +│ (\d+) in", out)
    assert steps is not None
    assert int(steps[1]) > 5
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize(
    "host", ["127.0.0.1", pytest.param("[::1]", marks=pytest.mark.ipv6)], ids=["IPv4", "IPv6"]
)
def test_three_processes_by_hand(host: str, start: Callable[..., Process], tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    server = start("server", "demo", "--bind", f"{host}:0", *QUICK)
    address = server.address()
    netem = start("netem", "demo", "--bind", f"{host}:0", "--server", address, *QUICK)
    address = netem.address()
    argv = ["client", "demo", "--server", address, "--duration", "3", "--json", str(file)]
    client = start(*argv, *QUICK)
    client.wait_for(rf"waiting for the server at {re.escape(host)}:\d+")
    client.wait_for("session open, flying")
    server.wait_for(rf"vehicle 1 flies, from {re.escape(host)}:\d+")
    netem.popen.send_signal(signal.SIGUSR1)
    for pattern in (
        *("counted so far:", r"flows +1$", "uplink  downlink$", r"  forwarded +\d+ +\d+$"),
        *(r"  lost +0 +0$", r"  overflowed +0 +0$", r"  queue +\d+ +\d+$"),
        *(r"  delays_ms 20 +\d+ +\d+$", r"  error_ms_p50 +[\d.]+ +[\d.]+$"),
    ):
        netem.wait_for(pattern)
    assert client.ended() == 0
    assert netem.end() == 0
    assert server.end(signal.SIGINT) == 0
    loud = [any("PLAINTEXT" in line for line in each.said) for each in (server, netem, client)]
    assert loud == [True, False, True]
    assert any("error_ms_p99" in line for line in netem.said[-20:])
    summary = json.loads(file.read_text())
    assert summary["steps"] > 0
    assert summary["event_ratio"] is None


@pytest.mark.long
@pytest.mark.realtime
def test_a_client_too_many_and_one_under_a_number_in_flight_are_told_why(
    start: Callable[..., Process],
) -> None:
    # Long time-out, so that a busy machine does not trip it.
    patient = ["--settle", "0", "--link.timeout-s", "10"]
    server = start("server", "demo", "--bind", "127.0.0.1:0", "--vehicles", "1", *patient)
    address = server.address()
    argv = ["client", "demo", "--server", address, *patient]
    flying = start(*argv)
    server.wait_for("vehicle 1 flies")
    reasons = {
        "1": "another client flies under this number; see --id",
        "2": "the server is full; see its --vehicles",
    }
    for number, reason in reasons.items():
        run = skytether(*argv, "--id", number, "--link.connect-s", "1.5")
        assert run.returncode == 2
        assert run.stderr == f"client: vehicle {number} is refused by {address}: {reason}\n"
    assert flying.counted("horizons") > 0
    assert (flying.end(), server.end()) == (0, 0)


@pytest.mark.long
@pytest.mark.realtime
def test_a_log_of_json_has_an_event_a_line(start: Callable[..., Process]) -> None:
    server = start("server", "demo", "--bind", "127.0.0.1:0", *QUICK)
    argv = ["--server", server.address(), "--duration", "3", "--log", "json", *QUICK]
    began_ns = time.monotonic_ns()
    run = skytether("client", "demo", *argv)
    assert run.returncode == 0, run.stderr
    lines = [msgspec.json.decode(line, type=LogLine) for line in run.stdout.splitlines()]
    kinds = [type(line.event) for line in lines]
    assert kinds[:3] == [Listening, Plaintext, Flying]
    assert ModeChanged in kinds
    assert kinds[-2:] == [Finished, Counted]
    assert {line.process for line in lines} == {"client"}
    times_ns = [began_ns, *(line.time_ns for line in lines), time.monotonic_ns()]
    assert times_ns == sorted(times_ns)
    assert json.loads(run.stdout.splitlines()[2])["event"] == {"type": "Flying", "vehicle": 1}
    assert server.end() == 0


# -- blocked output and full disks ---------------------------------------------------------------


@pytest.fixture
def unread() -> Iterator[int]:
    """Standard output that accepts no data: a pipe that is full."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with suppress(BlockingIOError):
        while os.write(writing, bytes(4096)):
            pass
    os.set_blocking(writing, True)
    yield writing
    os.close(writing)
    os.close(reading)


@pytest.mark.long
@pytest.mark.realtime
def test_a_server_whose_output_nobody_reads_flies_a_vehicle_and_ends_in_order(
    unread: int, start: Callable[..., Process], tmp_path: Path
) -> None:
    figures = tmp_path / "server.json"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    argv = ["server", "demo", "--bind", f"127.0.0.1:{port}", *QUICK, "--json", str(figures)]
    with Command(*argv, stdout=unread, stderr=sys.stderr.fileno()) as server:
        try:
            there = ["--server", f"127.0.0.1:{port}", "--link.connect-s", "30"]
            client = start("client", "demo", *there, "--duration", "3", *QUICK)
            client.wait_for("session open, flying")
            call_as_strangers(port, 2000)
            assert client.ended() == 0
            server.send_signal(signal.SIGTERM)
            assert server.wait(PATIENCE_S) == 0
        finally:
            server.kill()
    counted = json.loads(figures.read_text())
    assert counted["vehicles"] == 0  # the client has announced its end
    assert counted["counts"]["steps"] > 10


def call_as_strangers(port: int, count: int) -> None:
    """Send HELLO with other terms to a server, from several vehicles, and await each answer."""
    demo = reading.load("demo")
    control = msgspec.structs.replace(demo.control, dt=0.02, horizon=100)
    terms = msgspec.structs.replace(demo, control=control).terms()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.settimeout(PATIENCE_S)
        for number in range(count):
            stranger.sendto(encode(Hello(1000 + number, number, terms)), ("127.0.0.1", port))
            stranger.recv(65536)


@pytest.mark.realtime
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_workers_that_are_told_to_end_twice_end_in_order(number: signal.Signals) -> None:
    """A terminal or supervisor signals every process, and the parent signals its workers again."""
    argv = ["server", "demo", "--bind", "127.0.0.1:0", "--workers", "2"]
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "skytether", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    ) as server:
        try:
            assert server.stdout is not None
            said = [server.stdout.readline() for _ in range(4)]
            os.killpg(server.pid, number)
            rest, mistakes = server.communicate(timeout=PATIENCE_S)
        finally:
            server.kill()
    assert (server.returncode, mistakes) == (0, "")
    for worker in ("server.1", "server.2"):
        assert any(f" {worker}: listening on" in line for line in said)
        assert f"{worker}: counted so far:" in rest


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_whose_disk_fills_is_flown_and_shown_as_far_as_it_is_recorded(
    start: Callable[..., Process], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 1, the summary of the recorded part, and the share of the flight that it covers."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    file = tmp_path / "summary.json"
    argv = ["fly", "demo", *QUICK, "--duration", "4", "--json", str(file)]
    fly = start(*argv, file_bytes=5000)
    assert fly.ended() == 1, fly.said
    *said, last = fly.said
    found = re.findall(r"/(\w+): File too large: the record is incomplete", "\n".join(said))
    assert sorted(found) == ["client", "server"]
    steps = json.loads(file.read_text())["steps"]
    assert 0 < steps < 80
    assert any(re.search(rf"steps +│ {steps} in ", line) for line in said)
    assert re.fullmatch(r"fly: .*: File too large: recorded up to [\d.]+ of 4 s", last)


@pytest.mark.long
@pytest.mark.realtime
def test_the_other_two_survive_a_kill_and_restart_of_each(start: Callable[..., Process]) -> None:
    flags = [*QUICK, "--control.trigger", "always", "--duration", "60"]
    argv = {"server": ["server", "demo", "--bind", "127.0.0.1:0", *flags]}
    running = {"server": start(*argv["server"])}
    address = running["server"].address()
    argv["server"] = ["server", "demo", "--bind", address, *flags]
    argv["netem"] = ["netem", "demo", "--bind", "127.0.0.1:0", "--server", address, *flags]
    running["netem"] = start(*argv["netem"])
    address = running["netem"].address()
    argv["netem"] = ["netem", "demo", "--bind", address, *argv["netem"][4:]]
    argv["client"] = ["client", "demo", "--server", address, *flags]
    running["client"] = start(*argv["client"])
    running["client"].wait_for("flies a plan")
    for victim in ("server", "netem", "client"):
        assert running[victim].end(signal.SIGKILL) == -signal.SIGKILL
        if victim != "client":
            running["client"].wait_for("brakes: the server is silent")
        running[victim] = start(*argv[victim])
        client = running["client"]
        client.wait_for("session open, flying" if victim == "client" else "flies a plan")
        enough = client.counted("horizons") + 10
        while client.counted("horizons") < enough:
            time.sleep(0.1)
    for process in reversed(running.values()):
        assert process.end() == 0
        assert not any("Traceback" in line for line in process.said)
