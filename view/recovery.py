"""Recordings without an end, as a killed process leaves them: what is whole of one, with an end."""

import io
from collections.abc import Iterator
from pathlib import Path
from struct import Struct
from typing import BinaryIO, NamedTuple
from zlib import crc32

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from shared.endpoint import SECOND_NS
from view.recording import (
    BROKEN,
    CHUNK_BYTES,
    MAGIC,
    OURS,
    SUMMARY,
    known_of,
    opened,
    parts_of,
    reading,
    summary_of,
)

HEAD = Struct("<BQ")
"""Head of a record: what it is, and its size without the head [B]."""
SUMMED = {"client", "server", "netem"}
"""Parts of the record that a summary is made of."""


class Kept(NamedTuple):
    """What has been kept of a file without an end."""

    messages: int
    """Number of messages."""
    seconds: float
    """Time from the first of them to the last [s]."""
    bytes: int
    """Size of what was whole [B]."""
    of_bytes: int
    """Size of the file [B]."""


def recover(path: Path, out: Path) -> Kept:
    """Write a recording anew from all that is whole of it, with its summary and an index.

    Args:
        path: file that has no end, or is damaged.
        out: file for the recording; may be the same, which is then replaced once all is done.

    Raises:
        OSError: a file cannot be read, or written.
        RecordingError: it is no recording, or nothing of one.
    """
    source, size = opened(path)
    part = out.with_name(f"{out.name}.part")
    with source:
        try:
            with part.open("wb") as file:
                kept = _Recovery(path, file).of(source, size)
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)
    return kept


class _Recovery:
    """A recording that is written anew."""

    def __init__(self, path: Path, out: BinaryIO) -> None:
        self._path = path
        self._writer = Writer(out, chunk_size=CHUNK_BYTES)
        self._metadata: dict[str, dict[str, str]] = {}
        self._attached: dict[str, bytes] = {}
        self._schemas: dict[int, int] = {}
        """Number of each schema in the new file, by that in the old one."""
        self._channels: dict[int, tuple[int, Channel]] = {}
        self._rows: list[tuple[Channel, Message]] = []
        """Messages of which the summary is made."""
        self._times_ns: list[int] = []
        """Time of the first message and of the last."""
        self._count = 0

    def of(self, file: BinaryIO, size: int) -> Kept:
        """Take all that is whole from the old file, and end the new one."""
        self._writer.start(profile="", library=OURS)
        whole_bytes = len(MAGIC)
        for end, records in _whole(file, size):
            whole_bytes = end
            for record in records:
                self._take(record)
        about, scenario = known_of(self._path, self._metadata, self._attached)
        with reading(self._path):
            summary = summary_of(scenario, about, parts_of(self._rows))
        if summary:
            self._writer.add_attachment(
                0, 0, SUMMARY, "application/json", msgspec.json.encode(summary)
            )
        self._writer.finish()
        first_ns, last_ns = self._times_ns or (0, 0)
        return Kept(self._count, (last_ns - first_ns) / SECOND_NS, whole_bytes, size)

    def _take(self, record: McapRecord) -> None:
        writer = self._writer
        match record:
            case Metadata(name=name, metadata=values):
                self._metadata[name] = values
                writer.add_metadata(name, values)
            case Attachment(name=name, data=data) if name != SUMMARY:
                self._attached[name] = data
                times_ns = record.create_time, record.log_time
                writer.add_attachment(*times_ns, name, record.media_type, data)
            case Schema() if record.id not in self._schemas:
                made = writer.register_schema(record.name, record.encoding, record.data)
                self._schemas[record.id] = made
            case Channel() if record.id not in self._channels and record.schema_id in self._schemas:
                kind = self._schemas[record.schema_id]
                made = writer.register_channel(
                    record.topic, record.message_encoding, kind, record.metadata
                )
                self._channels[record.id] = made, record
            case Message() if record.channel_id in self._channels:
                self._take_message(record)

    def _take_message(self, message: Message) -> None:
        number, channel = self._channels[message.channel_id]
        self._writer.add_message(
            number, message.log_time, message.data, message.publish_time, message.sequence
        )
        if channel.metadata.get("part") in SUMMED:
            self._rows.append((channel, message))
        first_ns, last_ns = self._times_ns or (message.log_time, message.log_time)
        self._times_ns = [min(first_ns, message.log_time), max(last_ns, message.log_time)]
        self._count += 1


def _whole(file: BinaryIO, size: int) -> Iterator[tuple[int, list[McapRecord]]]:
    """Records that are whole, those of a chunk together, and where in the file they end [B].

    A record that is damaged is left out. What comes behind the data is not read: it is made anew.
    """
    file.seek(len(MAGIC))
    while True:
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack(head)
        end = file.tell() + length
        if end > size or opcode in {Opcode.DATA_END, Opcode.FOOTER}:
            return
        body = file.read(length)
        if opcode == Opcode.ATTACHMENT and crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            continue
        piece = io.BytesIO(head + body)
        try:
            record = next(StreamReader(piece, skip_magic=True, emit_chunks=True).records)
            if isinstance(record, Chunk):
                records = breakup_chunk(record, validate_crc=True)
            else:
                records = [record]
        except BROKEN:
            continue
        yield end, records
