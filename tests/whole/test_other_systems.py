"""What works on systems that lack what Linux has, and what says that it does not."""

import sys
from pathlib import Path

import pytest

from helpers import ran

RUNS = sys.executable, "-P", Path(__file__).parents[1] / "other_system.py"


@pytest.mark.parametrize("system", ["macos", "windows"])
def test_every_module_is_imported_and_virtual_time_gym_and_relay_work(system: str) -> None:
    done = ran(*RUNS, system, "--everything")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(" m\n")


@pytest.mark.parametrize("system", ["macos", "windows"])
@pytest.mark.parametrize(
    "command", ["--help", "fly --help", "netem --help", "fly demo --virtual --duration 2"]
)
def test_commands_run(system: str, command: str) -> None:
    done = ran(*RUNS, system, *command.split())
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.parametrize(
    "command",
    [
        *("fly demo --duration 2", "netem run -- true", "page .", "set nothing a=b"),
        "server demo --workers 2",
    ],
)
def test_what_a_system_cannot_do_is_said_in_one_line(command: str) -> None:
    done = ran(*RUNS, "windows", *command.split())
    assert done.returncode
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1
