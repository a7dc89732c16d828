"""`shared.telemetry.record`: rows are read back as written."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest

from skytether.shared.telemetry.parts import parse, read
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    MemoryRecorder,
    Recorder,
    client_columns,
    server_columns,
)

Columns = np.dtype[np.void]

COLUMN_SETS = {
    "client in 2-D": client_columns(2),
    "client in 3-D": client_columns(3),
    "server in 2-D": server_columns(2, "committed"),
    "server in 3-D, trajectory": server_columns(3, "trajectory"),
    "netem": PACKET_COLUMNS,
}


def some_rows(columns: Columns, count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(len(columns))
    return {
        name: rng.integers(0, 2 if kind.base.kind == "b" else 250, (count, *kind.shape))
        for name, kind in ((name, columns[name]) for name in columns.names)
    }


@pytest.fixture(params=COLUMN_SETS.values(), ids=COLUMN_SETS)
def columns(request: pytest.FixtureRequest) -> Columns:
    return request.param


def written(columns: Columns, count: int = 3) -> bytes:
    sink = io.BytesIO()
    Recorder(columns, sink).append(count, **some_rows(columns, count))
    return sink.getvalue()


def test_rows_survive_the_round_trip(columns: Columns) -> None:
    rows = parse(written(columns))
    assert rows.dtype == columns
    for name, values in some_rows(columns, 3).items():
        np.testing.assert_array_equal(rows[name], values)


def test_one_row_is_written_as_many_are(columns: Columns) -> None:
    rows, sink = some_rows(columns, 1), io.BytesIO()
    numbers = [number for values in rows.values() for number in values.ravel().tolist()]
    Recorder(columns, sink).append_row(*numbers)
    assert sink.getvalue() == written(columns, 1)


def test_rows_kept_in_memory_are_those_written_to_a_file(columns: Columns) -> None:
    recorder, rows = MemoryRecorder(columns), parse(written(columns))
    recorder.append(3, **some_rows(columns, 3))
    assert recorder.count == 3
    for first in (0, 1, -2, -5):
        np.testing.assert_array_equal(recorder.rows(first), rows[first:])


@pytest.mark.parametrize("count", [0, 8, 10])
def test_a_row_with_too_few_or_too_many_numbers_is_our_own_mistake(count: int) -> None:
    """Such a row would displace all others."""
    with pytest.raises(struct.error, match="expected 9 items"):
        Recorder(PACKET_COLUMNS, io.BytesIO()).append_row(*[0] * count)


def test_a_row_cut_short_is_left_out(columns: Columns) -> None:
    part = written(columns)
    for cut in (1, columns.itemsize // 2, columns.itemsize):
        np.testing.assert_array_equal(parse(part[:-cut]), parse(part)[:2])


def test_a_part_without_rows_is_read_as_none(columns: Columns) -> None:
    header = written(columns, 0)
    assert parse(header).size == parse(header + bytes(columns.itemsize - 1)).size == 0
    assert parse(header).dtype == columns


@pytest.mark.parametrize(
    "header",
    [
        *(b"", b"3", b"[]", b"null", b"a diary", b"[" * 100_000, b"\xff\x00"),
        *(b'[["a"]]', b'[["a","f8,("]]', b'[["a","O"]]', b'[["a", "zzz"]]'),
    ],
)
def test_what_is_no_part_is_a_value_error(header: bytes) -> None:
    with pytest.raises(ValueError, match="not a part of a record"):
        parse(header + b"\n" + bytes(100))


def test_a_part_begins_with_its_columns_in_a_line() -> None:
    """So a part can be read with numpy alone."""
    header, _, _ = written(PACKET_COLUMNS).partition(b"\n")
    assert header.startswith(b'[["direction", "|u1"], ["path", "|u1"], ["flow", "<u4"], ')


def test_one_value_is_broadcast_to_all_rows() -> None:
    sink = io.BytesIO()
    Recorder(PACKET_COLUMNS, sink).append(3, flow=7, number=[4, 5, 6], lost=True)
    rows = parse(sink.getvalue())
    assert rows["flow"].tolist() == [7, 7, 7]
    assert rows["number"].tolist() == [4, 5, 6]
    assert rows["lost"].tolist() == [True, True, True]


def test_a_column_left_out_is_zero() -> None:
    sink = io.BytesIO()
    recorder = Recorder(client_columns(2), sink)
    recorder.append(1, **some_rows(client_columns(2), 1))
    recorder.append(1, step=9)
    last = parse(sink.getvalue())[1]
    assert (last["step"], last["vehicle"], last["age_ns"]) == (9, 0, 0)
    assert not last["state"].any()


def test_rows_stay_in_the_order_in_which_they_were_appended() -> None:
    sink = io.BytesIO()
    recorder = Recorder(PACKET_COLUMNS, sink)
    for numbers in ([0, 1], [], [2], [3, 4, 5]):
        recorder.append(len(numbers), number=numbers)
    assert parse(sink.getvalue())["number"].tolist() == [0, 1, 2, 3, 4, 5]


def test_a_misspelt_column_is_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="no field of name"):
        Recorder(PACKET_COLUMNS, io.BytesIO()).append(1, no_such_column=1)


def test_a_part_is_read_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "netem"
    path.write_bytes(written(PACKET_COLUMNS))
    np.testing.assert_array_equal(read(path), parse(written(PACKET_COLUMNS)))
