"""`skytether calibrate`: search for the numbers that the paper does not print."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lab import calibration
from lab.calibration import FREE, Free, Search, Values
from shared import command
from shared.command import CommandError, ScenarioFlags, ScenarioName
from shared.config import ConfigError, Scenario, to_toml
from skytether import pool
from skytether.pool import Scheduler, Workers

BEST = "best.toml"
LOG = "log.jsonl"
POPULATION_MIN, POPULATION_MAX = 4, 1000


@dataclass(frozen=True)
class Options:
    """Of `skytether calibrate`."""

    scenario: ScenarioName = "paper"
    """A scenario's name (see `skytether scenarios`) or a .toml file, where the search starts."""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=LOW:HIGH")] = tuple(
        f"{key.key}={key.low:g}:{key.high:g}" for key in FREE
    )
    """What is searched for, each within its bounds, on a logarithmic scale."""
    runs: int = 10
    """Flights for each column of the table, with the seeds from --seed on."""
    generations: int = 40
    """How long to search; an existing search goes on until it has so many."""
    population: int = 10
    """Points in a generation."""
    sigma: float = 0.1
    """First step, as a share of the range of each key."""
    workers: Workers = None
    """Processes; one a core unless given."""
    scheduler: Scheduler = None
    """Use the workers of this Dask scheduler instead."""
    out: Path = Path("calibration")
    """Folder for the log of every point (log.jsonl) and for the best one (best.toml)."""
    config: ScenarioFlags = Scenario()


def calibrate(argv: Sequence[str]) -> None:
    """Search for the values of some keys that give the paper's Table 1.

    Every point is flown in all columns of the table. Everything flown is in OUT/log.jsonl; the same
    command goes on where an interrupted one stopped.
    """
    options = command.parse(Options(), argv, "skytether calibrate", calibrate.__doc__)
    command.check_count("--runs", options.runs, 1000)
    command.check_count("--generations", options.generations, 10**6)
    if not POPULATION_MIN <= options.population <= POPULATION_MAX:
        expected = f"expected {POPULATION_MIN} to {POPULATION_MAX}"
        raise CommandError(f"--population: got {options.population}, {expected}", 2)
    if not 0.0 < options.sigma <= 1.0:
        raise CommandError(f"--sigma: got {options.sigma:g}, expected more than 0, at most 1", 2)
    pool.check(options.workers, options.scheduler)
    try:
        free = [Free.parse(text) for text in options.free]
        calibration.check_free(free, options.config)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    scenario = options.config
    search = Search(
        *(scenario, free), population=options.population, sigma=options.sigma, seed=scenario.seed
    )
    fly = partial(calibration.fly_table, seeds=range(scenario.seed, scenario.seed + options.runs))
    log = _open(options)
    points = [point for generation in log for point in generation]
    with (
        command.interruptible() as interrupted,
        pool.executors(options.workers, options.scheduler) as executor,
        (options.out / LOG).open("a") as file,
        _progress(options.generations) as show,
    ):
        for generation in range(options.generations):
            proposed = search.ask()
            if generation < len(log):
                flown = log[generation]
                if [point["keys"] for point in flown] != list(map(search.values, proposed)):
                    what = f"{options.out}: generation {generation + 1} was another search's"
                    raise CommandError(f"{what}; give another --out", command.CONFIGURATION)
            else:
                values: dict[Scenario, Values] = {}
                if not pool.share(executor, fly, proposed, values.__setitem__, interrupted):
                    break
                flown = [
                    {
                        "keys": search.values(each),
                        "values": values[each],
                        "score": calibration.score(values[each]),
                    }
                    for each in proposed
                ]
                file.write(json.dumps(flown) + "\n")
                file.flush()
                points += flown
            search.tell([point["score"] for point in flown])
            best = min(points, key=lambda point: point["score"])
            show(generation + 1, f"best {best['score']:.4f}")
    _finish(options, free, points)


@contextmanager
def _progress(generations: int) -> Iterator[Callable[[int, str], None]]:
    with Progress(
        TextColumn("generation"),
        MofNCompleteColumn(),
        BarColumn(),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    ) as bar:
        task = bar.add_task("", total=generations)
        yield lambda done, text: bar.update(task, completed=done, description=text)


def _open(options: Options) -> list[list[dict[str, Any]]]:
    """The generations in the log; a torn last line, of a killed search, is cut off."""
    settings = {
        "scenario": to_toml(options.config).decode(),
        "free": options.free,
        "runs": options.runs,
        "population": options.population,
        "sigma": options.sigma,
    }
    log = options.out / LOG
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        text = log.read_text() if log.exists() else ""
        text = text[: text.rfind("\n") + 1] or json.dumps(settings) + "\n"
        log.write_text(text)
    except OSError as error:
        raise CommandError(f"{options.out}: {error.strerror}") from None
    before, *generations = map(json.loads, text.splitlines())
    for key, value in json.loads(json.dumps(settings)).items():
        if before[key] != value:
            raise CommandError(
                f"{options.out}: holds a search with another {key}; continue that one, "
                "or give another --out",
                command.CONFIGURATION,
            )
    return generations


def _finish(options: Options, free: Sequence[Free], points: list[dict[str, Any]]) -> None:
    if not points:
        raise CommandError("ended before the first generation was flown")
    best = min(points, key=lambda point: point["score"])
    found = calibration.put(options.config, {key: best["keys"][key.key] for key in free})
    (options.out / BEST).write_bytes(to_toml(found))
    console = Console()
    console.print(_entries(best["values"]))
    near = [point for point in points if calibration.is_admissible(point["values"])]
    table = Table(title=f"{len(near)} of {len(points)} points have every entry within tolerance")
    for heading in ("key", "best", "least", "most", "of these"):
        table.add_column(heading)
    for key, value in best["keys"].items():
        span = [point["keys"][key] for point in near]
        table.add_row(key, f"{value:g}", *([f"{min(span):g}", f"{max(span):g}"] if span else []))
    console.print(table)
    console.print(f"The best one is in {options.out / BEST}.")


def _entries(values: Values) -> Table:
    table = Table(title="Table 1")
    for heading in ("", "entry", "paper", "here", "off"):
        table.add_column(heading)
    for (column, name), off in calibration.deviations(values).items():
        paper, here = calibration.TABLE_1[column][name], values[column][name]
        mark = "" if calibration.within(name, off) else " !"
        table.add_row(column, name, f"{paper:.4f}", f"{here:.4f}", f"{off:+.1%}{mark}")
    return table
