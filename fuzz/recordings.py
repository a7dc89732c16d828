"""Target for recordings: altered files are read, exported, joined and reported.

A file is accepted, or refused with `RecordingError`; reading takes little memory, whatever sizes
the file claims.
"""

import io
import resource
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from zlib import crc32

import msgspec
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from fuzz.target import SCENARIO, Target, flown
from skytether.cli import recorder
from skytether.shared.base.errors import RecordingError
from skytether.shared.telemetry import feed
from skytether.shared.telemetry import summary as summaries
from skytether.shared.telemetry.summary import summarise
from skytether.view import rows
from skytether.view.recordings import container, export, recorded
from skytether.view.recordings.joining import join
from skytether.view.recordings.recorded import read
from skytether.view.recordings.recording import BEGUN, FEED
from skytether.view.recordings.report import page

REPORTED = 50
"""One in REPORTED readable recordings is also drawn, because drawing is slow."""
MEMORY_MAX_MB = 300
"""Memory that reading may take above the process's earlier peak [MB]."""
ODD: tuple[Any, ...] = (
    *(
        -(2**63),
        -1,
        0,
        7,
        255,
        2**16,
        600_000_000,
        2**31,
        2**40,
        2**53,
        2**63 - 1,
        2**63,
        2**64 - 1,
    ),
    *(-0.0, 1e-320, 1e12, 1e99, 1e308, -1e308, None, True, "", "x" * 5000, "=1+1", [], {}),
    *([0.5] * 400, [[]] * 50, bytes(7), bytes(5000)),
)
"""Values that are rarely valid."""
BITS = (0, 1, 2**63 - 1, 2**63, 2**64 - 1, 0x7FF0 << 48, 0xFFF8 << 48, 0x7FE0 << 48, 600_000_000)
"""Bits of numbers that are rarely valid in a column."""
DEEP = 100_000
COLUMNS = (
    *(
        "[]",
        "{}",
        "null",
        '[["step","|O"]]',
        '[["step","<i8",[1000000000]]]',
        '[["step","<M8[s]"]]',
        '[["step","f8,("]]',
    ),
    *('[["vehicle","<u2"],["step","<i8"]]', '[["state","<f8",[2,2]],["x","<f8",[900000]]]'),
    "[" * DEEP,
)
"""Column descriptions that no part has."""


def records(content: bytes) -> list[Any]:
    """Metadata, attachments, schemas, channels and messages of a recording."""
    kinds = Metadata | Attachment | Schema | Channel | Message
    items: list[Any] = []
    for each in StreamReader(io.BytesIO(content)).records:
        if isinstance(each, kinds) and not (isinstance(each, Schema | Channel) and each in items):
            items.append(each)
    return items


