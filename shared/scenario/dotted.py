"""Keys with dots, as in `control.epsilon`, and the tables within tables that they lead into."""

from collections.abc import Iterator, Mapping
from typing import Any

from skytether.shared.base.errors import ConfigError


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
        ConfigError: a key leads through something that is no table.
    """
    for path, value in changes.items():
        *sections, key = path.split(".")
        section = table
        for name in sections:
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                raise ConfigError(f"{path}: no such key")
        section[key] = value
