"""Side by side: how every benchmark here measures, and how it writes down what it measured.

Contestants take turns at the same problems, so that whatever else the machine does meanwhile hits
all of them alike: a ratio of two figures of one run can be trusted where the figures cannot. Time
is CPU time of this process, which does not run while somebody else has the core. How late the
process wakes from its pauses is the machine's own error, and is reported beside the figures.
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
from importlib import metadata
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from skytether.lab.commands import tables
from skytether.lab.commands.machine import commit, processor
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

Durations = NDArray[np.int64]
"""CPU time of each problem [ns]; shape (count,)."""
PACKAGES = ("casadi", "daqp", "numba", "numpy", "osqp", "piqp", "quadprog", "scipy")
CONSOLE = Console()
Step = TypeVar("Step")


def sleep_until(due_ns: int) -> None:
    """Wait for an absolute time; not at all if it has passed."""
    time.sleep(max(0, due_ns - time.monotonic_ns()) / SECOND_NS)


def quantile_ms(values_ns: Any, share: float) -> float:
    """A quantile of durations [ms]; not a number without any."""
    return float(np.quantile(values_ns, share)) / MILLISECOND_NS if len(values_ns) else float("nan")


@dataclass(frozen=True)
class Lateness:
    """Pauses, and how late this process woke from each."""

    late_ns: list[int] = field(default_factory=list)

    def sleep(self, pause_s: float) -> None:
        """Pause, and note how late the end of it came."""
        due_ns = time.monotonic_ns() + round(pause_s * SECOND_NS)
        sleep_until(due_ns)
        self.late_ns.append(time.monotonic_ns() - due_ns)

    def figures(self) -> dict[str, float]:
        """Quantiles of the lateness [ms], by name."""
        shares = {"p50_ms": 0.5, "p99_ms": 0.99, "max_ms": 1.0}
        return {name: quantile_ms(self.late_ns, share) for name, share in shares.items()}


@dataclass(frozen=True)
class Pace:
    """Rule by which contestants take turns."""

    turn: int
    """Number of problems in a row; the first of several only warms up."""
    pause_s: float
    """Sleep before every turn [s]."""


HOT = Pace(turn=50, pause_s=0.001)
"""Pace of problems back to back, with everything in the caches."""
PACED = Pace(turn=1, pause_s=0.05)
"""Pace of a controller with the paper's step of 50 ms: in every pause others take the caches."""


def interleave(
    contestants: Mapping[str, Callable[[int], object]],
    count: int,
    pace: Pace,
    lateness: Lateness,
    title: str,
    *,
    prepare: Mapping[str, Callable[[], object]] = MappingProxyType({}),
) -> dict[str, Durations]:
    """CPU time of each contestant for each of the problems 0 … count - 1.

    Who follows whom is drawn anew each time: after a long solve the caches hold nothing of ours.

    Args:
        contestants: what each does with a problem.
        count: how many problems.
        pace: hot or paced.
        lateness: of the pauses.
        title: for the progress bar.
        prepare: what a contestant has to do before each problem, which is not counted.
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
                        time.process_time_ns()  # the first call after a pause takes long
                    start_ns = time.process_time_ns()
                    solve(problem)
                    spent[name][problem] = time.process_time_ns() - start_ns
    warm = np.arange(count) % pace.turn >= min(1, pace.turn - 1)
    return {name: durations[warm] for name, durations in spent.items()}


@contextmanager
def without_gc() -> Iterator[None]:
    """Context in which no garbage is collected."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def progress(steps: Sequence[Step], title: str) -> Iterable[Step]:
    """Progress bar, drawn between the steps and not by a thread during them."""
    return track(steps, title, console=CONSOLE, transient=True, auto_refresh=False)


def figures_us(durations: Durations | Sequence[float], per: float = 1.0) -> dict[str, float]:
    """Median and p99 of durations [ns], divided by a number of packets or vehicles [µs]."""
    p50, p99 = np.quantile(durations, [0.5, 0.99]) / 1000.0 / per
    return {"p50_us": float(p50), "p99_us": float(p99)}


def ratios(theirs: Mapping[str, float], ours: Mapping[str, float]) -> dict[str, float]:
    """Ratios of the others' figures of `figures_us` to ours."""
    return {name: theirs[f"{name}_us"] / ours[f"{name}_us"] for name in ("p50", "p99")}


def machine() -> dict[str, Any]:
    """Description of the machine, the packages and the commit that are measured."""
    return {
        "cpu": processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version for name in PACKAGES if (version := _version(name))},
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True)
class TextTable:
    """Text in columns; the first is flush left, the others are numbers."""

    headings: list[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        """Table as Markdown."""
        rule = ["---", *["---:"] * (len(self.headings) - 1)]
        lines = [[" ".join(heading.split()) for heading in self.headings], rule, *self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def show(self, title: str) -> None:
        """Print the table on the console."""
        tables.show(title, self.headings, self.rows)


def refresh(document: str, tables: Mapping[str, TextTable]) -> str:
    """The document with each table put where `<!-- table: name -->` … `<!-- end -->` says.

    Raises:
        ValueError: it has no such place for one of them.
    """
    for name, table in tables.items():
        place = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(?=<!-- end -->)", re.DOTALL)
        body = table.markdown().replace("\\", r"\\")
        document, found = place.subn(rf"\1\n{body}\n", document)
        if found != 1:
            raise ValueError(f"table {name}: got {found} places in the document, expected 1")
    return document


def us(value: float) -> str:
    """Microseconds, to three digits."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def times(ratio: float, target: float | None = None) -> str:
    """A ratio, and the target beside it."""
    text = f"{ratio:.0f} x" if ratio >= 100 else f"{ratio:.1f} x"
    return text if target is None else f"{text} (≥ {target:g})"


def median(values: Iterable[float]) -> float:
    """Median of a few figures."""
    return float(statistics.median(values))
