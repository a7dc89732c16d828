"""`Flight`: arrays, summary, events, picture and recording of a flight, for Python."""

import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from skytether.figures import flights as figures
from skytether.shared.base import extras
from skytether.shared.base.errors import ConfigError, FlightError, RecordingError
from skytether.shared.base.hint import hint
from skytether.shared.events.flight import Failure
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import (
    RECORDING,
    FlightEvent,
    Record,
    trace_hash,
)
from skytether.shared.telemetry.record import Rows as Table
from skytether.shared.telemetry.summary import Summary, desired, summarise
from skytether.shell.commandline import terminal
from skytether.view.rows import Columns, arrays, no_rows, readable

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from skytether.explain.explanation import Explanation

PARTS = ("client", "server", "netem", "plan")
"""Parts of a record: the vehicle's steps, the server's steps, packets, and plans."""
QUIET_S = 2.0
"""Duration of `Flight.explain` after which it shows a progress bar [s]."""
UNITS = MappingProxyType({"m": "m", "mps": "m/s", "s": "s", "ns": "ns", "bytes": "B"})
"""Unit by the last word of an array's name; arrays with other last words have no unit."""


class Column(NamedTuple):
    """Name, shape and unit of an array of a flight, see `Flight.columns`."""

    name: str
    shape: tuple[int, ...]
    unit: str
    """Unit of the array; empty for counts, flags and ratios."""


