"""Recovery of recordings that are damaged, or lack their end because a process was killed.

    index, where there is one ──┐
    next whole record ──────────┴→ records → a new file, with its summary and an index

The index of a file knows where its chunks are, even if bytes between them are damaged. Without an
index, or where the indexed chunk is damaged, the search goes on at the next byte pattern of a
chunk, the scenario or the metadata. A chunk contains its size and a checksum, so a damaged length
does not lose the records behind it.
"""

import re
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from skytether.shared.base import files
from skytether.shared.base.errors import RecordingError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario.schema import Scenario
from skytether.view.container import (
    BROKEN,
    HEAD,
    MAGIC,
    Allowance,
    Bounded,
    Index,
    index_of,
    opened,
    reading,
)
from skytether.view.recording import (
    CHUNK_BYTES,
    OURS,
    SCENARIO,
    SUMMARY,
    About,
    Recorded,
    known_of,
    parts_of,
    summary_of,
)

SUMMED = {"client", "server", "netem"}
"""Parts of the record that a summary is computed from."""
SIGNS = re.compile(
    rb"(?P<chunk>\x04\0\0\0zstd)|(?P<scenario>\r\0\0\0scenario\.toml)|(?P<about>\t\0\0\0skytether)"
)
"""Byte patterns by which chunks, the scenario and the metadata are found; each follows the length
of a text."""
SIGN_AT = {"chunk": HEAD.size + 28, "scenario": HEAD.size + 16, "about": HEAD.size}
"""Position of the pattern in its record [B]."""
SEARCHED_BYTES = 1024 * 1024
"""Bytes that are searched at a time."""


class Kept(NamedTuple):
    """Report on a recovery."""

    messages: int
    """Number of messages."""
    seconds: float
    """Time from the first message to the last [s]."""
    lost_bytes: int
    """Number of bytes that were not recovered [B]."""
    rows_before: int
    """Number of rows that other commands could read in the old file; 0 where it had no end."""
    rows: int
    """Number of rows that other commands can read now."""


def recover(path: Path, out: Path) -> Kept:
    """Write a recording anew from all its intact records, with a summary and an index.

    Args:
        path: file that has no end, or is damaged.
        out: file for the recording; may be the same, which is replaced only after the new file was
            read and found to hold no fewer rows.

    Raises:
        OSError: a file cannot be read, or written.
        RecordingError: the file is no recording, or nothing in it is intact; or rows would be lost.
    """
    before = _readable(path)
    source, size = opened(path)
    with source, files.replacing(out, is_input=out == path) as file:
        recovery = _Recovery(path, Bounded(source, size), file)
        with reading(path):
            recovery.run()
        file.flush()
        with Recorded(Path(f"/proc/self/fd/{file.fileno()}")) as recorded:
            rows = sum(map(len, recorded.parts().values()))
        if rows < before:
            said = f"{rows} of its {before} rows would be left"
            raise RecordingError(f"{path}: it stays as it is, for {said}")
    first_ns, last_ns = recovery.times_ns or (0, 0)
    seconds = (last_ns - first_ns) / SECOND_NS
    return Kept(recovery.messages, seconds, recovery.lost_bytes, before, rows)


def _readable(path: Path) -> int:
    """Number of rows that can be read from a recording as it is."""
    count = 0
    try:
        with Recorded(path) as recorded:
            for channel, _ in recorded.messages():
                count += "part" in channel.metadata
    except RecordingError:
        pass  # the file has no end, or is readable up to here
    return count


