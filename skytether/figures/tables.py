"""Tables as CSV text."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

FORMULA = ("=", "+", "-", "@", "\t")
"""Characters with which a cell begins that a spreadsheet computes."""


def _plain(value: Any) -> Any:
    """A value as CSV has it: true and false as in TOML, nothing for None, text that is no formula.

    A text that a spreadsheet would compute is led by an apostrophe; a number stays one.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, str):
        return value
    line = value.replace("\r", " ")  # which `csv` leaves bare, and many take for the end of a row
    return f"'{line}" if line.startswith(FORMULA) and not _is_number(line) else line


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return not text.startswith("\t")


def rows_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table as CSV text, of rows that have all columns by name; empty where there are none."""
    return to_csv(list(rows[0]), [list(row.values()) for row in rows]) if rows else ""


def to_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV text."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(list(map(_plain, row)) for row in rows)
    return file.getvalue()
