"""Contracts of `make check` hold for whole packages, including new modules of a core."""

import os
import re
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from helpers import ran

ROOT = Path(__file__).parents[2]
CORES = (
    *("shared", "quadrotor", "mavlink", "ros2", "server", "client", "netem", "autopilot"),
    *("sim", "figures", "view", "lab", "gym"),
)
WITHOUT_FILES = (
    *(
        "shared/law",
        "shared/endpoints",
        "shared/events",
        "quadrotor",
        "mavlink",
        "ros2",
        "server",
        "client",
        "netem",
    ),
    *("autopilot", "probe", "sim"),
)
"""Rooms whose modules import neither paths nor the operating system."""
DRIVERS = ("lab/commands", "view/browser", "gym/networked.py")
"""Packages within a core that drive processes, and the module that measures how long a policy
thinks; they are exempt."""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Copy of the packages, with folders in place of links, and of the contracts."""
    ignore = shutil.ignore_patterns("__pycache__")
    for package in ("skytether", "bench", "fuzz"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path / "skytether"


def name(module: Path, copy: Path) -> str:
    parts = module.relative_to(copy.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def cores(copy: Path, rooms: Iterable[str]) -> list[Path]:
    """Files of all core modules of some rooms, without `__main__` modules."""
    files = (file for room in rooms for file in (copy / room).rglob("*.py"))
    drivers = tuple(copy / room for room in DRIVERS)
    return [
        file
        for file in files
        if file.name != "__main__.py" and not any(map(file.is_relative_to, drivers))
    ]


def append(lines: str, files: Iterable[Path]) -> None:
    for file in files:
        file.write_text(f"{file.read_text()}\n{lines}\n")


def complaints(copy: Path, *imported: str) -> list[set[str]]:
    """Modules reported to import each of `imported` against a contract; empty if all are kept."""
    lint = Path(sys.executable).with_name("lint-imports")
    environment = {**os.environ, "PYTHONPATH": str(copy.parent), "COLUMNS": "200"}
    run = ran(lint, "--no-cache", cwd=copy.parent, env=environment)
    found = [
        set(re.findall(rf"^ *-? *([\w.]+) -> {each} \(l\.\d+\)", run.stdout, re.MULTILINE))
        for each in imported
    ]
    assert any(found) == (run.returncode != 0), run.stdout + run.stderr
    return found


@pytest.mark.long
def test_every_core_module_is_named_for_a_clock_a_socket_dice_paths_or_the_system(
    copy: Path,
) -> None:
    """Also a new module: there is no list to maintain."""
    forbidden = {
        "import time": "time",
        "import random": "random",
        "import socket": "socket",
        "from skytether.shell import udp": r"skytether\.shell(?:\.udp)?",
    }
    for room in CORES:
        (copy / room / "brand_new.py").touch()
    silent, without_files = cores(copy, CORES), cores(copy, WITHOUT_FILES)
    append("\n".join(forbidden), silent)
    append("import os\nimport pathlib", without_files)
    found = complaints(copy, *forbidden.values(), "os", "pathlib")
    every = {name(module, copy) for module in silent}
    assert found[:4] == [every] * 4
    assert found[4:] == [{name(module, copy) for module in without_files}] * 2
