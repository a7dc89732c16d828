"""Tables that commands print."""

from collections.abc import Iterable, Sequence

from rich.table import Table
from rich.text import Text

from skytether.shell import terminal


def show(title: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table: the first column flush left, the others right, and nothing cut off.

    Without headings the table is a list of names and values.
    """
    table = Table(
        title=Text(title, style="table.title"),
        title_justify="left",
        min_width=len(title),
        show_header=bool(headings),
    )
    for number, heading in enumerate(headings or ("", "")):
        is_right = headings and number
        table.add_column(Text(heading), justify="right" if is_right else "left", no_wrap=True)
    for row in rows:
        cells = (f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in row)
        table.add_row(*map(Text, cells))
    terminal.show(table)
