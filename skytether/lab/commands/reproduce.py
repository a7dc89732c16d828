"""`skytether reproduce`: reproduce the paper's table and figures, and write a report."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from skytether.cli import processes
from skytether.lab.commands import delays, report_folder, tables
from skytether.lab.commands.pool import Crew, Flags, PoolFlags, crew, writing
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.engine import studies
from skytether.lab.engine.journal import StudyJournal
from skytether.lab.engine.studies import EVENT, EVERY, PERIODIC, Cells, ReproductionSize, Study
from skytether.lab.engine.sweep import Runs
from skytether.lab.pages import report
from skytether.lab.pages.plates import Samples
from skytether.lab.pages.report import Reproduction
from skytether.server.schemes.loading import others
from skytether.shared.base import files, machine_code
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import parts
from skytether.shared.telemetry.record import Record
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read
from skytether.sim.batch import fly_batch


@dataclass(frozen=True)
class ReproduceOptions:
    """Options of `skytether reproduce`."""

    runs: Annotated[int, Argument(metavar="N")] = 100
    """Number of flights of each column of Table 1; each point of a curve has half as many, each
    cell of Fig. 5 a quarter."""
    out: Path = Path("results")
    """Folder for the report; the same command continues an interrupted run."""
    quick: bool = False
    """Fly a short version, in under a minute: few flights, coarse grids."""
    pool: PoolFlags = Flags()


def reproduce(argv: Sequence[str]) -> None:
    """Reproduce the paper's Table 1 and Figures 2 to 5, and fly further usual studies.

    OUT/report.html has all results, and opens offline; every figure is in OUT as PNG, PDF and CSV.
    The report shows flights over UDP beside those in virtual time. All flights are stored: after
    Ctrl-C or a crash, the same command continues; after the last flight, it only redraws the
    report.
    """
    options = read(ReproduceOptions(), argv, "skytether reproduce", reproduce.__doc__)
    command.check_count("--runs", options.runs, 100_000)
    options.pool.check()
    scale = studies.full(options.runs)
    if options.quick:
        scale = replace(studies.QUICK, runs=min(options.runs, studies.QUICK.runs))
    scenario = msgspec.structs.replace(reading.load(studies.SCENARIO), duration=scale.duration)
    call = CommandCall.now("reproduce", argv)
    command.claim_folder("--out", options.out, report_folder.PAGE)
    with writing(options.out):
        measured, runs = _measure(options, scenario, scale)
        drawn = report.draw(measured)
        report_folder.write(options.out, drawn, scenario, call, runs)
    table = drawn.tables[0]
    tables.show(table.title, table.heading, table.rows)
    flown = terminal.counted(runs, "run")
    print(f"{options.out / report_folder.PAGE}: {len(drawn.pictures)} figures; {flown} flown")
    print(drawn.verdict)


def _measure(
    options: ReproduceOptions, scenario: Scenario, scale: ReproductionSize
) -> tuple[Reproduction, int]:
    """Fly the missing flights; returns all flights, and the number of flights of this call."""
    table = studies.table_study(scenario, scale)
    curves = studies.curve_studies(scenario, scale)
    maps, periods = studies.map_sweep(scenario, scale), studies.period_sweep(scenario, scale)
    points = sum(study.runs * len(study.axis.values) for study in (table, *curves))
    total = points * (len(studies.METHODS.values) + 1)
    total += maps.flights + periods.flights
    sweeps = options.out / "sweeps"
    # Refuse a folder of another reproduction before anything is flown.
    StudyJournal(sweeps / table.name, table.first().settings(), Runs).close()
    terminal.prepare(machine_code.missing(others(scenario)))
    # Real-time measurements come first, while the cores are idle.
    delay_ms = _delays(options.out, scenario, scale)
    real = {method: _really(options.out, table, method, scale) for method in (EVERY, EVENT)}
    with crew(options.pool, "reproducing", total) as flyers:
        table_cells = _fly_study(flyers, sweeps, table, "Table 1")
        curve_cells = [_fly_study(flyers, sweeps, study, f"RMSE, {study.name}") for study in curves]
        map_cells = flyers.sweep(maps, sweeps / "fig5", "Fig. 5")
        period_cells = flyers.sweep(periods, sweeps / "fig5-periodic", "Fig. 5, periodic")
    measured = Reproduction(
        table=(table, table_cells),
        curves=list(zip(curves, curve_cells, strict=True)),
        maps=studies.flown(maps, map_cells),
        periods=studies.flown(periods, period_cells),
        delay_ms=delay_ms,
        real=real,
        samples=_samples(table, table_cells, scale),
    )
    return measured, flyers.runs


def _fly_study(flyers: Crew, out: Path, study: Study, title: str) -> Cells:
    first = study.first()
    firstly = flyers.sweep(first, out / study.name, title)
    second = study.second(studies.flown(first, firstly))
    secondly = flyers.sweep(second, out / f"{study.name}-periodic", f"{title}, periodic")
    return studies.cells(study, first, firstly, second, secondly)


def _delays(out: Path, scenario: Scenario, scale: ReproductionSize) -> Array:
    file = out / "delays.npy"
    if not file.exists():
        folder = out / "netem"
        folder.mkdir(exist_ok=True)
        seconds = scale.delay_packets * delays.EVERY_S
        content = io.BytesIO()
        with terminal.progress("packets through netem, over UDP", seconds) as on_second:
            np.save(content, delays.measure(scenario, folder, scale.delay_packets, on_second))
        files.write(file, content.getvalue())
    kept: Array = np.load(file)
    return kept


def _really(out: Path, table: Study, method: str, scale: ReproductionSize) -> report.Real:
    """Flight over UDP with the scenario's seed; a stored flight is not flown again."""
    plan = table.first()
    scenario = plan.scenario_of(scale.real_s, method)
    folder = out / "real" / method.replace(" ", "-")
    if not folder.exists():
        part = folder.with_name(folder.name + ".part")
        part.mkdir(parents=True, exist_ok=True)
        title = f"flying over UDP: {method}"
        with (
            command.interruptible() as interrupted,
            terminal.progress(title, scale.real_s) as on_second,
        ):
            shortfalls = processes.run(scenario, part, on_second=on_second, interrupted=interrupted)
        if shortfalls:
            raise CommandError("; ".join(map(str, shortfalls)))
        steps = parts.read(part / "client")["step"]
        if not len(steps) or steps[-1] < scenario.steps - 2:
            message = "interrupted; the same command goes on from here"
            raise CommandError(message, command.INTERRUPTED)
        part.rename(folder)
    client, server, netem = (parts.read(folder / part) for part in processes.NAMES)
    figures = json.loads((folder / "netem.json").read_bytes())
    return report.Real(scenario, Record(client, server, netem), figures)


def _samples(table: Study, table_cells: Cells, scale: ReproductionSize) -> Samples:
    """Scenario and some complete records of flights in virtual time, by method."""
    steps = table_cells[table.here, PERIODIC].period
    plan, samples = table.first(), {}
    for method in (*studies.METHODS.values, PERIODIC):
        scenario = plan.scenario_of(table.here, EVENT if method == PERIODIC else method)
        if method == PERIODIC:
            control = msgspec.structs.replace(scenario.control, trigger=f"periodic({steps})")
            scenario = msgspec.structs.replace(scenario, control=control)
        seeds = range(scenario.seed, scenario.seed + scale.sample_runs)
        samples[method] = scenario, fly_batch(scenario, seeds)
    return samples
