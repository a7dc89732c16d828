"""Recorded networks: files of measured delays, and of times at which packets may go.

Delays are read from four formats, told apart by their content:

- CSV with a line of names: a time column `time_s` or `sent_s`, a delay column `delay_s` or
  `delay_ms`, or `rtt_s` or `rtt_ms` for round trips, and maybe `lost` (0 or 1; the delay may then
  be left out). This is what `skytether probe` writes;
- what `ping` prints, with or without the times of `-D`; without, a second lies between two;
- the JSON that `irtt client -o` writes.

Of a round trip half is taken for each direction. Times at which packets may go are files as
mahimahi has them: a line for each packet of 1504 bytes, with the millisecond at which it may go.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import StringIO
from typing import Literal

import msgspec
import numpy as np

from skytether.shared.base.units import seconds_to_ns
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.air.delays import interpolated
from skytether.shared.scenario.air.draws import Draws, Fate
from skytether.shared.scenario.air.impairment import Impairment, impairment
from skytether.shared.scenario.registry import File

ROWS_MAX = 1_000_000
"""Largest number of rows."""
PING_EVERY_S = 1.0
"""Time between two packets of `ping`, where its output does not tell [s]."""
DELAY_MAX_S = 3600.0
"""Largest delay [s]."""
DELIVERY_BYTES = 1504
"""Bytes that may go at a time of mahimahi's."""

Way = Literal["auto", "send", "receive"]

_PING = re.compile(
    r"^(?:\[(?P<at>\d+\.\d+)\] )?.*?\bicmp_[sr]eq=(?P<number>\d+)\b(?:.*\btime=(?P<ms>[\d.]+) ms)?",
    re.MULTILINE,
)
_TIMES = {"time_s": 1.0, "sent_s": 1.0}
_DELAYS = {"delay_s": 1.0, "delay_ms": 1e-3, "rtt_s": 0.5, "rtt_ms": 0.5e-3}
"""Columns of delays, and what makes them a one-way delay in seconds."""


@dataclass(frozen=True, slots=True)
class RecordedPath:
    """Delays of a recorded path, a row a packet."""

    time_s: Array
    """Times at which packets were sent, rising from 0 [s]; shape (n,)."""
    delay_s: Array
    """One-way delays [s]; those of lost packets are interpolated; shape (n,)."""
    lost: Flags
    """Whether each was lost; shape (n,)."""


@impairment(name="trace")
class Trace(Impairment):
    """Delays and loses packets as a recorded path did at that time; round and round, or once."""

    kind = "delay"

    def __init__(
        self, file: File, play: Literal["loop", "once"] = "loop", way: Way = "auto"
    ) -> None:
        try:
            recorded = recorded_in(file, way)
        except ValueError as error:
            raise ValueError(f"a file of delays ({error})") from None
        times_s, delays_s = recorded.time_s, recorded.delay_s
        last_s = float(times_s[-1])
        self._loop_s = last_s + last_s / max(len(times_s) - 1, 1) if play == "loop" else 0.0
        self._times_s: list[float] = times_s.tolist()
        self._delays_s: list[float] = delays_s.tolist()
        self._lost: list[float] = recorded.lost.astype(float).tolist()
        self._loses = bool(recorded.lost.any())
        self.least_s, self.mean_s = float(delays_s.min()), float(delays_s.mean())
        self.loss = float(recorded.lost.mean())

    def __call__(self, fate: Fate, draws: Draws) -> None:  # noqa: ARG002
        """See `Impairment`; a packet between two of the file is lost as the nearer was."""
        time_s = fate.time_s % self._loop_s if self._loop_s else fate.time_s
        fate.delay_ns += seconds_to_ns(interpolated(time_s, self._times_s, self._delays_s))
        if self._loses and interpolated(time_s, self._times_s, self._lost) > 0.5:
            fate.lost = True


@lru_cache(maxsize=16)
def recorded_in(file: File, way: Way = "auto") -> RecordedPath:
    """Delays that a file holds.

    Args:
        file: its name and content.
        way: of a file of irtt, the delay from client to server (send) or back (receive), which
            needs synchronised clocks; auto: half of the round trip.

    Raises:
        ValueError: it holds no delays in the order of time.
    """
    name, text = file.name, _text(file)
    if text.lstrip()[:1] == "{":
        rows = _of_irtt(name, text, way)
    elif _PING.search(text[:100_000]):
        rows = _of_ping(name, text)
    else:
        rows = _of_csv(name, text)
    return _checked(name, *rows)


@lru_cache(maxsize=16)
def deliveries_in(file: File) -> Array:
    """Times at which packets of DELIVERY_BYTES may go [s], in a file of mahimahi; shape (n,).

    Raises:
        ValueError: it holds no such times.
    """
    name = file.name
    times = _table(name, "\n".join(["ms", *_text(file).split()]), [0])[:, 0]
    wrong = ~np.isfinite(times) | (times < 0.0) | (np.diff(times, prepend=0.0) < 0.0)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(
            f"{name}: row {row + 1}: got {times[row]:g}, expected milliseconds in rising order"
        )
    if times[-1] == 0.0:
        raise ValueError(f"{name}: got times of 0 alone, expected milliseconds in rising order")
    return times * 1e-3


def _text(file: File) -> str:
    try:
        text = file.content.decode()
    except ValueError as error:
        raise ValueError(f"{file.name}: cannot be read: {error}") from None
    if not text.strip():
        raise ValueError(f"{file.name}: got an empty file, expected delays, see docs/network.md")
    return text


