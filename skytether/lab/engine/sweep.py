"""Sweeps: many flights over a grid of scenarios, their summaries, and the tables of their means.

A sweep has cells, and runs of each cell. A cell is the scenario with one value from each grid; its
runs differ only in the seed, which counts up from the scenario's. Tasks have a fixed number of
runs, so that no result depends on the number of workers, or on interruptions.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
from msgspec.structs import astuple, replace

from skytether.figures.tables import rows_csv, to_csv
from skytether.lab.engine.intervals import Estimate, interval
from skytether.lab.engine.journal import digests
from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.sim.batch import fly_batch

CHUNK = 25
"""Number of runs in a task; the last task of a cell may have fewer."""
FORM = "KEY=START:STOP:COUNT or KEY=VALUE,VALUE,..."
"""Form of a grid on the command line, as error messages show it."""
SEED_MAX = 2**32 - 1


@dataclass(frozen=True, slots=True)
class GridAxis:
    """Key of the scenario and its values; or a label, and the keys that each value changes."""

    key: str
    values: tuple[Any, ...]
    """Values of the key, or names of the changes."""
    changes: tuple[Mapping[str, Any], ...] = ()
    """Keys that each value changes, and their values; empty if each changes only `key`."""

    def __str__(self) -> str:
        """Text KEY=VALUE,VALUE,... as in `parse_axis`, or with changes in place of values."""
        values = self.changes or self.values
        return f"{self.key}={','.join(msgspec.json.encode(value).decode() for value in values)}"

    def points(self) -> list[tuple[Any, Mapping[str, Any]]]:
        """Each value, with the keys that it changes and their values."""
        changes = self.changes or [{self.key: value} for value in self.values]
        return list(zip(self.values, changes, strict=True))


def parse_axis(text: str) -> GridAxis:
    """Grid from a user's text: `vehicle.wind=0:0.5:6` or `control.scheme=committed,none`.

    Raises ConfigError if the text has another form, or a value twice.
    """
    key, equals, values_text = (part.strip() for part in text.partition("="))
    wrong = ConfigError(f"--grid: got {text!r}, expected {FORM}")
    if not (key and equals and values_text):
        raise wrong
    ends = values_text.split(":")
    try:
        values = _linear(*ends) if len(ends) == 3 else _listed(values_text)
    except ValueError:
        raise wrong from None
    if key == "seed":
        raise ConfigError(
            "--grid: got 'seed', expected another key: the seed counts the runs of a cell"
        )
    if not values:
        raise wrong
    for value in values:
        if values.count(value) > 1:
            raise ConfigError(f"--grid: {key}: got {value!r} twice, expected values that differ")
    return GridAxis(key, tuple(values))


def _linear(start: str, stop: str, count: str) -> list[float]:
    """Evenly spaced values, including both ends; integers if all values are whole."""
    first, last, n = float(start), float(stop), int(count)
    if n < 2 or not math.isfinite(first - last):
        raise ValueError
    values = [first + (last - first) * i / (n - 1) for i in range(n)]
    whole = all(value.is_integer() for value in values) and not {*".eE"} & {*start, *stop}
    return [int(value) for value in values] if whole else values


def _listed(given: str) -> list[Any]:
    """Values between commas, as in TOML; a bare word is a string."""
    try:
        return toml.loads(f"values = [{given}]")["values"]
    except ValueError:
        return [_value(part.strip()) for part in given.split(",")]


def _value(text: str) -> Any:
    try:
        return toml.loads(f"value = {text}")["value"]
    except ValueError:
        # A string without quotes, such as a name or a path.
        if not text or {*text} & {*"\"'[]{}=:"}:
            raise
        return text


class FlightTask(msgspec.Struct, frozen=True):
    cell: int
    chunk: int
    """Number of the task in its cell, from 0 on."""
    name: str
    scenario: Scenario
    """Scenario to fly; each run replaces the seed."""
    seeds: tuple[int, ...]


Runs = tuple[Summary, ...]
Results = Mapping[tuple[int, int], Runs]


def fly(task: FlightTask) -> Runs:
    return summaries(task.name, task.scenario, task.seeds)


def summaries(name: str, scenario: Scenario, seeds: Sequence[int]) -> Runs:
    """Summaries of flights of a scenario in virtual time, one per seed."""
    flown = zip(seeds, fly_batch(scenario, seeds), strict=True)
    return tuple(
        summarise(replace(scenario, seed=seed), name, each.client, each.server, each.netem)
        for seed, each in flown
    )


class Sweep:
    """Grid of scenarios, and the number of flights of each.

    Args:
        name: name of the scenario, for messages and summaries.
        scenario: common part of all cells.
        axes: grids; the last one changes fastest.
        runs: number of flights of each cell.

    Raises:
        ConfigError: a cell cannot be flown, or a key is given twice.
    """

    def __init__(self, name: str, scenario: Scenario, axes: Sequence[GridAxis], runs: int) -> None:
        self.name, self.scenario, self.axes, self.runs = name, scenario, tuple(axes), runs
        keys = [axis.key for axis in axes]
        for key in keys:
            if keys.count(key) > 1:
                raise ConfigError(f"--grid: {key}: got it twice, expected each key once")
        if scenario.seed + runs - 1 > SEED_MAX:
            most = SEED_MAX - runs + 1
            raise ConfigError(f"seed: got {scenario.seed}, expected at most {most} for {runs} runs")
        points = list(itertools.product(*(axis.points() for axis in axes)))
        self.cells = [tuple(value for value, _ in cell) for cell in points]
        """Values of each cell, in the order of the axes."""
        self.chunks = -(-runs // CHUNK)
        self._scenarios = [
            self._scenario({key: value for _, changes in cell for key, value in changes.items()})
            for cell in points
        ]

    @property
    def flights(self) -> int:
        return len(self.cells) * self.runs

    def _scenario(self, changes: Mapping[str, Any]) -> Scenario:
        table = reading.to_table(self.scenario)
        set_keys(changes, table)
        where = ", ".join(f"{key}={value}" for key, value in changes.items())
        return reading.check(table, f"{self.name} with {where}" if where else self.name)

    def tasks(self) -> Iterator[FlightTask]:
        first = self.scenario.seed
        for cell, scenario in enumerate(self._scenarios):
            for chunk in range(self.chunks):
                runs = range(chunk * CHUNK, min(self.runs, (chunk + 1) * CHUNK))
                seeds = tuple(first + run for run in runs)
                yield FlightTask(cell, chunk, self.name, scenario, seeds)

    def settings(self) -> dict[str, Any]:
        """Settings that determine the results, as plain values."""
        return {
            "name": self.name,
            "runs": self.runs,
            "grid": list(map(str, self.axes)),
            "files": digests(self._scenarios),
            "scenario": reading.to_table(self.scenario),
        }

    def runs_csv(self, done: Results) -> str:
        keys = [axis.key for axis in self.axes]
        rows = (
            [*values, *astuple(run)]
            for cell, values in enumerate(self.cells)
            for run in self.of_cell(done, cell)
        )
        return to_csv([*keys, *Summary.__struct_fields__], rows)

    def cells_csv(self, done: Results) -> str:
        """CSV table with a row for each cell: means, and half-widths of 95 % intervals."""
        keys = [axis.key for axis in self.axes]
        rows = []
        for cell, values in enumerate(self.cells):
            runs = self.of_cell(done, cell)
            flown = sum(run.rmse_xy is not None for run in runs)
            row = dict(zip(keys, values, strict=True)) | {"runs": len(runs), "flown": flown}
            rows.append(row | by_name(FIGURES, partial(estimate, runs)))
        return rows_csv(rows)

    def scenario_of(self, *values: Any) -> Scenario:
        return self._scenarios[self.cells.index(values)]

    def of_cell(self, done: Results, cell: int) -> list[Summary]:
        return [run for chunk in range(self.chunks) for run in done[cell, chunk]]


FIGURES = (
    "rmse_x",
    "rmse_y",
    "rmse_z",
    "rmse_xy",
    "error_max",
    "covered",
    "event_ratio",
    "uplink_above",
    "uplink_due",
    "uplink_packets",
    "uplink_bytes",
    "downlink_packets",
    "downlink_bytes",
    "packets_per_s",
    "bytes_per_s",
    "lost",
    "reordered",
    "stale",
    "age_ms_p50",
    "age_ms_p99",
    "aoi_s_mean",
    "aoi_s_peak",
    "plan_age_s_mean",
    "effort_mps",
    "saturated",
    "deadline_misses",
)
"""Figures of a summary that can be averaged."""


def estimate(runs: Iterable[Summary], figure: str) -> Estimate:
    """Mean of a figure over the runs that have it, and half-width of its 95 % interval."""
    return interval([value for run in runs if (value := getattr(run, figure)) is not None])


def by_name(figures: Iterable[str], estimate_of: Callable[[str], Estimate]) -> dict[str, Any]:
    """Mean of each figure by its name, and half-width of its interval as NAME_ci95."""
    found: dict[str, Any] = {}
    for figure in figures:
        found[figure], found[f"{figure}_ci95"] = estimate_of(figure)
    return found
