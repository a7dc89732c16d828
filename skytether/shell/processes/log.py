"""Log of a process: its events on stdout, as text for an operator or as JSON for a program.

A line of text begins with the local time and the name of the process. A thread writes lines from a
bounded queue, so that logging never blocks the process; if stdout is closed or full, lines are lost
without an error.
"""

import errno
import sys
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, Literal

import msgspec

from skytether.shared.base.printable import printable
from skytether.shared.events.flight import Event, Omitted
from skytether.shared.events.processes import Counted
from skytether.shared.telemetry.every_event import EveryEvent
from skytether.shell.host.limit import Limit
from skytether.shell.host.writer import Writer

ROOM_BYTES = 256 * 1024
"""Largest number of bytes of lines waiting to be written."""
TOGETHER_BYTES = 4096
"""Largest number of bytes in one write: PIPE_BUF, up to which a write to a pipe is atomic, also
with several writers."""
PATIENCE_S = 0.5
"""Longest time to wait at the end until all lines are written [s]."""

LogFormat = Literal["text", "json"]


class LogLine(msgspec.Struct, frozen=True, kw_only=True):
    process: str
    """Name: server, netem or client; `server.N`: a server's worker N; `netem N`: path N's netem."""
    time_ns: int
    """Time of the event [ns; CLOCK_MONOTONIC]."""
    event: EveryEvent


_DECODER = msgspec.json.Decoder(LogLine)
_UNDECODABLE = msgspec.DecodeError, UnicodeDecodeError, RecursionError


def line_of(text: bytes) -> LogLine | None:
    """Parse a printed line; None for other text, such as a line of a traceback."""
    try:
        return _DECODER.decode(text)
    except _UNDECODABLE:
        return None


class Log:
    """Log of a process; writing to it never blocks and never raises.

    Args:
        form: text or JSON.
        beside: called with each event that is logged.
        to_stderr: whether lines go to stderr, because another program uses stdout.
    """

    def __init__(
        self,
        process: str,
        form: LogFormat,
        beside: Callable[[Event], None] = lambda _: None,
        *,
        to_stderr: bool = False,
    ) -> None:
        self._process = process
        self._form = form
        self._beside = beside
        closed = OSError(errno.EBADF, "the standard output is closed")
        stream = sys.stderr if to_stderr else sys.stdout
        self._writer = Writer(stream or closed, capacity=ROOM_BYTES, together=TOGETHER_BYTES)
        self._limit = Limit()
        self._unread = 0

    def hear(self, event: Event) -> None:
        """Log an event of an endpoint, within the limit of each kind."""
        for admitted in self._limit.admit(event, now_ns=time.monotonic_ns()):
            self.say(admitted)

    def say(self, event: Event) -> None:
        """Log an event; each write has whole lines only, because workers may share the output."""
        self._beside(event)
        for line in self._lines(event):
            if not self._writer.write(line):
                self._unread += 1

    def note(self, event: Event) -> None:
        """Pass an event to `beside` alone, without printing it."""
        self._beside(event)

    def each_second(self, *, last: bool = False) -> None:
        """Report omitted events; called once a second, and at the end."""
        now_ns = None if last else time.monotonic_ns()
        for omitted in self._limit.omitted(now_ns=now_ns):
            self.say(omitted)
        if self._unread:
            before, self._unread = self._unread, 0
            self.say(Omitted(kind="lines", count=before))
            if self._unread:  # stdout is still blocked
                self._unread = before

    def close(self) -> None:
        self._writer.close(PATIENCE_S)

    def _lines(self, event: Event) -> list[bytes]:
        if self._form == "json":
            line = LogLine(process=self._process, time_ns=time.monotonic_ns(), event=event)
            return [msgspec.json.encode(line) + b"\n"]
        lines = str(event).splitlines()
        if isinstance(event, Counted):
            lines += rendered(_for_people(event.figures), indent=2)
        now = f"{datetime.now():%Y-%m-%d %H:%M:%S.%f}"[:-3]  # noqa: DTZ005 - the operator's own
        # `printable`, because a file's name may be invalid Unicode.
        shown = (f"{now} {self._process}: {printable(line)}\n" for line in lines)
        return [line.encode(errors="replace") for line in shown]


def rendered(figures: Mapping[str, Any], *, indent: int = 0) -> list[str]:
    """Figures as lines: names and numbers in two columns, nested groups indented.

    Two groups with the same names, such as both directions, share lines, with a column each.
    """
    groups = {name: value for name, value in figures.items() if isinstance(value, Mapping)}
    if len(groups) == 2 and len({frozenset(group) for group in groups.values()} - {()}) == 1:
        alone = {name: value for name, value in figures.items() if name not in groups}
        return rendered(alone, indent=indent) + _columns(groups, indent)
    width = max(map(len, figures), default=0)
    lines = []
    for name, value in figures.items():
        if isinstance(value, Mapping):
            lines.append(f"{'':{indent}}{name}" if value else f"{'':{indent}}{name:{width}}  none")
            lines += rendered(value, indent=indent + 2)
        else:
            lines.append(f"{'':{indent}}{name:{width}}  {_shown(value)}")
    return lines


def _for_people(figures: Mapping[str, Any]) -> dict[str, Any]:
    shown: dict[str, Any] = {}
    for name, value in figures.items():
        if name.endswith("_within_ms"):
            continue
        if isinstance(value, list):  # the paths of a session
            numbered = {str(number): each for number, each in enumerate(value, start=1)}
            shown[name] = _for_people(numbered)
        elif isinstance(value, Mapping):
            shown[name] = _for_people(value)
        else:
            shown[name] = value
    return shown


def _columns(groups: Mapping[str, Mapping[str, Any]], indent: int) -> list[str]:
    flat = [_flat(group) for group in groups.values()]
    names = dict.fromkeys(name for each in flat for name in each)
    table = [
        ("", *groups),
        *((name, *(_shown(each.get(name, 0)) for each in flat)) for name in names),
    ]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        f"{'':{indent}}{name:{widths[0]}}"
        + "".join(f"  {text:>{width}}" for text, width in zip(shown, widths[1:], strict=True))
        for name, *shown in table
    ]


def _flat(group: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in group.items():
        inner = isinstance(value, Mapping)
        flat |= _flat(value, f"{before}{name} ") if inner else {f"{before}{name}": value}
    return flat


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)
