"""Recorded paths: files of measured delays, in one of several formats.

- CSV with a line of names: a column of times, a column of delays or round trips, and optionally
`lost` (`_TIMES`, `_DELAYS`). `skytether probe` writes this format, with `time_s,delay_s,lost`.
- Logs of ping and similar programs (`pings`).
- The JSON that `irtt client -o` writes, gzipped or not.

Each file is read as rows of a time and a delay, or NaN; `_checked` converts the rows to a path.
Half of a round trip is used for each direction. A packet without an answer counts as lost in both
directions.
"""

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import StringIO
from typing import Literal

import msgspec
import numpy as np

from skytether.shared.formats import pings
from skytether.shared.formats.pings import BACK_MAX_S, ROWS_MAX
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.registry import File

DELAY_MAX_S = 3600.0
TEXT_BYTES_MAX = 256 * 1024 * 1024
"""Largest size of a file after decompression [B]."""
CELLS_MAX = 2_000_000
"""Largest number of columns; bounds the memory for a line."""
TIE_S = 1e-6
"""Difference of times up to which two packets count as sent at the same time [s]."""

CAPTURES = *map(bytes.fromhex, ("d4c3b2a1", "a1b2c3d4", "4d3cb2a1", "a1b23c4d")), b"\n\r\r\n"
"""First bytes of a capture of packets: pcap, in both byte orders, and pcapng."""

Way = Literal["auto", "send", "receive"]


@dataclass(frozen=True, slots=True)
class RecordedPath:
    """Delays of a recorded path, one row per packet."""

    time_s: Array
    """Times at which packets were sent, rising from 0 [s]; shape (n,)."""
    delay_s: Array
    """One-way delays [s], interpolated for lost packets; shape (n,)."""
    lost: Flags
    halved: bool = False
    copies: int = 0
    """Number of duplicate answers, if the file lists them."""
    begin_s: float = 0.0
    """Time of the first packet on the file's own clock [s]."""


@lru_cache(maxsize=16)
def recorded_in(file: File, way: Way = "auto") -> RecordedPath:
    """Path recorded in a file.

    Args:
        file: name and content of the file.
        way: delay to use from a file of irtt: from client to server (send) or back (receive), for
            which irtt's two clocks must be synchronised, or half of the round trip (auto).

    Raises:
        ValueError: the file has no delays, or they contradict each other.
    """
    try:
        text = text_in(file)
        if text.lstrip()[:1] == "{":
            return _of_irtt(text, way)
        if pings.is_log(text):
            runs = pings.runs(text)
            times_s, trips_s = pings.joined(runs)
            copies = sum(run.copies for run in runs)
            begin_s = float(runs[0].timed()[0][0])
            return _checked(times_s, trips_s / 2.0, halved=True, copies=copies, begin_s=begin_s)
        return _of_csv(text)
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from None


def text_in(file: File) -> str:
    """Text of a file: UTF-8, or UTF-16 and code pages as Windows writes them, gzipped or not.

    Raises:
        ValueError: the content is empty, too long, or no text.
    """
    content = file.content
    if content[:2] == b"\x1f\x8b":
        unzip = zlib.decompressobj(31)
        try:
            content = unzip.decompress(content, TEXT_BYTES_MAX)
        except zlib.error as error:
            raise ValueError(f"cannot be read: {error}") from None
        if not unzip.eof or unzip.unused_data:
            raise ValueError(
                f"got a truncated file, several files, or more than {TEXT_BYTES_MAX} bytes unzipped"
            )
    if content[:4] in CAPTURES:
        raise ValueError("got a capture of packets, expected a log")
    try:
        if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
            text = content.decode("utf-16")
        else:
            text = content.decode("utf-8-sig")
    except ValueError:
        text = content.decode("latin-1")
    if "\0" in text:
        raise ValueError("cannot be read: got NUL bytes, expected text")
    if not text.strip():
        raise ValueError("got an empty file, expected delays, see docs/network.md")
    return text


# -- CSV ------------------------------------------------------------------------------------------

_TIMES = ("time", "sent", "timestamp", "t")
_DELAYS = {"delay": 1.0, "rtt": 0.5}
"""Names of columns of delays, without units, and the factor to a one-way delay."""
_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_NAME = re.compile(r"([a-z]+)(?:[ _]?[\[(]?(s|sec|ms|msec|us|µs|ns)[\])]?)?", re.IGNORECASE)


