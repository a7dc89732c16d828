"""The page of a report: tables and figures in one file that opens offline."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a report: its numbers as CSV, and as they are shown."""

    name: str
    """Name of the table's file."""
    title: str
    """Heading above the table."""
    says: str
    """A few sentences on what the numbers come to."""
    csv: str
    """Numbers in full."""
    heading: Sequence[str]
    """Headings of the columns that are shown."""
    rows: Sequence[Sequence[str]]
    """Cells that are shown, row by row."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of a page."""

    name: str
    """Name by which the page, and a file, refers to it."""
    title: str
    """Heading above it."""
    says: str
    """One or two sentences on what it shows."""
    png: bytes
    """Drawing for the screen."""


def as_text(value: Any, spec: str) -> str:
    """A number as a table shows it, and a dash for none."""
    return "–" if value is None else format(value, spec)


def rendered(template: str, **values: Any) -> str:
    """A page made from a template.

    Args:
        template: its package and file; it may extend another one.
        values: what it is given.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined  # takes a tenth of a second

    def source(name: str) -> str:
        return resources.files("skytether").joinpath(name).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(source), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
    return environment.get_template(template).render(**values)
