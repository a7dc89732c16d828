"""Feed: socket through which a process sends rows and events to readers without waiting.

The feed runs in the process's own event loop and never blocks: bytes for a slow reader are queued
up to a bound; a reader whose queue is full is disconnected. `shared.telemetry.feed` defines the
frames; `Subscriber` reads them.
"""

import asyncio
import socket
import threading
import time
from asyncio import AbstractEventLoop, TimerHandle
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from skytether.shared.events.flight import Event
from skytether.shared.telemetry.feed import (
    FeedError,
    Figures,
    Frame,
    Opened,
    Reader,
    Rows,
    Said,
    described,
    encode,
)
from skytether.shell.host.local import Local

READERS_MAX = 8
"""Largest number of readers at once; further readers are refused and counted."""
WAITING_BYTES_MAX = 4 * 1024 * 1024
"""Largest number of bytes queued for a reader; a slower reader is disconnected and counted."""
BACKLOG_BYTES_MAX = 1024 * 1024
"""Largest number of bytes of sent frames that are kept for readers that connect later."""
ROWS_BYTES_MAX = 256 * 1024
"""A frame ends once its rows have this size [B]; the next rows go into a new frame."""
SEND_BYTES_MAX = 64 * 1024
"""Largest number of bytes sent to a reader in one turn of the loop."""
GATHER_S = 0.01
"""Time for which frames are collected before they are sent [s]."""
REST_S = 0.02
"""Pause between two accepted readers [s], which bounds the cost of reconnecting in a loop."""
PATIENCE_S = 0.5
"""Longest time to wait at the end until readers have received everything [s]."""

READ_BYTES = 256 * 1024
AGAIN_S = 1.0
"""Time between two attempts to connect to a process, and between searches for new feeds [s]."""
FOLLOWED_MAX = 128
"""Largest number of feeds that a subscriber follows."""


class _Part:
    """Rows of one part of the record that wait to be put into a frame."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.rows: list[bytes] = []

    def write(self, rows: bytes) -> None:
        self.rows.append(rows)

    def frames(self, now_ns: int) -> Iterator[bytes]:
        rows, self.rows = self.rows, []
        first = size = 0
        for last, piece in enumerate(rows, start=1):
            size += len(piece)
            if size >= ROWS_BYTES_MAX or last == len(rows):
                together = b"".join(rows[first:last])
                yield encode(Rows(part=self.name, time_ns=now_ns, rows=together))
                first, size = last, 0


class _Reader:
    def __init__(self, connection: socket.socket, waiting: bytes) -> None:
        connection.setblocking(False)
        self.connection = connection
        self.waiting = bytearray(waiting)

    def send(self) -> None:
        """Send what the socket accepts, at most SEND_BYTES_MAX.

        Raises:
            OSError: the reader has closed the connection.
        """
        with suppress(BlockingIOError):
            del self.waiting[: self.connection.send(self.waiting[:SEND_BYTES_MAX])]


class Feed:
    """Feed of a process; only the thread that drives the endpoint may use it.

    Args:
        path: path of the socket, see `Local`.

    Raises:
        LocalError: the socket cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._local = Local(path, socket.SOCK_STREAM)
        self._local.socket.listen(READERS_MAX)
        self._columns: dict[str, np.dtype[np.void]] = {}
        self._parts: list[_Part] = []
        self._fresh: list[bytes] = []
        self._backlog: deque[bytes] = deque()
        """Newest frames that were sent; each item has one frame or several."""
        self._backlog_bytes = 0
        self._readers: list[_Reader] = []
        self._behind: set[_Reader] = set()
        """Readers whose sockets are full; the loop calls back when a socket can send again."""
        self._loop: AbstractEventLoop | None = None
        self._armed: TimerHandle | None = None
        self._opened: Callable[[], Opened] | None = None
        self._dropped = self._refused = 0

    def part(self, name: str, columns: np.dtype[np.void]) -> _Part:
        self._columns[name] = columns
        self._parts.append(_Part(name))
        return self._parts[-1]

    @property
    def parts(self) -> dict[str, str]:
        """Parts of the record with their columns, as `Opened` contains them."""
        return described(self._columns)

    def open(self, opened: Callable[[], Opened]) -> None:
        """Accept readers once the event loop runs; `opened` makes the first frame of a reader."""
        self._opened = opened

    def begin(self, loop: AbstractEventLoop) -> None:
        self._loop = loop
        self._listen()

    def take(self) -> None:
        """Make frames from the rows that were recorded since the last call."""
        for part in self._parts:
            if part.rows:
                for frame in part.frames(time.monotonic_ns()):
                    self._add(frame)

    def say(self, event: Event) -> None:
        self.take()
        self._add(encode(Said(time_ns=time.monotonic_ns(), event=event)))

    def count(self, figures: Mapping[str, Any]) -> None:
        self._add(encode(Figures(time_ns=time.monotonic_ns(), figures=dict(figures))))

    def figures(self) -> dict[str, Any]:
        return {
            "readers": len(self._readers),
            "dropped": self._dropped,
            "refused": self._refused,
        }

    def end(self) -> None:
        if self._loop is None:
            return
        self._loop.remove_reader(self._local.socket)
        for reader in self._behind:
            self._loop.remove_writer(reader.connection)
        self._behind.clear()
        if self._armed is not None:
            self._armed.cancel()
            self._armed = None
        self._loop = None

    def close(self) -> None:
        """Send remaining bytes to readers, within PATIENCE_S, and remove the socket."""
        self.end()
        self.take()
        self._send()
        until_s = time.monotonic() + PATIENCE_S
        for reader in self._readers:
            reader.connection.settimeout(max(until_s - time.monotonic(), 0.001))
            with suppress(OSError):
                reader.connection.sendall(reader.waiting)
            reader.connection.close()
        self._readers.clear()
        self._local.close()

    def _add(self, frame: bytes) -> None:
        self._fresh.append(frame)
        if not self._readers:
            self._send()
        elif self._armed is None and self._loop is not None:
            self._armed = self._loop.call_later(GATHER_S, self._send)

    def _send(self) -> None:
        self._armed = None
        if not self._fresh:
            return
        piece = b"".join(self._fresh)
        self._fresh.clear()
        for reader in tuple(self._readers):
            reader.waiting += piece
            if len(reader.waiting) > WAITING_BYTES_MAX:
                self._dropped += 1
                self._forget(reader)
            elif reader not in self._behind:
                self._go_on(reader)
        self._backlog.append(piece)
        self._backlog_bytes += len(piece)
        while self._backlog_bytes > BACKLOG_BYTES_MAX:
            self._backlog_bytes -= len(self._backlog.popleft())

    def _go_on(self, reader: _Reader) -> None:
        try:
            reader.send()
        except OSError:
            self._forget(reader)
            return
        if self._loop is None or bool(reader.waiting) == (reader in self._behind):
            return
        if reader.waiting:
            self._behind.add(reader)
            self._loop.add_writer(reader.connection, self._go_on, reader)
        else:
            self._behind.discard(reader)
            self._loop.remove_writer(reader.connection)

    def _forget(self, reader: _Reader) -> None:
        if self._loop is not None and reader in self._behind:
            self._loop.remove_writer(reader.connection)
        self._behind.discard(reader)
        self._readers.remove(reader)
        reader.connection.close()

    def _listen(self) -> None:
        if self._loop is not None:
            self._loop.add_reader(self._local.socket, self._let_in)

    def _let_in(self) -> None:
        assert self._loop is not None
        assert self._opened is not None
        self._loop.remove_reader(self._local.socket)
        self._loop.call_later(REST_S, self._listen)
        try:
            connection, _ = self._local.socket.accept()
        except OSError:  # the reader has closed already, or too many files are open
            return
        if len(self._readers) == READERS_MAX:
            self._refused += 1
            connection.close()
            return
        self._send()
        reader = _Reader(connection, b"".join((encode(self._opened()), *self._backlog)))
        self._readers.append(reader)
        self._go_on(reader)