def table(text: str, columns: Sequence[int], delimiter: str = ",") -> Array:
    """Numbers of columns below a line of names; shape (rows, columns). An empty cell is NaN.

    Raises:
        ValueError: there are too many rows or none, or a cell is invalid.
    """
    rows = text.rstrip().count("\n")
    if rows > ROWS_MAX:
        raise ValueError(f"got {rows} rows, expected at most {ROWS_MAX}")
    body = text.split("\n", 1)[1] if "\n" in text else ""
    if not body.strip():
        raise ValueError("got no rows, expected at least one below its first line")
    if any(line.count(delimiter) >= CELLS_MAX for line in StringIO(body)):
        raise ValueError(f"expected at most {CELLS_MAX} columns")
    try:
        return np.loadtxt(
            StringIO(body),
            delimiter=delimiter,
            ndmin=2,
            comments=None,
            converters=_cell,
            usecols=columns,
            dtype=np.float64,
        )
    except ValueError:
        raise ValueError(_wrong_cell(text, columns, delimiter)) from None


def _cell(word: str) -> float:
    word = word.strip().strip('"')
    return float(word) if word else np.nan


def _wrong_cell(text: str, columns: Sequence[int], delimiter: str) -> str:
    """Message for the first line without a number in a column that needs numbers."""
    for number, line in enumerate(StringIO(text), 1):
        cells = line.rstrip("\r\n").split(delimiter)
        if number == 1 or not line.strip():
            continue
        for column in columns:
            try:
                _cell(cells[column])
            except LookupError:
                return f"line {number}: got {len(cells)} columns, expected at least {column + 1}"
            except ValueError:
                return f"line {number}: got {cells[column][:60]!r}, expected numbers"
    return "expected numbers"


def _of_csv(text: str) -> RecordedPath:
    head = text.split("\n", 1)[0]
    delimiter = next((each for each in ";\t" if each in head), ",")
    if delimiter == ";":
        text = text.replace(",", ".")
    names = [name.strip().strip('"') for name in head.split(delimiter)]
    kinds: dict[str, tuple[int, str]] = {}
    for index, name in enumerate(names):
        if found := _NAME.fullmatch(name):
            kinds.setdefault(found[1].lower(), (index, (found[2] or "").lower()))
    time = next((name for name in _TIMES if name in kinds), "")
    delay = next((name for name in _DELAYS if name in kinds), "")
    if not time or not delay:
        raise ValueError(
            f"got the first line {','.join(names)[:60]!r}, expected the columns of a time, such as "
            "time_s or timestamp, and of a delay, such as delay_s, rtt_s or rtt_ms"
        )
    (time_at, time_unit), (delay_at, delay_unit) = kinds[time], kinds[delay]
    columns = [time_at, delay_at, *([kinds["lost"][0]] if "lost" in kinds else [])]
    rows = table(text, columns, delimiter)
    times, delays = rows[:, 0], rows[:, 1]
    delays = np.where(delays == -1.0, np.nan, delays)
    flags = (rows[:, 2:] != 0.0).any(axis=1)
    if "lost" in kinds:
        _refuse(~flags & np.isnan(delays), rows[:, 1], "a delay, or 1 in the column lost")
        delays = np.where(flags, np.nan, delays)
    times = times * (_UNITS.get(time_unit) or _unit_of_times(times, names[time_at]))
    delays = delays * (_UNITS.get(delay_unit) or _unit(delays, names[delay_at], 0.15, 2.0))
    return _checked(times, delays * _DELAYS[delay], halved=delay == "rtt")


def _unit_of_times(times: Array, name: str) -> float:
    """Unit of times without a stated unit [s]: by their size if since 1970, else by intervals."""
    largest = float(np.nanmax(times, initial=0.0))
    for least, unit in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0)):
        if largest >= least:
            return unit
    return _unit(np.diff(times), name, 2.0, 20.0)


def _unit(values: Array, name: str, low: float, high: float) -> float:
    """Unit of a column: seconds if its median is below `low`, milliseconds if above `high`.

    Raises:
        ValueError: the median lies between `low` and `high`.
    """
    finite = values[np.isfinite(values)]
    median = float(np.median(finite)) if len(finite) else 0.0
    if low <= median <= high:
        problem = f"got {name!r}, which may be seconds or milliseconds (median {median:.3g})"
        raise ValueError(f"{problem}, expected {name}_s or {name}_ms in the first line")
    return 1.0 if median < low else 1e-3


