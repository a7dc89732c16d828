"""MCAP files as they are read: what a file says of a size is checked before memory is taken for it.

A file of a few kilobytes may say that it holds gigabytes. The library `mcap` believes that, so it
is handed what cannot mislead it: a stream that ends where the file does (`Bounded`), chunks whose
size is known before they are decompressed, and never more records than the file has room to
index (`Allowance`).
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

from skytether.shared.base.errors import RecordingError
from skytether.shared.telemetry.record import RECORDING

MAGIC = b"\x89MCAP0\r\n"
"""Bytes that an MCAP file begins and ends with."""
HEAD = struct.Struct("<BQ")
"""Head of a record: what it is, and its size without the head [B]."""
FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
"""Size of the end of a file [B]: a record that says where the index begins."""

CHUNK_BYTES_MAX = 8 * 1024 * 1024
"""Largest size of a chunk, decompressed [B]; ours end at 256 KiB and a message."""
MESSAGE_BYTES_MAX = 4 * 1024 * 1024
"""Largest size of a message [B]: the scenario of a process that begins is the largest of ours."""
ROOM_BYTES = 16 * 1024 * 1024
"""Size that the chunks of any file may have together, decompressed [B]."""
RATIO_MAX = 50
"""Largest ratio by which the chunks may be larger, together, than their file; flights have 3 to 5,
as the index of their messages is not compressed."""
ROOM_MESSAGES = 10_000
"""Number of messages that any file may have: those of a chunk whose index was not written yet."""
INDEXED_BYTES = 16
"""Size of a message in the index [B]: a file has no more messages than it has room to index."""
ATTACHED_MAX = 100
"""Most attachments and pieces of metadata; ours have three."""

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
"""What the library, or what reads the messages, may meet in a file that is damaged."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Make one error of whatever is met in a damaged file."""
    try:
        yield
    except RecordingError:
        raise
    except BROKEN as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: it is damaged: {what}") from None


def opened(path: Path) -> tuple[BinaryIO, int]:
    """A file that begins as an MCAP file does, and its size [B].

    Raises:
        OSError: it cannot be read.
        RecordingError: it is no MCAP file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise RecordingError(f"{path}: it is no plain file, expected a recording ({RECORDING})")
    file = os.fdopen(descriptor, "rb")
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        what = "it is no MCAP file" if status.st_size else "it is empty"
        raise RecordingError(f"{path}: {what}, expected a recording ({RECORDING})")
    return file, status.st_size


class Bounded:
    """A file from which nobody reads, or reserves memory for, more than there is of it.

    All that is read of it together is bounded, too: a file may name the same place many times.

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
        """Place of the next byte that is read [B]."""

    def read(self, size: int = -1) -> bytes:
        """The next bytes, as many as there are.

        Raises:
            ValueError: far more was read than there is, or the place is none.
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
        """The file as the library takes it, which reads nothing but `read`."""
        return self

    def records(self, at: int) -> Iterator[McapRecord]:
        """Records from a place on; chunks stay closed.

        Raises:
            BROKEN: there is none.
        """
        self.at = at
        limit = self.size
        yield from StreamReader(
            self.stream, skip_magic=True, emit_chunks=True, record_size_limit=limit
        ).records

    def chunk(self, at: int) -> Chunk:
        """The chunk at a place, whatever its head says."""
        self.at = at + HEAD.size
        return Chunk.read(ReadDataStream(self.stream))


class Allowance:
    """What may still be read of a file.

    Args:
        size: size of the file [B].
    """

    def __init__(self, size: int) -> None:
        self._bytes = ROOM_BYTES + RATIO_MAX * size
        self._messages = ROOM_MESSAGES + size // INDEXED_BYTES

    def content(self, chunk: Chunk) -> bytes:
        """Content of a chunk.

        Raises:
            BROKEN: it is damaged.
            ValueError: it is larger than any of ours, or all of them together are.
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
            BROKEN: it is damaged.
            ValueError: see `content`; or there are more messages than a file of this size has.
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
    """The end of a file: what is in it, and where [B]."""

    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[int] = field(default_factory=list)
    metadata: list[int] = field(default_factory=list)


def index_of(file: Bounded) -> Index:
    """Index of a file.

    Raises:
        BROKEN: it has none, or that is damaged.
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
        BROKEN: some are damaged, or not there.
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
    """Messages of a file, as they lie in it.

    Raises:
        BROKEN: it is damaged.
    """
    allowance = Allowance(file.size)
    for at in sorted(each.chunk_start_offset for each in index.chunks):
        for record in allowance.records(file.chunk(at)):
            if isinstance(record, Message):
                yield index.channels[record.channel_id], record


def in_time(file: Bounded, index: Index) -> Iterator[tuple[Channel, Message]]:
    """Messages of a file in the order of their times; those of one time as they lie in it.

    Raises:
        BROKEN: it is damaged.
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
