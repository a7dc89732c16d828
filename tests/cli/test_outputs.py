"""Outputs of commands: no input, nor the output of another running command, is overwritten, and no
file is left half-written.
"""

import dataclasses
import fcntl
import importlib
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from helpers import until
from skytether.__main__ import COMMANDS, main
from skytether.shared.base import files, input_files
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import PACKET_COLUMNS
from skytether.shell.commandline.command import CommandError
from skytether.shell.processes.process import recorded

pytestmark = pytest.mark.usefixtures("plugin_tables")

SHORT = ("--virtual", "--duration", "6", "--settle", "0")
SCENARIO = "extends = 'demo'\nduration = 6.0\n"
LINES = {
    "fly --json": "fly SCENARIO OUT",
    "fly --record": "fly SCENARIO OUT.mcap",
    "fly --figure": "fly SCENARIO OUT.png",
    "fleet --json": "fleet --mission MISSION --virtual OUT",
    "fleet --figure": "fleet SCENARIO --virtual --vehicles 1 OUT.png",
    "sweep --out": "sweep SCENARIO --runs 1 OUT/runs.csv",
    "margins --json": "margins SCENARIO --runs 1 OUT",
    "identify --out": "identify --scenario SCENARIO OUT/scenario.toml",
    "reproduce --out": "reproduce --quick --plugin PLUGIN OUT/report.html",
    "compare --out": "compare --quick --weights WEIGHTS OUT/report.html",
    "calibrate --out": "calibrate SCENARIO --objective rmse OUT/best.toml",
    "report --html": "report RECORDING OUT",
    "explain --json": "explain SCENARIO OUT",
    "explain --figure": "explain SCENARIO OUT.png",
    "export --csv": "export RECORDING OUT/client.csv",
    "export --parquet": "export RECORDING OUT/client.parquet",
    "export --traces": "export RECORDING OUT/uplink-0.csv",
    "export --pcap": "export RECORDING OUT",
    "join --record": "join RECORDING OTHER OUT.mcap",
    "probe --out": "probe 127.0.0.1:9 --keys KEYS --duration 1 OUT/uplink.csv",
    "probe --json": "probe 127.0.0.1:9 --keys KEYS --duration 1 OUT",
    "probe --figure": "probe 127.0.0.1:9 --keys KEYS --duration 1 OUT.png",
    "probe --record": "probe 127.0.0.1:9 --keys KEYS --duration 1 OUT",
    "policy --json": "policy join 127.0.0.1:9 --actions delta --keys KEYS OUT",
    "policy --record": "policy join 127.0.0.1:9 --actions delta --keys KEYS OUT.mcap",
    "server --json": "server demo --keys KEYS OUT",
    "server --record": "server SCENARIO OUT",
    "netem --json": "netem SCENARIO OUT",
    "netem --record": "netem SCENARIO OUT.mcap",
    "client --json": "client demo --keys KEYS OUT",
    "client --record": "client SCENARIO OUT.mcap",
    "autopilot --json": "autopilot SCENARIO OUT",
    "autopilot --record": "autopilot SCENARIO OUT",
}
"""Command line for each option that names an output; OUT is the option's value, and another path of
the input.
"""
READ = {"plugin", "keys", "replay", "file", "files", "folder", "folders", "path", "show"}
READ |= {"contender"}
"""Options that name files to read, or sockets and folders of sockets."""
SOCKETS = {"control", "feed"}
"""Options that name sockets to create, which replace no file."""
IN_PLACE = {("keygen", "file")}
"""Options whose file is read and written on purpose."""


def options_of(command: str) -> type:
    module = importlib.import_module(COMMANDS[command].partition(":")[0])
    found = [
        each
        for name, each in vars(module).items()
        if name.endswith("Options") and each.__module__ == module.__name__
    ]
    return found[-1] if found else type("Nothing", (), {"__dataclass_fields__": {}})


def test_every_option_that_names_a_file_is_looked_at() -> None:
    """A new option belongs into LINES, or is only read."""
    for command in COMMANDS:
        kind = options_of(command)
        for field in dataclasses.fields(kind):
            if "Path" in str(get_type_hints(kind, include_extras=True)[field.name]):
                flag = field.name.replace("_", "-")
                known = f"{command} --{flag}" in LINES or (command, field.name) in IN_PLACE
                assert known or field.name in READ | SOCKETS, (command, field.name)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    assert main(["fly", "demo", *SHORT, "--record", str(path)]) == 0
    return path