def _table(file: str, text: str, columns: Sequence[int]) -> Array:
    """Numbers of columns below a line of names; shape (rows, columns). What is left out is NaN."""
    rows = text.rstrip().count("\n")
    if rows > ROWS_MAX:
        raise ValueError(f"{file}: got {rows} rows, expected at most {ROWS_MAX}")
    body = text.split("\n", 1)[1] if "\n" in text else ""
    if not body.strip():
        raise ValueError(f"{file}: got no rows, expected at least one below its first line")
    try:
        return np.loadtxt(
            StringIO(body),
            delimiter=",",
            ndmin=2,
            comments=None,
            converters=lambda word: float(word) if word.strip() else np.nan,
            usecols=columns,
            dtype=np.float64,
        )
    except ValueError as error:
        raise ValueError(f"{file}: {str(error).partition(';')[0]}, expected numbers") from None


def _of_csv(file: str, text: str) -> tuple[Array, Array, Flags]:
    names = [name.strip() for name in text.split("\n", 1)[0].split(",")]
    time = next((name for name in names if name in _TIMES), None)
    delay = next((name for name in names if name in _DELAYS), None)
    if time is None or delay is None:
        expected = f"the columns {' or '.join(_TIMES)}, and {' or '.join(_DELAYS)}"
        given = ",".join(names)[:60]
        raise ValueError(f"{file}: got the first line {given!r}, expected {expected}")
    columns = [time, delay, *(["lost"] if "lost" in names else [])]
    table = _table(file, text, list(map(names.index, columns)))
    lost = (table[:, 2:] != 0.0).any(axis=1)
    return table[:, 0], table[:, 1] * _DELAYS[delay], lost


def _of_ping(file: str, text: str) -> tuple[Array, Array, Flags]:
    """Rows of ping's output: those that it has no answer to are lost."""
    heard: dict[int, tuple[float, float]] = {}
    for number, found in enumerate(_PING.finditer(text)):
        if number >= ROWS_MAX:
            raise ValueError(f"{file}: got more rows than {ROWS_MAX}")
        if found["ms"] and int(found["number"]) not in heard:  # and not a doubled answer
            at = float(found["at"]) if found["at"] else np.nan
            heard[int(found["number"])] = at, float(found["ms"]) * 1e-3
    if not heard:
        raise ValueError(f"{file}: got no answer to a ping, expected at least one")
    low, high = min(heard), max(heard)
    if high - low >= ROWS_MAX:
        raise ValueError(f"{file}: got icmp_seq from {low} to {high}: more rows than {ROWS_MAX}")
    numbers = np.array(sorted(heard))
    ended_s, rtt_s = np.array([heard[number] for number in numbers]).T
    count = high - low + 1
    sent_s = numbers * PING_EVERY_S if np.isnan(ended_s).any() else ended_s - rtt_s
    delay_s, lost = np.full(count, np.nan), np.ones(count, dtype=bool)
    delay_s[numbers - low], lost[numbers - low] = rtt_s / 2.0, False
    return np.interp(np.arange(low, high + 1), numbers, sent_s), delay_s, lost


class _Stamp(msgspec.Struct):
    """Time of day of a packet, on a clock that only rises [ns]."""

    monotonic: float


class _OfClient(msgspec.Struct):
    """Times of the end that measured."""

    send: _Stamp


class _Stamps(msgspec.Struct):
    """Times of one packet."""

    client: _OfClient


class _Trip(msgspec.Struct):
    """Packet there and back."""

    lost: str | bool
    timestamps: _Stamps
    delay: dict[str, float] = {}


class _Irtt(msgspec.Struct):
    """File of irtt: everything else in it takes no memory."""

    round_trips: list[_Trip]


def _of_irtt(file: str, text: str, way: Way) -> tuple[Array, Array, Flags]:
    key = "rtt" if way == "auto" else way
    rows = []
    try:
        for trip in msgspec.json.decode(text, type=_Irtt).round_trips[: ROWS_MAX + 1]:
            lost = trip.lost not in ("false", False)
            delay_ns = trip.delay[key] if not lost else np.nan
            rows.append((trip.timestamps.client.send.monotonic, delay_ns, lost))
        table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{file}: expected JSON as irtt writes it: {error!r}") from None
    factor = 0.5e-9 if way == "auto" else 1e-9
    return table[:, 0] * 1e-9, table[:, 1] * factor, table[:, 2] != 0.0


def _checked(file: str, time_s: Array, delay_s: Array, lost: Flags) -> RecordedPath:
    """Rows whose times rise and whose delays are possible.

    Raises:
        ValueError: with the first that is not.
    """
    if not 0 < len(time_s) <= ROWS_MAX:
        raise ValueError(f"{file}: got {len(time_s)} rows, expected 1 to {ROWS_MAX}")
    came = ~lost
    for wrong, values, expected in (
        (~np.isfinite(time_s), time_s, "a time in seconds"),
        (np.diff(time_s, prepend=-np.inf) <= 0.0, time_s, "a time after that of the row before"),
        (came & ~np.isfinite(delay_s), delay_s, "a delay"),
        (came & (delay_s < 0.0), delay_s, "a delay of at least 0"),
        (came & (delay_s > DELAY_MAX_S), delay_s, f"a delay of at most {DELAY_MAX_S:g} s"),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ValueError(f"{file}: row {row + 1}: got {values[row]:g}, expected {expected}")
    if not came.any():
        raise ValueError(f"{file}: got lost packets alone, expected at least one that came")
    time_s = time_s - time_s[0]
    if time_s[-1] > 1e9:
        raise ValueError(f"{file}: got {time_s[-1]:g} s, expected at most 1e9 s")
    return RecordedPath(time_s, np.interp(time_s, time_s[came], delay_s[came]), lost)
