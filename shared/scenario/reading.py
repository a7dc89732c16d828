"""Reading a scenario from a TOML file, with the scenarios it extends and the files it names.

A scenario with `extends = "other"` (name of a built-in scenario, or of a file in the same folder)
contains only its differences from that scenario. Every value is checked here, and every file that a
scenario names is read here, so that endpoints open no files. `skytether list scenarios` lists the
built-in scenarios.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from skytether import scenarios
from skytether.shared.base import input_files, toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint, short
from skytether.shared.scenario import registry, rooms, schema
from skytether.shared.scenario.contradictions import contradictions
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import IMPAIRMENTS, File, Files, PluginTable
from skytether.shared.scenario.schema import Contradiction, NetworkConfig
from skytether.shared.scenario.whole import Scenario, WithFiles

SCENARIOS = Path(scenarios.__file__).parent
EXTENDS_MAX = 20
"""Largest number of scenarios that extend each other in a chain."""
FILES: Mapping[str, tuple[PluginTable, int]] = MappingProxyType(
    {
        "network.uplink": (IMPAIRMENTS, 128 * 1024 * 1024),
        "network.downlink": (IMPAIRMENTS, 128 * 1024 * 1024),
        **rooms.FILES,
    }
)
"""Keys whose text may name files, each with the table of entries allowed in the text, and the
largest size of a file [B]."""
TABLE_BYTES_MAX, LOG_BYTES_MAX = 16_000_000, 64_000_000
"""Largest size of `reference.file` [B] if it is a table, and if it is an autopilot's log."""
LOGS = (".ulg", ".bin")
WAYS = ("uplink", "downlink")
COMPARED = "compare"
"""Name of the file with the scenarios of `skytether compare`."""


def names(file: str = "") -> list[str]:
    """Names of the built-in scenarios, or of the scenarios in a file.

    Args:
        file: COMPARED, or path of a file with one scenario per table; empty: built-in scenarios.

    Raises:
        ConfigError: the file cannot be read.
    """
    if file:
        return [f"{file}/{name}" for name in read_toml(_path(file), file)]
    files = (each.name for each in SCENARIOS.iterdir())
    named = {name.removesuffix(".toml") for name in files if name.endswith(".toml")}
    return sorted(named - {COMPARED})


def load(name: str) -> Scenario:
    """Load a scenario by name, or from a file by path (any text that ends in .toml).

    If a file has several scenarios, a scenario is named by file and table:
    `compare/paper-event-gusts`.

    Raises:
        ConfigError: the scenario does not exist or is invalid.
    """
    return _without_contradictions(load_base(name), name)


def load_base(name: str) -> Scenario:
    """Load a scenario like `load`, but without a check for contradictions.

    Command-line flags are applied next, and may resolve a contradiction of the file. `check` then
    checks the final values.

    Raises:
        ConfigError: the scenario does not exist, or a value is invalid.
    """
    return convert(_read(name), name)


def check(
    raw: Mapping[str, Any],
    source: str = "",
    *,
    checked: schema.Scenario | None = None,
    any_network: bool = False,
) -> Scenario:
    """Make a scenario from a table of plain values, and check it for contradictions.

    Args:
        raw: the table.
        source: origin of the values, a file or the command line, for messages.
        checked: a scenario that was checked before; if the new scenario has the same desired
            trajectory, files are not read again.
        any_network: whether a network too slow or too lossy for a flight is allowed.

    Raises:
        ConfigError: the first error.
    """
    scenario = convert(raw, source)
    return _without_contradictions(scenario, source, checked=checked, any_network=any_network)


def convert(raw: Mapping[str, Any], source: str = "") -> Scenario:
    """Make a scenario from a table of plain values, checking only single values; see `check`.

    Raises:
        ConfigError: the first invalid value.
    """
    raw = _with_paths(_with_texts(raw, source), source)
    try:
        scenario = msgspec.convert(raw, Scenario)
    except msgspec.ValidationError as error:
        from skytether.shared.scenario.wrong_values import explain

        why = explain(str(error), raw, Scenario)
        raise ConfigError(f"{_where(source)}{why}") from None
    _refuse_first(_infinite(to_table(scenario)), source)
    several = scenario.network.paths if len(scenario.network.paths) > 1 else ()
    network = msgspec.structs.replace(scenario.on_path(0).network, paths=several)
    return msgspec.structs.replace(scenario, network=network)


