"""Safe reading of MCAP files: sizes that a file claims are checked before memory is allocated.

A file of a few kilobytes may claim to hold gigabytes, and the library `mcap` would allocate them.
So this module passes only records that end within the file to the library, and only chunks whose
size is known before they are decompressed. The file is read once, from its beginning, so that a
file without an index, whose writer was killed, can be read as well. After a damaged record, reading
continues at the next chunk.
"""

import os
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from errno import EINVAL, EISDIR
from io import BytesIO
from pathlib import Path
from typing import Any
from zlib import crc32

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
)
from mcap.stream_reader import CRCValidationError, breakup_chunk

from skytether.shared.base import input_files
from skytether.shared.base.errors import ConfigError, RecordingError
from skytether.shared.telemetry.feed import FeedError
from skytether.shared.telemetry.record import RECORDING

MAGIC = b"\x89MCAP0\r\n"
ENCODING = "msgpack"
"""Encoding of the messages that `recorded` reads; others are for other programs."""
COPY, COPY_OF = "/copy", "copy_of"
"""Topic prefix of a channel that copies another channel's first message, and metadata key for the
number of the other channel.
"""
HEAD = struct.Struct("<BQ")
"""Head of a record: kind, and size of the rest [B]."""
KINDS: Mapping[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
"""Types of records outside of chunks, up to the end of a recording's data."""
CHUNK = re.compile(rb"\x06.{36}\x04\0\0\0zstd.{8}\x28\xb5\x2f\xfd", re.DOTALL)
"""Pattern of a chunk's beginning, to find the next chunk after a damaged record."""
CHUNK_HEAD_BYTES = 57
DAMAGES_MAX = 100
"""Largest number of damaged places that reading skips; it bounds the reading time."""

CHUNK_BYTES_MAX = 5 * 1024 * 1024
"""Largest size of a decompressed chunk [B]; Skytether's have 256 KiB plus a message."""
SPARE_BYTES = 16 * 1024 * 1024
"""Total decompressed size that the chunks of even the smallest file may have [B]."""
RATIO_MAX = 50
"""Largest ratio of the chunks' total decompressed size to the file's size; flights have 3 to 5,
because the index of messages is not compressed.
"""
SPARE_MESSAGES = 10_000
"""Number of messages allowed without an index, in the last chunk of a killed writer."""
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
    except ConfigError as error:  # scenario of another version, or one that names a missing file
        raise RecordingError(f"{path}: {error}") from None
    except FeedError as error:  # the frame is invalid, though its chunk has the right checksum
        raise RecordingError(f"{path}: it is of another version, or damaged: {error}") from None
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
        try:
            self._file = input_files.opened(path)
        except OSError as error:
            if error.errno not in (EINVAL, EISDIR):
                raise
            what = "it is not a plain file"
            raise RecordingError(f"{path}: {what}, expected a recording ({RECORDING})") from None
        self._size = os.fstat(self._file.fileno()).st_size
        self.lost_bytes = 0
        """Number of bytes lost at the end of an incomplete file; valid after `messages`."""
        self.damaged_bytes = 0
        """Number of bytes of damaged records, which are skipped; valid after `messages`."""
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                what = "it is not an MCAP file" if self._size else "it is empty"
                raise RecordingError(f"{path}: {what}, expected a recording ({RECORDING})")
            self._file.seek(max(self._size - len(MAGIC), len(MAGIC)))
            self.is_whole = self._file.read() == MAGIC
            """Whether the file was completed; files of killed flights are not."""
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Topics and contents of messages with the encoding ENCODING, see `timed`."""
        return ((topic, content) for topic, _, content in self.timed(ENCODING))

    def timed(self, wanted: str) -> Iterator[tuple[str, int, bytes]]:
        """Topics, times [ns] and contents of messages with an encoding, in file order.

        A damaged record is skipped, with everything up to the next chunk. If a message is lost, its
        copy is returned.

        Raises:
            BROKEN: the file has contents that no flight writes.
        """
        topics: dict[int, str] = {}
        has_copies = False
        messages_left = SPARE_MESSAGES + self._size // INDEXED_BYTES
        for record in self._unpacked():
            match record:
                case Channel(message_encoding=encoding):
                    topics[record.id] = record.topic if encoding == wanted else ""
                    if original := record.metadata.get(COPY_OF):
                        has_copies = True
                        is_needed = int(original) not in topics
                        topics[record.id] = record.topic.removeprefix(COPY) if is_needed else ""
                        topics.setdefault(int(original), topics[record.id])
                case Message(channel_id=number) if number not in topics:
                    if not self.damaged_bytes:
                        raise ValueError(f"a message before its channel {number}")
                    # In a file with copies, an unknown channel is one for other programs.
                    self.damaged_bytes += 0 if has_copies else len(record.data)
                case Message(channel_id=number) if topic := topics[number]:
                    messages_left -= 1
                    if messages_left < 0:
                        raise ValueError("it has more messages than fit into its size")
                    yield topic, record.log_time, record.data

    def _unpacked(self) -> Iterator[McapRecord]:
        """Records of channels and messages in all chunks, in file order."""
        left_bytes = SPARE_BYTES + RATIO_MAX * self._size
        for record in self._chunks():
            size = record.uncompressed_size
            if fault := _fault(record):
                if not record.uncompressed_crc:  # Skytether always writes this checksum
                    raise ValueError(fault)
                self.damaged_bytes += len(record.data)
                continue
            left_bytes -= size
            if left_bytes < 0:
                raise ValueError("the chunks are too large for a file of this size")
            try:
                records = breakup_chunk(record, validate_crc=True)
            except (CRCValidationError, zstandard.ZstdError):
                self.damaged_bytes += len(record.data)
            else:
                yield from records

    def _chunks(self) -> Iterator[Chunk]:
        """Chunks up to the end of the data; counts the damaged and lost bytes between them."""
        at, checksum = len(MAGIC), crc32(MAGIC)
        for _ in range(DAMAGES_MAX):
            while (content := self._framed(at)) and (record := _parsed(content)):
                if isinstance(record, DataEnd):
                    if record.data_section_crc not in {0, checksum}:
                        self.damaged_bytes = max(self.damaged_bytes, 1)
                    return
                at, checksum = at + len(content), crc32(content, checksum)
                if isinstance(record, Chunk):
                    yield record
            following = self._next_chunk(at + 1)
            if following is None:
                break
            self.damaged_bytes += following - at
            at = following
        if self.is_whole:
            self.damaged_bytes += self._size - at
        else:
            self.lost_bytes = self._size - at

    def _framed(self, at: int) -> bytes:
        """Record at an offset in the file; empty if the file is too short."""
        self._file.seek(at)
        head = self._file.read(HEAD.size)
        if len(head) < HEAD.size:
            return b""
        size = HEAD.unpack(head)[1]
        return head + self._file.read(size) if at + len(head) + size <= self._size else b""

    def _next_chunk(self, at: int) -> int | None:
        """Offset of the first chunk from `at` on; None if there is none."""
        self._file.seek(at)
        rest = b""
        while piece := self._file.read(CHUNK_BYTES_MAX):
            rest += piece
            if found := CHUNK.search(rest):
                return at + found.start()
            at += max(len(rest) - CHUNK_HEAD_BYTES, 0)
            rest = rest[-CHUNK_HEAD_BYTES:]
        return None


def _parsed(content: bytes) -> McapRecord | None:
    """Record in these bytes; None if it is too short, or its type is not allowed outside chunks."""
    stream = ReadDataStream(BytesIO(content[HEAD.size :]))
    try:
        record: McapRecord = KINDS[content[0]].read(stream)
    except BROKEN:
        return None
    return record if stream.count == len(content) - HEAD.size else None


def _fault(chunk: Chunk) -> str:
    """Reason why a chunk must not be decompressed; empty if there is none."""
    size = chunk.uncompressed_size
    if size > CHUNK_BYTES_MAX:
        return f"a chunk of {size} B, expected at most {CHUNK_BYTES_MAX} B"
    if chunk.compression not in {"", "zstd"}:
        return f"a chunk is compressed with {chunk.compression[:20]!r}, expected zstd"
    try:
        packed = zstandard.frame_content_size if chunk.compression else len
        is_of_this_size = packed(chunk.data) in {-1, size}
    except zstandard.ZstdError:
        is_of_this_size = False
    return "" if is_of_this_size else "a chunk's content has another size than stated"
