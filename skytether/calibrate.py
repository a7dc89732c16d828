"""`skytether calibrate`: search for the numbers that the paper does not print."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from lab import calibration
from lab.calibration import HERE, Objective, ObjectiveName, Values
from lab.search import Free, Search, check_free, put
from shared.config import ConfigError, Scenario, to_toml
from shell import command
from shell.command import CommandError, ScenarioFlags, ScenarioName
from skytether import pool
from skytether.pool import Scheduler, Workers

BEST = "best.toml"
LOG = "log.jsonl"
SIGMA = 0.1
"""First step of a search unless another is asked for, as a share of the range of each key."""
POPULATION_MIN, POPULATION_MAX = 4, 1000


@dataclass(frozen=True)
class Options:
    """Of `skytether calibrate`."""

    scenario: ScenarioName = "paper"
    """A scenario's name (see `skytether scenarios`) or a .toml file, where the search starts."""
    objective: ObjectiveName = "table1"
    """What to search for: the paper's Table 1, or the smallest mean RMSE xy."""
    packets: float = 0.1
    """Most steps that may send, as a share; of rmse, where the trigger has a say in it."""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=LOW:HIGH")] = ()
    """What may change, each within its bounds, on a logarithmic scale. Unless given: of table1
    weights and plant; of rmse weights (but the position's: ratios matter) and the keys of scheme
    and trigger."""
    runs: int = 10
    """Flights of each point (of each column of the table), with the seeds from --seed on."""
    generations: int = 40
    """How long to search; an existing search goes on until it has so many."""
    population: int = 10
    """Points in a generation."""
    sigma: float = SIGMA
    """First step, as a share of the range of each key."""
    workers: Workers = None
    """Processes; one a core unless given."""
    scheduler: Scheduler = None
    """Use the workers of this Dask scheduler instead."""
    out: Path = Path("calibration")
    """Folder for the log of every point (log.jsonl) and for the best one (best.toml)."""
    config: ScenarioFlags = Scenario()


Point = dict[str, Any]
"""As it stands in the log: `keys`, `values` and `score`."""


@dataclass(frozen=True, slots=True)
class Hunt:
    """A search, and the folder of its log, from which it goes on."""

    out: Path
    start: Scenario
    objective: ObjectiveName
    packets: float
    free: Sequence[Free]
    runs: int
    population: int
    sigma: float

    def aim(self) -> Objective:
        """What it searches for."""
        return calibration.objective(self.objective, self.start, self.packets)

    def settings(self) -> dict[str, Any]:
        """All that its log follows from."""
        return {
            "scenario": to_toml(self.start).decode(),
            "objective": self.objective,
            "packets": self.packets,
            "free": list(map(str, self.free)),
            "runs": self.runs,
            "population": self.population,
            "sigma": self.sigma,
        }

    def run(
        self,
        generations: int,
        executor: Executor,
        interrupted: Callable[[], bool],
        show: Callable[[int, float], None],
    ) -> tuple[list[Point], bool]:
        """Every point, those in the log with them, and whether all generations were flown.

        Args:
            show: called with the generations flown and the best score.

        Raises:
            CommandError: the folder holds another search, or a worker has died.
        """
        search = Search(
            *(self.start, self.free),
            population=self.population,
            sigma=self.sigma,
            seed=self.start.seed,
        )
        aim = self.aim()
        fly = partial(aim.fly, seeds=range(self.start.seed, self.start.seed + self.runs))
        log = self._read()
        points: list[Point] = []
        with (self.out / LOG).open("a") as file:
            for generation in range(generations):
                proposed = search.ask()
                if generation < len(log):
                    flown = log[generation]
                    if [point["keys"] for point in flown] != list(map(search.values, proposed)):
                        what = f"{self.out}: generation {generation + 1} was another search's"
                        raise CommandError(f"{what}; give another --out", command.CONFIGURATION)
                else:
                    values: dict[Scenario, Values] = {}
                    if not pool.share(executor, fly, proposed, values.__setitem__, interrupted):
                        return points, False
                    flown = [
                        {
                            "keys": search.values(each),
                            "values": values[each],
                            "score": aim.score(values[each]),
                        }
                        for each in proposed
                    ]
                    file.write(json.dumps(flown) + "\n")
                    file.flush()
                points += flown
                search.tell([point["score"] for point in flown])
                show(generation + 1, best(points)["score"])
        return points, True

    def found(self, point: Point) -> Scenario:
        """The scenario of a point."""
        return put(self.start, {key: point["keys"][key.key] for key in self.free})

    def _read(self) -> list[list[Point]]:
        """The generations in the log; a torn last line, of a killed search, is cut off."""
        log = self.out / LOG
        settings = self.settings()
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            text = log.read_text() if log.exists() else ""
            text = text[: text.rfind("\n") + 1] or json.dumps(settings) + "\n"
            log.write_text(text)
        except OSError as error:
            raise CommandError(f"{self.out}: {error.strerror}") from None
        before, *generations = map(json.loads, text.splitlines())
        for key, value in settings.items():
            if before.get(key) != value:
                raise CommandError(
                    f"{self.out}: holds a search with another {key}; continue that one, "
                    "or give another --out",
                    command.CONFIGURATION,
                )
        return generations


