"""Commands without something usual: streams, files, home, locale, terminal, or time to end."""

import os
import pty
import re
import shlex
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, CompletedProcess, Popen
from typing import Any

import pytest

from helpers import PATIENCE_S, SKYTETHER, ran, refused, until
from skytether.__main__ import main
from skytether.shell.host import system

SIGUSR1_IGNORED = 1 << (signal.SIGUSR1 - 1)

VIRTUAL = ["--virtual", "--vehicles", "2", "--duration", "1", "--settle", "0"]
SHORT = ["--duration", "2", "--settle", "0"]
for _direction in ("uplink", "downlink"):  # a plan arrives at once
    SHORT += [f"--network.{_direction}", "loss(0.1)"]

POOR = {
    "PYTHONWARNINGS": "error",
    "HOME": None,
    "TERM": "dumb",
    "TMPDIR": "/nowhere",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
}
ENVIRONMENTS: dict[str, tuple[dict[str, str | None], str]] = {
    "no stdin": ({}, "{} <&-"),
    "no stdout": ({}, "{} >&-"),
    "no stderr": ({}, "{} 2>&-"),
    "no stream at all": ({}, "{} <&- >&- 2>&-"),
    "64 open files": ({}, "ulimit -n 64; {}"),
    "warnings are errors, ASCII alone, neither home nor terminal": (POOR, "{}"),
    "everything at once": (POOR, "ulimit -n 64; {} </dev/null >&- 2>&-"),
}
"""Differences from this environment: variables, and the shell line around a command."""


def run(argv: list[str], environment: str = "", line: str = "{}") -> CompletedProcess[str]:
    variables, line = ENVIRONMENTS.get(environment, ({}, line))
    merged = {**os.environ, **variables}
    return ran(
        *("sh", "-c", line.replace("{}", shlex.join([*SKYTETHER, *argv]))),
        env={name: value for name, value in merged.items() if value is not None},
        timeout=PATIENCE_S,
    )


def begun(*argv: str, **keys: Any) -> "Popen[str]":
    begun: Popen[str] = Popen([*SKYTETHER, *argv], stdout=PIPE, stderr=PIPE, text=True, **keys)
    return begun


