"""Annotation of a command's options."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, get_type_hints

HELP_KEYS = "--help-keys"


@dataclass(frozen=True, slots=True)
class Argument:
    """Annotation of a field: how its option is written on the command line."""

    name: str | None = None
    """Name of the flag. None: the field's name. "": each field of the value has its own flag."""
    metavar: str | None = None
    help: str | None = None
    """Help text of the option; None for the field's docstring."""
    positional: bool = False
    append: bool = False
    """Whether the flag may be repeated, with one value each time."""


def argument_of(hint: Any) -> Argument:
    found = (each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Argument))
    return next(found, Argument())


@cache
def hints_of(options: type) -> Mapping[str, Any]:
    return get_type_hints(options, include_extras=True)
