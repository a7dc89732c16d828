"""The log of a process: its events on stdout, as text for an operator or as JSON for a program."""

import time
from collections.abc import Mapping
from typing import Any, Literal

import msgspec

from shared.events import Counted, Event

LogFormat = Literal["text", "json"]


class Line(msgspec.Struct, frozen=True, kw_only=True):
    """A line of JSON: an event, who says it, and when."""

    process: str
    """Name of the process: server, netem or client; `server.N` is worker N of a server."""
    time_ns: int
    """Time at which it is said [ns; CLOCK_MONOTONIC]."""
    event: Event


def say(event: Event, *, process: str, log: LogFormat) -> None:
    """Print an event, at once and in one write: several workers may share the standard output."""
    if log == "json":
        line = Line(process=process, time_ns=time.monotonic_ns(), event=event)
        text = f"{msgspec.json.encode(line).decode()}\n"
    else:
        lines = [str(event)]
        if isinstance(event, Counted):
            lines += rendered(event.figures, indent=2)
        text = "".join(f"{process}: {line}\n" for line in lines)
    print(text, end="", flush=True)


def rendered(figures: Mapping[str, Any], *, indent: int = 0) -> list[str]:
    """Figures as lines: names and numbers in two columns, the groups among them indented."""
    width = max(map(len, figures), default=0)
    lines = []
    for name, value in figures.items():
        if isinstance(value, Mapping):
            lines.append(f"{'':{indent}}{name}" if value else f"{'':{indent}}{name:{width}}  none")
            lines += rendered(value, indent=indent + 2)
        else:
            shown = f"{value:g}" if isinstance(value, float) else value
            lines.append(f"{'':{indent}}{name:{width}}  {shown}")
    return lines
