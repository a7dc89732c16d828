"""Feed of a process: its record and events, for observers during the flight.

A feed is a stream of frames, each a length (`LENGTH_BYTES`, big-endian) followed by as many bytes
of msgpack. The first frame is `Opened`, which names parts of the record; `Rows` of these parts
follow. An observer that connects late gets the most recent complete frames. A reader that is too
slow is disconnected; the process never waits for readers (`shell.driving.feed`).
"""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.telemetry import parts
from skytether.shared.telemetry.every_event import EveryEvent
from skytether.shared.telemetry.record import Rows as Table

LENGTH_BYTES = 4
FRAME_BYTES_MAX = 4 * 1024 * 1024
ROW_BYTES_MAX = 4096
"""Largest size of a row [B]; a plan of 270 inputs has about 1200 B."""


class FeedError(ValueError):
    """Invalid data in a feed."""


class Opened(msgspec.Struct, frozen=True, tag=True, kw_only=True, omit_defaults=True):
    """First frame of a feed. It describes the process and the scenario."""

    process: str
    """Name of the process: server, netem or client; `server.N` is worker N of a server."""
    name: str
    scenario: str
    """The scenario as TOML, with all changes in flight so far."""
    parts: dict[str, str]
    """Columns of each part of the record in this feed, as numpy's description in JSON, by the
    part's name."""
    directions: Directions = msgspec.field(name="ways", default=FLIGHT)
    """Names of both directions of the process's network."""
    wall_ns: int
    """Time of day corresponding to `time_ns` [ns since 1970]."""
    time_ns: int
    """Start time on the process's clock [ns; CLOCK_MONOTONIC]."""


class Rows(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    part: str
    """Name of the part: client, server, plan or netem."""
    time_ns: int
    """Time at which the rows were recorded [ns; CLOCK_MONOTONIC]."""
    rows: bytes


class Said(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    time_ns: int
    event: EveryEvent


class Figures(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """Frame with the process's figures so far, sent about once a second."""

    time_ns: int
    figures: dict[str, Any]


Frame = Opened | Rows | Said | Figures

_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(Frame)
_UNDECODABLE = msgspec.DecodeError, UnicodeDecodeError, RecursionError, TypeError


def pack(frame: Frame) -> bytes:
    return _ENCODER.encode(frame)


def unpack(body: bytes | bytearray) -> Frame:
    """Frame from the bytes of `pack`; raises FeedError if they are not a frame."""
    try:
        frame: Frame = _DECODER.decode(body)
        if isinstance(frame, Figures):  # refuse values that JSON does not have
            msgspec.json.encode(frame.figures)
        return frame
    except _UNDECODABLE as error:
        raise FeedError(f"got no frame: {error}") from None


def encode(frame: Frame) -> bytes:
    body = pack(frame)
    return len(body).to_bytes(LENGTH_BYTES, "big") + body


class Reader:
    def __init__(self) -> None:
        self._bytes = bytearray()

    def read(self, piece: bytes) -> list[Frame]:
        """Frames that are complete now; raises FeedError if the bytes are not frames."""
        self._bytes += piece
        frames: list[Frame] = []
        begin = 0
        while len(self._bytes) - begin >= LENGTH_BYTES:
            body = begin + LENGTH_BYTES
            size = int.from_bytes(self._bytes[begin:body], "big")
            if size > FRAME_BYTES_MAX:
                raise FeedError(f"got a frame of {size} B, expected at most {FRAME_BYTES_MAX} B")
            if len(self._bytes) < body + size:
                break
            frames.append(unpack(self._bytes[body : body + size]))
            begin = body + size
        del self._bytes[:begin]
        return frames


def described(columns: Mapping[str, np.dtype[np.void]]) -> dict[str, str]:
    """Descriptions of the parts of the record for `Opened`, from their columns."""
    return {part: msgspec.json.encode(kind.descr).decode() for part, kind in columns.items()}


def columns_of(described: str) -> np.dtype[np.void]:
    """Columns of a part from their description; raises FeedError if it is invalid."""
    try:
        columns = parts.columns_of(msgspec.json.decode(described))
    except (ValueError, RecursionError) as error:
        raise FeedError(f"got no columns: {error}") from None
    if columns.itemsize > ROW_BYTES_MAX:
        raise FeedError(f"got rows of {columns.itemsize} B, expected at most {ROW_BYTES_MAX} B")
    return columns


def table(rows: bytes, columns: np.dtype[np.void]) -> Table:
    """Rows as a structured array; raises FeedError if the last row is incomplete."""
    if len(rows) % columns.itemsize:
        raise FeedError(f"got {len(rows)} B, expected rows of {columns.itemsize} B")
    return np.frombuffer(rows, columns)
