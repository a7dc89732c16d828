"""Safe reading of MCAP files: sizes that a file claims are checked before memory is allocated.

A file of a few kilobytes may claim to hold gigabytes, and the library `mcap` believes that. So the
library is only given safe input: a stream that ends where the file does (`Bounded`), chunks whose
size is known before they are decompressed, and never more records than the file has room to index
(`Allowance`).
"""

import io
import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
)
from mcap.stream_reader import StreamReader

from skytether.shared.base import files
from skytether.shared.base.errors import RecordingError
from skytether.shared.telemetry.record import RECORDING

MAGIC = b"\x89MCAP0\r\n"
"""Bytes that an MCAP file begins and ends with."""
HEAD = struct.Struct("<BQ")
"""Header of a record: its type, and its size without the header [B]."""
FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
"""Size of the end of a file [B]: the record with the position of the index."""

CHUNK_BYTES_MAX = 8 * 1024 * 1024
"""Largest size of a decompressed chunk [B]; this program ends chunks at 256 KiB and a message."""
MESSAGE_BYTES_MAX = 4 * 1024 * 1024
"""Largest size of a message [B]; the largest written by this program has a process's scenario."""
ROOM_BYTES = 16 * 1024 * 1024
"""Total decompressed size of chunks that any file may have, however small it is [B]."""
RATIO_MAX = 50
"""Largest total decompressed size of the chunks over the file's size; flights have 3 to 5, as the
index of their messages is not compressed."""
ROOM_MESSAGES = 10_000
"""Number of messages that any file may have: those of a chunk whose index was not written yet."""
INDEXED_BYTES = 16
"""Size of a message's entry in the index [B]; it bounds the number of messages in a file."""
ATTACHED_MAX = 100
"""Most attachments and metadata records; this program writes three."""

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
    """Turn any exception from a damaged file into one error."""
    try:
        yield
    except RecordingError:
        raise
    except BROKEN as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: it is damaged: {what}") from None


def opened(path: Path) -> tuple[BinaryIO, int]:
    """File that begins with MCAP's magic bytes, and its size [B].

    Raises:
        OSError: the file cannot be read.
        RecordingError: the file is no MCAP file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise RecordingError(f"{path}: it is no plain file, expected a recording ({RECORDING})")
    file = os.fdopen(descriptor, "rb")
    try:
        files.note(path, file)
    except OSError:
        file.close()
        raise
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        what = "it is no MCAP file" if status.st_size else "it is empty"
        raise RecordingError(f"{path}: {what}, expected a recording ({RECORDING})")
    return file, status.st_size


class Bounded:
    """File of which no more is read, and for which no more memory is reserved, than its size.

    The total number of bytes read is bounded, too: a file's index may name one position many times.

    Args:
        file: the file.
        size: its size [B].
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._left = ROOM_BYTES + RATIO_MAX * size
        self.size = size
        """Size of the file [B]."""
        self.at = 0
        """Position of the next byte to read [B]."""

    def read(self, size: int = -1) -> bytes:
        """Next bytes, as many as there are.

        Raises:
            ValueError: far more was read in total than the file has, or the position is invalid.
        """
        if self._left < 0:
            raise ValueError("it names the same places again and again")
        if not 0 <= self.at < self.size:
            raise ValueError("it names a place that is not in it")
        left = self.size - self.at
        self._file.seek(self.at)
        piece = self._file.read(left if size < 0 else min(size, left))
        self.at += len(piece)
        self._left -= len(piece)
        return piece

    @property
    def stream(self) -> Any:
        """The file as a stream for the library, which calls only `read`."""
        return self

    def records(self, at: int) -> Iterator[McapRecord]:
        """Records from a position on; chunks stay compressed.

        Raises:
            BROKEN: no record is there.
        """
        self.at = at
        limit = self.size
        yield from StreamReader(
            self.stream, skip_magic=True, emit_chunks=True, record_size_limit=limit
        ).records

    def chunk(self, at: int) -> Chunk:
        """Chunk at a position; its claimed size is checked."""
        self.at = at + HEAD.size
        return Chunk.read(ReadDataStream(self.stream))


