"""`skytether calibrate`: search for the paper's unpublished parameters, or optimal parameters."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from skytether.figures.page import as_text
from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, Interrupted, PoolFlags, crew, writing
from skytether.lab.engine import calibration
from skytether.lab.engine.calibration import ONLY, Rmse, SearchLimits, Table1
from skytether.lab.engine.search import SIGMA, Free, Search, SearchPoint, Values, best, check_free
from skytether.shared.base import files
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName

BEST = "best.toml"
POPULATION_MIN, POPULATION_MAX = 4, 1000


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of `skytether calibrate`."""

    scenario: ScenarioName = "paper"
    """Scenario that the search starts from: a name (`skytether list scenarios`) or a .toml file."""
    objective: Literal["table1", "rmse"] = "table1"
    """Goal of the search: table1 reproduces the paper's Table 1; rmse minimises the mean RMSE
    xy."""
    packets: float = 0.1
    """Largest event ratio, for the objective rmse with a trigger that uses the state."""
    effort: Annotated[float, Argument(metavar="MPS")] = math.inf
    """Largest effort (RMS change of the command from step to step) with the objective rmse [m/s];
    by default no limit."""
    free: Annotated[tuple[str, ...], Argument(metavar="KEY=LOW:HIGH")] = ()
    """Keys that may change, each within its bounds, on a logarithmic scale. By default table1
    changes weights and plant; rmse changes the keys of scheme and trigger, and all weights except
    that of the position, because only ratios of weights matter."""
    runs: int = 10
    """Number of flights of each point (with table1: for each column of the table); seeds count up
    from --seed."""
    generations: int = 40
    """Number of generations; an earlier search in OUT continues up to this number."""
    population: int = 10
    """Number of points in a generation."""
    sigma: float = SIGMA
    """Initial step size, as a share of each key's range."""
    pool: PoolFlags = Flags()
    out: Path = Path("calibration")
    """Folder for every point flown (journal.jsonl) and the scenario of the best point (best.toml).
    """
    config: ScenarioFlags = Scenario()


def calibrate(argv: Sequence[str]) -> None:
    """Search for the values of some keys that reproduce the paper's Table 1, or minimise the error.

    Every point is flown in virtual time with the same seeds. OUT/best.toml is the best scenario,
    and can be flown like any scenario. All flights are stored: after Ctrl-C or a crash, the same
    command continues the search.
    """
    options = command.parse(CalibrateOptions(), argv, "skytether calibrate", calibrate.__doc__)
    command.check_count("--runs", options.runs, 1000)
    command.check_count("--generations", options.generations, 10**6)
    if not POPULATION_MIN <= options.population <= POPULATION_MAX:
        expected = f"expected {POPULATION_MIN} to {POPULATION_MAX}"
        raise CommandError(f"--population: got {options.population}, {expected}", 2)
    for flag, share in (("--sigma", options.sigma), ("--packets", options.packets)):
        if not 0.0 < share <= 1.0:
            raise CommandError(f"{flag}: got {share:g}, expected more than 0, at most 1", 2)
    if not options.effort > 0.0:
        raise CommandError(f"--effort: got {options.effort:g}, expected more than 0", 2)
    options.pool.check()
    scenario = options.config
    is_rmse = options.objective == "rmse"
    limits = SearchLimits(packets=options.packets, effort_mps=options.effort)
    objective = Rmse(scenario, limits) if is_rmse else Table1()
    free = list(map(Free.parse, options.free)) or objective.free()
    check_free(free, scenario)
    search = Search(
        start=scenario,
        objective=objective,
        free=free,
        runs=options.runs,
        population=options.population,
        sigma=options.sigma,
    )
    command.claim_folder("--out", options.out, BEST)
    title = f"searching from {options.scenario}"
    points: list[SearchPoint] = []
    with writing(options.out):
        with (
            crew(options.pool, title, options.generations, "generations") as flyers,
            suppress(Interrupted),
        ):
            for flown in flyers.search(search, options.out, options.generations):
                points = flown
        if not points:
            raise CommandError("the search ended before its first generation was flown")
        files.write(options.out / BEST, to_toml(search.scenario(best(points))))
    if is_rmse:
        _print_rmse(points)
    else:
        _print_table_1(points)
    print(f"The best one is in {options.out / BEST}.")


def _print_rmse(points: Sequence[SearchPoint]) -> None:
    found = best(points)
    means = found.values[ONLY]
    rows = [
        ("score", f"{found.score:.4f}"),
        ("RMSE xy [m]", as_text(means["rmse_xy"], ".4f")),
        ("event ratio", as_text(means["event_ratio"], ".4f")),
        ("effort [m/s]", as_text(means["effort_mps"], ".4f")),
    ]
    rows += [(key, f"{value:g}") for key, value in found.keys.items()]
    tables.show(f"the best of {terminal.counted(len(points), 'point')}", (), rows)


def _print_table_1(points: Sequence[SearchPoint]) -> None:
    found, rows = best(points), []
    _print_entries(found.values)
    near = [point for point in points if calibration.is_admissible(point.values)]
    for key, value in found.keys.items():
        span = [point.keys[key] for point in near]
        ends = [f"{min(span):g}", f"{max(span):g}"] if span else []
        rows.append((key, f"{value:g}", *ends))
    title = (
        f"{len(near)} of {terminal.counted(len(points), 'point')} have every entry within tolerance"
    )
    tables.show(title, ("key", "best", "least of these", "most of these"), rows)


def _print_entries(values: Values) -> None:
    rows = []
    for (column, name), off in calibration.deviations(values).items():
        paper, reproduced = calibration.TABLE_1[column][name], values[column][name]
        mark = "" if calibration.within(name, off) else " !"
        rows.append((column, name, f"{paper:.4f}", as_text(reproduced, ".4f"), f"{off:+.1%}{mark}"))
    tables.show("Table 1", ("", "entry", "paper", "here", "off"), rows)