def best(points: Sequence[Point]) -> Point:
    """The one with the smallest score."""
    return min(points, key=lambda point: point["score"])


def calibrate(argv: Sequence[str]) -> None:
    """Search for the values of some keys that give the paper's Table 1, or the smallest error.

    Every point is flown with the same seeds, for the table in all its columns. Everything flown is
    in OUT/log.jsonl; the same command goes on where an interrupted one stopped.
    """
    options = command.parse(Options(), argv, "skytether calibrate", calibrate.__doc__)
    command.check_count("--runs", options.runs, 1000)
    command.check_count("--generations", options.generations, 10**6)
    if not POPULATION_MIN <= options.population <= POPULATION_MAX:
        expected = f"expected {POPULATION_MIN} to {POPULATION_MAX}"
        raise CommandError(f"--population: got {options.population}, {expected}", 2)
    for flag, share in (("--sigma", options.sigma), ("--packets", options.packets)):
        if not 0.0 < share <= 1.0:
            raise CommandError(f"{flag}: got {share:g}, expected more than 0, at most 1", 2)
    pool.check(options.workers, options.scheduler)
    scenario = options.config
    aim = calibration.objective(options.objective, scenario, options.packets)
    try:
        free = list(map(Free.parse, options.free)) or aim.free()
        check_free(free, scenario)
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    hunt = Hunt(
        *(options.out, scenario, options.objective, options.packets, free),
        *(options.runs, options.population, options.sigma),
    )
    with (
        command.interruptible() as interrupted,
        pool.executors(options.workers, options.scheduler) as executor,
        progress(options.generations) as bar,
    ):
        show = lambda done, score: bar(done, f"best {score:.4f}")  # noqa: E731
        points, _ = hunt.run(options.generations, executor, interrupted, show)
    if not points:
        raise CommandError("ended before the first generation was flown")
    (options.out / BEST).write_bytes(to_toml(hunt.found(best(points))))
    if options.objective == "rmse":
        _print_rmse(points)
    else:
        _print_table_1(points)
    print(f"The best one is in {options.out / BEST}.")


@contextmanager
def progress(generations: int) -> Iterator[Callable[[int, str], None]]:
    """A bar on stderr; what is yielded takes the generations flown, and what to say of them."""
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


def _print_rmse(points: Sequence[Point]) -> None:
    found = best(points)
    here = found["values"][HERE]
    table = Table(title=f"the best of {len(points)} points", show_header=False)
    table.add_row("score", f"{found['score']:.4f}")
    table.add_row(Text("RMSE xy [m]"), f"{here['rmse_xy']:.4f}")
    table.add_row("event ratio", f"{here['event_ratio']:.4f}")
    for key, value in found["keys"].items():
        table.add_row(key, f"{value:g}")
    Console().print(table)


def _print_table_1(points: Sequence[Point]) -> None:
    found, console = best(points), Console()
    console.print(_entries(found["values"]))
    near = [point for point in points if calibration.is_admissible(point["values"])]
    table = Table(title=f"{len(near)} of {len(points)} points have every entry within tolerance")
    for heading in ("key", "best", "least", "most", "of these"):
        table.add_column(heading)
    for key, value in found["keys"].items():
        span = [point["keys"][key] for point in near]
        table.add_row(key, f"{value:g}", *([f"{min(span):g}", f"{max(span):g}"] if span else []))
    console.print(table)


def _entries(values: Values) -> Table:
    table = Table(title="Table 1")
    for heading in ("", "entry", "paper", "here", "off"):
        table.add_column(heading)
    for (column, name), off in calibration.deviations(values).items():
        paper, here = calibration.TABLE_1[column][name], values[column][name]
        mark = "" if calibration.within(name, off) else " !"
        table.add_row(column, name, f"{paper:.4f}", f"{here:.4f}", f"{off:+.1%}{mark}")
    return table
