"""Dotted keys such as `control.horizon`, for reading and setting values in nested tables.

A key may also address an argument in a text: `network.uplink.loss` is the first argument of `loss`
in `network.uplink`, and `control.trigger.state_gap.decay_rate` the argument `decay_rate`.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario import arguments
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.rooms import TEXTS


def flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def set_keys(changes: Mapping[str, Any], table: dict[str, Any]) -> None:
    """Set values by dotted key in a nested table, in place.

    Raises:
        ConfigError: a key is unknown, a text has no such argument, or a key of the network is set
            although there are several paths.
    """
    for path, value in changes.items():
        network = table.get("network")
        paths = network.get("paths") if isinstance(network, dict) else None
        if paths and text_key(path) in ("network.uplink", "network.downlink"):
            raise ConfigError(f"{path}: got {value!r}, expected a value per path in network.paths")
        *sections, key = path.split(".")
        section: Any = table
        for depth, name in enumerate(sections):
            text = ".".join(sections[: depth + 1])
            below = section.setdefault(name, {})
            if isinstance(below, str) and text in TEXTS:
                section[name] = with_argument(text, below, path, value)
                break
            if not isinstance(below, dict):
                raise ConfigError(f"{path}: no such key")
            section = below
        else:
            section[key] = value


def text_key(key: str) -> str:
    """Key of the text, if `key` addresses an argument of a text; otherwise `key` itself."""
    return next((each for each in TEXTS if key.startswith(f"{each}.")), key)


def value(table: Any, key: str) -> Any:
    """Value of a dotted key.

    Raises:
        KeyError, TypeError: there is no such key.
        GrammarError: the key addresses an argument in an invalid text.
    """
    *sections, last = key.split(".")
    for depth, name in enumerate(sections):
        table, text = table[name], ".".join(sections[: depth + 1])
        if isinstance(table, str) and text in TEXTS:
            return arguments.argument(TEXTS[text], table, key.removeprefix(f"{text}."))
    return table[last]


def with_argument(key: str, text: str, path: str, value: object) -> str:
    """Text with one argument changed.

    Args:
        key: dotted key of the text.
        text: present text.
        path: dotted key of the argument.
        value: new value of the argument.

    Raises:
        ConfigError: the text has no such argument.
    """
    table, at = TEXTS[key], path.removeprefix(f"{key}.")
    try:
        return arguments.with_argument(table, text, at, value)
    except KeyError:
        name, _, last = at.partition(".")
        names = [each.name for each in table[name].parameters] if name in table else list(table)
        suggestion = hint(last if name in table else name, names)
        raise ConfigError(f"{path}: no such key; {suggestion}") from None
    except GrammarError as error:
        raise ConfigError(f"{path}: got {error.given!r}, expected {error.expected}") from None
