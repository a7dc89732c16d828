"""Page of a report: tables, figures and facts in one HTML file that opens offline."""

import base64
import io
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

from skytether.figures.tables import rows_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a report: its numbers as CSV, and the cells that the page shows."""

    name: str
    title: str
    says: str
    """Explanation of the numbers: a few sentences."""
    csv: str
    """Numbers as CSV, with all digits."""
    heading: Sequence[str]
    rows: Sequence[Sequence[str]]
    bold: Collection[tuple[int, int]] = ()
    """Row and column number of each cell in bold type."""
    own: Collection[int] = ()
    """Row numbers of the user's own contenders."""
    is_grouped: bool = True

    @property
    def groups(self) -> dict[str, list[int]]:
        """Numbers of rows by value in the first column; without grouping, one unnamed group."""
        groups: dict[str, list[int]] = {}
        for at, (first, *_) in enumerate(self.rows):
            groups.setdefault(first if self.is_grouped else "", []).append(at)
        return groups if len(groups) < len(self.rows) else {"": [*range(len(self.rows))]}


@dataclass(frozen=True, slots=True)
class Picture:
    name: str
    title: str
    says: str
    """Caption: one or two sentences."""
    png: bytes


@dataclass(frozen=True, slots=True)
class Facts:
    title: str
    facts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Folded:
    """Part of a page that can be folded; while folded, only its title is shown."""

    title: str
    parts: Sequence["Part"] = ()
    text: str = ""
    """Preformatted text, shown before the parts."""
    is_open: bool = False


Part = Table | Picture | Facts | Folded


def blank(width: float, height: float) -> "Figure":
    """Empty figure of a size [inch]."""
    from matplotlib.figure import Figure  # imported here, because the import takes 0.5 s

    return Figure(figsize=(width, height), layout="constrained")


@contextmanager
def lettered(width: float, height: float, size: float) -> "Iterator[Figure]":
    """Yield an empty figure of a size [inch]; text drawn in the block has `size` points."""
    import matplotlib as mpl

    letters: Any = {"font.size": size, "axes.titlesize": size, "legend.fontsize": 8}
    grid: Any = {"axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}
    with mpl.rc_context(letters | grid):
        yield blank(width, height)


def as_png(figure: "Figure", dpi: int) -> bytes:
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=dpi)
    return png.getvalue()


def as_text(value: Any, spec: str) -> str:
    """Text of a number in a table; a dash for None."""
    return "–" if value is None else format(value, spec)


Row = Mapping[str, Any]
"""Numbers of a row, by column name."""
Cell = tuple[str, str] | Callable[[Row], str]
"""Content of a cell: name and format of a number, or a function of the row."""


def table_of(
    name: str,
    title: str,
    says: str,
    rows: Sequence[Row],
    shown: Mapping[str, Cell],
    own: Collection[int] = (),
) -> Table:
    """Table made from rows of numbers.

    Args:
        name, title, says: see `Table`.
        rows: all numbers, which are written to the CSV.
        shown: content of each column's cells, by heading.
        own: see `Table`.
    """

    def text(row: Row, cell: Cell) -> str:
        return cell(row) if callable(cell) else as_text(row[cell[0]], cell[1])

    lines = [[text(row, cell) for cell in shown.values()] for row in rows]
    return Table(name, title, says, rows_csv(rows), list(shown), lines, own=own)


def rendered(title: str, about: str, parts: Sequence[Part]) -> str:
    """Page as HTML, with all figures embedded."""
    from jinja2 import Environment, StrictUndefined  # the import takes 0.1 s

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
    template = resources.files("skytether").joinpath("figures/report.html.jinja")
    return environment.from_string(template.read_text(encoding="utf-8")).render(
        title=title, about=about, parts=parts
    )
