"""DataFlash logs of ArduPilot (`.bin`): the track of one vehicle.

A log describes itself: each message is 0xA3 0x95, its type, and a payload whose fields are named in
a message FMT (type 128). Places are taken from messages POS, or else from messages GPS with a fix
in 3D; altitudes are above the sea. Home is taken from ORGN, or else it is the first place. Between
messages, and after an incomplete message, bytes are skipped until the next message of a known type.

pymavlink's reader needs the name of a file, and prints a line for each skipped byte. This reader
needs only the content, and its time is bounded.
"""

from struct import Struct
from typing import Any

import numpy as np

from skytether.shared.formats import Tracks
from skytether.shared.formats.bounded import POINTS_MAX
from skytether.shared.formats.geographic import Origin, above_sea
from skytether.shared.formats.timing import Line, together

HEAD = b"\xa3\x95"
FMT, FMT_BYTES = 128, 89
FIX_3D = 3
HOME = 1
"""Type of ORGN messages that give home."""
CODES = {
    **{code: code for code in "bBhHiIqQfd"},
    "c": "h",
    "C": "H",
    "L": "i",
    "e": "i",
    "E": "I",
    "M": "B",
    "g": "e",
    "n": "4s",
    "N": "16s",
    "Z": "64s",
    "a": "64s",
}
"""Format code of Python's `struct` for each code of a field's type in the log."""
FACTORS = {"L": 1e-7, "c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01}
"""Factor that converts a stored number to the field's unit, by the code of the field's type."""
WANTED = {
    "POS": ("TimeUS", "Lng", "Lat", "Alt"),
    "GPS": ("TimeUS", "Lng", "Lat", "Alt", "Status"),
    "ORGN": ("Type", "Lng", "Lat", "Alt"),
}
"""Names of the fields to read, by message."""


class _Fields:
    """Reader of the wanted fields of one type of message."""

    def __init__(self, name: str, codes: str, columns: list[str]) -> None:
        self.name = name
        self._struct = Struct("<" + "".join(CODES[code] for code in codes))
        self.length = len(HEAD) + 1 + self._struct.size
        self._at = [columns.index(column) for column in WANTED[name]]
        self._factors = [FACTORS.get(codes[at], 1) for at in self._at]

    def __call__(self, content: bytes, begin: int) -> list[Any]:
        values = self._struct.unpack_from(content, begin)
        return [values[at] * factor for at, factor in zip(self._at, self._factors, strict=True)]


def tracks(content: bytes, axes: int, origin: Origin | None, speed_mps: float) -> Tracks:
    found = _messages(content)
    rows = found["POS"] or [row[:4] for row in found["GPS"] if row[4] >= FIX_3D]
    if not rows:
        raise ValueError("expected a DataFlash log with messages POS, or GPS with a fix")
    places = np.array([row[1:] for row in rows], dtype=np.float64)
    homes = [row[1:] for row in found["ORGN"] if row[0] == HOME]
    longitude, latitude, altitude_m = (homes or [places[0].tolist()])[0]
    placed = above_sea(places, axes, origin, (latitude, longitude, altitude_m))
    times_ns = 1000 * np.array([row[0] for row in rows], dtype=np.int64)
    return together([Line("the log", placed, times_ns)], speed_mps)


def axes_of(_: bytes) -> int:
    return 3


def _messages(content: bytes) -> dict[str, list[list[Any]]]:
    """Wanted fields of the messages of a log, by the name of the message; raises ValueError if
    there are too many.
    """
    found: dict[str, list[list[Any]]] = {name: [] for name in WANTED}
    lengths, readers = {FMT: FMT_BYTES}, dict[int, _Fields]()
    at, end = 0, len(content)
    while 0 <= at < end - 2:
        kind = content[at + 2]
        length = lengths.get(kind, 0)
        if content[at : at + 2] != HEAD or not length or at + length > end:
            at = content.find(HEAD, at + 1)
            continue
        if kind == FMT:
            of, size, reader = _format(content, at + 3)
            lengths[of] = size
            if reader is not None:
                readers[of] = reader
        elif kind in readers:
            reader = readers[kind]
            found[reader.name].append(reader(content, at + 3))
            if len(found[reader.name]) > POINTS_MAX:
                raise ValueError(f"expected at most {POINTS_MAX} messages {reader.name}")
        at += length
    return found


def _format(content: bytes, at: int) -> tuple[int, int, _Fields | None]:
    """Type and length of the messages that an FMT describes, and a reader if these are wanted."""
    of, size, name, codes, columns = Struct("<BB4s16s64s").unpack_from(content, at)
    title, named = (_text(each) for each in (name, codes))
    fields = _text(columns).split(",")
    is_wanted = title in WANTED and {*WANTED[title]} <= {*fields} and {*named} <= CODES.keys()
    reader = _Fields(title, named, fields) if is_wanted and len(named) == len(fields) else None
    return of, max(size, 3), reader if reader and reader.length == size else None


def _text(word: bytes) -> str:
    return word.partition(b"\0")[0].decode("ascii", "replace")
