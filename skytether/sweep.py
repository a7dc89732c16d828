"""`skytether sweep`: many flights over a grid, on all cores or on a Dask cluster."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table
from rich.text import Text

from lab import figures
from lab.journal import Journal
from lab.sweep import Sweep, estimate, parse_axis
from shared.config import ConfigError, Scenario
from shell import command
from shell.command import CommandError, ScenarioFlags, ScenarioName
from skytether import pool
from skytether.pool import Scheduler, Spent, Workers, crew

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
    workers: Workers = None
    """Processes; one a core unless given."""
    scheduler: Scheduler = None
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
    pool.check(options.workers, options.scheduler)
    try:
        axes = [parse_axis(text) for text in options.grid]
        plan = Sweep(options.scenario, options.config, axes, options.runs)
        version = metadata.version("skytether")
        with contextlib.closing(Journal(options.out, plan, version)) as journal:
            spent = Spent()
            if plan.todo(journal.done):
                title = f"sweeping {options.scenario}, {len(plan.cells)} cells"
                total = len(plan.cells) * plan.runs
                with crew(options.workers, options.scheduler, title, total) as flyers:
                    flyers.fly(plan, journal)
                    spent = flyers.spent
            _finish(options, plan, journal, spent)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    except OSError as error:
        raise CommandError(f"{error.filename or options.out}: {error.strerror or error}") from None


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
    command.show(table)
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
