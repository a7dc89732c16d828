"""Tables that commands print."""

from collections.abc import Iterable, Iterator, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from skytether.shell.commandline import terminal

AROUND = 3
"""Width of the frame and space around a cell [characters]."""

Cells = Sequence[Sequence[str]]


def show(title: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table: first column left-aligned, others right-aligned, no cell truncated.

    On a narrow terminal the table is split into several, one below the other. Without headings the
    table is a list of names and values.
    """
    cells = [
        [f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in row] for row in rows
    ]
    console = Console()
    parts = fitted(title, headings, cells, console.width) if console.is_terminal else ()
    for named, heads, some in parts or [(title, headings, cells)]:
        table = Table(
            title=Text(named, style="table.title"),
            title_justify="left",
            min_width=len(named),
            show_header=bool(heads),
        )
        for number, heading in enumerate(heads or ("", "")):
            is_right = heads and number
            table.add_column(Text(heading), justify="right" if is_right else "left", no_wrap=True)
        for row in some:
            table.add_row(*map(Text, row))
        terminal.show(table)


def fitted(
    title: str, headings: Sequence[str], rows: Cells, width: int
) -> list[tuple[str, Sequence[str], Cells]]:
    """Split a table into tables no wider than `width`, if the width of its cells allows it.

    If values of the first column repeat, there is a table for each value, with the value in its
    title. Tables that are still too wide are split by columns; each part has the first column.
    """
    widths = [AROUND + max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    if not headings or len(headings) < 3 or 1 + sum(widths) <= width:
        return [(title, headings, rows)]
    groups: dict[str, list[Sequence[str]]] = {}
    for first, *rest in rows:
        groups.setdefault(first, []).append(rest)
    if len(groups) < len(rows):
        return [
            each
            for first, some in groups.items()
            for each in fitted(f"{title}: {first}", headings[1:], some, width)
        ]
    return [
        (title, [headings[at] for at in piece], [[row[at] for at in piece] for row in rows])
        for piece in _pieces(widths, width)
    ]


def _pieces(widths: Sequence[int], width: int) -> Iterator[list[int]]:
    """Column numbers of each part of a split table; each part has the first column."""
    piece, used = [0], 1 + widths[0]
    for at, wide in enumerate(widths[1:], start=1):
        if used + wide > width and len(piece) > 1:
            yield piece
            piece, used = [0], 1 + widths[0]
        piece.append(at)
        used += wide
    yield piece
