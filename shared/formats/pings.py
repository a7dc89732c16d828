"""Logs of ping, fping and similar programs, in any language: round trips of packets.

`_TABLE` lists the kinds of lines, and the function that handles each. Words are not interpreted,
because ping prints them in the user's language: the line of a packet contains a number, and the
line of an answer also a round trip such as `=20.3 ms`; a packet without a round trip is lost.
Windows prints no numbers: there each line between the first line and an empty line is a packet.

A run is one call of ping. It ends with its summary, which also counts the packets sent after the
last answer. A new run begins with ping's first line, with a number that is answered twice without
the mark of a copy (`DUP!`), or with a number far below the previous one, unless icmp_seq, a number
of 16 bits, has wrapped.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import StringIO
from math import isfinite, nan

import numpy as np

from skytether.shared.law.model import Array

ROWS_MAX = 1_000_000
LINES_MAX = 2 * ROWS_MAX
LINE_MAX = 400
EVERY_S = 1.0
"""Time between two packets in a log without times, summary and command line [s]."""
WRAP = 65536
NEAR = 1000
"""Number of packets that an answer may be late, or that may be lost when icmp_seq wraps."""
BACK_MAX_S = 10.0
"""Largest step back of a log's times that counts as reordering of answers [s]."""


class LogError(ValueError):
    """Contradiction in a log; the message names the line, its content and the expected content."""


@dataclass(slots=True)
class Run:
    first: int | None = None
    """Number of the first packet; None if the log begins after the first packet."""
    numbered: bool = True
    peer: str = ""
    """Host of the run, in a log of fping."""
    trips: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Time of the answer [s], NaN if not printed, and round trip [s], NaN without an answer, by
    number of the packet."""
    last: int = -1
    every_s: float | None = None
    """Time between two packets [s]; None if unknown."""
    at_s: float = -np.inf
    copies: int = 0

    def answered(self) -> int:
        return sum(isfinite(trip_s) for _, trip_s in self.trips.values())

    def low(self) -> int:
        return min([self.last if self.first is None else self.first, *self.trips])

    def place(self, number: int) -> int | None:
        """Packet number without wraps of icmp_seq; None if the packet belongs to a new run."""
        if self.last < 0:
            return number
        wrap = WRAP if number < WRAP else 0
        wrapped = number + wrap * round((self.last - number) / WRAP)
        if wrapped >= 0 and abs(wrapped - self.last) <= NEAR:
            return wrapped
        ahead = number + wrap * (self.last // WRAP)
        return ahead if ahead > self.last else None

    def timed(self) -> tuple[Array, Array]:
        """Sending times [s] and round trips [s] of all packets in order; NaN for a lost packet."""
        low = self.low()
        numbers = np.arange(low, self.last + 1, dtype=np.float64)
        answered = sorted((n, *trip) for n, trip in self.trips.items() if isfinite(trip[1]))
        at, at_s, trip_s = np.array(answered, dtype=np.float64).reshape(-1, 3).T
        trips_s: Array = np.full(len(numbers), nan)
        trips_s[at.astype(int) - low] = trip_s
        stamped = np.isfinite(at_s)
        at, sent_s = at[stamped], (at_s - trip_s)[stamped]
        every_s = self.every_s
        if len(at) > 1:
            every_s = max(float(np.median(np.diff(sent_s) / np.diff(at))), 1e-6)
        self.every_s = every_s = every_s or EVERY_S
        if not len(at):
            return numbers * every_s, trips_s
        before, after = np.minimum(numbers - at[0], 0.0), np.maximum(numbers - at[-1], 0.0)
        return np.interp(numbers, at, sent_s) + (before + after) * every_s, trips_s


@dataclass(slots=True)
class Log:
    runs: list[Run] = field(default_factory=list)
    run: Run | None = None
    """Run that the next line belongs to."""
    in_list: bool = False
    """Whether every line describes a packet, as in the output of Windows."""
    every_s: float | None = None
    """Time between two packets, from the log's newest command line [s]; None if it has none."""

    def begin(self, first: int | None, *, numbered: bool = True) -> Run:
        self.run = Run(first, numbered, every_s=self.every_s if numbered else None)
        self.runs.append(self.run)
        self.in_list = not numbered
        return self.run

    def add(self, number: int, trip_s: float, at_s: float, *, copy: bool, peer: str = "") -> None:
        """Add a packet of a run with numbers; raises LogError if it contradicts earlier packets."""
        run = self.run
        if run is None or not run.numbered:
            run = self.begin(None)
        if run.peer not in (peer, ""):
            both = f"got answers of {run.peer} and of {peer}"
            raise LogError(f"{both}, expected one host: keep the lines of one host")
        placed = run.place(number)
        is_answered = isfinite(trip_s)
        present = run.trips.get(-1 if placed is None else placed, (nan, nan))
        twice = isfinite(present[1])
        if placed is None or (twice and is_answered and not copy):
            run, placed, twice = self.begin(None), number, False
        if at_s < run.at_s - BACK_MAX_S:
            back = f"{run.at_s - at_s:.6g} s before the line above"
            raise LogError(f"got a time {back}, expected rising times: split the file there")
        run.peer, run.last = peer, max(run.last, placed)
        if is_answered:
            run.at_s = max(run.at_s, at_s)
            run.copies += twice
        if not twice:
            run.trips[placed] = at_s, trip_s

    def list_one(self, trip_s: float) -> None:
        run = self.run if self.run and self.in_list else self.begin(0, numbered=False)
        run.last += 1
        run.trips[run.last] = nan, trip_s

    def end(self, sent: int, came: int, time_ms: int | None = None) -> None:
        """End the run with its summary; raises LogError if the summary contradicts the lines above
        it.
        """
        run, self.run, self.in_list = self.run, None, False
        if run is None:
            return
        first = run.first if run.first is not None else int(time_ms is not None)
        answered, last = run.answered(), first + sent - 1
        # A log that begins late lacks the answers before its first line.
        before = 0 if run.first is not None else max(min(run.trips, default=0) - first, 0)
        if last < run.last or came < answered:
            raise LogError(
                f"got a summary of {sent} sent and {came} received, but more packets above it, "
                "expected the summary of the same run: delete the line"
            )
        if run.numbered and came - answered > before:
            raise LogError(
                f"got a summary of {came} received, but {answered} answers above it, expected a "
                "line for each packet: log without -q, and omit no line"
            )
        run.last = last
        if time_ms and sent > 1:
            run.every_s = time_ms / (sent - 1) / 1e3