@pytest.mark.long
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_command_does_the_same_in_any_environment(environment: str, tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    fleet = run(["fleet", *VIRTUAL, "--json", str(file)], environment)
    assert (fleet.returncode, fleet.stderr) == (0, "")
    assert '"vehicles": 2' in file.read_text()
    if "no stdout" in environment or ">&-" in ENVIRONMENTS[environment][1].replace("2>&-", ""):
        assert fleet.stdout == ""
    else:
        assert "server's plan [" in fleet.stdout
    mistake = run(["list", "papr"], environment)
    assert mistake.returncode == 2
    if "2>&-" not in ENVIRONMENTS[environment][1]:
        assert mistake.stderr.startswith("list: got papr, expected scenarios, ")


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_over_udp_needs_neither_streams_nor_home(tmp_path: Path) -> None:
    """A process without standard streams must not open a socket in their place."""
    file = tmp_path / "summary.json"
    flags = ["--network.uplink", "constant(0.03)", "--network.downlink", "constant(0.03)"]
    fly = run(["fly", "demo", *SHORT, *flags, "--json", str(file)], "everything at once")
    assert fly.returncode == 0
    assert re.search(r'"steps": \d\d', file.read_text())


def test_streams_that_were_closed_are_there_for_children_too(tmp_path: Path) -> None:
    """A worker that prints must not print to a socket."""
    file = tmp_path / "streams"
    child = (
        "import os, pathlib; names = [os.readlink(f'/proc/self/fd/{n}') for n in range(3)]; "
        f"pathlib.Path({str(file)!r}).write_text(' '.join(names))"
    )
    code = (
        "import subprocess, sys; from skytether.shell.commandline import start; start.begin(); "
        f"subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    )
    line = f"{shlex.join([sys.executable, '-P', '-c', code])} <&- >&- 2>&-"
    assert ran("sh", "-c", line).returncode == 0
    assert file.read_text().split() == ["/dev/null"] * 3


@pytest.mark.long
def test_a_sweep_needs_neither_streams_nor_home(tmp_path: Path) -> None:
    out = tmp_path / "swept"
    argv = ["sweep", "demo", *SHORT, "--runs", "2", "--workers", "1", "--out", str(out)]
    assert run(argv, "everything at once").returncode == 0
    assert len((out / "runs.csv").read_text().splitlines()) == 3


@pytest.mark.long
@pytest.mark.parametrize("term", ["dumb", "xterm"])
def test_a_terminal_that_cannot_move_its_cursor_is_not_told_to(term: str) -> None:
    ours, theirs = pty.openpty()
    argv = [*SKYTETHER, "fleet", *VIRTUAL]
    environment = os.environ | {"TERM": term}
    with Popen(argv, stdout=theirs, stderr=theirs, env=environment) as command:
        os.close(theirs)
        shown = b""
        with suppress(OSError):  # the other end is closed
            while True:
                shown += os.read(ours, 65536)
    os.close(ours)
    assert command.returncode == 0
    assert b"server's plan" in shown
    assert (b"\x1b" in shown) == (term == "xterm")


# -- exhausted resources -------------------------------------------------------------------------


TOO_MANY = "got 200, which takes 248 open files; expected at most 16, for 64 may be open"


@pytest.mark.parametrize("argv", [["client", "--vehicles", "200"], ["netem", "--flows", "200"]])
def test_too_few_open_files_are_told_before_anything_flies(
    argv: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(system, "files_max", lambda: 64)
    assert f"{argv[1]}: {TOO_MANY}" in refused(argv, capfd)


@pytest.mark.long
def test_too_few_open_files_for_a_fleet_are_told_by_its_netem() -> None:
    done = run(["fleet", "--vehicles", "200", "--duration", "1"], "64 open files")
    assert done.returncode in (1, 2)
    assert f"--flows: {TOO_MANY}" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.long
@pytest.mark.realtime
def test_netem_takes_as_many_clients_as_files_may_be_open() -> None:
    line = f"ulimit -n 64; exec {shlex.join([*SKYTETHER, 'netem', '--bind', '127.0.0.1:0'])}"
    with Popen(["sh", "-c", line], stdout=PIPE, stderr=PIPE, text=True) as netem:
        assert netem.stdout is not None
        assert "listening" in netem.stdout.readline()
        netem.terminate()
        _, said = netem.communicate(timeout=PATIENCE_S)
    room = "netem: at most 16 clients instead of 512: 64 files may be open here (ulimit -n)\n"
    assert (netem.returncode, said) == (0, room)


@pytest.mark.parametrize(("command", "flag"), [("fly", "--json"), ("fleet", "--figure")])
def test_a_file_that_cannot_be_written_is_told_before_the_flight(
    command: str, flag: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "kept.png"
    kept.write_text("kept")
    argv = [command, "--virtual", "--duration", "86400"]
    for file, reason in (
        (tmp_path / "none" / "a.png", "No such file or directory"),
        (kept / "a.png", "Not a directory"),
        (tmp_path, "Is a directory"),
    ):
        assert main([*argv, flag, str(file)]) == 2
        said = f"{command}: {flag}: {file}: cannot be written: {reason}\n"
        assert capfd.readouterr().err == said
    # Files that can be written are not mentioned.
    for fine in (kept, tmp_path / "new.png"):
        assert main([*argv, flag, str(fine), "--link.heartbeat_s", "9"]) == 2
        assert "link.timeout_s" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["kept.png"]
    assert kept.read_text() == "kept"


@pytest.mark.parametrize(
    ("process", "flag"), [("server", "--json"), ("netem", "--record"), ("client", "--record")]
)
def test_a_process_that_cannot_write_does_not_start(
    process: str, flag: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "none" / "a"
    assert main([process, flag, str(file)]) == 2
    said = f"{process}: {flag}: {file}: cannot be written: No such file or directory\n"
    assert capfd.readouterr().err == said


@pytest.mark.long
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    full = run(["list", "scenarios"], line="{} >/dev/full")
    assert (full.returncode, full.stderr) == (1, "list: No space left on device\n")
    file = tmp_path / "summary.json"
    flown = run(["fly", "--virtual", *SHORT, "--json", str(file)], line="ulimit -f 0; {}")
    said = f"fly: {file}: cannot be written: File too large\n"
    assert (flown.returncode, flown.stderr) == (1, said)


def test_a_mistake_is_one_line_whatever_stands_in_it(capfd: pytest.CaptureFixture[str]) -> None:
    said = r"fly: a\n\x1b[31m\udcff: no such scenario; there are "
    assert refused(["fly", "a\n\x1b[31m\udcff"], capfd).startswith(said)


# -- signals -------------------------------------------------------------------------------------


def about(pid: int, path: str) -> str:
    """File `path` of a process in /proc; empty if the process has ended, even during the read."""
    try:
        return Path(f"/proc/{pid}/{path}").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def ignores_usr1(pid: int) -> bool:
    """Whether a process already ignores SIGUSR1; False if it has ended."""
    found = re.search(r"SigIgn:\s*(\w+)", about(pid, "status"))
    return found is not None and bool(int(found[1], 16) & SIGUSR1_IGNORED)


def children(pid: int) -> list[int]:
    return [int(pid) for pid in about(pid, f"task/{pid}/children").split()]


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize(
    "argv",
    [
        ["skytether", "fly"],
        ["skytether", "sweep", "--out", "swept"],
        ["server", "--bind", "127.0.0.1:0"],
        ["netem", "--bind", "127.0.0.1:0"],
        ["client", "--server", "127.0.0.1:9"],
    ],
    ids=lambda argv: " ".join(argv[:2]),
)
def test_sigusr1_ends_no_process_that_starts(argv: list[str], tmp_path: Path) -> None:
    """SIGUSR1 requests figures; before any exist, the signal must be ignored."""
    module = argv[0] if argv[0] == "skytether" else f"skytether.{argv[0]}"
    command = [sys.executable, "-P", "-m", module, *argv[1:]]
    with Popen(command, cwd=tmp_path, stdout=DEVNULL, stderr=DEVNULL) as process:
        until(lambda: ignores_usr1(process.pid))
        for _ in range(20):
            process.send_signal(signal.SIGUSR1)
            time.sleep(0.01)
        assert process.poll() is None
        process.terminate()
    assert process.returncode != -signal.SIGUSR1


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_and_its_processes_outlive_sigusr1() -> None:
    with begun("fly", *SHORT) as fly:
        until(lambda: ignores_usr1(fly.pid))
        while fly.poll() is None:
            for pid in (fly.pid, *children(fly.pid)):
                if ignores_usr1(pid):
                    # It may end between the two lines.
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGUSR1)
            time.sleep(0.02)
        out, err = fly.communicate()
    assert (fly.returncode, err) == (0, "")
    assert "RMSE" in out


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("count", "number"),
    [(1, signal.SIGINT), (2, signal.SIGTERM), (3, signal.SIGINT)],
)
def test_a_flight_that_is_ended_while_it_starts_leaves_nothing(
    count: int, number: int, tmp_path: Path
) -> None:
    folder = tmp_path / "tmp"
    folder.mkdir()
    # No horizon arrives: the flight cannot begin before the signal.
    environment = os.environ | {"TMPDIR": str(folder)}
    with begun("fly", "--network.uplink.loss", "1", env=environment) as fly:
        until(lambda: len(children(fly.pid)) >= count)
        started = children(fly.pid)
        fly.send_signal(number)
        out, err = fly.communicate(timeout=PATIENCE_S)
    assert (fly.returncode, out, err) == (130, "", "fly: interrupted before the first step\n")
    assert list(folder.iterdir()) == []
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)


@pytest.mark.long
@pytest.mark.realtime
def test_ctrl_c_while_a_command_is_imported_is_no_traceback() -> None:
    with begun("fly") as fly:
        until(lambda: ignores_usr1(fly.pid))  # imports have just begun
        fly.send_signal(signal.SIGINT)
        out, err = fly.communicate(timeout=PATIENCE_S)
    assert fly.returncode in (-signal.SIGINT, 130)
    assert (out, err) == ("", "")
