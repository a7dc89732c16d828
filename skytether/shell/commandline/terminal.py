"""Output of commands on the terminal: progress bars, tables, and a flight's summary."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import msgspec

from skytether.shared.telemetry.summary import Summary
from skytether.shell.commandline.command import write

# imported for type checking only, because the import is slow and not needed in flight
if TYPE_CHECKING:
    from rich.table import Table

    from skytether.shared.base.machine_code import Missing


class Bar(Protocol):
    def __call__(self, done: float, text: str = "") -> None:
        """Show the progress `done`, in the unit of the bar, and a remark beside the bar."""


@contextmanager
def progress(title: str, total: float, unit: str = "s") -> Iterator[Bar]:
    """Progress bar on stderr: title, progress and the time remaining.

    The bar is shown only if stderr is a terminal that can move its cursor, and disappears at the
    end. Lines printed on stderr meanwhile appear above it.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} " + unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}", markup=False),
        console=console,
        transient=True,
        speed_estimate_period=600.0,  # a step of the bar may take minutes
        disable=not console.is_interactive,
    ) as shown:
        row = shown.add_task(title, total=total, text="")

        def show(done: float, text: str = "") -> None:
            shown.update(row, completed=min(done, total), text=text)

        yield show


def prepare(kernels: Sequence["Missing"], folder: Path | None = None) -> None:
    """Compile the kernels that are not compiled on this machine yet, with a note on stderr.

    Args:
        folder: folder of the flight's sockets, where the flight's page reads the progress.
    """
    if not kernels:
        return
    from skytether.shared.base import machine_code
    from skytether.shell.host.compiling import alone, compile_kernels, tell

    waiting = "waiting for another command, which compiles the control loops"

    def wait() -> None:
        print(waiting, file=sys.stderr, flush=True)
        tell(folder, waiting)

    with alone(machine_code.folder(), wait):
        left = [each for each in kernels if not each.is_compiled()]
        if not left:
            tell(folder, "")
            return
        message = "compiling control loops, once on this machine: takes up to a minute"
        print(message, file=sys.stderr, flush=True)
        with progress("compiling", len(left), "kernels") as bar:
            done = count(1)

            def on_done() -> None:
                number = next(done)
                bar(number)
                tell(folder, f"compiling control loops: {number} of {len(left)}")

            tell(folder, f"compiling control loops: 0 of {len(left)}")
            compile_kernels(left, on_done)
        tell(folder, "")


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def show(table: "Table") -> None:
    """Print a table in full width: long lines are better than truncated numbers."""
    from rich.console import Console

    Console(width=max(Console().width, Console(width=1000).measure(table).maximum)).print(table)


COMPARED = (
    ("RMSE xy [m]", "rmse_xy", ".4f"),
    ("largest error [m]", "error_max", ".4f"),
    ("steps with a planned input", "covered", ".3f"),
    ("packets/s, both ways", "packets_per_s", ".2f"),
    ("bytes/s with headers, both ways", "bytes_per_s", ".0f"),
    ("age p99 [ms]", "age_ms_p99", ".0f"),
)
"""Rows of a table that compares flights: name, field of `Summary`, and number format."""


def finish(
    summary: Summary, title: str, json: Path | None = None, beside: Sequence[Summary] = ()
) -> None:
    """Print a summary as a table, and write it to a file.

    Args:
        beside: summaries of further flights; the table then has one column per flight, named by its
            scenario, and only the rows of COMPARED.

    Raises:
        CommandError: the file cannot be written.
    """
    # The file is written first, because printing fails if the reader of stdout is gone.
    if json is not None:
        write(json, msgspec.json.encode(summary))
    if not beside:
        _print(title, (), summary_rows(summary))
        return
    flights = (summary, *beside)
    rows = [
        (name, *(_values(spec, getattr(each, field)) for each in flights))
        for name, field, spec in COMPARED
    ]
    _print(title, ("", *(each.scenario for each in flights)), rows)


def _print(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", show_header=bool(header))
    for each in header:
        table.add_column(Text(each))
    for row in rows:
        table.add_row(*map(Text, row))  # `Text`, because rich would take "[m]" for markup
    Console().print(table)


def summary_rows(summary: Summary) -> list[tuple[str, str]]:
    s = summary
    ages = _values(".3f", s.aoi_s_mean, s.aoi_s_peak, s.plan_age_s_mean)
    rows = [
        ("steps", f"{s.steps} in {s.duration_s:g} s"),
        ("RMSE x, y, xy [m]", _values(".4f", s.rmse_x, s.rmse_y, s.rmse_xy)),
        ("RMSE z [m]", _values(".4f", s.rmse_z)),
        ("largest error [m]", _values(".4f", s.error_max)),
        ("steps too fast to follow", _values(".3f", s.too_fast or None)),
        ("error of the estimate [m]", _values(".4f", s.estimate_error_m)),
        ("steps with a planned input", _values(".3f", s.covered)),
        ("modes [s]", ", ".join(f"{mode} {seconds:g}" for mode, seconds in s.modes.items())),
        ("event ratio", _values(".3f", s.event_ratio)),
        ("uplink horizons, other packets", _values("d", *_uplink(s))),
        ("  horizons by the trigger's figure, due", _values("d", s.uplink_above, s.uplink_due)),
        ("uplink packets, bytes", _values("d", s.uplink_packets, s.uplink_bytes)),
        ("downlink packets, bytes", _values("d", s.downlink_packets, s.downlink_bytes)),
        ("paths: packets up, down", "; ".join(_values("d", *each) for each in s.paths or ())),
        (
            "packets/s up, down, both",
            _values(".2f", s.uplink_packets_per_s, s.downlink_packets_per_s, s.packets_per_s),
        ),
        (
            "bytes/s with headers up, down, both",
            _values(".0f", s.uplink_bytes_per_s, s.downlink_bytes_per_s, s.bytes_per_s),
        ),
        ("lost, reordered packets", _values("d", s.lost, s.reordered)),
        ("stale packets", _values("d", s.stale)),
        *drops(s.drops or {}),
        ("errors of plug-ins", listed(s.plugin_errors or {})),
        ("link", "sealed" if s.secure else "plaintext"),
        ("age p50, p99 [ms]", _values(".0f", s.age_ms_p50, s.age_ms_p99)),
        ("mean age, its peaks, age of the plan [s]", ages),
        ("effort [m/s], share of steps at a bound", _values(".3f", s.effort_mps, s.saturated)),
        ("solve p50, p99 [ms]", _values(".2f", s.solve_ms_p50, s.solve_ms_p99)),
        ("deadline misses", _values("d", s.deadline_misses)),
    ]
    return [(name, values) for name, values in rows if values]


def drops(by_end: Mapping[str, Mapping[str, int]]) -> list[tuple[str, str]]:
    return [(f"dropped by {end}", listed(reasons)) for end, reasons in by_end.items()]


def listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _uplink(s: Summary) -> tuple[int, ...]:
    if s.uplink_horizons is None or s.uplink_packets is None:
        return ()
    return s.uplink_horizons, max(0, s.uplink_packets - s.uplink_horizons)


def _values(spec: str, *values: float | None) -> str:
    return ", ".join(format(value, spec) for value in values if value is not None)
