"""Messages about wrong values of a scenario. The module is loaded at the first wrong value."""

import re
import typing
from collections.abc import Mapping
from typing import Any, Literal

from skytether.shared.base.hint import hint, short
from skytether.shared.scenario import rooms

_PLAIN = {
    "Number out of range": "a smaller number",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
    "object": "a table",
}
"""Words of msgspec's messages, and their replacements."""

_ERROR = re.compile(r"(?P<what>.*?)(?: - at `\$\.?(?P<path>[^`]*)`)?", re.DOTALL)


def explain(message: str, raw: Mapping[str, Any], scenario: type[Any]) -> str:
    """Message of msgspec, reworded as `key: got …, expected …`.

    Args:
        message: the message.
        raw: table of plain values that was to be converted.
        scenario: class of the scenario.
    """
    # Unknown keys come first, because their names may contain any text, even msgspec's syntax.
    if unknown := _unknown_key(raw, scenario):
        return unknown
    parts = _ERROR.fullmatch(message)
    assert parts is not None
    what, path = parts["what"], parts["path"] or ""
    section: Any = scenario
    given: Any = raw
    for part in filter(None, path.split(".")):
        key, *index = part.replace("]", "").split("[")
        given = given[key] if isinstance(given, Mapping) else given
        for digits in index:
            given = given[int(digits)] if digits.isdigit() else given
        section = typing.get_type_hints(section).get(key, section)
        if index and hasattr(typing.get_args(section)[0], "__struct_fields__"):
            section = typing.get_args(section)[0]
    if what.startswith("Invalid enum value") or " | " in what:
        return f"{path}: got {_represented(given)}, expected {_choices(section)}"
    expected = what.removeprefix("Expected ").split(", got ")[0].replace("`", "")
    for theirs, ours in _PLAIN.items():
        expected = re.sub(rf"^{theirs}\b", ours, expected)
    return f"{path or 'the scenario'}: got {_represented(given)}, expected {expected}"


def _unknown_key(table: object, section: Any, at: str = "") -> str | None:
    """Message about the first unknown key of a table; None if all keys are known."""
    if isinstance(table, list | tuple) and typing.get_origin(section) is tuple:
        section = typing.get_args(section)[0]
        each = (_unknown_key(one, section, f"{at[:-1]}[{i}].") for i, one in enumerate(table))
        return next(filter(None, each), None)
    if not (isinstance(table, Mapping) and hasattr(section, "__struct_fields__")):
        return None
    kinds = typing.get_type_hints(section)
    for key, value in table.items():
        if key not in kinds and not at and key in rooms.SECTIONS:
            return f"{key}: {rooms.SECTIONS[key]} is not installed"
        if key not in kinds:
            return (
                f"{at}{short(str(key))}: no such key; {hint(str(key), section.__struct_fields__)}"
            )
        if below := _unknown_key(value, kinds[key], f"{at}{key}."):
            return below
    return None


def _represented(given: object) -> str:
    try:
        return short(repr(given))
    except ValueError:  # Python cannot format numbers of more than 4300 digits
        return "a number of thousands of digits"


def _choices(kind: Any) -> str:
    """Allowed values in words: the words of a Literal, or the types of a union."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        return _PLAIN["array"]
    if typing.get_origin(kind) is Literal:
        return " or ".join(map(repr, parts))
    return " or ".join(map(_choices, parts)) if parts else _PLAIN[kind.__name__]