class Allowance:
    """Remaining budget of bytes and messages that may be read of a file.

    Args:
        size: size of the file [B].
    """

    def __init__(self, size: int) -> None:
        self._bytes = ROOM_BYTES + RATIO_MAX * size
        self._messages = ROOM_MESSAGES + size // INDEXED_BYTES

    def content(self, chunk: Chunk) -> bytes:
        """Content of a chunk.

        Raises:
            BROKEN: the chunk is damaged.
            ValueError: the chunk, or all chunks together, exceed the bounds.
        """
        size = chunk.uncompressed_size
        if size > CHUNK_BYTES_MAX:
            raise ValueError(f"a chunk of {size} B, expected at most {CHUNK_BYTES_MAX} B")
        self._bytes -= size
        if self._bytes < 0:
            raise ValueError("its chunks are far larger than any flight's, for a file of its size")
        match chunk.compression:
            case "":
                content = chunk.data
            case "zstd":
                if zstandard.frame_content_size(chunk.data) not in {-1, size}:
                    raise ValueError("a chunk's content has another size than it says")
                decompressor = zstandard.ZstdDecompressor(max_window_size=CHUNK_BYTES_MAX)
                content = decompressor.decompress(chunk.data, max_output_size=size)
            case other:
                raise ValueError(f"a chunk is compressed with {other[:20]!r}, expected zstd")
        if len(content) != size:
            raise ValueError("a chunk's content has another size than it says")
        if chunk.uncompressed_crc and crc32(content) != chunk.uncompressed_crc:
            raise ValueError("a chunk's checksum is wrong")
        return content

    def records(self, chunk: Chunk) -> Iterator[McapRecord]:
        """Records of a chunk, one by one.

        Raises:
            BROKEN: the chunk is damaged.
            ValueError: see `content`; or the file has more messages than its size allows.
        """
        content = self.content(chunk)
        stream = io.BytesIO(content)
        limit = MESSAGE_BYTES_MAX
        records = StreamReader(
            stream, skip_magic=True, emit_chunks=True, record_size_limit=limit
        ).records
        while stream.tell() < len(content):
            record = next(records)
            if isinstance(record, Message):
                self._messages -= 1
                if self._messages < 0:
                    raise ValueError("it has more messages than a file of its size has room for")
            yield record


@dataclass(slots=True)
class Index:
    """Index of a file: positions of its records [B]."""

    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[int] = field(default_factory=list)
    metadata: list[int] = field(default_factory=list)


def index_of(file: Bounded) -> Index:
    """Index of a file.

    Raises:
        BROKEN: the file has no index, or a damaged one.
    """
    footer = next(file.records(file.size - FOOTER_BYTES))
    if not isinstance(footer, Footer) or not footer.summary_start:
        raise ValueError("it has no index")
    index = Index()
    for record in file.records(footer.summary_start):
        match record:
            case Channel():
                index.channels[record.id] = record
            case ChunkIndex():
                index.chunks.append(record)
            case AttachmentIndex():
                index.attachments.append(record.offset)
            case MetadataIndex():
                index.metadata.append(record.offset)
    return index


def attached(file: Bounded, index: Index) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """Metadata and attachments of a file, by name.

    Raises:
        BROKEN: some are damaged or missing.
    """
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    places = {*index.metadata, *index.attachments}
    if len(places) > ATTACHED_MAX:
        raise ValueError(f"{len(places)} attachments, expected at most {ATTACHED_MAX}")
    for at in sorted(places):
        match next(file.records(at)):
            case Metadata() as record:
                metadata[record.name] = record.metadata
            case Attachment() as record:
                attachments[record.name] = record.data
            case _:
                raise ValueError("its index names what is not there")
    return metadata, attachments


def messages(file: Bounded, index: Index) -> Iterator[tuple[Channel, Message]]:
    """Messages of a file, in file order.

    Raises:
        BROKEN: the file is damaged.
    """
    allowance = Allowance(file.size)
    for at in sorted(each.chunk_start_offset for each in index.chunks):
        for record in allowance.records(file.chunk(at)):
            if isinstance(record, Message):
                yield index.channels[record.channel_id], record


def in_time(file: Bounded, index: Index) -> Iterator[tuple[Channel, Message]]:
    """Messages of a file in order of time, equal times in file order.

    Raises:
        BROKEN: the file is damaged.
    """
    allowance, number = Allowance(file.size), 0
    waiting: list[tuple[int, int, int, Message]] = []
    for each in sorted(index.chunks, key=lambda it: (it.message_start_time, it.chunk_start_offset)):
        while waiting and waiting[0][0] < each.message_start_time:
            *_, message = heappop(waiting)
            yield index.channels[message.channel_id], message
        for record in allowance.records(file.chunk(each.chunk_start_offset)):
            if isinstance(record, Message):
                number += 1
                item = record.log_time, each.chunk_start_offset, number, record
                heappush(waiting, item)
    while waiting:
        *_, message = heappop(waiting)
        yield index.channels[message.channel_id], message
