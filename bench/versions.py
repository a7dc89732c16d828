"""Comparison of this checkout with another commit, on the same machine and in one run.

    python -m bench.versions HEAD~10

A commit is checked out into a temporary folder, which is removed at the end; the folder of another
checkout can be given instead.

Each checkout has a process of its own, its `versions_worker.py`. Only one of them works at a time,
in short turns of random order, so that other load affects both alike. Time is CPU time. Planning is
also compared with OSQP, in this checkout only.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bench import tick
from bench.harness import HOT, PACED, TextTable, WakeLateness, progress, us
from skytether.shared.base import files

ROOT = Path(__file__).parents[1]
WORKERS = tuple(
    f"{folder}/versions_worker.py" for folder in ("bench", "skytether/lab/benchmarks", "benchmarks")
)
"""Paths of a checkout's worker: the present path, and those of older commits, newest first."""
RUN = """
import importlib, runpy, sys
worker, harness, pause_s = sys.argv[1:]
there = importlib.import_module(harness)
there.PACED = type(there.PACED)(there.PACED.turn, float(pause_s))
runpy.run_path(worker, run_name="__main__")
"""
"""Program that runs a worker with the pauses of this checkout; older checkouts have 5 ms."""
SIDES = ("before", "after")
VALUES_MIN = 20
"""Number of values below which no p99 is given."""


@dataclass(frozen=True)
class Contest:
    """Work that both checkouts do in turns; a row of the table."""

    title: str
    """Description, with the unit of the figures in brackets."""
    turn: tuple[Any, ...]
    """Name and arguments of the worker's turn."""
    turns: int
    """Number of measured turns of each checkout, after one warm-up turn."""
    per_unit: float = 1.0
    """Number of the worker's units in one unit of the title."""
    target_ratio: str = ""
    """Target of the ratio of medians, after / before."""
    target_p99: str = ""
    """Target of the p99 after."""


@dataclass(frozen=True)
class VersionsCounts:
    hot: int = 150
    """Number of turns of 50 hot ticks of one vehicle."""
    paced: int = 40
    """Number of turns of 10 paced ticks of one vehicle."""
    fleets: tuple[int, ...] = (200, 1000)
    """Number of vehicles of each fleet."""
    fleet: int = 30
    """Number of turns of 10 hot ticks of each fleet."""
    crowd: int = 2500
    """Number of vehicles of the crowd."""
    planning: int = 40
    """Number of turns of 10 paced ticks of the crowd."""
    flights: int = 20
    """Number of flights in virtual time, or of batches of them, of each scenario."""
    seconds: float = 3.0
    """Duration of each flight [s]."""
    osqp: tick.TickCounts = tick.FULL


FULL = VersionsCounts()
QUICK = VersionsCounts(20, 6, (200, 1000), 4, 2500, 3, 2, 2.0, tick.QUICK)


@dataclass(frozen=True)
class VersionsBenchmarkOptions:
    other: Annotated[str, tyro.conf.Positional]
    """Commit to compare with, or the folder of another checkout."""
    quick: bool = False
    """Measure with small counts, only to test the benchmark."""
    json: Path | None = None
    """File for the figures."""


def main(argv: Sequence[str] | None = None) -> int:
    options = tyro.cli(VersionsBenchmarkOptions, args=argv, description=__doc__)
    try:
        result = measure(options.other, QUICK if options.quick else FULL)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    for title, table in tables(result).items():
        table.show(title)
    if options.json:
        files.write(options.json, (json.dumps(result, indent=1) + "\n").encode())
    return 0


def contests(counts: VersionsCounts) -> list[Contest]:
    rows = []
    for name in ("smooth", "saturated"):
        title = f"one vehicle's tick, {name}"
        hot: tuple[Any, ...] = ("ticks", name, 1, HOT.turn, False)
        paced: tuple[Any, ...] = ("ticks", name, 1, 10, True)
        rows += [
            Contest(f"{title}, hot [µs]", hot, counts.hot, 1e3, target_ratio="≤ 0.5"),
            Contest(f"{title}, paced [µs]", paced, counts.paced, 1e3, target_ratio="≤ 0.5"),
        ]
    for vehicles in counts.fleets:
        title = f"tick of {vehicles} vehicles, per vehicle [µs]"
        turn: tuple[Any, ...] = ("ticks", "half", vehicles, 11, False)
        rows.append(Contest(title, turn, counts.fleet, 1e3, target_ratio="≤ 0.7"))
    title = f"{counts.crowd} vehicles, estimate + trigger + plan + solve [ms]"
    turn = ("planning", "half", counts.crowd, 10)
    target_p99 = f"< {tick.TARGET_P99_MS:g}"
    rows.append(Contest(title, turn, counts.planning, 1e6, target_p99=target_p99))
    for name, vehicles, seeds in (("fleet", 20, 1), ("paper", 1, 25), ("demo", 1, 25)):
        title = f"{name}, vehicle-steps per core-second"
        turn = ("flight", name, counts.seconds, vehicles, seeds)
        rows.append(Contest(title, turn, counts.flights, target_ratio="≥ 1.2"))
    return rows