def _without_contradictions(
    scenario: Scenario,
    source: str,
    *,
    checked: schema.Scenario | None = None,
    any_network: bool = False,
) -> Scenario:
    """Scenario with its files; raises ConfigError if it has contradictions, see `check`."""
    scenario = _with_files(scenario, source, checked)
    _refuse_first(contradictions(scenario, checked, any_network=any_network), source)
    return scenario


def _refuse_first(wrong: Iterator[Contradiction], source: str) -> None:
    for key, given, expected in wrong:
        raise ConfigError(f"{_where(source)}{key}: got {short(str(given))}, expected {expected}")


def _where(source: str) -> str:
    return f"{source}: " if source else ""


def to_table(scenario: schema.Scenario) -> dict[str, Any]:
    """Plain values of a scenario, from which `check` makes an equal scenario."""
    return {
        name: msgspec.to_builtins(getattr(scenario, name)) for name in Scenario.__struct_fields__
    }


def to_toml(scenario: schema.Scenario) -> bytes:
    return msgspec.toml.encode(to_table(scenario))


def _read(name: str, seen: Mapping[tuple[Path, str], str] = MappingProxyType({})) -> dict[str, Any]:
    """Raw table of a scenario, merged with the tables of the scenarios that it extends.

    Args:
        name: name or path of the scenario.
        seen: scenarios that extend this one, directly or indirectly; this scenario must extend none
            of them.
    """
    file, _, entry = name.rpartition("/")
    if name.endswith(".toml") or name in names():
        file, entry = name, ""
    elif not (entry and (file == COMPARED or file.endswith(".toml"))):
        with suppress(OSError):  # the name is too long for a file
            if Path(name).exists():
                expected = "expected the name of a scenario, or a file that ends in .toml"
                raise ConfigError(f"{name}: {expected}")
        raise ConfigError(f"{name}: no such scenario; {hint(name, names())}")
    path = _path(file)
    raw = read_toml(path, file)
    if entry:
        if not isinstance(raw.get(entry), dict):
            raise ConfigError(f"{name}: no such scenario; {hint(entry, raw)}")
        raw = raw[entry]
    if (path, entry) in seen:
        circle = " → ".join([*seen.values(), name])
        raise ConfigError(f"{seen[path, entry]}: extends: got a circle of {circle}")
    if len(seen) > EXTENDS_MAX:
        raise ConfigError(f"{name}: extends: got a chain of more than {EXTENDS_MAX} scenarios")
    _relative_to(path.parent.absolute(), raw)
    base = raw.pop("extends", None)
    if base is None:
        return raw
    if not isinstance(base, str):
        raise ConfigError(f"{name}: extends: got {base!r}, expected the name of a scenario")
    if ".toml" in base:
        base = str(path.parent / base)
    return _overlay(_read(base, {**seen, (path, entry): name}), raw, name)


def _relative_to(folder: Path, raw: dict[str, Any], prefix: str = "") -> None:
    """Replace the file names in a raw table by full paths; the names are relative to a folder."""
    for name, value in raw.items():
        key = f"{prefix}{name}"
        if isinstance(value, dict):
            _relative_to(folder, value, f"{key}.")
        elif key == "network.paths" and isinstance(value, list):
            for path in value:
                if isinstance(path, dict):
                    _relative_to(folder, path, prefix)
        elif key == "reference.file" and isinstance(value, str) and value:
            raw[name] = str(folder / value)
        elif key in FILES and isinstance(value, str):
            with suppress(GrammarError):  # reported by `check`
                raw[name] = FILES[key][0].with_files(value, lambda file: str(folder / file))


def _with_files(scenario: Scenario, source: str, checked: schema.Scenario | None) -> Scenario:
    """Scenario with the contents of the files that it names; raises ConfigError if a file cannot be
    read.
    """
    before = _naming_files(checked) if checked else ()
    contents: dict[str, File] = {}
    for key, text in _naming_files(scenario):
        if key == "reference.file" and scenario.reference.shape not in rooms.FROM_FILE:
            continue
        with suppress(GrammarError):  # reported by `contradictions`
            own = checked.files if checked and (key, text) in before else ()
            contents |= {file.name: file for file in files_of(key, text, source, own)}
    if not contents:
        return scenario
    return WithFiles(**msgspec.structs.asdict(scenario), contents=tuple(contents.values()))


def _naming_files(scenario: schema.Scenario) -> list[tuple[str, str]]:
    """Keys whose values may name files, with the values; network keys once for each path."""
    return [
        ("reference.file", scenario.reference.file),
        *((f"network.{way}", getattr(path, way)) for path in scenario.paths for way in WAYS),
        *((key, str(_value(scenario, key))) for key in FILES if not key.startswith("network.")),
    ]