# -- irtt -----------------------------------------------------------------------------------------


class _Stamp(msgspec.Struct):
    """Time at which a packet was sent [ns]: on a monotonic clock, or the time of day."""

    monotonic: float | None = None
    wall: float | None = None


class _OfClient(msgspec.Struct):
    send: _Stamp


class _Stamps(msgspec.Struct):
    client: _OfClient


class _Trip(msgspec.Struct):
    lost: str | bool
    timestamps: _Stamps
    delay: dict[str, float] = {}


class _Irtt(msgspec.Struct):
    """Members of irtt's JSON that are read; all others are ignored."""

    round_trips: list[_Trip]


_LOST = (np.nan, np.nan)
CLOCKS_S = 1e-3
"""Largest error of irtt's one-way delays with synchronised clocks [s]."""


def _of_irtt(text: str, way: Way) -> RecordedPath:
    key = "rtt" if way == "auto" else way
    rows = []
    try:
        for trip in msgspec.json.decode(text, type=_Irtt).round_trips[: ROWS_MAX + 1]:
            sent = trip.timestamps.client.send
            sent_ns = sent.monotonic if sent.monotonic is not None else sent.wall
            arrived = trip.lost in ("false", False)
            rows.append((sent_ns, *((trip.delay[key], trip.delay["rtt"]) if arrived else _LOST)))
        times, delays, trips = np.array(rows, dtype=np.float64).reshape(-1, 3).T * 1e-9
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"expected JSON as irtt writes it: {error!r}") from None
    if way == "auto":
        return _checked(times, trips / 2.0, halved=True)
    _refuse(
        (delays < -CLOCKS_S) | (delays > trips + CLOCKS_S),
        delays,
        f"way={way} within the round trip; the clocks of the two ends differ: take way=auto",
    )
    return _checked(times, np.clip(delays, 0.0, None))


# -- all formats ---------------------------------------------------------------------


def _refuse(wrong: Flags, values: Array, expected: str) -> None:
    """Raise ValueError with the first row that is `wrong`, if there is one."""
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"row {row + 1}: got {values[row]:.10g}, expected {expected}")


def _checked(
    time_s: Array,
    delay_s: Array,
    *,
    halved: bool = False,
    copies: int = 0,
    begin_s: float = 0.0,
) -> RecordedPath:
    """Recorded path of the given rows, sorted by time.

    Args:
        time_s: times of sending [s]; shape (n,).
        delay_s: one-way delays, NaN for a lost packet [s]; shape (n,).
        begin_s: time on the file's own clock at which `time_s` is 0 [s].

    Raises:
        ValueError: a row is invalid; the message names the first such row.
    """
    if not 0 < len(time_s) <= ROWS_MAX:
        raise ValueError(f"got {len(time_s)} rows, expected 1 to {ROWS_MAX}")
    _refuse(~np.isfinite(time_s), time_s, "a time")
    lost = np.isnan(delay_s)
    newest_s = np.maximum.accumulate(time_s)
    behind = f"a time at most {BACK_MAX_S:g} s before that of a row above: split the file there"
    _refuse(time_s < newest_s - BACK_MAX_S, time_s, behind)
    _refuse(delay_s < 0.0, delay_s, "a delay of at least 0, or -1 of a lost packet")
    _refuse(delay_s > DELAY_MAX_S, delay_s, f"a delay of at most {DELAY_MAX_S:g} s")
    if lost.all():
        raise ValueError("got lost packets only, expected at least one packet that arrived")
    order = np.argsort(time_s, kind="stable")
    begin_s += float(time_s[order[0]])
    time_s, delay_s, lost = time_s[order] - time_s[order[0]], delay_s[order], lost[order]
    if time_s[-1] > 1e9:
        raise ValueError(f"got {time_s[-1]:g} s, expected at most 1e9 s")
    apart_s = np.diff(time_s)
    if (apart_s <= 0.0).any():
        if float(np.median(apart_s)) <= 0.0:
            raise ValueError("got equal times in most rows, expected a time for each packet")
        shift_s = TIE_S * np.arange(len(time_s))
        time_s = np.maximum.accumulate(time_s - shift_s) + shift_s
    came = ~lost
    filled_s = np.interp(time_s, time_s[came], delay_s[came])
    return RecordedPath(time_s, filled_s, lost, halved, copies, begin_s)