class Flight:
    """Result of a flight, flown just now or loaded from a recording.

    `flight["position_m"]` is an array with a row for each step of the vehicle; a vector has the
    shape (steps, axes). Names of the other arrays begin with `server.`, `netem.` or `plan.`, as in
    `flight["server.event"]`. `print(flight)` lists all arrays with shape and unit. Arrays are
    read-only.
    """

    def __init__(
        self, scenario: Scenario, record: Record, *, name: str, secure: bool = False
    ) -> None:
        self.scenario = scenario
        """Scenario that was flown."""
        self.name = name
        """Name of the scenario."""
        self.secure = secure
        """Whether the link was encrypted."""
        # A part without rows gets empty columns, so that its arrays exist.
        parts: dict[str, Any] = {**no_rows(scenario)}
        parts |= {part: rows for part in PARTS if len(rows := getattr(record, part))}
        events = tuple(each._replace(host=each.process) for each in record.events)
        self.record = replace(record, **parts, events=events)
        """Record of the flight, which has each part as a numpy structured array."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Array of this name.

        Raises:
            KeyError: there is no array of this name.
        """
        try:
            return self._arrays[name]
        except (KeyError, TypeError):
            raise KeyError(f"no array {name!r}; {hint(str(name), self._arrays)}") from None

    def columns(self) -> tuple[Column, ...]:
        """Name, shape and unit of every array."""
        return tuple(
            Column(name, array.shape, UNITS.get(name.replace(".", "_").rpartition("_")[2], ""))
            for name, array in self._arrays.items()
        )

    @cached_property
    def _arrays(self) -> Columns:
        dt_s, client, server = self.scenario.control.dt, self.record.client, self.record.server
        made: Columns = {"time_s": client["step"] * dt_s, **arrays(client)}
        made["desired_position_m"] = desired(self.scenario, client, server)
        for part in PARTS[1:]:
            rows = getattr(self.record, part)
            own = {"time_s": rows["step"] * dt_s} if "step" in rows.dtype.names else {}
            made |= {f"{part}.{name}": array for name, array in (own | arrays(rows)).items()}
        for array in made.values():
            array.flags.writeable = False
        return made

    @cached_property
    def summary(self) -> Summary:
        """Figures of the flight; with several vehicles, of the first vehicle."""
        client = self.record.client
        client = client[client["vehicle"] == client["vehicle"][:1]]
        rows = client, self.record.server, self.record.netem
        process_figures = self.record.figures
        return summarise(
            self.scenario, self.name, *rows, figures=process_figures, secure=self.secure
        )

    @property
    def events(self) -> tuple[FlightEvent, ...]:
        """Events in order of time, each with its time of flight [s] and the name of its process."""
        return self.record.events

    @property
    def failure(self) -> Failure | None:
        """Event that ended the flight early; None if the vehicle flew to the end."""
        return self.record.failure

    @extras.named()
    def explain(self, at: float | None = None, *, seeds: int = 0) -> "Explanation":
        """Explain why the vehicle braked or was far from its reference, and how to prevent this.

        The flight must have been flown in virtual time. It is flown again up to a hundred times,
        see docs/explain.md. A progress bar is shown if stderr is a terminal.

        Args:
            at: time of the moment to explain, as in `events` [s]; by default the gravest moment.
            seeds: number of other seeds with which each remedy is flown.

        Raises:
            ConfigError: the flight cannot be reproduced, or has no moment at that time.
        """
        from skytether.explain.cases import FlightCase, overridden
        from skytether.explain.explanation import STEPS, explained

        client = self.record.client
        case = FlightCase(
            self.scenario,
            len(np.unique(client["vehicle"])) or 1,
            self.secure,
            overridden=overridden(self.scenario, self.name),
        )
        began_s = time.monotonic()
        with ExitStack() as stack:
            bar: terminal.Bar | None = None

            def on_flight(done: int, step: str) -> None:
                nonlocal bar
                if bar is None and time.monotonic() - began_s > QUIET_S:
                    title, steps = f"explaining {self.name}", STEPS + bool(seeds)
                    bar = stack.enter_context(terminal.progress(title, steps, "steps"))
                if bar is not None:
                    bar(done, step)

            return explained(
                case,
                self.name,
                at_s=at,
                seeds=seeds,
                trace=trace_hash(client),
                on_flight=on_flight,
            )

    @extras.named()
    def plot(self, ax: "Axes | None" = None) -> "Figure":
        """Picture of the flight: the path over the reference, and the packets in each second.

        Args:
            ax: matplotlib axes for the path only; without them, path and packets in a new figure.

        Raises:
            FlightError: no step was flown.
        """
        if not len(self.record.client):
            raise FlightError(f"{self.name}: no step was flown: {self.failure or 'no vehicle'}")
        if ax is not None:
            figures.draw_path(ax, self.scenario, self.record)
            return ax.figure.canvas.figure
        title = f"{self.name}, seed {self.scenario.seed}"
        return figures.drawn({title: (self.scenario, self.record)})

    @extras.named()
    def to_pandas(self, part: str = "client") -> "pandas.DataFrame":
        """Table of a part of the record, a column for each number; its name has axis and unit.

        Args:
            part: "client" for the vehicle's steps, "server" for the server's steps, "netem" for
                packets, or "plan" for plans.

        Raises:
            ExtraMissing: pandas is not installed.
            KeyError: there is no such part.
        """
        if part not in PARTS:
            raise KeyError(f"no part {part!r}; {hint(str(part), PARTS)}")
        import pandas as pd

        rows: Table = getattr(self.record, part)
        time = {"time_s": rows["step"] * self.scenario.control.dt} if part != "netem" else {}
        return pd.DataFrame(time | readable(rows))

    @extras.named()
    def save(self, path: str | PathLike[str]) -> None:
        """Write the flight to a recording, from which `Flight.load` restores it.

        Args:
            path: file that ends in .mcap.

        Raises:
            ConfigError: the file has another suffix.
            RecordingError: the file cannot be written.
        """
        from skytether.cli import recorder

        file = Path(path)
        if file.suffix != RECORDING:
            raise ConfigError(f"{file}: expected a file that ends in {RECORDING}")
        if fault := recorder.write(file, self.scenario, self.name, self.record, self.summary):
            raise RecordingError(fault)

    @classmethod
    @extras.named()
    def load(cls, path: str | PathLike[str]) -> "Flight":
        """Flight from a recording, written by `save` or by `skytether fly --record`.

        Raises:
            OSError: the file cannot be read.
            RecordingError: the file is not a recording, or damaged.
        """
        from skytether.view.recordings.recorded import read

        recorded = read(Path(path))
        about = recorded.about
        return cls(recorded.scenario, recorded.record, name=about.scenario, secure=about.secure)

    def __repr__(self) -> str:
        steps, seconds = len(self.record.client), self.summary.duration_s
        return f"<Flight {self.name!r}, seed {self.scenario.seed}: {steps} steps in {seconds:g} s>"

    def __str__(self) -> str:
        rows = [(column.name, str(column.shape), column.unit) for column in self.columns()]
        name_width, shape_width = (max(len(row[i]) for row in rows) for i in (0, 1))
        lines = (
            f"{name:{name_width}}  {shape:{shape_width}}  {unit}" for name, shape, unit in rows
        )
        return "\n".join([repr(self), *(line.rstrip() for line in lines)])


@extras.named()
def table(flights: Iterable[Flight]) -> "pandas.DataFrame":
    """Table of flights: a row for each flight, a column for each single-valued field of `Summary`.

    Raises:
        ExtraMissing: pandas is not installed.
    """
    import pandas as pd

    return pd.DataFrame([values(each.summary) for each in flights])


def values(summary: Summary) -> dict[str, Any]:
    """Single-valued fields of a summary: all fields except the tables `modes` and `drops`."""
    fields = msgspec.structs.asdict(summary)
    return {name: value for name, value in fields.items() if name not in ("modes", "drops")}
