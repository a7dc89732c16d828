"""Comparison of this checkout with another commit, on the same machine and in one run.

    python -m bench.versions HEAD~10

A commit is checked out into a temporary folder, which is removed at the end; the folder of another
checkout can be given instead.

Each checkout has a process of its own, its `versions_worker.py`, and starts its own commands. Only
one of the two works at a time, in short turns of random order, so that other load affects both
alike. Time is CPU time.
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
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro

from bench.harness import HOT, TextTable, progress, us
from bench.starting import started

ROOT = Path(__file__).parents[1]
WORKERS = "bench/versions_worker.py", "skytether/lab/benchmarks/versions_worker.py"
"""Paths of a checkout's worker: the present one, and that of older commits."""
SIDES = ("before", "after")
VALUES_MIN = 20
"""Number of values below which no p99 is given."""


class Contest(NamedTuple):
    """Work that both checkouts do in turns; a row of the table."""

    title: str
    """Description, with the unit of the figures in brackets."""
    turn: tuple[Any, ...]
    """Name and arguments of a worker's turn; or "start", a command, a figure of `StartCost`."""
    turns: int
    """Number of measured turns of each checkout, after one warm-up turn."""
    per_unit: float = 1.0
    """Number of the turn's units in one unit of the title."""


@dataclass(frozen=True)
class VersionsCounts:
    hot: int = 150
    """Number of turns of 50 hot ticks of one vehicle."""
    paced: int = 40
    """Number of turns of 10 paced ticks of one vehicle."""
    fleets: tuple[int, ...] = (64, 200, 1000)
    """Number of vehicles of each fleet."""
    fleet: int = 30
    """Number of turns of 10 hot ticks of each fleet."""
    flights: int = 20
    """Number of flights in virtual time, or of batches of them, of each scenario."""
    seconds: float = 3.0
    """Duration of each flight [s]."""
    starts: int = 10
    """Number of starts of each command."""


FULL, QUICK = VersionsCounts(), VersionsCounts(20, 6, fleet=4, flights=2, seconds=2.0, starts=2)


class Side(NamedTuple):
    """A checkout with its worker."""

    folder: Path
    worker: subprocess.Popen[str]

    def take(self, turn: Sequence[Any]) -> Any:
        """Figures of a turn.

        Raises:
            ValueError: the worker has failed.
            RuntimeError: the command has failed.
        """
        if turn[0] == "start":
            cost = started(turn[1], {"PYTHONPATH": str(self.folder)})
            return [getattr(cost, turn[2])]
        assert self.worker.stdin is not None
        assert self.worker.stdout is not None
        self.worker.stdin.write(json.dumps(turn) + "\n")
        self.worker.stdin.flush()
        answer = self.worker.stdout.readline()
        if not answer:
            raise ValueError(f"turn {turn}: the worker failed, see above")
        return json.loads(answer)


@dataclass(frozen=True)
class VersionsBenchmarkOptions:
    other: Annotated[str, tyro.conf.Positional]
    """Commit to compare with, or the folder of another checkout."""
    quick: bool = False
    """Measure with small counts."""


def main(argv: Sequence[str] | None = None) -> int:
    options = tyro.cli(VersionsBenchmarkOptions, args=argv, description=__doc__)
    try:
        result = measure(options.other, QUICK if options.quick else FULL)
    except (ValueError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 1
    commits = " against ".join(f"{result[side]['commit']} ({side})" for side in SIDES[::-1])
    table(result["contests"]).show(commits)
    return 0


def contests(counts: VersionsCounts) -> list[Contest]:
    one = "saturated", 1
    rows = [
        Contest("one vehicle's tick, hot [µs]", ("ticks", *one, HOT.turn, False), counts.hot, 1e3),
        Contest("one vehicle's tick, paced [µs]", ("ticks", *one, 10, True), counts.paced, 1e3),
    ]
    for vehicles in counts.fleets:
        title = f"tick of {vehicles} vehicles, per vehicle [µs]"
        rows.append(Contest(title, ("ticks", "half", vehicles, 11, False), counts.fleet, 1e3))
    kinds = ("paper", 1, 25), ("demo", 1, 25), ("target", 1, 25), ("swap", 16, 1), ("fleet", 20, 1)
    for name, vehicles, seeds in kinds:
        turn = ("flight", name, counts.seconds, vehicles, seeds)
        rows.append(Contest(f"{name}, vehicle-steps per core-second", turn, counts.flights))
    for command in ("fly demo --virtual --duration 10", "server demo", "client demo"):
        for figure, title, per_unit in (("cpu_s", "[ms]", 1e-3), ("memory_bytes", "[MB]", 1e6)):
            name = f"start of {command} {title}"
            rows.append(Contest(name, ("start", command, figure), counts.starts, per_unit))
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
    """Figures of both checkouts.

    Raises:
        ValueError: `other` is no checkout with benchmarks, or the worker fails in one of the two.
        RuntimeError: a command fails in one of the two.
    """
    rng = np.random.default_rng(1)
    with ExitStack() as stack:
        before = stack.enter_context(checkout(other)).resolve()
        sides = {
            name: Side(folder, stack.enter_context(_start(folder)))
            for name, folder in zip(SIDES, (before, ROOT), strict=True)
        }
        machines = {name: side.take(("where",)) for name, side in sides.items()}
        figures = {contest.title: _compete(contest, sides, rng) for contest in contests(counts)}
    return {**machines, "contests": figures}


def _start(folder: Path) -> subprocess.Popen[str]:
    """Start a worker that imports from this folder; closing its stdin ends it."""
    worker = next((name for name in WORKERS if (folder / name).exists()), None)
    if worker is None:
        raise ValueError(f"{folder}: got a folder without benchmarks, expected a checkout")
    return subprocess.Popen(
        [sys.executable, "-P", worker],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _compete(
    contest: Contest, sides: Mapping[str, Side], rng: np.random.Generator
) -> dict[str, Any]:
    """Median and p99 of each side in the contest's unit, and the ratios after / before.

    The ratio of medians is computed for each pair of neighbouring turns, and the median of these
    ratios is returned, because the machine's speed changes little between neighbouring turns.
    """
    turns: dict[str, list[list[float]]] = {side: [] for side in SIDES}
    for _ in progress(range(contest.turns + 1), contest.title):
        for side in rng.permutation(SIDES):
            turns[side].append(sides[side].take(contest.turn))
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
    return {**figures, "values": values["after"].size}


def table(contests: Mapping[str, Any]) -> TextTable:
    headings = ["", "before p50", "p99", "after p50", "p99", "after / before p50", "p99"]
    rows = []
    for title, figures in contests.items():
        row = [title]
        for key in (*SIDES, "ratio"):
            p50, p99 = (us(figures[key][share]) for share in ("p50", "p99"))
            row += [p50, p99 if figures["values"] >= VALUES_MIN else ""]
        rows.append(row)
    return TextTable(headings, rows)


if __name__ == "__main__":
    sys.exit(main())
