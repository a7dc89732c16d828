"""`skytether reproduce`: the paper's table and figures, and more, flown and put in a report."""

import json
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tyro

from lab import report, studies
from lab.journal import Journal
from lab.report import Measured
from lab.studies import EVENT, EVERY, PERIODIC, Cells, Scale, Study
from shared import config, record
from shared.config import ConfigError, Scenario
from shared.model import Array
from shell import command
from shell.command import CommandError
from sim.flight import Flight, fly_batch
from skytether import delays, page, pool, processes
from skytether.page import Call
from skytether.pool import Crew, Scheduler, Workers, crew


@dataclass(frozen=True)
class Options:
    """Of `skytether reproduce`."""

    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Flights of each column of Table 1; half as many of each point of a curve, a quarter of each
    cell of Fig. 5."""
    out: Path = Path("results")
    """Folder for the report; what was broken off there goes on."""
    quick: bool = False
    """A first look, in under a minute: few flights, coarse grids."""
    workers: Workers = None
    """Processes; one a core unless given."""
    scheduler: Scheduler = None
    """Use the workers of this Dask scheduler instead."""


def reproduce(argv: Sequence[str]) -> None:
    """Fly the paper's Table 1 and Figures 2 to 5, and what the literature asks for besides.

    OUT/report.html has all of it, and opens anywhere; every figure is in OUT as PNG, PDF and CSV.
    Flights over real UDP stand beside those in virtual time. What is done is kept whatever happens:
    after Ctrl-C, or worse, the same command goes on; once all is done, it only draws anew.
    """
    options = tyro.cli(
        Options,
        args=argv,
        prog="skytether reproduce",
        description=cleandoc(reproduce.__doc__ or ""),
    )
    command.check_count("--runs", options.runs, 100_000)
    pool.check(options.workers, options.scheduler)
    scale = studies.full(options.runs)
    if options.quick:
        scale = replace(studies.QUICK, runs=min(options.runs, studies.QUICK.runs))
    scenario = msgspec.structs.replace(config.load(studies.SCENARIO), duration=scale.duration)
    call = Call.now("reproduce", argv)
    try:
        measured, runs = _measure(options, scenario, scale)
        drawn = report.draw(measured)
        page.write(options.out, drawn, scenario, call, runs)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    except OSError as error:
        raise CommandError(f"{error.filename or options.out}: {error.strerror or error}") from None
    page.show(drawn.tables[0])
    print(f"{options.out / page.PAGE}: {len(drawn.pictures)} figures; {runs} runs flown")
    print(drawn.verdict)


def _measure(options: Options, scenario: Scenario, scale: Scale) -> tuple[Measured, int]:
    """All flights, those done before with them; and how many were flown now."""
    table = studies.table_study(scenario, scale)
    curves = studies.curve_studies(scenario, scale)
    maps, periods = studies.map_sweep(scenario, scale), studies.period_sweep(scenario, scale)
    points = sum(study.runs * len(study.axis.values) for study in (table, *curves))
    total = points * (len(studies.METHODS.values) + 1)
    total += sum(len(plan.cells) * plan.runs for plan in (maps, periods))
    sweeps = options.out / "sweeps"
    # Another reproduction's folder is refused before anything is flown.
    Journal(sweeps / table.name, table.first(), metadata.version("skytether")).close()
    # First what is measured on the clock, while nobody else needs the cores.
    delay_ms = _delays(options.out, scenario, scale)
    real = {method: _really(options.out, table, method, scale) for method in (EVERY, EVENT)}
    with crew(options.workers, options.scheduler, "Table 1", total) as flyers:
        table_cells = _fly_study(flyers, sweeps, table, "Table 1")
        curve_cells = [_fly_study(flyers, sweeps, study, f"RMSE, {study.name}") for study in curves]
        map_cells = flyers.flown(maps, sweeps / "fig5", "Fig. 5")
        period_cells = flyers.flown(periods, sweeps / "fig5-periodic", "Fig. 5, periodic")
    measured = Measured(
        table=(table, table_cells),
        curves=list(zip(curves, curve_cells, strict=True)),
        maps=studies.flown(maps, map_cells),
        periods=studies.flown(periods, period_cells),
        delay_ms=delay_ms,
        real=real,
        samples=_samples(options.out, table, table_cells, scale),
    )
    return measured, flyers.spent.runs


def _fly_study(flyers: Crew, out: Path, study: Study, title: str) -> Cells:
    """Both its sweeps."""
    first = study.first()
    firstly = flyers.flown(first, out / study.name, title)
    second = study.second(studies.flown(first, firstly))
    secondly = flyers.flown(second, out / f"{study.name}-periodic", f"{title}, periodic")
    return studies.cells(study, first, firstly, second, secondly)


def _delays(out: Path, scenario: Scenario, scale: Scale) -> Array:
    """How long packets take through netem; see `delays.measure`."""
    file = out / "delays.npy"
    if not file.exists():
        folder = out / "netem"
        folder.mkdir(exist_ok=True)
        seconds = scale.delay_packets * delays.EVERY_S
        with command.progress("packets through netem, over UDP", seconds) as on_second:
            found = delays.measure(scenario, folder, scale.delay_packets, on_second)
        _keep(file, lambda part: np.save(part, found))
    kept: Array = np.load(file)
    return kept


def _really(out: Path, table: Study, method: str, scale: Scale) -> report.Real:
    """A flight over UDP, with the scenario's seed."""
    plan = table.first()
    scenario = plan.scenario_of(scale.real_s, method)
    folder = out / "real" / method.replace(" ", "-")
    if not folder.exists():
        part = folder.with_name(folder.name + ".part")
        part.mkdir(parents=True, exist_ok=True)
        title = f"flying over UDP: {method}"
        with command.progress(title, scale.real_s) as on_second:
            processes.run(scenario, part, on_second=on_second)
        steps = record.read(part / "client")["step"]
        if not len(steps) or steps[-1] < scenario.steps - 2:
            raise CommandError(
                "interrupted; the same command goes on from here", 128 + signal.SIGINT
            )
        part.rename(folder)
    client, server, netem = (record.read(folder / part) for part in processes.NAMES)
    figures = json.loads((folder / "netem.json").read_bytes())
    return report.Real(scenario, Flight(client, server, netem), figures)