@pytest.fixture
def inputs(tmp_path: Path, recording: Path) -> dict[str, Path]:
    folder = tmp_path / "in"
    folder.mkdir(mode=0o700)
    made = {
        "SCENARIO": folder / "scenario.toml",
        "MISSION": folder / "mission.csv",
        "PLUGIN": folder / "plugin.py",
        "WEIGHTS": folder / "weights.toml",
        "RECORDING": folder / "flight.mcap",
        "OTHER": folder / "other.mcap",
        "KEYS": folder / "keys",
    }
    made["SCENARIO"].write_text(SCENARIO)
    made["MISSION"].write_text("vehicle,t,x,y\n1,0,0,0\n2,0,5,0\n")
    made["PLUGIN"].write_text(
        "from skytether.plugin import reference\nimport numpy as np\n"
        "@reference\ndef still(scenario):\n"
        "    '''At rest.'''\n    return lambda t: np.zeros((*np.shape(t), 2, 2))\n"
    )
    scenarios = Path(importlib.import_module("skytether.scenarios").__file__ or "").parent
    made["WEIGHTS"].write_bytes((scenarios / "compare.toml").read_bytes())
    for name in ("RECORDING", "OTHER"):
        made[name].write_bytes(recording.read_bytes())
    assert main(["keygen", str(made["KEYS"])]) == 0
    return made


def line_of(option: str, inputs: dict[str, Path], out: Path) -> tuple[list[str], Path, Path]:
    """Arguments of a line of LINES, its input, and the output path, a link to the input."""
    *words, last = LINES[option].split()
    flag = option.partition(" ")[2]
    (source,) = (inputs[word] for word in words if word in inputs and word != "OTHER")
    name, _, inside = last.partition("/")
    target = out / inside if inside else out / name.replace("OUT", "it")
    given = [str(inputs.get(word, word)) for word in words]
    return [*given, flag, str(out if inside else target)], source, target


