"""Safe reading of MCAP files: sizes that a file claims are checked before memory is allocated.

A file of a few kilobytes may claim to hold gigabytes, and the library `mcap` allocates them. So the
library gets a stream that ends where the file does, and chunks whose size is known before they are
decompressed. The file is read once, from its beginning, so that one without an index, whose writer
was killed, can be read as well.
"""

import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from skytether.shared.base import files
from skytether.shared.base.errors import ConfigError, RecordingError
from skytether.shared.telemetry.record import RECORDING

MAGIC = b"\x89MCAP0\r\n"
ENCODING = "msgpack"
"""Encoding of the messages that are read back; others are written for other programs."""

CHUNK_BYTES_MAX = 5 * 1024 * 1024
"""Largest size of a decompressed chunk [B]; Skytether writes 256 KiB and a message."""
SPARE_BYTES = 16 * 1024 * 1024
"""Total decompressed size of chunks that any file may have, however small it is [B]."""
RATIO_MAX = 50
"""Largest total decompressed size of the chunks over the file's size; flights have 3 to 5, because
the index of messages is not compressed.
"""
SPARE_MESSAGES = 10_000
"""Number of messages that any file may have: those of a chunk whose index was not written yet."""
INDEXED_BYTES = 16
"""Size of a message's entry in the index [B]; it bounds the number of messages in a file."""

BROKEN = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""Exceptions that reading a damaged file may raise in the library or in the decoders."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any exception from a damaged file into a RecordingError."""
    try:
        yield
    except RecordingError:
        raise
    except ConfigError as error:  # of another version, or its trajectory's file is missing here
        raise RecordingError(f"{path}: {error}") from None
    except BROKEN as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: it is damaged: {what}") from None


class Container:
    """MCAP file that is read once; a record is never given more memory than the file's size.

    Raises:
        OSError: the file cannot be read.
        RecordingError: it is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            os.close(descriptor)
            raise RecordingError(
                f"{path}: it is not a plain file, expected a recording ({RECORDING})"
            )
        self._file = os.fdopen(descriptor, "rb")
        self._size = status.st_size
        self.lost_bytes = 0
        """Bytes lost at the end of a file that was not completed; valid after `messages`."""
        self.damaged_bytes = 0
        """Bytes of damaged records, which are left out; valid after `messages`."""
        try:
            files.note(path, self._file)
            if self._file.read(len(MAGIC)) != MAGIC:
                what = "it is not an MCAP file" if self._size else "it is empty"
                raise RecordingError(f"{path}: {what}, expected a recording ({RECORDING})")
            self._file.seek(max(self._size - len(MAGIC), len(MAGIC)))
            self.is_whole = self._file.read() == MAGIC
            """Whether the file was completed; those of killed flights are not."""
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        """Next bytes, at most `size`; the only method of a file that the library calls."""
        return self._file.read(min(size, self._size - self._file.tell()))

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Topics and contents of messages in the encoding that is read back, in file order.

        A file that was not completed is read up to the first record that is not whole. Of a
        completed one damaged chunks are left out, and everything after a damaged length.

        Raises:
            BROKEN: the file holds what no flight writes.
        """
        self._file.seek(0)
        whole_bytes = len(MAGIC)
        topics: dict[int, str] = {}
        messages_left = SPARE_MESSAGES + self._size // INDEXED_BYTES
        try:
            for record in self._unpacked():
                match record:
                    case DataEnd():
                        return
                    case Channel(message_encoding=encoding):
                        topics[record.id] = record.topic if encoding == ENCODING else ""
                    case Message(channel_id=number) if number not in topics:
                        if not self.damaged_bytes:
                            raise ValueError(f"a message before its channel {number}")
                        self.damaged_bytes += len(record.data)
                    case Message(channel_id=number) if topic := topics[number]:
                        messages_left -= 1
                        if messages_left < 0:
                            raise ValueError("it has more messages than fit into its size")
                        yield topic, record.data
                whole_bytes = self._file.tell()
        except CRCValidationError:  # of all data: what is read of it has checksums of its own
            self.damaged_bytes = max(self.damaged_bytes, 1)
        except BROKEN as error:
            lost_bytes = self._size - whole_bytes
            if not self.is_whole:
                self.lost_bytes = lost_bytes
            elif isinstance(error, McapError):
                self.damaged_bytes += lost_bytes
            else:
                raise

    def _unpacked(self) -> Iterator[McapRecord]:
        left_bytes = SPARE_BYTES + RATIO_MAX * self._size
        stream: Any = self
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            if not isinstance(record, Chunk):
                yield record
                continue
            size = record.uncompressed_size
            left_bytes -= size
            if size > CHUNK_BYTES_MAX:
                raise ValueError(f"a chunk of {size} B, expected at most {CHUNK_BYTES_MAX} B")
            if left_bytes < 0:
                raise ValueError("its chunks are larger than any flight's, for a file of its size")
            if record.compression not in {"", "zstd"}:
                compression = record.compression[:20]
                raise ValueError(f"a chunk is compressed with {compression!r}, expected zstd")
            packed = zstandard.frame_content_size if record.compression else len
            if packed(record.data) not in {-1, size}:
                raise ValueError("a chunk's content has another size than it says")
            try:
                records = breakup_chunk(record, validate_crc=True)
            except (CRCValidationError, zstandard.ZstdError):
                self.damaged_bytes += len(record.data)
            else:
                yield from records