def _samples(
    out: Path, table: Study, table_cells: Cells, scale: Scale
) -> Mapping[str, tuple[Scenario, Sequence[Flight]]]:
    """A few flights in virtual time with their whole records, by method."""
    steps = table_cells[table.here, PERIODIC].period
    samples = {}
    for method in (*studies.METHODS.values, PERIODIC):
        plan = table.first()
        scenario = plan.scenario_of(table.here, EVENT if method == PERIODIC else method)
        if method == PERIODIC:
            keys = {"trigger": "periodic", "period": steps}
            control = msgspec.structs.replace(scenario.control, **keys)
            scenario = msgspec.structs.replace(scenario, control=control)
        file = out / "samples" / f"{method.replace(' ', '-')}.npz"
        if not file.exists():
            file.parent.mkdir(exist_ok=True)
            seeds = range(scenario.seed, scenario.seed + scale.sample_runs)
            rows = {
                f"{part}{number}": getattr(flight, part)
                for number, flight in enumerate(fly_batch(scenario, seeds))
                for part in processes.NAMES
            }
            _keep(file, lambda part, rows=rows: np.savez_compressed(part, **rows))  # type: ignore[misc]
        with np.load(file) as kept:
            samples[method] = (
                scenario,
                [
                    Flight(*(kept[f"{part}{number}"] for part in processes.NAMES))
                    for number in range(scale.sample_runs)
                ],
            )
    return samples


def _keep(file: Path, write: Callable[[Any], None]) -> None:
    """A file that is there as a whole, or not at all."""
    part = file.with_name(f"{file.name}.part")
    with part.open("wb") as sink:
        write(sink)
    part.replace(file)
