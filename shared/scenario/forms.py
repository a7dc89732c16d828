"""Notation of a table's entries in a scenario, with parameters and bounds, for messages."""

import typing
from typing import Annotated, Any, Literal

from skytether.shared.scenario.registry import Entry, Parameter

LOW, HIGH = {"ge": "<=", "gt": "<"}, {"le": "<=", "lt": "<"}
"""Signs of lower and upper bounds of a number, by the bounds' names in msgspec.Meta."""
FURTHER = {
    "multiple_of": "a multiple of",
    "pattern": "with the pattern",
    "min_length": "of a length from",
    "max_length": "of a length up to",
}
"""Words for all other bounds, by the bounds' names in msgspec.Meta."""


def form(name: str, entry: Entry) -> str:
    """Notation of an entry in a scenario, with its parameters and their bounds, for messages."""
    if not entry.parameters:
        return name
    shown = ", ".join(
        f"{each.name}{'…' if each.is_rest else ''}"
        if each.default is None
        else f"{each.name}={each.default}"
        for each in entry.parameters
    )
    texts = [parameter_text(each) for each in entry.parameters]
    bounds = [text for text, each in zip(texts, entry.parameters, strict=True) if text != each.name]
    return f"{name}({shown})" + (f" with {' and '.join(bounds)}" if bounds else "")


def parameter_text(parameter: Parameter) -> str:
    """Text of a parameter for messages: its name and bounds."""
    kind, bounds = bounds_of(parameter.type)
    if parameter.file or typing.get_origin(kind) is Literal:
        what = "a file" if parameter.file else " or ".join(typing.get_args(kind))
        return " ".join([parameter.name, what, *_further(bounds)])
    low = [f"{bounds[key]:.15g} {sign} " for key, sign in LOW.items() if key in bounds]
    high = [f" {sign} {bounds[key]:.15g}" for key, sign in HIGH.items() if key in bounds]
    ends = ["(whole)"] * (kind is int) + _further(bounds)
    return " ".join(["".join([*low, parameter.name, *high]), *ends])


def bounds_of(hint: Any) -> tuple[Any, dict[str, Any]]:
    kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    pairs = [(key, getattr(mark, key)) for mark in marks for key in (*LOW, *HIGH, *FURTHER)]
    return kind, {key: bound for key, bound in pairs if bound is not None}


def _further(bounds: dict[str, Any]) -> list[str]:
    return [f"({FURTHER[key]} {bounds[key]})" for key in FURTHER if key in bounds]