def _value(scenario: schema.Scenario, key: str) -> Any:
    """Value of a key in an optional package's section; empty if the package is not installed."""
    section, _, name = key.partition(".")
    return getattr(getattr(scenario, section, None), name, "")


def files_of(key: str, text: str, source: str = "", have: Files = ()) -> Files:
    """Files that the value of a key names, with their contents.

    Args:
        key: `reference.file`, or one of FILES.
        text: value of the key.
        source: origin of the value, a file or the command line, for messages.
        have: files read before.

    Raises:
        ConfigError: a file cannot be read.
        GrammarError: the text is invalid.
    """
    is_log = text.lower().endswith(LOGS)
    table, most = FILES.get(key, (None, LOG_BYTES_MAX if is_log else TABLE_BYTES_MAX))
    read = {file.name: file for file in have}
    return tuple(
        read.get(name) or File(name, _content(f"{_where(source)}{key}", name, most))
        for name in (table.files(text) if table else [text])
    )


def _content(where: str, name: str, most: int) -> bytes:
    try:
        path = Path(name)
        if path.is_dir():
            content: bytes = registry.load("skytether.shared.base.folders", name).zipped(path, most)
            return content
        return input_files.read(path, most)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        expected = f"a file that can be read ({reason})"
        raise ConfigError(f"{where}: got {short(repr(name))}, expected {expected}") from None


def _with_texts(raw: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Raw table in which arguments given as keys, such as `network.uplink.loss`, replace the
    arguments in the default texts.
    """
    default = to_table(Scenario())
    for key in rooms.TEXTS:
        section, name = key.split(".")
        below = raw.get(section)
        if isinstance(below, Mapping) and isinstance(below.get(name), Mapping):
            text = _with_arguments(key, default[section][name], below[name], source)
            raw = {**raw, section: {**below, name: text}}
    return dict(raw)


def _with_paths(raw: dict[str, Any], source: str) -> dict[str, Any]:
    """Raw table in which every path has both directions, by default those of the network."""
    network: Any = raw.get("network")
    paths = network.get("paths") if isinstance(network, Mapping) else None
    if not (isinstance(paths, list | tuple) and all(isinstance(each, Mapping) for each in paths)):
        return raw  # no paths, or paths of a wrong type, which other code refuses
    both = {way: getattr(NetworkConfig(), way) for way in WAYS}
    both |= {way: network[way] for way in WAYS if way in network}
    whole = [_overlay(both, dict(each), source, "network.") for each in paths]
    return {**raw, "network": {**network, "paths": whole}}


def _with_arguments(key: str, text: str, arguments: Mapping[str, Any], source: str) -> str:
    from skytether.shared.scenario.dotted import flat, with_argument

    try:
        for path, value in flat(arguments, f"{key}."):
            text = with_argument(key, text, path, value)
    except ConfigError as error:
        raise ConfigError(f"{_where(source)}{error}") from None
    return text


def _path(file: str) -> Path:
    if not file.endswith(".toml"):
        return SCENARIOS / f"{file}.toml"
    try:
        return Path(file).resolve()
    except (ValueError, OSError, RuntimeError) as error:  # a NUL in the name, or a cycle of links
        raise ConfigError(f"{file}: cannot be read: {error}") from None


def read_toml(path: Path, file: str) -> dict[str, Any]:
    try:
        return toml.loads(input_files.read(path, toml.BYTES_MAX).decode())
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{file}: no valid TOML: {error}") from None


def _overlay(
    below: dict[str, Any], above: dict[str, Any], source: str, prefix: str = ""
) -> dict[str, Any]:
    """Merge two raw tables. Values in `above` take precedence; an argument that `above` sets by a
    key replaces the argument in the text.
    """
    merged = dict(below)
    for name, value in above.items():
        key, old = f"{prefix}{name}", merged.get(name)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[name] = _overlay(old, value, source, f"{key}.")
        elif isinstance(old, str) and isinstance(value, dict) and key in rooms.TEXTS:
            merged[name] = _with_arguments(key, old, value, source)
        else:
            merged[name] = value
    return merged


def _infinite(value: object, key: str = "") -> Iterator[Contradiction]:
    """Contradictions for infinite numbers and NaN, which TOML allows."""
    if isinstance(value, float) and not math.isfinite(value):
        yield key, value, "a finite number"
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _infinite(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _infinite(inner, f"{key}[{index}]")
