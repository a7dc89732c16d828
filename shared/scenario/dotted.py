"""Keys with dots, as in `control.horizon`, and the tables within tables that they lead into.

A key may lead on into a text: `network.uplink.loss` is the first argument of `loss` in
`network.uplink`, and `control.trigger.state_gap.decay_rate` an argument by its name.
"""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import (
    IMPAIRMENTS,
    REFERENCES,
    REPORTS,
    TRIGGERS,
    PluginTable,
)

TEXTS: Mapping[str, PluginTable] = MappingProxyType(
    {
        "control.trigger": TRIGGERS,
        "reference.shape": REFERENCES,
        "vehicle.report": REPORTS,
        "network.uplink": IMPAIRMENTS,
        "network.downlink": IMPAIRMENTS,
    }
)
"""Keys whose value is a text, and the table of what it may name."""


def flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys of a table, with dots, and their values."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def lay(changes: Mapping[str, Any], table: dict[str, Any]) -> None:
    """Put values into a table, where their keys with dots say.

    Raises:
        ConfigError: a key leads through something that is no table and no text, or a text has no
            such argument.
    """
    for path, value in changes.items():
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


def whole(key: str) -> str:
    """Key of the text that an argument's key leads into; any other key itself."""
    return next((each for each in TEXTS if key.startswith(f"{each}.")), key)


def value(table: Any, key: str) -> Any:
    """Value under a key with dots.

    Raises:
        KeyError, TypeError: there is none.
        GrammarError: the text that it leads into is wrong.
    """
    *sections, last = key.split(".")
    for depth, name in enumerate(sections):
        table, text = table[name], ".".join(sections[: depth + 1])
        if isinstance(table, str) and text in TEXTS:
            return TEXTS[text].argument(table, key.removeprefix(f"{text}."))
    return table[last]


def with_argument(key: str, text: str, path: str, value: object) -> str:
    """The text of a key with another argument, whose own key is `path`.

    Raises:
        ConfigError: the text has no such argument.
    """
    table, at = TEXTS[key], path.removeprefix(f"{key}.")
    try:
        return table.with_argument(text, at, value)
    except KeyError:
        name, _, last = at.partition(".")
        known = [each.name for each in table[name].parameters] if name in table else list(table)
        suggestion = hint(last if name in table else name, known)
        raise ConfigError(f"{path}: no such key; {suggestion}") from None
    except GrammarError as error:
        raise ConfigError(f"{path}: got {error.given!r}, expected {error.expected}") from None
