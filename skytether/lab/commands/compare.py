"""`skytether compare`: schemes and triggers on the same seeds, each with its own best weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from skytether.figures.page import as_text
from skytether.lab.commands import report_folder, tables
from skytether.lab.commands.pool import Crew, Flags, PoolFlags, crew, writing
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.engine import contenders
from skytether.lab.engine.budgets import Plan
from skytether.lab.engine.calibration import ONLY, Rmse, SearchLimits
from skytether.lab.engine.comparison import ComparedCase, compared
from skytether.lab.engine.contenders import CASES, PACKETS, ComparisonSize, TunedWeights
from skytether.lab.engine.floor import Baselines, Floor, Work, floor_of, summarise_aboard
from skytether.lab.engine.search import Search, best
from skytether.lab.pages import comparison
from skytether.lab.pages.report import Drawn
from skytether.shared.base import files
from skytether.shared.scenario import reading
from skytether.shared.telemetry.summary import Summary
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read

WEIGHTS = "weights.toml"


@dataclass(frozen=True)
class CompareOptions:
    """Options of `skytether compare`."""

    runs: Annotated[int, Argument(metavar="N")] = 100
    """Number of flights of each contender per case and budget, with seeds from 1 on."""
    out: Path = Path("compare")
    """Folder for report, weights and searches; the same command continues an interrupted run."""
    quick: bool = False
    """Fly a short version: few flights, cases and thresholds."""
    cases: Annotated[tuple[str, ...], Argument(metavar="CASE")] = ()
    """Cases to fly; by default all."""
    tune: bool = False
    """Only search for the weights of every contender in every case, each with the same effort, and
    write them to OUT/weights.toml."""
    generations: Annotated[int, Argument(metavar="N")] = 16
    """Number of generations of each search of --tune."""
    weights: Annotated[str, Argument(metavar="FILE")] = reading.COMPARED
    """File of weights, as written by --tune; by default the included file."""
    contender: Annotated[tuple[Path, ...], Argument(metavar="FILE", append=True)] = ()
    """File with the keys of a contender of your own (see docs/compare.md), flown beside the
    built-in ones; may be repeated."""
    pool: PoolFlags = Flags()


def compare(argv: Sequence[str]) -> None:
    """Compare schemes and triggers on a target whose motion only the server sees.

    OUT/report.html has the tables and figures, and opens offline. OUT also has every table as CSV,
    and every figure as PNG, PDF and CSV. All flights are stored: after Ctrl-C or a crash, the same
    command continues; after the last flight, it only draws the report again.
    """
    options = read(CompareOptions(), argv, "skytether compare", compare.__doc__)
    command.check_count("--runs", options.runs, 100_000)
    command.check_count("--generations", options.generations, 10**6)
    options.pool.check()
    if options.tune and options.contender:
        searches = "expected one of the two: `skytether calibrate` tunes your own contender"
        raise CommandError(f"--contender: got it with --tune, {searches}", command.CONFIGURATION)
    scale = size(options)
    with writing(options.out):
        if options.tune:
            _tune(options, scale)
            return
        _, drawn, runs = run(options, scale, CommandCall.now("compare", argv))
    for table in drawn.tables:
        tables.show(table.title, table.heading, table.rows)
    page = options.out / report_folder.PAGE
    print(f"{page}: {len(drawn.pictures)} figures; {terminal.counted(runs, 'run')} flown")
    print(drawn.verdict)


def size(options: CompareOptions) -> ComparisonSize:
    cases = contenders.cases(options.cases)
    all_ = [*contenders.CONTENDERS, *contenders.of_user(options.contender)]
    scale = ComparisonSize(options.runs, options.generations, cases=cases, contenders=all_)
    return contenders.quick(scale) if options.quick else scale


def run(
    options: CompareOptions, scale: ComparisonSize, call: CommandCall
) -> tuple[list[ComparedCase], Drawn, int]:
    """Fly all cases and write the report; returns results, report and number of flights flown."""
    plans = [Plan(case, options.weights, scale) for case in scale.cases]
    command.claim_folder("--out", options.out, report_folder.PAGE)
    runs = sum(_scout(options, plans, number) for number in range(1 + scale.rounds))
    chosen = [plan.chosen() for plan in plans]
    sweeps = [plan.comparison(each.values()) for plan, each in zip(plans, chosen, strict=True)]
    results = []
    with crew(options.pool, "comparing", sum(each.flights for each in sweeps)) as flyers:
        for plan, points, sweep in zip(plans, chosen, sweeps, strict=True):
            done = flyers.sweep(sweep, options.out / "sweeps" / plan.case.name, plan.case.title)
            beside = _beside(flyers, plan, options.out / "beside" / plan.case.name)
            results.append(compared(plan, points, sweep, done, beside))
        runs += flyers.runs
    drawn = comparison.draw(results)
    report_folder.write(options.out, drawn, reading.load(CASES[0].plant), call, runs)
    return results, drawn, runs


def _scout(options: CompareOptions, plans: Sequence[Plan], number: int) -> int:
    """Fly the scouting flights of a round: in round 0 all points, later only points near a budget.

    Returns the number of flights flown by this call.
    """
    asked = [plan.halfway() if number else plan.points for plan in plans]
    if not any(asked):
        return 0
    sweeps = [plan.scouts(points) for plan, points in zip(plans, asked, strict=True)]
    with crew(options.pool, "choosing", sum(each.flights for each in sweeps)) as flyers:
        for plan, points, sweep in zip(plans, asked, sweeps, strict=True):
            if points:
                folder = options.out / "scouts" / plan.case.name / f"round-{number}"
                plan.scouted(points, sweep, flyers.sweep(sweep, folder, plan.case.title))
        return flyers.runs


def _beside(flyers: Crew, plan: Plan, folder: Path) -> Baselines:
    """Baselines of a case; empty for a case that is flown with the weights of another case."""
    if plan.case.weights:
        return Baselines()
    work, no_work = Work(plan), lambda _: 0.0
    settings = work.settings()
    floor = flyers.study(floor_of, work.regular, Floor, settings, folder / "floor", size=no_work)
    aboard = flyers.study(
        summarise_aboard, work.aboard, Summary, settings, folder / "aboard", size=no_work
    )
    return Baselines(list(floor.values()), list(aboard.values()))


def _tune(options: CompareOptions, scale: ComparisonSize) -> None:
    command.claim_folder("--out", options.out, WEIGHTS)
    found = []
    total = len(scale.searched) * scale.generations
    with crew(options.pool, "searching", total, "generations") as flyers:
        for contender, case in scale.searched:
            start = contenders.search_start(contender, case, scale)
            objective = Rmse(start, SearchLimits(PACKETS, case.effort_mps))
            search = Search(
                start=start,
                objective=objective,
                free=objective.free(),
                runs=scale.search_runs,
                population=scale.population,
            )
            name = contenders.entry(contender, case)
            folder = options.out / "searches" / name
            *_, points = flyers.search(search, folder, scale.generations, f"{name}: ")
            point = best(points)
            means = point.values[ONLY]
            says = (
                f"RMSE xy {as_text(means['rmse_xy'], '.4f')} m at "
                f"{as_text(means['event_ratio'], '.1%')} of the steps, effort "
                f"{as_text(means['effort_mps'], '.3f')} m/s"
            )
            found.append(TunedWeights(contender, case, search.scenario(point), says))
            print(f"{name}: {says}")
    files.write(options.out / WEIGHTS, contenders.to_file(found, scale).encode())
    print(f"{options.out / WEIGHTS}: weights of {len(found)} contenders in their cases")
