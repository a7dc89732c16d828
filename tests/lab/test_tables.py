"""Tables of a terminal."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.lab.commands.tables import AROUND, fitted

cells = st.text("ab", max_size=12)
tables = st.integers(3, 9).flatmap(
    lambda count: st.tuples(
        st.lists(cells, min_size=count, max_size=count),
        st.lists(st.lists(cells, min_size=count, max_size=count), min_size=1, max_size=6),
    )
)


@given(tables, st.integers(10, 120))
def test_a_table_that_is_too_wide_is_cut_and_nothing_of_it_is_lost(
    table: tuple[list[str], list[list[str]]], width: int
) -> None:
    headings, rows = table
    parts = fitted("title", headings, rows, width)
    for _, heads, some in parts:
        widths = [AROUND + max(map(len, each)) for each in zip(heads, *some, strict=True)]
        assert 1 + sum(widths) <= width or len(heads) <= 2
    # every cell, but for first columns, which are in titles, or repeated
    expected = sorted(cell for row in rows for cell in row[1:])
    shown = [cell for _, _, some in parts for row in some for cell in row]
    titles = " ".join(title for title, *_ in parts)
    for cell in expected:
        assert cell in shown or cell in titles


def test_a_column_that_repeats_itself_becomes_a_title() -> None:
    rows = [["one", "a", "1"], ["one", "b", "2"], ["two", "a", "3"]]
    assert fitted("t", ["case", "who", "n"], rows, 12) == [
        ("t: one", ["who", "n"], [["a", "1"], ["b", "2"]]),
        ("t: two", ["who", "n"], [["a", "3"]]),
    ]
    assert fitted("t", ["case", "who", "n"], rows, 80) == [("t", ["case", "who", "n"], rows)]
