"""Plug-ins: users' Python code that adds names for scenarios (`shared.scenario.registry`).

A plug-in is a file (`--plugin FILE`), or an installed package that declares entry points. Plug-ins
are imported before a scenario is read; the child processes of a command import the same files. A
plug-in runs with all rights of the user.
"""

import hashlib
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from skytether.shared.base import input_files
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.registry import (
    IMPAIRMENTS,
    PLANNERS,
    PLUGIN_TABLES,
    REFERENCES,
    SCHEMES,
    TRIGGERS,
    VEHICLES,
)

FLAG = "--plugin"
FILE_BYTES_MAX = 1_000_000
GROUPS = {
    "skytether.schemes": SCHEMES,
    "skytether.planners": PLANNERS,
    "skytether.triggers": TRIGGERS,
    "skytether.references": REFERENCES,
    "skytether.vehicles": VEHICLES,
    "skytether.impairments": IMPAIRMENTS,
}
"""Tables that plug-ins extend, by group of entry points."""


class Plugin(NamedTuple):
    path: str
    """Absolute path of the file, which is also the name of the module."""
    code: bytes


_loaded: dict[str, Plugin] = {}


def named(argv: Sequence[str]) -> list[str]:
    """Plug-in files named on a command line. They are imported before other flags are parsed."""
    return flag_values(argv, FLAG)[0]


def flag_values(argv: Sequence[str], flag: str) -> tuple[list[str], list[str]]:
    """Values of a flag on a command line, and all other words; the flag without value is a word."""
    words, values, rest = deque(argv), list[str](), list[str]()
    while words:
        word = words.popleft()
        if word == flag and words and not words[0].startswith("-"):
            values.append(words.popleft())
        elif word.startswith(f"{flag}="):
            values.append(word.removeprefix(f"{flag}="))
        else:
            rest.append(word)
    return values, rest


def load(paths: Iterable[str] = ()) -> None:
    """Import the plug-ins of installed packages (once per process), and plug-in files.

    Raises:
        ConfigError: a plug-in cannot be read or imported, adds nothing, or adds an existing name.
    """
    _load_installed()
    for path in paths:
        try:
            code = input_files.read(Path(path), FILE_BYTES_MAX)
        except OSError as error:
            raise ConfigError(f"{FLAG}: {path}: cannot be read: {error.strerror}") from None
        except ValueError as error:
            raise ConfigError(f"{FLAG}: {path}: cannot be read: {error}") from None
        use([Plugin(str(Path(path).absolute()), code)])


def loaded() -> tuple[Plugin, ...]:
    """Plug-in files that this process has imported, as arguments of `use` in another process."""
    return tuple(_loaded.values())


def flags() -> list[str]:
    return [word for path in _loaded for word in (FLAG, path)]


def use(plugins: Iterable[Plugin]) -> None:
    """Import installed plug-ins, and plug-in files that this or another process has read."""
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
        for table in PLUGIN_TABLES:  # remove entries of an older version of the file
            for name in [name for name, entry in table.items() if entry.source == path]:
                del table[name]
        _guarded(run, f"{FLAG}: {path}", path)
        version, added = hashlib.blake2b(code, digest_size=8).hexdigest(), 0
        for table in PLUGIN_TABLES:
            for name, entry in table.items():
                if entry.source == path:
                    table[name], added = replace(entry, version=version), added + 1
        if not added:
            kinds = "@planner, @trigger, @scheme, @reference, @vehicle or @impairment"
            expected = f"{kinds} on a function or class, see docs"
            raise ConfigError(f"{FLAG}: {path}: adds nothing, expected {expected}")


@cache
def _load_installed() -> None:
    if not any(_mention_groups(Path(folder)) for folder in sys.path):
        return
    from importlib import metadata  # the import takes 0.1 s

    for group, table in GROUPS.items():
        for point in sorted(metadata.entry_points(group=group)):
            dist = point.dist
            version = f"{dist.name} {dist.version}" if dist else ""
            where = f"entry point {point.name} = {point.value} of {version}"
            with _tables(where):
                function = _guarded(point.load, where)
                present = table.get(point.name)
                if present is None or present.make is not function:
                    table.add(function, point.name)
                table[point.name] = replace(table[point.name], version=version)


def _mention_groups(folder: Path) -> bool:
    words = [f"[{group}]".encode() for group in GROUPS]
    for points in folder.glob("*-info/entry_points.txt"):
        with suppress(OSError):
            content = points.read_bytes()
            if any(word in content for word in words):
                return True
    return False


@contextmanager
def _tables(where: str) -> Iterator[None]:
    """If the block fails, restore all tables of names, and name the plug-in in the error."""
    before = [dict(table) for table in PLUGIN_TABLES]
    try:
        yield
    except BaseException as error:
        for table, entries in zip(PLUGIN_TABLES, before, strict=True):
            table.clear()
            table.update(entries)
        if isinstance(error, ConfigError) and not str(error).startswith(where):
            raise ConfigError(f"{where}: {error}") from None
        raise


def _guarded(run: Callable[[], Any], where: str, path: str = "") -> Any:
    """Run a plug-in's code; any exception becomes a ConfigError of one line."""
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
