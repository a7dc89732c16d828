"""Measuring contestants side by side, studies of many flights, and tables of the results; used by
every benchmark.

Contestants take turns at the same problems, so that other load on the machine affects all of them
alike: ratios of figures from one run are reliable even if the figures are not. Time is the CPU time
of this process, which excludes the time of other processes. The lateness with which the process
wakes from its pauses shows how busy the machine was, and is reported with the figures.
"""

import gc
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from skytether.lab.commands import tables
from skytether.lab.commands.machine import commit, processor
from skytether.lab.commands.pool import Flags, study
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

Durations = NDArray[np.int64]
"""CPU time of each problem [ns]; shape (count,)."""
CONSOLE = Console()
Step = TypeVar("Step")
C = TypeVar("C")
R = TypeVar("R")


def sleep_until(due_ns: int) -> None:
    time.sleep(max(0, due_ns - time.monotonic_ns()) / SECOND_NS)


def quantile_ms(values_ns: Any, share: float) -> float:
    """Quantile of durations [ms]; NaN without any."""
    return float(np.quantile(values_ns, share)) / MILLISECOND_NS if len(values_ns) else float("nan")


@dataclass(frozen=True)
class WakeLateness:
    """Pauses of this process, and the lateness of each wake."""

    late_ns: list[int] = field(default_factory=list)

    def sleep(self, pause_s: float) -> None:
        due_ns = time.monotonic_ns() + round(pause_s * SECOND_NS)
        sleep_until(due_ns)
        self.late_ns.append(time.monotonic_ns() - due_ns)

    def figures(self) -> dict[str, float]:
        shares = {"p50_ms": 0.5, "p99_ms": 0.99, "max_ms": 1.0}
        return {name: quantile_ms(self.late_ns, share) for name, share in shares.items()}


@dataclass(frozen=True)
class Pace:
    """Rule by which contestants take turns."""

    turn: int
    """Number of consecutive problems of a turn; the first of several is a warm-up."""
    pause_s: float
    """Pause before every turn [s]."""


HOT = Pace(turn=50, pause_s=0.001)
"""Pace of problems back to back, with all data in the caches."""
PACED = Pace(turn=1, pause_s=0.05)
"""Pace of a controller with the paper's step of 50 ms: in every pause others take the caches."""


def interleave(
    contestants: Mapping[str, Callable[[int], object]],
    count: int,
    pace: Pace,
    lateness: WakeLateness,
    title: str,
    *,
    prepare: Mapping[str, Callable[[], object]] = MappingProxyType({}),
) -> dict[str, Durations]:
    """CPU time of each contestant for each of the problems 0 … count - 1.

    The order of contestants is random in each turn, as it affects the content of the caches.

    Args:
        contestants: function that solves a problem by its number, by name.
        prepare: preparation of a contestant before each problem, which is not measured.
    """
    order, rng = list(contestants.items()), np.random.default_rng(1)
    spent = {name: np.empty(count, dtype=np.int64) for name in contestants}
    with without_gc():
        for first in progress(range(0, count, pace.turn), title):
            for name, solve in (order[i] for i in rng.permutation(len(order))):
                for problem in range(first, min(first + pace.turn, count)):
                    if name in prepare:
                        prepare[name]()
                    if problem == first:
                        lateness.sleep(pace.pause_s)
                        time.process_time_ns()  # the first call after a pause is slow
                    start_ns = time.process_time_ns()
                    solve(problem)
                    spent[name][problem] = time.process_time_ns() - start_ns
    warm = np.arange(count) % pace.turn >= min(1, pace.turn - 1)
    return {name: durations[warm] for name, durations in spent.items()}


@contextmanager
def without_gc() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def progress(steps: Sequence[Step], title: str) -> Iterable[Step]:
    """Progress bar, drawn between the steps and not by a concurrent thread."""
    return track(steps, title, console=CONSOLE, transient=True, auto_refresh=False)


