"""The contracts of `make check` hold for whole packages: no module of a core escapes them."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CORES = ("shared", "server", "client", "netem", "sim", "lab")
OTHERS = ("shell", "view", "skytether", "scenarios")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the sources and of the contracts."""
    for package in (*CORES, *OTHERS):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def name(module: Path, copy: Path) -> str:
    """Dotted name of a module by its file."""
    return ".".join(module.relative_to(copy).with_suffix("").parts).removesuffix(".__init__")


def cores(copy: Path) -> list[Path]:
    """Files of all core modules; a `__main__` is a process, and none of them."""
    files = (file for package in CORES for file in (copy / package).rglob("*.py"))
    return [file for file in files if file.name != "__main__.py"]


def append(line: str, files: Iterable[Path]) -> None:
    """Put a line at the end of each file."""
    for file in files:
        file.write_text(f"{file.read_text()}\n{line}\n")


def complaints(copy: Path, imported: str) -> set[str]:
    """Modules said to import `imported` against a contract; none where every contract is kept."""
    run = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    found = re.findall(rf"^ *-? *([\w.]+) -> {imported} \(l\.\d+\)", run.stdout, re.MULTILINE)
    assert bool(found) == (run.returncode != 0), run.stdout + run.stderr
    return set(found)


def test_the_sources_as_they_are_keep_every_contract(copy: Path) -> None:
    """A clock in the processes, which each build one endpoint and drive it, is allowed as well."""
    append("import time", copy.glob("*/__main__.py"))
    assert complaints(copy, "time") == set()


@pytest.mark.parametrize(
    ("line", "imported"),
    [
        ("import time", "time"),
        ("import random", "random"),
        ("import socket", "socket"),
        ("from shell import udp", r"shell(?:\.udp)?"),
    ],
)
def test_no_core_module_may_have_a_clock_a_socket_or_dice(
    line: str, imported: str, copy: Path
) -> None:
    """Each is named that has one."""
    append(line, cores(copy))
    assert complaints(copy, imported) == {name(module, copy) for module in cores(copy)}


@pytest.mark.parametrize("package", CORES)
def test_a_new_core_module_is_silent_as_well(package: str, copy: Path) -> None:
    """No list has to be kept of them."""
    (copy / package / "brand_new.py").write_text("import time\n")
    assert complaints(copy, "time") == {f"{package}.brand_new"}