@pytest.mark.parametrize("option", LINES)
def test_no_output_is_an_input(
    option: str, inputs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    argv, source, target = line_of(option, inputs, out)
    os.link(source, target)
    before = source.read_bytes()
    capsys.readouterr()
    assert main(argv) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "put as well, expected another file" in said
    assert str(target) in said or str(source) in said
    assert source.read_bytes() == target.read_bytes() == before
    assert {each.name for each in out.iterdir()} == {target.name}


@pytest.mark.parametrize("option", ["fly --json", "join --record"])
def test_nor_by_its_own_name(
    option: str, inputs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv, source, _ = line_of(option, inputs, tmp_path)
    argv[-1] = str(source)
    before = source.read_bytes()
    assert main(argv) == 2
    assert f"{source}: " in capsys.readouterr().err.splitlines()[-1]
    assert source.read_bytes() == before


def test_a_file_that_a_scenario_names_is_an_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "below.toml").write_text(SCENARIO)
    (tmp_path / "way.csv").write_text("t,x,y\n0,0,0\n10,1,1\n")
    above = tmp_path / "above.toml"
    above.write_text("extends = 'below.toml'\n[reference]\nshape = 'csv'\nfile = 'way.csv'\n")
    for name in ("below.toml", "way.csv"):
        before = (tmp_path / name).read_bytes()
        assert main(["fly", str(above), "--virtual", "--json", str(tmp_path / name)]) == 2
        assert "it is an input as well" in capsys.readouterr().err
        assert (tmp_path / name).read_bytes() == before


def test_two_options_do_not_name_one_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at = str(tmp_path / "it.png")
    assert main(["fly", "demo", *SHORT, "--json", at, "--figure", at]) == 2
    assert "another option names it as well" in capsys.readouterr().err
    assert not Path(at).exists()


def test_a_file_read_in_place_is_written_unless_an_option_names_it(tmp_path: Path) -> None:
    """As are keys by `keygen --add`, and the memory of a client."""
    at = tmp_path / "it"
    at.write_bytes(b"older")
    with files.apart():
        assert input_files.read(at, 9, is_input=False) == b"older"
        files.write(at, b"newer")
        files.claim(at)
        with pytest.raises(OSError, match="it is an output as well"):
            input_files.read(at, 9, is_input=False)
    assert at.read_bytes() == b"newer"


# -- concurrent commands -------------------------------------------------------------------------


@contextmanager
def locked(path: Path) -> Iterator[None]:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (("fly", "demo", *SHORT, "--record"), "it.mcap"),
        (("server", "demo", "--record"), "it"),
        (("export", "FLIGHT", "--csv"), "folder"),
    ],
    ids=lambda each: each if isinstance(each, str) else " ".join((each[0], each[-1])),
)
def test_two_commands_do_not_write_one_file(
    argv: tuple[str, ...],
    name: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    at = tmp_path / name
    if name == "folder":
        at.mkdir()
    else:
        at.write_bytes(b"older")
    words = [str(recording) if word == "FLIGHT" else word for word in argv]
    with locked(at):
        assert main([*words, str(at)]) == 2
    assert f"{at}: cannot be written: another command is writing it" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [at]
    assert at.is_dir() or at.read_bytes() == b"older"


def test_a_new_file_is_locked_at_once_and_gone_where_nothing_was_written(tmp_path: Path) -> None:
    at = tmp_path / "it"
    with files.apart():
        files.claim(at)
        assert at.read_bytes() == b""
        with at.open() as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert not at.exists()
    with files.apart():
        files.claim(at)
        files.write(at, b"content")
    assert at.read_bytes() == b"content"


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_that_is_killed_leaves_the_older_recording(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Meanwhile no other command may write there; the recorded part is readable."""
    at, part = tmp_path / "it.mcap", tmp_path / "it.part1.mcap"
    at.write_bytes(recording.read_bytes())
    argv = ["fly", "demo", "--no-page", "--duration", "60", "--record", str(at)]
    child = subprocess.Popen([sys.executable, "-P", "-m", "skytether", *argv])
    try:
        until(lambda: part.exists() and part.stat().st_size >= 100_000)
        assert main(["fly", "demo", *SHORT, "--record", str(at)]) == 2
        assert "another command is writing it" in capsys.readouterr().err
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert at.read_bytes() == recording.read_bytes()
    assert main(["export", str(part), "--csv", str(tmp_path / "tables")]) == 0


# -- a full disk ---------------------------------------------------------------------------------


@contextmanager
def room_for(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes = sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python would leave a truncated .pyc and read it later
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        sys.dont_write_bytecode = writes
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (("fly", "demo", *SHORT, "--record"), "it.mcap"),
        (("export", "FLIGHT", "--pcap"), "it.pcap"),
        pytest.param(("report", "FLIGHT", "--html"), "it.html", marks=pytest.mark.long),
    ],
    ids=lambda each: each if isinstance(each, str) else " ".join((each[0], each[-1])),
)
def test_a_full_disk_leaves_the_older_file(
    argv: tuple[str, ...],
    name: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    at = tmp_path / name
    words = [str(recording) if word == "FLIGHT" else word for word in argv]
    for older in (b"older", None):
        if older is None:
            at.unlink()
        else:
            at.write_bytes(older)
        with room_for(2000):
            assert main([*words, str(at)]) != 0
        assert "File too large" in capsys.readouterr().err
        assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == (
            {name: older} if older else {}
        )


def test_a_new_file_takes_its_name_once_it_is_whole(tmp_path: Path) -> None:
    at = tmp_path / "it"
    with files.replacing(at) as file:
        file.write(b"content")
        (part,) = tmp_path.iterdir()
        assert part.name == "it.part1"
    assert at.read_bytes() == b"content"
    with pytest.raises(OSError, match="exists"), files.replacing(at, is_new=True) as file:
        file.write(b"other")
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"content"]


def test_an_older_record_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    """The incomplete new record, left by a full disk, is beside the old one."""
    at, part = tmp_path / "it", tmp_path / "it.part1"

    def fly(rows: int) -> None:
        with recorded(at, PACKET_COLUMNS) as record:
            for number in range(rows):
                record.recorder.append(1, number=number)

    fly(10)
    older = at.read_bytes()
    with room_for(4096), pytest.raises(CommandError, match=r"it\.part1: File too large"):
        fly(1000)
    assert at.read_bytes() == older
    kept = read(part)["number"]
    np.testing.assert_array_equal(kept, np.arange(len(kept)))
    part.unlink()
    fly(20)
    assert read(at)["number"].tolist() == list(range(20))
    fly(0)
    assert read(at)["number"].tolist() == list(range(20))
    assert list(tmp_path.iterdir()) == [at]