@contextmanager
def checkout(other: str) -> Iterator[Path]:
    """Folder of a checkout: `other` itself, or the commit of that name in a temporary worktree.

    Raises:
        ValueError: `other` is neither a folder nor a commit.
    """
    if Path(other).is_dir():
        yield Path(other)
        return
    git = ("git", "-C", str(ROOT), "worktree")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "before"
        added = subprocess.run(
            [*git, "add", "--quiet", "--detach", str(folder), other],
            capture_output=True,
            text=True,
            check=False,
        )
        if added.returncode:
            raise ValueError(f"{other}: expected a folder or a commit: {added.stderr.strip()}")
        try:
            yield folder
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=False)


def measure(other: str, counts: VersionsCounts) -> dict[str, Any]:
    """Figures of both checkouts, and of planning against OSQP.

    Raises:
        ValueError: `other` is no checkout with benchmarks, or the worker fails in one of the two.
    """
    rng = np.random.default_rng(1)
    with ExitStack() as stack:
        before = stack.enter_context(checkout(other))
        workers = {
            side: stack.enter_context(_start(folder.resolve()))
            for side, folder in zip(SIDES, (before, ROOT), strict=True)
        }
        machines = {side: _ask(worker, "where") for side, worker in workers.items()}
        figures = {contest.title: _compete(contest, workers, rng) for contest in contests(counts)}
    tunings = tick.tune(counts.osqp, WakeLateness())
    return {**machines, "contests": figures, "fleets": tick.fleets(counts.osqp, tunings)}


def _start(folder: Path) -> subprocess.Popen[str]:
    """Start a worker that imports from this folder; closing its stdin ends it."""
    worker = next((name for name in WORKERS if (folder / name).exists()), None)
    if worker is None:
        raise ValueError(f"{folder}: got a folder without benchmarks, expected a checkout")
    harness = ".".join(Path(worker).with_name("harness").parts)
    return subprocess.Popen(
        [sys.executable, "-P", "-c", RUN, worker, harness, str(PACED.pause_s)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _ask(worker: subprocess.Popen[str], *turn: Any) -> Any:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(json.dumps(turn) + "\n")
    worker.stdin.flush()
    answer = worker.stdout.readline()
    if not answer:
        raise ValueError(f"turn {turn}: the worker failed, see above")
    return json.loads(answer)


def _compete(
    contest: Contest, workers: Mapping[str, subprocess.Popen[str]], rng: np.random.Generator
) -> dict[str, Any]:
    """Median and p99 of each side in the contest's unit, and the ratios after / before.

    The ratio of medians is computed for each pair of neighbouring turns, and the median of these
    ratios is returned, because the machine's speed changes little between neighbouring turns.
    """
    turns: dict[str, list[list[float]]] = {side: [] for side in SIDES}
    for _ in progress(range(contest.turns + 1), contest.title):
        for side in rng.permutation(SIDES):
            turns[side].append(_ask(workers[side], *contest.turn))
    values = {side: np.array(turns[side][1:]) / contest.per_unit for side in SIDES}
    figures: dict[str, Any] = {
        side: {"p50": float(np.median(measured)), "p99": float(np.quantile(measured, 0.99))}
        for side, measured in values.items()
    }
    medians = (np.median(values[side], axis=1) for side in ("after", "before"))
    figures["ratio"] = {
        "p50": float(np.median(np.divide(*medians))),
        "p99": figures["after"]["p99"] / figures["before"]["p99"],
    }
    targets = {"ratio": contest.target_ratio, "p99": contest.target_p99}
    return {**figures, "values": values["after"].size, "targets": targets}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    commits = " against ".join(f"{result[side]['commit']} ({side})" for side in SIDES[::-1])
    headings = ["", "before p50", "p99", "after p50", "p99", "after / before p50", "p99"]
    rows = [_row(title, figures) for title, figures in result["contests"].items()]
    planning = "planning against sequential OSQP, after"
    return {commits: TextTable(headings, rows), planning: tick.fleet_table(result["fleets"])}


def _row(title: str, figures: Mapping[str, Any]) -> list[str]:
    row = [title]
    for key in (*SIDES, "ratio"):
        p50, p99 = (us(figures[key][share]) for share in ("p50", "p99"))
        row += [p50, p99 if figures["values"] >= VALUES_MIN else ""]
    for column, key in ((4, "p99"), (5, "ratio")):
        if target := figures["targets"][key]:
            row[column] += f" ({target})"
    return row


if __name__ == "__main__":
    sys.exit(main())
