"""Background writer of a file, so that a process never waits for a full pipe or a slow disk."""

import contextlib
import os
import select
import threading
from queue import Empty, SimpleQueue
from typing import IO, Any


class Writer:
    """Writer of a file, in its own thread; drops pieces when more than `capacity` bytes wait.

    The thread starts at once, so a process that forks must create writers in its children. A
    blocked thread does not keep the process from ending. A killed process loses pieces not yet
    written.

    Args:
        file: unbuffered file to write to; or the error from opening it.
        capacity: largest number of bytes waiting to be written.
        together: largest number of bytes in one write of several pieces; a piece is never split.
        pause_s: time for which pieces are collected before they are written [s].
    """

    def __init__(
        self, file: IO[Any] | OSError, *, capacity: int, together: int, pause_s: float = 0.0
    ) -> None:
        self._file = file
        self._capacity = capacity
        self._together = together
        self._pause_s = pause_s
        # The caller's thread changes `offered` and `refused`, the writer's thread the rest.
        self.offered = 0
        self.refused = 0
        """Number of bytes that were dropped because too many were waiting."""
        self.written = 0
        self._handled = 0
        self._pieces: SimpleQueue[bytes] = SimpleQueue()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def failure(self) -> OSError | None:
        return self._file if isinstance(self._file, OSError) else None

    def write(self, piece: bytes) -> bool:
        """Queue a piece for writing; False if it was dropped. Never blocks, never raises."""
        self.offered += len(piece)
        if self.offered - self.refused - self._handled > self._capacity:
            self.refused += len(piece)
            return False
        self._pieces.put(piece)
        return True

    def close(self, patience_s: float) -> bool:
        """Wait at most `patience_s` until all is written; returns whether the thread has ended.

        The file may be closed only if this returns True.
        """
        self._closed.set()
        self._pieces.put(b"")
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while not (self._closed.is_set() and self._pieces.empty()):
            pieces = [self._pieces.get()]
            self._closed.wait(self._pause_s)
            with contextlib.suppress(Empty):
                while True:
                    pieces.append(self._pieces.get_nowait())
            block: list[bytes] = []
            size = 0
            for piece in pieces:
                if size + len(piece) > self._together:
                    self._put(b"".join(block))
                    block, size = [], 0
                block.append(piece)
                size += len(piece)
            self._put(b"".join(block))

    def _put(self, block: bytes) -> None:
        rest = memoryview(block)
        while rest and not isinstance(self._file, OSError):
            try:
                count = os.write(self._file.fileno(), rest)
            except BlockingIOError:  # another process has made the pipe non-blocking
                poll = select.poll()
                poll.register(self._file, select.POLLOUT)
                poll.poll()
            except OSError as error:
                self._file = error
            else:
                self.written += count
                rest = rest[count:]
        self._handled += len(block)