def written(found: list[Any]) -> bytes:
    """File of these records, with valid checksums."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=64 * 1024)
    writer.start()
    schemas, channels = {0: 0}, {}
    for each in found:
        match each:
            case Metadata():
                writer.add_metadata(each.name, each.metadata)
            case Attachment():
                writer.add_attachment(0, 0, each.name, each.media_type, each.data)
            case Schema():
                schemas[each.id] = writer.register_schema(each.name, each.encoding, each.data)
            case Channel():
                channels[each.id] = writer.register_channel(
                    each.topic, each.message_encoding, schemas[each.schema_id], each.metadata
                )
            case Message():
                writer.add_message(
                    channels[each.channel_id], each.log_time, each.data, each.publish_time
                )
    writer.finish()
    return file.getvalue()


def of_topic(found: list[Any], topic: str) -> list[int]:
    """Positions of the messages on topics with this prefix."""
    numbers = {e.id for e in found if isinstance(e, Channel) and e.topic.startswith(topic)}
    return [i for i, e in enumerate(found) if isinstance(e, Message) and e.channel_id in numbers]


def frames_of(found: list[Any], kind: str) -> dict[int, dict[str, Any]]:
    frames = {i: msgspec.msgpack.decode(found[i].data) for i in of_topic(found, FEED)}
    return {i: frame for i, frame in frames.items() if frame["type"] == kind}


def put(found: list[Any], at: int, content: Any) -> None:
    found[at] = replace(found[at], data=msgspec.msgpack.encode(content))


def deep(rng: Random) -> bytes:
    return rng.choice([b"\x91" * DEEP, b"\x81\xa1a" * DEEP, b"\x91" * DEEP + b"\x90"])


def changed_value(rng: Random, found: list[Any]) -> None:
    """Replace or delete a value of a frame or of the first message, or nest it deeply."""
    at = rng.choice(of_topic(found, rng.choice([FEED, FEED, BEGUN])))
    if rng.random() < 0.1:
        found[at] = replace(found[at], data=deep(rng))
        return
    message = msgspec.msgpack.decode(found[at].data)
    below = message
    while isinstance(below, dict) and below:
        key = rng.choice(list(below))
        if isinstance(below[key], dict) and rng.random() < 0.8:
            below = below[key]
            continue
        if rng.random() < 0.1:
            del below[key]
        else:
            below[key] = rng.choice(ODD)
        break
    put(found, at, message)


def changed_column(rng: Random, found: list[Any]) -> None:
    """Replace a value in a column of every row, or of one row."""
    part = rng.choice([each["part"] for each in frames_of(found, "Rows").values()])
    parts = [each["parts"] for each in frames_of(found, "Opened").values()]
    columns = next(feed.columns_of(each[part]) for each in parts if part in each)
    name, bits = rng.choice(columns.names or ()), rng.choice(BITS).to_bytes(8, "little")
    rows = [(i, e) for i, e in frames_of(found, "Rows").items() if e["part"] == part]
    for i, each in rows if rng.random() < 0.5 else rng.sample(rows, 1):
        table = np.frombuffer(each["rows"], columns).copy()
        table[name] = np.frombuffer(bits, columns[name].base, 1)[0]
        put(found, i, {**each, "rows": table.tobytes()})


def changed_columns(rng: Random, found: list[Any]) -> None:
    at, opened = rng.choice(list(frames_of(found, "Opened").items()))
    part = rng.choice([*opened["parts"], "client", "netem", "plan", ""])
    parts = {**opened["parts"], part: rng.choice([*COLUMNS, *opened["parts"].values()])}
    put(found, at, {**opened, "parts": parts})


def changed_channel(rng: Random, found: list[Any]) -> None:
    at = rng.choice([i for i, each in enumerate(found) if isinstance(each, Channel)])
    if rng.random() < 0.5:
        topics = [e.topic for e in found if isinstance(e, Channel)]
        found[at] = replace(found[at], topic=rng.choice([*topics, FEED, BEGUN, ""]))
    else:
        found[at] = replace(found[at], message_encoding=rng.choice(["json", "msgpack", ""]))


def changed_words(rng: Random, found: list[Any]) -> None:
    begun = of_topic(found, BEGUN)[0]
    at = rng.choice([begun, *frames_of(found, "Opened")])
    message = msgspec.msgpack.decode(found[at].data)
    text = message["scenario"]
    match rng.randrange(4):
        case 0:
            text = "x = " + rng.choice(["[", '{"a":']) * DEEP
        case 1:
            text = ".".join(["reference"] * DEEP) + " = 1\n"
        case 2:
            text = text.replace("= 0.05", f"= {rng.choice(ODD[:20])}")
        case _:
            lines = text.splitlines(keepends=True)
            lines[rng.randrange(len(lines))] = 'points = "' + "x" * 10**6 + '"\n'
            text = "".join(lines)
    put(found, at, {**message, "scenario": text})


def changed_times(rng: Random, found: list[Any]) -> None:
    at = rng.choice(of_topic(found, FEED))
    frame = msgspec.msgpack.decode(found[at].data)
    time_ns = rng.choice([0, 1, 2**31, 2**50, 2**61, 2**62, 2**63, 2**64 - 1, -1, -(2**63)])
    put(found, at, {**frame, "time_ns": time_ns})


def repeated(rng: Random, found: list[Any]) -> None:
    message = rng.choice([each for each in found if isinstance(each, Message)])
    found += [message] * rng.choice([100, 2000])


def of_columns_alone(rng: Random, found: list[Any]) -> None:
    """Add empty rows of a part whose columns are huge."""
    at, opened = rng.choice(list(frames_of(found, "Opened").items()))
    part = rng.choice(list(opened["parts"]))
    columns = msgspec.json.decode(opened["parts"][part])
    columns.append(["inputs" if rng.random() < 0.5 else "more", "<f4", [2, 100_000]])
    parts = {**opened["parts"], part: msgspec.json.encode(columns).decode()}
    put(found, at, {**opened, "parts": parts})
    empty = {"type": "Rows", "part": part, "time_ns": 1, "rows": b""}
    data = msgspec.msgpack.encode(empty)
    found += [replace(found[at], data=data)] * 3000


def bomb(rng: Random, content: bytes) -> bytes:
    """Insert a chunk that decompresses to far more than its size."""
    recorded_items = records(content)
    channel = rng.choice([each for each in recorded_items if isinstance(each, Channel)])
    builder = RecordBuilder()
    Message(channel.id, 0, rng.choice([b"{}", b"[" * 200, b" " * 4000]), 0, 0).write(builder)
    inside = builder.end()
    inside *= rng.choice([1 << 16, 1 << 24, 40 << 20]) // len(inside)
    data = zstandard.compress(inside, 19 if len(inside) < 1 << 20 else 3)
    size = len(inside)
    if rng.random() < 0.3:
        size = rng.choice([0, 1, 2**31, 2**40, 2**63])
    if rng.random() < 0.2:  # a zstd frame that claims more than it contains
        data = (
            b"\x28\xb5\x2f\xfd\xe0"
            + struct.pack("<Q", rng.choice([2**33, 2**40, 2**62]))
            + data[9:]
        )
    chunk = Chunk("zstd", data, 10**9, 0, rng.choice([0, crc32(inside)]), size)
    chunk.write(builder)
    record = builder.end() * rng.choice([1, 1, 30])
    reader = make_reader(io.BytesIO(content))
    summary = reader.get_summary()
    assert summary is not None
    place = summary.chunk_indexes[0].chunk_start_offset
    if rng.random() < 0.5:  # at the position of a chunk in the index
        return content[:place] + record + content[place + len(record) :]
    return content[:place] + record + content[place:]


def misled(rng: Random, content: bytes) -> bytes:
    """Make the index point to missing or repeated positions, or headers claim false sizes."""
    changed = bytearray(content)
    start = struct.unpack_from("<Q", content, len(content) - 28)[0]
    match rng.randrange(4):
        case 0:
            where = rng.choice([8, start // 2, len(content) - 37, 2**40])
            struct.pack_into("<Q", changed, len(content) - 28, where)
        case 1:
            ends = changed[start:]
            changed[start:start] = ends[: ends.find(b"\x0b")] * rng.choice([2, 500])
        case 2:
            for _ in range(rng.randrange(1, 6)):
                at = rng.randrange(start, len(changed) - 36)
                changed[at] = rng.choice([0, 1, 127, 128, 255])
        case _:
            summary = make_reader(io.BytesIO(content)).get_summary()
            assert summary is not None
            at = rng.choice(summary.chunk_indexes).chunk_start_offset
            for _ in range(rng.randrange(1, 4)):
                changed[at + rng.randrange(50)] = rng.choice([0, 1, 127, 128, 255])
    return bytes(changed)


def scattered(rng: Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.randrange(1, 5)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    if rng.random() < 0.3:
        del changed[rng.randrange(len(changed)) :]
    return bytes(changed)


INSIDE = (
    *(changed_value, changed_value, changed_column, changed_column, changed_columns),
    *(changed_channel, changed_words, changed_times, repeated, of_columns_alone),
)
"""Mutations of records, which are then written as a valid file."""
OUTSIDE = (bomb, misled, scattered)
"""Mutations of bytes."""


def hostile(rng: Random, content: bytes, lines: list[Any]) -> tuple[str, bytes]:
    """Mutated recording, and the name of the mutation; `known` are the records in `content`."""
    if rng.random() < 0.6:
        how, found = rng.choice(INSIDE), list(lines)
        how(rng, found)
        return how.__name__, written(found)
    outside = rng.choice(OUTSIDE)
    return outside.__name__, outside(rng, content)


class RecordingFile(Target):
    """Target for a recording's file: it is refused, or can be read, exported and reported."""

    code = (container, export, feed, recorded, rows, summaries)
    largest = 256 * 1024

    def __init__(self, folder: Path) -> None:
        self._path = folder / "it.mcap"
        self._before_mb = peak_mb()
        parts = flown().client, flown().server, flown().netem
        summary = summarise(SCENARIO, "demo", *parts)
        assert recorder.write(self._path, SCENARIO, "demo", flown(), summary) is None
        self._content = self._path.read_bytes()
        self._records = records(self._content)

    def seeds(self) -> Sequence[bytes]:
        return (self._content,)

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        if payload != self._content:
            return scattered(rng, payload or b"\0")
        return hostile(rng, payload, self._records)[1]

    def __call__(self, payload: bytes) -> None:
        self._path.write_bytes(payload)
        with suppress(RecordingError):
            recording = read(self._path)
            for columns in export.tables(recording).values():
                export.csv(columns)
            join([recording], io.BytesIO())
            if crc32(payload) % REPORTED == 0:
                page(recording, [])
        assert peak_mb() < self._before_mb + MEMORY_MAX_MB


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
