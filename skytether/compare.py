"""`skytether compare`: schemes and triggers on the same seeds, each at its own best weights."""

import signal
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from inspect import cleandoc
from pathlib import Path
from typing import Annotated

import tyro

from lab import calibration, comparison, contenders
from lab.contenders import CONTENDERS, PACKETS, PLANT, SEARCH_SEED, Plan, Scale
from shared import config
from shared.config import ConfigError
from shell import command
from shell.command import CommandError
from skytether import page, pool
from skytether.calibrate import SIGMA, Hunt, best, progress
from skytether.page import Call
from skytether.pool import Scheduler, Workers, crew


@dataclass(frozen=True)
class Options:
    """Of `skytether compare`."""

    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Flights of each contender in each case at each threshold, with seeds from 1 on."""
    out: Path = Path("compare")
    """Folder for the report, and the logs of searches; what was broken off there goes on."""
    quick: bool = False
    """A first look: few flights, cases and thresholds."""
    tune: bool = False
    """Search for the weights of every contender in every case, with the same effort for each, and
    write them to the folder of scenarios; nothing else."""
    generations: Annotated[int, tyro.conf.arg(metavar="N")] = 40
    """How long each of these searches goes on."""
    scenarios: Path = Path(str(resources.files("scenarios") / config.COMPARED))
    """Folder of the scenarios with the weights."""
    workers: Workers = None
    """Processes; one a core unless given."""
    scheduler: Scheduler = None
    """Use the workers of this Dask scheduler instead."""


def compare(argv: Sequence[str]) -> None:
    """Fly every scheme with every trigger, with wind, gusts and a wrong model, on the same seeds.

    OUT/report.html has the tables and figures, and opens anywhere; each is in OUT as CSV, PNG and
    PDF, too. What is done is kept whatever happens: after Ctrl-C, or worse, the same command goes
    on; once all is done, it only draws anew.
    """
    options = tyro.cli(
        Options,
        args=argv,
        prog="skytether compare",
        description=cleandoc(compare.__doc__ or ""),
    )
    command.check_count("--runs", options.runs, 100_000)
    command.check_count("--generations", options.generations, 10**6)
    pool.check(options.workers, options.scheduler)
    scale = (contenders.quick if options.quick else contenders.full)(
        options.runs, options.generations
    )
    try:
        if options.tune:
            _tune(options, scale)
        else:
            _compare(options, scale, Call.now("compare", argv))
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    except OSError as error:
        raise CommandError(f"{error.filename or options.out}: {error.strerror or error}") from None


def _compare(options: Options, scale: Scale, call: Call) -> None:
    plans = [Plan(case, options.scenarios, scale) for case in scale.cases]
    total = sum(len(plan.sweep.cells) * scale.runs for plan in plans)
    with crew(options.workers, options.scheduler, "comparing", total) as flyers:
        results = [
            (
                plan.case,
                comparison.flown(
                    plan,
                    flyers.flown(
                        plan.sweep, options.out / "sweeps" / plan.case.name, plan.case.title
                    ),
                ),
            )
            for plan in plans
        ]
    drawn = comparison.draw(results, scale.runs)
    page.write(options.out, drawn, config.load(PLANT), call, flyers.spent.runs)
    for table in drawn.tables:
        page.show(table)
    runs = flyers.spent.runs
    print(f"{options.out / page.PAGE}: {len(drawn.pictures)} figures; {runs} runs flown")
    print(drawn.verdict)


def _tune(options: Options, scale: Scale) -> None:
    """Search for the weights of every contender in every case."""
    pairs = [(contender, case) for case in scale.cases for contender in CONTENDERS]
    options.scenarios.mkdir(parents=True, exist_ok=True)
    with (
        command.interruptible() as interrupted,
        pool.executors(options.workers, options.scheduler) as executor,
        progress(len(pairs) * scale.generations) as bar,
    ):
        for number, (contender, case) in enumerate(pairs):
            start = contenders.search_start(contender, case, scale)
            file = contenders.file_name(contender, case)
            hunt = Hunt(
                out=options.out / "searches" / Path(file).stem,
                start=start,
                objective="rmse",
                packets=PACKETS,
                free=calibration.Rmse(start, PACKETS).free(),
                runs=scale.search_runs,
                population=scale.population,
                sigma=SIGMA,
            )

            def show(
                done: int, score: float, file: str = file, before: int = number * scale.generations
            ) -> None:
                bar(before + done, f"{file}: {score:.4f}")

            points, whole = hunt.run(scale.generations, executor, interrupted, show)
            if not whole:
                raise CommandError(
                    f"interrupted with {number} of {len(pairs)} searches done; "
                    "the same command goes on from here",
                    128 + signal.SIGINT,
                )
            found = best(points)
            here = found["values"][calibration.HERE]
            how = (
                f"Found by `skytether compare --tune`: {scale.generations} generations of "
                f"{scale.population} points, {scale.search_runs} seeds from {SEARCH_SEED} on; "
                f"RMSE xy {here['rmse_xy']:.4f} m at {here['event_ratio']:.1%} of the steps."
            )
            content = contenders.to_file(contender, case, hunt.found(found), how)
            (options.scenarios / file).write_bytes(content)
            print(f"{file}: {here['rmse_xy']:.4f} m at {here['event_ratio']:.1%} of the steps")
