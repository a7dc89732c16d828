"""Plug-ins: Python of one's own that adds to what a scenario can name (`shared.scenario.registry`).

A plug-in is a file (`--plugin FILE`), or an installed package that says so by its entry points.
All are imported before a scenario is read; processes that a command starts are given the same
files. What is imported runs with all rights of the user.
"""

import hashlib
import sys
import traceback
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from skytether.shared.base import files
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.registry import (
    IMPAIRMENTS,
    REFERENCES,
    TABLES,
    TRIGGERS,
    VEHICLES,
)

FLAG = "--plugin"
FILE_BYTES_MAX = 1_000_000
"""Largest size of a plug-in's file [B]."""
GROUPS = {
    "skytether.triggers": TRIGGERS,
    "skytether.references": REFERENCES,
    "skytether.vehicles": VEHICLES,
    "skytether.impairments": IMPAIRMENTS,
}
"""Groups of entry points, and the tables that they add to."""


class Plugin(NamedTuple):
    """A plug-in that is a file."""

    path: str
    """Absolute path, which is the name of its module, too."""
    code: bytes
    """Content of the file."""


_loaded: dict[str, Plugin] = {}


def named(argv: Sequence[str]) -> list[str]:
    """Files that a command line names as plug-ins, before anything else of it is read."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument(FLAG, action="append", default=[])
    with suppress(ArgumentError):  # a flag without its file: whoever reads the rest will say so
        return parser.parse_known_args(list(argv))[0].plugin
    return []


def load(paths: Iterable[str] = ()) -> None:
    """Import plug-ins: installed packages', once in a process, and files.

    Raises:
        ConfigError: one cannot be read or imported, adds nothing, or a name that there is.
    """
    _load_installed()
    for path in paths:
        try:
            code = files.read(Path(path), FILE_BYTES_MAX)
        except OSError as error:
            raise ConfigError(f"{FLAG}: {path}: cannot be read: {error.strerror}") from None
        except ValueError as error:
            raise ConfigError(f"{FLAG}: {path}: cannot be read: {error}") from None
        use([Plugin(str(Path(path).absolute()), code)])


def loaded() -> tuple[Plugin, ...]:
    """Files that this process has imported, for others to `use`."""
    return tuple(_loaded.values())


def flags() -> list[str]:
    """Arguments with which a process imports the same files."""
    return [word for path in _loaded for word in (FLAG, path)]


def use(plugins: Iterable[Plugin]) -> None:
    """Import plug-ins that were read, maybe by another process; installed ones, too.

    Raises:
        ConfigError: see `load`.
    """
    _load_installed()
    for plugin in plugins:
        if _loaded.get(plugin.path) != plugin:
            _import(plugin)
            _loaded[plugin.path] = plugin


def _import(plugin: Plugin) -> None:
    path, code = plugin
    module = ModuleType(path)
    module.__file__ = path

    def run() -> None:
        sys.modules[path] = module
        exec(compile(code, path, "exec"), module.__dict__)

    with _tables(f"{FLAG}: {path}"):
        for table in TABLES:  # of an older content of the file
            for name in [name for name, entry in table.items() if entry.source == path]:
                del table[name]
        _guarded(run, f"{FLAG}: {path}", path)
        version, found = hashlib.blake2b(code, digest_size=8).hexdigest(), 0
        for table in TABLES:
            for name, entry in table.items():
                if entry.source == path:
                    table[name], found = replace(entry, version=version), found + 1
        if not found:
            expected = "@trigger, @reference, @vehicle or @impairment on something, see docs"
            raise ConfigError(f"{FLAG}: {path}: adds nothing, expected {expected}")


@cache
def _load_installed() -> None:
    """Import what installed packages add by their entry points.

    Raises:
        ConfigError: see `load`.
    """
    if not any(_mention_groups(Path(folder)) for folder in sys.path):
        return
    from importlib import metadata  # takes 0.1 s, with all that it reads

    for group, table in GROUPS.items():
        for point in sorted(metadata.entry_points(group=group)):
            dist = point.dist
            version = f"{dist.name} {dist.version}" if dist else ""
            where = f"entry point {point.name} = {point.value} of {version}"
            with _tables(where):
                made = _guarded(point.load, where)
                there = table.get(point.name)
                if there is None or there.make is not made:
                    table.add(made, point.name)
                table[point.name] = replace(table[point.name], version=version)


def _mention_groups(folder: Path) -> bool:
    """Whether a package in a folder of packages has entry points of ours."""
    words = [f"[{group}]".encode() for group in GROUPS]
    for points in folder.glob("*-info/entry_points.txt"):
        with suppress(OSError):
            content = points.read_bytes()
            if any(word in content for word in words):
                return True
    return False


@contextmanager
def _tables(where: str) -> Iterator[None]:
    """Leave all tables as they were where something goes wrong, and say where it did."""
    before = [dict(table) for table in TABLES]
    try:
        yield
    except BaseException as error:
        for table, entries in zip(TABLES, before, strict=True):
            table.clear()
            table.update(entries)
        if isinstance(error, ConfigError) and not str(error).startswith(where):
            raise ConfigError(f"{where}: {error}") from None
        raise


def _guarded(run: Callable[[], Any], where: str, path: str = "") -> Any:
    """Run a plug-in's code, with one line for whatever it raises.

    Args:
        path: its file, for the number of the line.

    Raises:
        ConfigError: it has raised something.
    """
    try:
        return run()
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == path]
        if isinstance(error, SyntaxError) and error.filename == path:
            lines = [error.lineno]
        at = f"line {lines[-1]}: " if lines else ""
        what = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ConfigError(f"{where}: {at}{type(error).__name__}: {what}") from None
