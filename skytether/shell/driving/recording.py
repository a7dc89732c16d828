"""File of a part of the record, written in a thread: a slow or full disk delays no flight."""

import os
from typing import BinaryIO

import numpy as np

from skytether.shared.events.flight import RecordIncomplete
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import Recorder, Rows
from skytether.shell.host.writer import Writer

ROOM_BYTES = 32 * 1024 * 1024
"""Largest number of bytes of rows waiting for the disk: 8 s of 1000 vehicles at 20 Hz. Short rows,
such as netem's, take three times as much memory.
"""
TOGETHER_BYTES = 256 * 1024
"""Largest number of bytes of rows in one write."""
PAUSE_S = 0.02
"""Time for which rows are collected before a write [s]; a killed process loses these rows."""
PATIENCE_S = 3.0
"""Longest time to wait at the end until all rows are written [s]."""

SLOW = "the disk is too slow"


class RecordFile:
    """Recorder and its file; rows that cannot be written are lost and counted.

    Args:
        name: name of the file, for messages.
        file: the file, open for reading and writing without a buffer; or the error from opening it.
    """

    def __init__(self, name: str, columns: np.dtype[np.void], file: BinaryIO | OSError) -> None:
        self._name = name.encode(errors="replace").decode()  # a file's name may be invalid Unicode
        self._file = file
        self._writer = Writer(file, capacity=ROOM_BYTES, together=TOGETHER_BYTES, pause_s=PAUSE_S)
        self.recorder = Recorder(columns, self._writer)
        self._header_bytes = self._writer.offered
        self._ended = False
        self._is_reported = False

    def news(self) -> RecordIncomplete | None:
        """Event that reports lost rows, returned once after the first loss; otherwise None."""
        reason = self._reason()
        if reason is None or self._is_reported:
            return None
        self._is_reported = True
        return RecordIncomplete(file=self._name, reason=reason)

    def end(self) -> None:
        """Wait at most PATIENCE_S until the last row is written."""
        self._writer.close(PATIENCE_S)
        self._ended = True

    def fault(self) -> str | None:
        """Message about rows missing in the file; None if no row is missing. Valid after `end`."""
        reason = self._reason()
        if reason is None:
            return None
        writer, row_bytes = self._writer, self.recorder.columns.itemsize
        recorded, rows = (
            max(count - self._header_bytes, 0) // row_bytes
            for count in (writer.written, writer.offered)
        )
        return f"{self._name}: {reason}: {recorded} of {rows} rows are recorded"

    @property
    def is_empty(self) -> bool:
        return self._writer.written <= self._header_bytes

    def rows(self) -> Rows:
        """Complete rows in the file; valid after `end`."""
        part = bytearray()
        while not isinstance(self._file, OSError) and len(part) < self._writer.written:
            # Not `read`, which would move the position at which the thread may still write.
            count = min(self._writer.written - len(part), TOGETHER_BYTES)
            piece = os.pread(self._file.fileno(), count, len(part))
            if not piece:
                break
            part += piece
        if len(part) < self._header_bytes:
            return np.empty(0, self.recorder.columns)
        return parse(bytes(part))

    def close(self) -> None:
        """Close the file, unless the thread still writes to it."""
        done = self._writer.close(0.0 if self._ended else PATIENCE_S)
        if done and not isinstance(self._file, OSError):
            self._file.close()

    def _reason(self) -> str | None:
        writer = self._writer
        if writer.failure is not None:
            return writer.failure.strerror or str(writer.failure)
        late = self._ended and writer.written < writer.offered
        return SLOW if writer.refused or late else None
