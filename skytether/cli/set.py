"""`skytether set`: change keys of a scenario in flight."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from skytether.shared.endpoints.change import REQUEST_BYTES_MAX
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read, toml_value
from skytether.shell.driving.control import Caller, ControlError


@dataclass(frozen=True)
class SetOptions:
    path: Annotated[Path, Argument(positional=True, metavar="PATH")]
    """Control socket of a process: the path given to server, netem or client as --control."""
    changes: Annotated[tuple[str, ...], Argument(positional=True, metavar="KEY=VALUE")]
    """Keys and values, as in network.uplink.loss=0.3; a value that is not TOML is a string."""


def set_keys(argv: Sequence[str]) -> None:
    """Change keys of a scenario in flight; if one change is refused, none is made.

    Without arguments, list the keys that may change, and their present values. The exit code is 2
    if the change was refused, and 1 if no process answers.
    """
    options = read(SetOptions(tyro.MISSING, ()), argv, "skytether set", set_keys.__doc__)
    values = parsed(options.changes)
    try:
        caller = Caller(options.path)
        try:
            answer = caller.ask(values)
        finally:
            caller.close()
    except ControlError as error:
        raise CommandError(str(error)) from None
    if answer.refused:
        raise CommandError(f"{options.path}: {answer.refused}", CONFIGURATION)
    for key, value in answer.values.items():
        print(f"{answer.names.get(key, key)} = {msgspec.json.encode(value).decode()}")
    for event in answer.changed:
        print(event)


def parsed(changes: Sequence[str]) -> dict[str, Any]:
    """Values by key, parsed from texts such as `control.horizon=60`."""
    values: dict[str, Any] = {}
    for change in changes:
        key, equals, text = change.partition("=")
        key = key.strip()
        if not (key and equals):
            raise CommandError(f"got {change!r}, expected KEY=VALUE", CONFIGURATION)
        if key in values:
            raise CommandError(f"{key}: got two values, expected one", CONFIGURATION)
        values[key] = toml_value(text.strip())
    size = len(msgspec.json.encode(values))
    if size > REQUEST_BYTES_MAX:
        expected = f"expected at most {REQUEST_BYTES_MAX} B at a time"
        raise CommandError(f"got {size} B of keys and values, {expected}", CONFIGURATION)
    return values
