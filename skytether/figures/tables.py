"""Tables as CSV text."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from skytether.shared.base.printable import printable

FORMULA = ("=", "+", "-", "@")
"""First characters that make spreadsheets treat a cell as a formula."""


def _plain(value: Any) -> Any:
    """Value for a CSV cell: `true` or `false`, nothing for None, and safe text.

    A text that a spreadsheet would treat as a formula gets an apostrophe in front. Control
    characters are escaped by `printable`, so that they cannot affect a terminal.
    """
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, str):
        return value
    line = printable(value)
    return f"'{line}" if line.startswith(FORMULA) and not _is_number(line) else line


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def rows_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """CSV text of rows with equal keys; empty without rows."""
    return to_csv(list(rows[0]), [list(row.values()) for row in rows]) if rows else ""


def to_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(list(map(_plain, header)))
    writer.writerows(list(map(_plain, row)) for row in rows)
    return file.getvalue()
