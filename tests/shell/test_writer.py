"""Background writing: ordered, complete, bounded; never blocks or raises.

Threads write when they are waited for; one test has a thread that writes by itself.
"""

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import pytest

from helpers import PATIENCE_S
from skytether.shell.host import writer as writer_module
from skytether.shell.host.writer import Writer
from virtual_loop import AtJoin


@pytest.fixture(autouse=True)
def _threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if not request.node.get_closest_marker("realtime"):
        monkeypatch.setattr(writer_module.threading, "Thread", AtJoin)


@pytest.fixture
def pipe() -> Iterator[tuple[IO[bytes], IO[bytes]]]:
    """Pipe of 4096 bytes whose every write is read as one: ends to read from and write to."""
    reading, writing = os.pipe2(os.O_DIRECT)
    with (
        os.fdopen(reading, "rb", buffering=0) as read,
        os.fdopen(writing, "wb", buffering=0) as write,
    ):
        yield read, write


def test_what_is_written_arrives_in_order(tmp_path: Path) -> None:
    pieces = [b"%d\n" % number for number in range(1000)]
    with (tmp_path / "file").open("wb") as file:
        writer = Writer(file, capacity=10**6, together=100, pause_s=0.001)
        assert all(writer.write(piece) for piece in pieces)
        assert writer.close(PATIENCE_S)
    assert (tmp_path / "file").read_bytes() == b"".join(pieces)
    assert writer.written == writer.offered == len(b"".join(pieces))
    assert (writer.refused, writer.failure) == (0, None)


def test_pieces_share_a_write_but_none_is_torn(pipe: tuple[IO[bytes], IO[bytes]]) -> None:
    reading, writing = pipe
    writer = Writer(writing, capacity=10**6, together=100, pause_s=0.1)
    for _ in range(9):
        writer.write(b"x" * 29 + b"\n")
    assert writer.close(PATIENCE_S)
    assert [len(reading.read(4096)) for _ in range(3)] == [90, 90, 90]


def test_what_waits_is_bounded(tmp_path: Path) -> None:
    with (tmp_path / "file").open("wb") as file:
        writer = Writer(file, capacity=100, together=1)
        taken = [writer.write(b"%09d\n" % number) for number in range(1000)]
        assert taken == [True] * 10 + [False] * 990
        assert (writer.offered, writer.refused, writer.written) == (10_000, 9900, 0)
        assert not writer.close(0.0)
        assert writer.close(PATIENCE_S)
    assert (tmp_path / "file").read_bytes() == b"".join(b"%09d\n" % number for number in range(10))


@pytest.mark.realtime
def test_nobody_waits_for_a_reader_who_does_not_read(pipe: tuple[IO[bytes], IO[bytes]]) -> None:
    """The thread waits for the pipe; it goes on once somebody reads."""
    reading, writing = pipe
    pages = 0
    os.set_blocking(writing.fileno(), False)
    while writing.write(b"before") is not None:
        pages += 1
    os.set_blocking(writing.fileno(), True)
    writer = Writer(writing, capacity=100, together=1)
    taken = [writer.write(b"%09d\n" % number) for number in range(1000)]
    assert taken == [True] * 10 + [False] * 990
    assert not writer.close(0.01)
    assert {reading.read(4096) for _ in range(pages)} == {b"before"}
    assert [reading.read(4096) for _ in range(10)] == [b"%09d\n" % number for number in range(10)]
    assert writer.close(PATIENCE_S)


def test_a_pipe_that_does_not_block_loses_nothing(
    pipe: tuple[IO[bytes], IO[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program may have made a shared standard output non-blocking."""
    reading, writing = pipe
    os.set_blocking(writing.fileno(), False)
    read: list[int] = []

    class Poll:
        """Somebody reads one piece whenever the writer waits for room."""

        def register(self, *_: object) -> None:
            """There is one pipe."""

        def poll(self) -> None:
            read.append(int(reading.read(4096)))

    monkeypatch.setattr(writer_module, "select", SimpleNamespace(poll=Poll, POLLOUT=4))
    writer = Writer(writing, capacity=10**6, together=10)
    for number in range(1000):
        writer.write(b"%09d\n" % number)
    assert writer.close(PATIENCE_S)
    assert read
    read += [int(reading.read(4096)) for _ in range(1000 - len(read))]
    assert read == list(range(1000))
    assert writer.failure is None


def test_a_full_disk_ends_the_writing_and_nothing_else() -> None:
    with Path("/dev/full").open("wb", buffering=0) as full:
        writer = Writer(full, capacity=100, together=100)
        for _ in range(1000):
            writer.write(b"row")
        assert writer.close(PATIENCE_S)
    assert writer.failure is not None
    assert writer.failure.errno == errno.ENOSPC
    assert (writer.offered, writer.written) == (3000, 0)


def test_a_reader_who_is_gone_ends_the_writing_and_nothing_else() -> None:
    reading, number = os.pipe()
    os.close(reading)
    with os.fdopen(number, "wb", buffering=0) as writing:
        writer = Writer(writing, capacity=100, together=100)
        writer.write(b"line\n")
        assert writer.close(PATIENCE_S)
        writer.write(b"line\n")
    assert isinstance(writer.failure, BrokenPipeError)


def test_without_a_file_all_is_left_out() -> None:
    closed = OSError(errno.EBADF, "closed")
    writer = Writer(closed, capacity=100, together=100)
    for _ in range(1000):
        writer.write(b"row")
    assert writer.close(PATIENCE_S)
    assert (writer.failure, writer.written) == (closed, 0)