class _Recovery:
    """Recovery of one recording.

    Args:
        path: name of the old file.
        file: the old file.
        out: the new file.
    """

    def __init__(self, path: Path, file: Bounded, out: BinaryIO) -> None:
        self._path = path
        self._file = file
        self._writer = Writer(out, chunk_size=CHUNK_BYTES)
        self._schemas: dict[int, int] = {}
        """Id of each schema in the new file, by its id in the old one."""
        self._channels: dict[int, tuple[int, Channel]] = {}
        try:
            self._index = index_of(file)
        except BROKEN:
            self._index = Index()
        self.times_ns: list[int] = []
        """Time of the first message and of the last [ns]."""
        self.messages = 0
        """Number of messages that were recovered."""
        self.lost_bytes = 0
        """Number of bytes that were not recovered [B]."""

    def run(self) -> None:
        """Copy all intact records from the old file, and end the new one."""
        about, scenario = self._known()
        self._writer.start(profile="", library=OURS)
        summary = summary_of(scenario, about, parts_of(self._taken(), scenario))
        if summary:
            content = msgspec.json.encode(summary)
            self._writer.add_attachment(0, 0, SUMMARY, "application/json", content)
        self._writer.finish()

    def _known(self) -> tuple[About, Scenario]:
        """Facts about the old file, which precede all its messages."""
        metadata: dict[str, dict[str, str]] = {}
        attached: dict[str, bytes] = {}
        for record in self._whole():
            match record:
                case Metadata():
                    metadata[record.name] = record.metadata
                case Attachment():
                    attached[record.name] = record.data
            if OURS in metadata and SCENARIO in attached:
                break
        return known_of(self._path, metadata, attached)

    def _taken(self) -> Iterator[tuple[Channel, Message]]:
        """Write all intact records; yields those that a summary is computed from."""
        writer = self._writer
        for record in self._whole():
            match record:
                case Metadata(name=name, metadata=values):
                    writer.add_metadata(name, values)
                case Attachment(name=name, data=data) if name != SUMMARY:
                    times_ns = record.create_time, record.log_time
                    writer.add_attachment(*times_ns, name, record.media_type, data)
                case Schema() if record.id not in self._schemas:
                    made = writer.register_schema(record.name, record.encoding, record.data)
                    self._schemas[record.id] = made
                case Channel(schema_id=kind) if kind in self._schemas:
                    if record.id not in self._channels:
                        made = writer.register_channel(
                            record.topic,
                            record.message_encoding,
                            self._schemas[kind],
                            record.metadata,
                        )
                        self._channels[record.id] = made, record
                case Message() if record.channel_id in self._channels:
                    channel = self._take_message(record)
                    if channel.metadata.get("part") in SUMMED:
                        yield channel, record

    def _take_message(self, message: Message) -> Channel:
        number, channel = self._channels[message.channel_id]
        time_ns = message.log_time
        self._writer.add_message(
            number, time_ns, message.data, message.publish_time, message.sequence
        )
        first_ns, last_ns = self.times_ns or (time_ns, time_ns)
        self.times_ns = [min(first_ns, time_ns), max(last_ns, time_ns)]
        self.messages += 1
        return channel

    def _whole(self) -> Iterator[McapRecord]:
        """Intact records, except for the end of the file, which is made anew."""
        allowance = Allowance(self._file.size)
        chunks = {each.chunk_start_offset for each in self._index.chunks}
        hints = sorted(chunks | {*self._index.attachments, *self._index.metadata})
        signs = self._signs()
        sign = at = len(MAGIC)
        self.lost_bytes = 0
        while at < self._file.size:
            try:
                end, records = self._record(at, allowance, is_chunk=at in chunks)
            except BROKEN:
                while sign <= at:
                    sign = next(signs, self._file.size)
                behind = bisect_right(hints, at)
                end = min([sign, *hints[behind : behind + 1]])
                self.lost_bytes += end - at
            else:
                if not records:
                    return
                yield from records
            at = end

    def _record(
        self, at: int, allowance: Allowance, *, is_chunk: bool
    ) -> tuple[int, list[McapRecord]]:
        """End of the record at a position, and the record, or all those of a chunk; none at the
        file's end.

        Raises:
            BROKEN: no intact record is there.
        """
        file = self._file
        file.at = at
        opcode, length = HEAD.unpack(file.read(HEAD.size))
        if is_chunk or opcode == Opcode.CHUNK:
            chunk = file.chunk(at)
            end = file.at
            return end, list(allowance.records(chunk))
        if (opcode, length) in {(Opcode.DATA_END, 4), (Opcode.FOOTER, 20)}:
            return file.size, []
        if opcode == Opcode.ATTACHMENT:
            return self._attachment(at)
        if opcode == Opcode.METADATA:
            known = Metadata.read(ReadDataStream(file.stream))
            return file.at, [known]
        Opcode(opcode)  # a record of unknown type counts as damaged
        record = next(file.records(at))
        if file.at != at + HEAD.size + length:
            raise ValueError("a record has another size than it says")
        return file.at, [record]

    def _attachment(self, at: int) -> tuple[int, list[McapRecord]]:
        """Attachment with the size that it claims, if its checksum is right."""
        file = self._file
        file.at = at + HEAD.size
        record = Attachment.read(ReadDataStream(file.stream))
        end = file.at
        file.at = at + HEAD.size
        body = file.read(end - file.at)
        if crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            raise ValueError("an attachment's checksum is wrong")
        return end, [record]

    def _signs(self) -> Iterator[int]:
        """Positions where a record may begin, found by byte patterns."""
        at, overlap = 0, 32
        while at < self._file.size:
            self._file.at = at
            piece = self._file.read(SEARCHED_BYTES + overlap)
            for found in SIGNS.finditer(piece):
                if found.start() < SEARCHED_BYTES:
                    yield at + found.start() - SIGN_AT[found.lastgroup or ""]
            at += SEARCHED_BYTES