class Subscriber:
    """Reader of processes' feeds, in its own thread; reconnects after a feed ends.

    Args:
        paths: feeds' sockets by process name; the processes need not run yet.
        take: called in the thread with the process name and each frame; a feed begins with
            `Opened`.
        lost: called in the thread with the process name when a feed has ended.
        further: called every AGAIN_S; returns the feeds' sockets at that time, by process name.
    """

    def __init__(
        self,
        paths: Mapping[str, Path],
        take: Callable[[str, Frame], None],
        lost: Callable[[str], None] = lambda _: None,
        further: Callable[[], Mapping[str, Path]] | None = None,
    ) -> None:
        self._take, self._lost, self._further = take, lost, further
        self._closed = False
        self._loop = asyncio.new_event_loop()
        self._reading = self._loop.create_task(self._read_all(paths))
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading; no callback runs after this returns."""
        self._closed = True
        with suppress(RuntimeError):  # the thread has ended already
            self._loop.call_soon_threadsafe(self._reading.cancel)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _work(self) -> None:
        with closing(self._loop), suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._reading)

    async def _read_all(self, paths: Mapping[str, Path]) -> None:
        async with asyncio.TaskGroup() as readers:
            followed: set[str] = set()
            found = paths
            while True:
                for name in list(found.keys() - followed)[: FOLLOWED_MAX - len(followed)]:
                    followed.add(name)
                    readers.create_task(self._follow(name, found[name]))
                if self._further is None:
                    break
                await asyncio.sleep(AGAIN_S)
                found = self._further()

    async def _follow(self, name: str, path: Path) -> None:
        """Read the feed of a process, and of each process that later listens at the same path."""
        while not self._closed:
            with suppress(OSError):  # no process listens, or its connection queue is full
                stream, connection = await asyncio.open_unix_connection(path, limit=READ_BYTES)
                with closing(connection), suppress(OSError, FeedError):
                    await self._read(name, stream)
                if not self._closed:
                    self._lost(name)
            await asyncio.sleep(AGAIN_S)

    async def _read(self, name: str, stream: asyncio.StreamReader) -> None:
        """Read a feed until it ends.

        Raises:
            OSError, FeedError: the connection or a frame is broken.
        """
        reader = Reader()
        while piece := await stream.read(READ_BYTES):
            for frame in reader.read(piece):
                if not self._closed:
                    self._take(name, frame)
