"""`skytether sweep`: many flights over a grid, on all cores or on a Dask cluster."""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

import lab.sweep
from lab import figures
from lab.journal import Journal
from lab.sweep import Done, Sweep, Task, estimate, parse_axis
from shared import command
from shared.command import CommandError, ScenarioFlags, ScenarioName
from shared.config import ConfigError, Scenario
from shared.workers import die_with_parent

UNDER_WAY_MAX = 256
"""Tasks handed out at once: more than any machine has cores, and no more than need be."""
POLL_S = 0.2
"""How soon Ctrl-C is noticed."""
CONNECT_S = 10.0
"""How long a scheduler may take to answer."""
DRAWN = {"rmse_xy": "RMSE xy [m]", "event_ratio": "event ratio"}
"""Figures that make a picture each."""


@dataclass(frozen=True)
class Options:
    """Of `skytether sweep`."""

    out: Path
    """Folder for the results; a sweep that was broken off there goes on."""
    scenario: ScenarioName = "paper"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    grid: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUES")
    ] = ()
    """A key of the scenario and its values: KEY=START:STOP:COUNT, evenly spaced, or KEY=A,B,C.
    Several make all combinations."""
    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 50
    """Flights of each combination, with seeds that count up from the scenario's."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes; one a core unless given."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Use the workers of this Dask scheduler instead."""
    config: ScenarioFlags = Scenario()


def sweep(argv: Sequence[str]) -> None:
    """Fly a scenario many times in virtual time, for every combination of some keys' values.

    OUT/runs.csv has a row for each flight, OUT/cells.csv one for each combination, with means and
    95 % intervals; over one or two keys there are pictures, too. What is done is kept whatever
    happens: after Ctrl-C, or worse, the same command goes on, and in the end the tables have the
    same bytes, for any number of workers.
    """
    options = command.parse(Options(tyro.MISSING), argv, "skytether sweep", sweep.__doc__)
    command.check_count("--runs", options.runs, 100_000)
    if options.workers is not None:
        command.check_count("--workers", options.workers, 1024)
        if options.scheduler:
            raise CommandError("--workers: got --scheduler as well, which has its own", 2)
    try:
        axes = [parse_axis(text) for text in options.grid]
        plan = Sweep(options.scenario, options.config, axes, options.runs)
        version = metadata.version("skytether")
        with contextlib.closing(Journal(options.out, plan, version)) as journal:
            spent = _fly(options, plan, journal)
            _finish(options, plan, journal, spent)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    except OSError as error:
        raise CommandError(f"{error.filename or options.out}: {error.strerror or error}") from None


@dataclass(slots=True)
class Spent:
    """What this part of the sweep cost."""

    cpu_s: float = 0.0
    steps: int = 0
    """Flown by all vehicles."""