def figures_us(durations: Durations | Sequence[float], per: float = 1.0) -> dict[str, float]:
    """Median and p99 [µs] of durations [ns], divided by `per` packets or vehicles."""
    p50, p99 = np.quantile(durations, [0.5, 0.99]) / 1000.0 / per
    return {"p50_us": float(p50), "p99_us": float(p99)}


def ratios(theirs: Mapping[str, float], ours: Mapping[str, float]) -> dict[str, float]:
    return {name: theirs[f"{name}_us"] / ours[f"{name}_us"] for name in ("p50", "p99")}


def machine() -> dict[str, Any]:
    return {
        "cpu": processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


@dataclass(frozen=True)
class TextTable:
    """Table as text; the first column is left-aligned, the others are numbers."""

    headings: list[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        rule = ["---", *["---:"] * (len(self.headings) - 1)]
        lines = [[" ".join(heading.split()) for heading in self.headings], rule, *self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def show(self, title: str) -> None:
        tables.show(title, self.headings, self.rows)


@dataclass(frozen=True)
class StudyOptions:
    seeds: int
    """Number of seeds, from 1 on."""
    jobs: int | None = None
    """Number of flights at once; one per core unless given."""
    out: Path | None = None
    """Folder for the flights: after Ctrl-C, or with more seeds, the same command continues."""


@dataclass(frozen=True)
class Study(Generic[C, R]):
    """Flights of some cells with several seeds, and the tables of their results."""

    description: str | None
    cells: Callable[[int], Sequence[C]]
    """Returns the cells to fly, for a number of seeds from 1 on."""
    fly: Callable[[C], R]
    """Flies a cell, and evaluates the flight; called in a worker."""
    kind: Any
    """Type of a result."""
    tables: Callable[[Sequence[R]], Mapping[str, TextTable]]
    """Returns the tables by name, from the results in the order of the cells."""
    seeds: int
    """Number of seeds of the tables in the documents."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """All settings that determine the results, besides the cells."""

    def make(self, seeds: int, out: Path | None, flags: Flags) -> Mapping[str, TextTable]:
        """Tables, after flying what the folder does not have; see `lab.commands.pool.study`."""
        return self.tables(study(self.fly, self.cells(seeds), self.kind, self.settings, out, flags))

    def document_tables(self, out: Path | None, flags: Flags) -> Mapping[str, TextTable]:
        return self.make(self.seeds, out, flags)

    def show(self, options: StudyOptions) -> None:
        for title, table in self.make(options.seeds, options.out, Flags(options.jobs)).items():
            table.show(title)

    def main(self, argv: Sequence[str]) -> None:
        default = StudyOptions(self.seeds)
        self.show(tyro.cli(StudyOptions, args=argv, default=default, description=self.description))


def place_of(name: str) -> re.Pattern[str]:
    """Pattern of a table in a document, between `<!-- table: name -->` and `<!-- end -->`."""
    begin = f"<!-- table: {re.escape(name)} -->\n"
    return re.compile(rf"(?<={begin}).*?(?=<!-- end -->)", re.DOTALL)


def refresh(document: str, tables: Mapping[str, TextTable]) -> str:
    """Document with each table replaced in its place, see `place_of`.

    Raises:
        ValueError: the document has not exactly one place for a table.
    """
    for name, table in tables.items():
        body = table.markdown().replace("\\", r"\\")
        document, count = place_of(name).subn(rf"\n{body}\n", document)
        if count != 1:
            raise ValueError(f"table {name}: got {count} places in the document, expected 1")
    return document


def us(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def times(ratio: float, target: float | None = None) -> str:
    text = f"{ratio:.0f} x" if ratio >= 100 else f"{ratio:.1f} x"
    return text if target is None else f"{text} (≥ {target:g})"


def median(values: Iterable[float]) -> float:
    return float(statistics.median(values))
