"""Page of a report: tables and figures in one file that opens offline."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a report: its numbers as CSV, and as shown."""

    name: str
    """Name of the table's file."""
    title: str
    """Heading above the table."""
    says: str
    """Explanation of the numbers: a few sentences."""
    csv: str
    """Numbers as CSV, with all digits."""
    heading: Sequence[str]
    """Headings of the shown columns."""
    rows: Sequence[Sequence[str]]
    """Shown cells, row by row."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Figure of a page."""

    name: str
    """Name of the figure in the page, and of its file."""
    title: str
    """Heading above it."""
    says: str
    """Caption: one or two sentences."""
    png: bytes
    """Drawing as PNG."""


def as_text(value: Any, spec: str) -> str:
    """Number as shown in a table, with a dash for an unknown one."""
    return "–" if value is None else format(value, spec)


def rendered(template: str, **values: Any) -> str:
    """Page made from a template.

    Args:
        template: its package and file; it may extend another one.
        values: values for the template.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined  # takes a tenth of a second

    def source(name: str) -> str:
        return resources.files("skytether").joinpath(name).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(source), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
    return environment.get_template(template).render(**values)