def _command(log: Log, found: re.Match[str]) -> None:
    fping = found["program"] == "fping"
    if (found["flag"] == "p") == fping:
        log.every_s = _number(found["value"]) * (1e-3 if fping else 1.0) or None


def _head(log: Log, found: re.Match[str]) -> None:
    # iputils counts from 1; busybox and BSD count from 0 and print a colon: "(192.0.2.1): 56 data".
    log.begin(0 if found["six"] or found["colon"] else 1)


def _summary(log: Log, found: re.Match[str]) -> None:
    log.end(int(found["sent"]), int(found["came"]), int(found["ms"]) if found["ms"] else None)


def _counts(log: Log, found: re.Match[str]) -> None:
    log.end(int(found["sent"]), int(found["came"]))


def _numbered(log: Log, found: re.Match[str]) -> None:
    log.add(int(found["number"]), _trip_s(found), _at_s(found), copy="DUP" in found.string)


def _fping(log: Log, found: re.Match[str]) -> None:
    log.add(
        int(found["number"]),
        _trip_s(found),
        _at_s(found),
        copy=bool(found["copy"]),
        peer=found["peer"],
    )


def _listed(log: Log, found: re.Match[str]) -> None:
    log.list_one(_trip_s(found))


def _list_head(log: Log, _: re.Match[str]) -> None:
    log.begin(0, numbered=False)


def _empty(log: Log, _: re.Match[str]) -> None:
    log.in_list = False


def _other(log: Log, _: re.Match[str]) -> None:
    if log.in_list:
        log.list_one(nan)