def _fly(options: Options, plan: Sweep, journal: Journal) -> Spent:
    """Whatever is not done yet."""
    todo = [task for task in plan.tasks() if (task.cell, task.chunk) not in journal.done]
    spent, total = Spent(), len(plan.cells) * plan.runs
    if not todo:
        return spent
    left = sum(len(task.seeds) for task in todo)

    def on_done(done: Done, cpu_s: float) -> None:
        journal.append(done)
        spent.cpu_s += cpu_s
        spent.steps += sum(run.steps for run in done.runs)
        bar.update(bar.task_ids[0], advance=len(done.runs))

    with (
        command.interruptible() as interrupted,
        _workers(options) as executor,
        Progress(
            TextColumn(f"sweeping {options.scenario}, {len(plan.cells)} cells"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("runs"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            speed_estimate_period=600.0,
            disable=not sys.stderr.isatty(),
        ) as bar,
    ):
        bar.add_task("", total=total, completed=total - left)
        try:
            ended = _share(executor, todo, on_done, interrupted)
        except BrokenExecutor:
            raise CommandError("a worker has died; the same command goes on from here") from None
        except CancelledError:
            raise CommandError(f"{options.scheduler}: has gone; the same command goes on") from None
    if not ended:
        flown = sum(len(done.runs) for done in journal.done.values())
        raise CommandError(
            f"interrupted with {flown} of {total} runs done; the same command goes on from here",
            128 + signal.SIGINT,
        )
    return spent


def _share(
    executor: Executor,
    tasks: Iterable[Task],
    on_done: Callable[[Done, float], None],
    stopped: Callable[[], bool],
) -> bool:
    """Have all tasks done, in any order; False where it was told to stop."""
    waiting = iter(tasks)
    under_way: set[Future[tuple[Done, float]]] = set()
    while True:
        with _deaf():
            for task in islice(waiting, UNDER_WAY_MAX - len(under_way)):
                under_way.add(executor.submit(work, task))
        if not under_way:
            return True
        ready, under_way = wait(under_way, POLL_S, FIRST_COMPLETED)
        for future in ready:
            on_done(*future.result())
        if stopped():
            return False


@contextmanager
def _deaf() -> Iterator[None]:
    """A worker that is started within it never hears Ctrl-C, which is for the command alone."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def work(task: Task) -> tuple[Done, float]:
    """Runs in a worker: its flights, and the CPU time they took [s]."""
    began_s = time.thread_time()
    return lab.sweep.fly(task), time.thread_time() - began_s


def _workers(options: Options) -> AbstractContextManager[Executor]:
    if options.scheduler:
        return _cluster(options.scheduler)
    return _processes(options.workers or len(os.sched_getaffinity(0)))


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    """Processes of this machine, a core each; at the end nothing of them goes on."""
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _start, (os.getpid(),))
    before = set(multiprocessing.active_children())
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _start(parent: int) -> None:
    """Runs in a worker, first."""
    die_with_parent()
    if os.getppid() != parent:  # it was gone before
        os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        message = "--scheduler: needs Dask: install skytether[cluster], here and on the workers"
        raise CommandError(message, command.CONFIGURATION) from None
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise CommandError(f"--scheduler: {address} cannot be reached: {error}") from None
    with client:
        ours = metadata.version("skytether")
        try:
            theirs = client.run(metadata.version, "skytether")
        except ModuleNotFoundError as error:
            raise CommandError(f"--scheduler: {address}: its workers have no skytether") from error
        for worker, version in theirs.items():
            if version != ours:
                other = f"{worker} has skytether {version}, expected {ours}"
                raise CommandError(f"--scheduler: {address}: {other}")
        yield client.get_executor(pure=False)


def _finish(options: Options, plan: Sweep, journal: Journal, spent: Spent) -> None:
    """The tables and pictures of a sweep that is whole."""
    files = ["runs.csv", "cells.csv"]
    journal.write("runs.csv", plan.runs_csv(journal.done).encode())
    journal.write("cells.csv", plan.cells_csv(journal.done).encode())
    cells = [plan.of_cell(journal.done, cell) for cell in range(len(plan.cells))]
    title = f"{options.scenario}, {plan.runs} runs each, in virtual time"
    for figure, name in DRAWN.items():
        pairs = [estimate(runs, figure) for runs in cells]
        means, halves = np.array(pairs, dtype=np.float64).T  # None becomes NaN
        path = options.out / f"{figure}.png"
        match [axis for axis in plan.axes if len(axis.values) > 1]:
            case (axis,):
                halves = np.nan_to_num(halves)
                figures.curve(path, title, axis, name, means=means, halves=halves)
            case (one, other):
                shape = (len(one.values), len(other.values))
                means = means.reshape(shape)
                figures.heat_map(path, title, (one, other), name, means=means)
            case _:
                continue
        files.append(path.name)
    table = Table(title=title, title_justify="left")
    shown = {"rmse_xy": ("RMSE xy [m]", ".4f"), "event_ratio": ("event ratio", ".4f")}
    shown |= {"uplink_packets": ("packets up", ".1f")}
    for heading in (*(axis.key for axis in plan.axes), *(name for name, _ in shown.values())):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for values, runs in zip(plan.cells, cells, strict=True):
        row = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
        for figure, (_, spec) in shown.items():
            row.append(_interval(*estimate(runs, figure), spec))
        table.add_row(*map(Text, row))
    # A number cut off would be worse than a line too long.
    Console(width=max(Console().width, Console(width=1000).measure(table).maximum)).print(table)
    failed = sum(not run.steps for runs in cells for run in runs)
    if failed:
        print(f"{failed} runs found no server and count in no mean of the error")
    if spent.cpu_s:
        rate = spent.steps / spent.cpu_s
        print(f"{spent.steps} vehicle-steps, {rate:.0f} per core-second")
    print(f"{options.out}: {', '.join(files)}")


def _interval(mean: float | None, half: float | None, spec: str) -> str:
    if mean is None:
        return "-"
    return format(mean, spec) + ("" if half is None else f" ± {half:{spec}}")
