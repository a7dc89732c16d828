"""The contracts of `make check` hold for whole packages: no module of a core escapes them."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORES = (
    *("shared", "quadrotor", "mavlink", "server", "client", "netem", "autopilot"),
    *("sim", "figures", "view", "lab"),
)
WITHOUT_FILES = (
    *("shared/law", "shared/core", "quadrotor", "mavlink", "server", "client", "netem"),
    *("autopilot", "station", "probe", "sim"),
)
"""Rooms whose modules import neither paths nor the operating system."""
DRIVERS = ("lab/commands", "view/browser")
"""Rooms within a core that drive processes, and are none themselves."""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the packages, in which links are folders, and of the contracts."""
    ignore = shutil.ignore_patterns("__pycache__")
    for package in ("skytether", "bench", "fuzz"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path / "skytether"


def name(module: Path, copy: Path) -> str:
    """Dotted name of a module by its file."""
    parts = module.relative_to(copy.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def cores(copy: Path, rooms: Iterable[str] = CORES) -> list[Path]:
    """Files of all core modules of some rooms; a `__main__` is a process, and none of them."""
    files = (file for room in rooms for file in (copy / room).rglob("*.py"))
    drivers = tuple(copy / room for room in DRIVERS)
    return [
        file
        for file in files
        if file.name != "__main__.py" and not any(map(file.is_relative_to, drivers))
    ]


def append(line: str, files: Iterable[Path]) -> None:
    """Put a line at the end of each file."""
    for file in files:
        file.write_text(f"{file.read_text()}\n{line}\n")


def complaints(copy: Path, *imported: str) -> list[set[str]]:
    """Modules said to import each of `imported` against a contract; none where all are kept."""
    run = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=copy.parent,
        env={**os.environ, "PYTHONPATH": str(copy.parent), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    found = [
        set(re.findall(rf"^ *-? *([\w.]+) -> {each} \(l\.\d+\)", run.stdout, re.MULTILINE))
        for each in imported
    ]
    assert any(found) == (run.returncode != 0), run.stdout + run.stderr
    return found


def test_the_sources_as_they_are_keep_every_contract(copy: Path) -> None:
    """A clock in the processes, which each build one endpoint and drive it, is allowed as well."""
    append("import time", copy.glob("*/__main__.py"))
    assert complaints(copy, "time") == [set()]


def test_no_core_module_may_have_a_clock_a_socket_or_dice(copy: Path) -> None:
    """Each is named that has one, for each that it has."""
    forbidden = {
        "import time": "time",
        "import random": "random",
        "import socket": "socket",
        "from skytether.shell import udp": r"skytether\.shell(?:\.udp)?",
    }
    append("\n".join(forbidden), cores(copy))
    every = {name(module, copy) for module in cores(copy)}
    assert complaints(copy, *forbidden.values()) == [every] * len(forbidden)


def test_no_end_may_import_paths_or_the_operating_system(copy: Path) -> None:
    append("import os\nimport pathlib", cores(copy, WITHOUT_FILES))
    every = {name(module, copy) for module in cores(copy, WITHOUT_FILES)}
    assert complaints(copy, "os", "pathlib") == [every] * 2


def test_a_new_core_module_is_silent_as_well(copy: Path) -> None:
    """No list has to be kept of them."""
    for package in CORES:
        (copy / package / "brand_new.py").write_text("import time\n")
    assert complaints(copy, "time") == [{f"skytether.{package}.brand_new" for package in CORES}]