_AT, _NUMBER = r"(?:\[(?P<at>\d{1,12}\.\d{1,9})\] )?", r"\d{1,9}(?:[.,]\d{1,9})?"
_TIME = rf"(?P<sign>[=<])(?P<ms>{_NUMBER}) ?ms?\b"
_TABLE: tuple[tuple[str, str, Callable[[Log, "re.Match[str]"], None]], ...] = (
    # [1700000000.020000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.0 ms; busybox: seq=0
    # no answer yet for icmp_seq=2; Request timeout for icmp_seq 3
    ("eq", rf"{_AT}.*?\b(?:icmp_)?[sr]eq[= ](?P<number>\d{{1,9}})\b(?:.*?{_TIME})?", _numbered),
    # [1700000000.02000] 192.0.2.1 : [0], 64 bytes, 20.1 ms (20.1 avg, 0% loss); … : [1], timed out
    (
        "],",
        (
            rf"{_AT}(?P<peer>\S+)\s+: (?P<copy>duplicate for )?\[(?P<number>\d{{1,9}})\], "
            rf"(?:\d+ bytes, )?(?:(?P<sign>)(?P<ms>{_NUMBER}) ms|timed out)"
        ),
        _fping,
    ),
    # Reply from 192.0.2.1: bytes=32 time<1ms TTL=64
    ("m", rf".*?{_TIME}", _listed),
    # $ ping -i 0.2 192.0.2.1; $ fping -D -p 200 192.0.2.1
    (
        " -",
        (
            r"(?>.*?\b(?P<program>f?ping)6? )(?:.* )?"
            rf"-(?P<flag>[ip]) ?(?P<value>{_NUMBER})(?!\S)"
        ),
        _command,
    ),
    # PING example (192.0.2.1) 56(84) bytes of data.
    ("PING", r"PING(?P<six>6?)\b(?!:)(?:.*\)(?P<colon>:) \d)?", _head),
    # 34 packets transmitted, 20 received, 41% packet loss, time 5812ms
    (
        "%",
        r"(?P<sent>\d{1,9}) [^\d,]+, (?P<came>\d{1,9}) [^\d,]+, [^%]*%(?:.* (?P<ms>\d{1,12}) ?ms)?",
        _summary,
    ),
    # 192.0.2.1 : xmt/rcv/%loss = 12/8/33%, min/avg/max = 0.038/0.043/0.049
    ("rcv", r"\S+\s+: xmt/rcv/%loss = (?P<sent>\d{1,9})/(?P<came>\d{1,9})/", _counts),
    #     Packets: Sent = 4, Received = 2, Lost = 2 (50% loss),
    ("= ", r"[^=]*= (?P<sent>\d{1,9}), [^=]*= (?P<came>\d{1,9}), [^=]*= \d", _counts),
    # Pinging example [192.0.2.1] with 32 bytes of data:
    (":", r"(?>\S.*? \d{1,6} ).*:$", _list_head),
    ("", r"$", _empty),
    # Request timed out.
    ("", r".", _other),
)
LINES = tuple((needle, re.compile(pattern), act) for needle, pattern, act in _TABLE)
"""Kinds of lines: a substring for a quick check, a pattern, and a function that processes the line.
The first kind that matches a line applies. Every pattern takes linear time."""
_PACKET = re.compile(rf"\b(?:icmp_)?[sr]eq[= ]\d|: \[\d{{1,9}}\], |{_TIME}|^PING6?\b", re.MULTILINE)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _trip_s(found: re.Match[str]) -> float:
    """Round trip in a line [s]; NaN if the line has none, and 0.5 ms for `time<1ms`."""
    if not found["ms"]:
        return nan
    return _number(found["ms"]) * 1e-3 * (0.5 if found["sign"] == "<" else 1.0)


def _at_s(found: re.Match[str]) -> float:
    return float(found["at"]) if found["at"] else nan


def is_log(text: str) -> bool:
    return _PACKET.search(text[:100_000]) is not None


def runs(text: str) -> list[Run]:
    """Runs in a log; raises LogError if the log contradicts itself, or is too long."""
    log = Log()
    for number, whole in enumerate(StringIO(text), 1):
        if number > LINES_MAX:
            raise LogError(f"got more than {LINES_MAX} lines, expected fewer")
        line = whole[:LINE_MAX].rstrip()
        for needle, pattern, act in LINES:
            if needle in line and (found := pattern.match(line)):
                try:
                    act(log, found)
                except LogError as error:
                    raise LogError(f"line {number}: {error}") from None
                break
    return [run for run in log.runs if run.last >= run.low() and (run.numbered or run.answered())]


def joined(found: Sequence[Run]) -> tuple[Array, Array]:
    """Times of sending [s] and round trips [s] of the packets of all runs, one run after the other;
    the round trip of a lost packet is NaN.

    Raises:
        LogError: there are too many packets, or no answer.
    """
    count = sum(run.last + 1 - run.low() for run in found)
    if count > ROWS_MAX:
        raise LogError(f"got {count} packets, expected at most {ROWS_MAX}")
    if not any(run.answered() for run in found):
        raise LogError("got no answer to a ping, expected at least one")
    times_s, trips_s, begin_s = [], [], 0.0
    for run in found:
        sent_s, trip_s = run.timed()
        times_s.append(sent_s - sent_s[0] + begin_s)
        trips_s.append(trip_s)
        begin_s = float(times_s[-1].max()) + (run.every_s or EVERY_S)
    return np.concatenate(times_s), np.concatenate(trips_s)
