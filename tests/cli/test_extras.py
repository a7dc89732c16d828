"""Extras: each command runs with the extras that it needs, and names a missing one in one line."""

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

import skytether
from helpers import ran, refused
from skytether.__main__ import COMMANDS
from skytether.shared.base import extras
from skytether.shared.base.extras import MODULES

ALL = (
    *("server", "mavlink", "ros2", "page", "plot", "record", "pandas", "parquet", "cluster"),
    *("gym", "lab", "ulog", "policy"),
)
LAB = (
    *("sweep", "margins", "identify", "reproduce"),
    *("compare", "calibrate", "explain"),
)
BARE = ("client", "netem", "keygen", "set", "probe", "completion", "list")
NEEDS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(BARE, ()),
    "server": ("server",),
    "autopilot": ("mavlink", "server"),
    "fly": ("server",),
    "fleet": ("server",),
    "duel": ("server", "page"),
    "page": ("page",),
    "ros2": ("ros2",),
    "policy": ("policy",),
    "replay": ("page", "record"),
    "export": ("record",),
    "join": ("record",),
    "report": ("record",),
    **dict.fromkeys(LAB, ("lab",)),
}
"""Extras that the help of each command needs: everything imported before it parses its options."""

BROUGHT = {"osqp": "jinja2", "viser": "zstandard"}
"""Packages that bring a package which another extra requires."""

RUN = """
import sys

sys.modules |= dict.fromkeys(sys.argv.pop(1).split(","))
from skytether.__main__ import main

sys.exit(main())
"""


def packages(*names: str) -> set[str]:
    found = {module for name in names for module in extras._extras()[name]}
    return found | {BROUGHT[one] for one in found & BROUGHT.keys()}


def run(argv: list[str], installed: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    """Run a command with only these extras installed."""
    missing = packages(*ALL) - packages(*installed) or {"none"}
    return ran(sys.executable, "-P", "-c", RUN, ",".join(missing), *argv)


def refusal(prog: str, module: str, extra: str) -> str:
    return f"{prog}: {extras.ExtraMissing(module, extra)}\n"


def test_every_command_has_its_needs_told_here() -> None:
    assert set(NEEDS) == set(COMMANDS)


@pytest.mark.long
def test_every_package_that_is_imported_is_asked_for() -> None:
    """Requirements name every imported package, independently of other packages' requirements."""
    asked = {re.split("[^a-z0-9_-]", one)[0] for one in metadata.requires("skytether") or ()}
    ours = {"skytether", *(MODULES.get(name, name.replace("-", "_")) for name in asked)}
    imported = set()
    for folder, _, files in os.walk(Path(skytether.__file__).parent, followlinks=True):
        for file in files:
            if file.endswith(".py"):
                imported |= set(_imports(ast.parse(Path(folder, file).read_text())))
    assert imported > {"numpy", "mcap"}
    assert imported - sys.stdlib_module_names <= ours


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module).partition(".")[0]


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(name, marks=() if name in ("client", "fly") else pytest.mark.long)
        for name in NEEDS
        if name not in LAB[1:]
    ],
)
def test_a_command_runs_with_what_it_needs_and_names_what_it_misses(command: str) -> None:
    """Without extras the command ends with 2 and one line; with its own it prints its help.

    One command of the laboratory stands for all, because their package checks the extra.
    """
    shown = run([command, "vehicles" if command == "list" else "--help"], NEEDS[command])
    assert (shown.returncode, shown.stderr) == (0, "")
    if not NEEDS[command]:
        return
    missing = run([command, "--help"], ())
    lines = {
        refusal(command, module, extra) for extra in NEEDS[command] for module in packages(extra)
    }
    assert (missing.returncode, missing.stdout) == (2, "")
    assert missing.stderr in lines


@pytest.mark.parametrize(
    ("argv", "module", "extra"),
    [
        (["fly", "--virtual", "--figure", "a.png"], "matplotlib", "plot"),
        (["fleet", "--virtual", "--figure", "a.png"], "matplotlib", "plot"),
        (["export", "a.mcap", "--parquet", "tables"], "pyarrow", "parquet"),
    ],
)
def test_an_option_names_the_extra_that_it_misses_before_anything_flies(
    argv: list[str],
    module: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    assert f"{refused(argv, capfd)}\n" == refusal(argv[0], module, extra)


@pytest.mark.long
@pytest.mark.parametrize(
    ("argv", "installed"),
    [
        (["fly", "--virtual", "--record", "a.mcap"], ("server",)),
        (["client", "--record", "a.mcap"], ()),
        (["netem", "--record", "a.mcap"], ()),
        (["server", "--record", "a.mcap"], ("server",)),
    ],
    ids=lambda words: words[0] if words else "",
)
def test_a_recording_names_the_extra_that_it_misses_before_anything_flies(
    argv: list[str], installed: tuple[str, ...]
) -> None:
    missing = run(argv, installed)
    assert (missing.returncode, missing.stdout) == (2, "")
    assert missing.stderr in {refusal(argv[0], module, "record") for module in packages("record")}


def test_a_library_call_names_the_extra_too(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("mcap", "json.tool", "pytest"):
        monkeypatch.setitem(sys.modules, module, None)
    smallest = pytest.raises(extras.ExtraMissing, match=r"^mcap is not .*'skytether\[record\]'")
    with smallest, extras.named():
        import mcap  # noqa: F401
    with pytest.raises(ModuleNotFoundError, match=r"json\.tool") as caught, extras.named():
        import json.tool  # noqa: F401
    assert type(caught.value) is ModuleNotFoundError
    with pytest.raises(extras.ExtraMissing, match=r"^mcap is not .*'skytether\[lab\]'"):
        extras.need("lab")
