"""`skytether sweep`: many flights over a grid, on all cores or on a Dask cluster."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from skytether.lab.commands import tables
from skytether.lab.commands.pool import Crew, Flags, PoolFlags, crew, writing
from skytether.lab.engine.sweep import Results, Sweep, estimate, parse_axis
from skytether.lab.pages import figures
from skytether.shared.base import files
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import ScenarioFlags, ScenarioName

DRAWN = {"rmse_xy": "RMSE xy [m]", "event_ratio": "event ratio"}
SHOWN = {
    "rmse_xy": ("RMSE xy [m]", ".4f"),
    "event_ratio": ("event ratio", ".4f"),
    "uplink_above": ("sent by the trigger's figure", ".1f"),
    "uplink_due": ("due", ".1f"),
    "packets_per_s": ("packets/s both ways", ".2f"),
}


@dataclass(frozen=True)
class SweepOptions:
    """Options of `skytether sweep`."""

    out: Path
    """Folder for the results; the same command continues an interrupted run."""
    scenario: ScenarioName = "paper"
    """Name of a scenario (`skytether list scenarios`) or path of a .toml file."""
    grid: Annotated[tuple[str, ...], Argument(append=True, metavar="KEY=VALUES")] = ()
    """Key of the scenario and its values: KEY=START:STOP:COUNT, evenly spaced, or KEY=A,B,C.
    With several grids, all combinations of their values are flown."""
    runs: Annotated[int, Argument(metavar="N")] = 50
    """Number of flights of each combination, with seeds that count up from the scenario's."""
    pool: PoolFlags = Flags()
    config: ScenarioFlags = Scenario()


def sweep(argv: Sequence[str]) -> None:
    """Fly a scenario many times in virtual time, for every combination of some keys' values.

    OUT/runs.csv has a row for each flight, OUT/cells.csv one for each combination, with means and
    95 % intervals. With one or two keys, OUT also has pictures. All flights are stored: after
    Ctrl-C or a crash, the same command continues. The resulting tables are identical for any number
    of workers.
    """
    options = command.parse(
        SweepOptions(tyro.MISSING), argv, "skytether sweep", sweep.__doc__, is_final=False
    )
    command.check_count("--runs", options.runs, 100_000)
    options.pool.check()
    axes = [parse_axis(text) for text in options.grid]
    plan = Sweep(options.scenario, options.config, axes, options.runs)
    command.claim_folder("--out", options.out, "runs.csv", "cells.csv")
    title = f"sweeping {options.scenario}, {terminal.counted(len(plan.cells), 'cell')}"
    with writing(options.out):
        with crew(options.pool, title, plan.flights) as flyers:
            done = flyers.sweep(plan, options.out)
        _finish(options, plan, done, flyers)


def _finish(options: SweepOptions, plan: Sweep, done: Results, flyers: Crew) -> None:
    written = ["runs.csv", "cells.csv"]
    files.write(options.out / "runs.csv", plan.runs_csv(done).encode())
    files.write(options.out / "cells.csv", plan.cells_csv(done).encode())
    cells = [plan.of_cell(done, cell) for cell in range(len(plan.cells))]
    title = f"{options.scenario}, {terminal.counted(plan.runs, 'run')} each, in virtual time"
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
        written.append(path.name)
    rows = []
    for values, runs in zip(plan.cells, cells, strict=True):
        row = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
        for figure, (_, spec) in SHOWN.items():
            mean, half = estimate(runs, figure)
            row.append(_interval(mean, half, spec))
        rows.append(row)
    headings = [axis.key for axis in plan.axes] + [name for name, _ in SHOWN.values()]
    tables.show(title, headings, rows)
    failed = sum(not run.steps for runs in cells for run in runs)
    if failed:
        print(f"{terminal.counted(failed, 'run')} found no server, left out of the mean errors")
    if flyers.cpu_s:
        steps = sum(run.steps for runs in flyers.fresh for run in runs)
        print(f"{steps} vehicle-steps, {steps / flyers.cpu_s:.0f} per core-second")
    print(f"{options.out}: {', '.join(written)}")


def _interval(mean: float | None, half: float | None, spec: str) -> str:
    if mean is None:
        return "-"
    return format(mean, spec) + ("" if half is None else f" ± {half:{spec}}")
