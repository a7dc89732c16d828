"""Many flights over a grid of scenarios: which there are, what each gives, and what they say.

A sweep is cells × runs. A cell is the scenario with one value from each grid; its runs differ in
the seed alone, counting up from the scenario's. They are flown in chunks of a fixed size, so that
no result depends on how many workers there were, or on what was interrupted.
"""

import csv
import io
import itertools
import math
import tomllib
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from scipy import stats

from shared import config
from shared.config import ConfigError, Scenario
from shared.summary import Summary, summarise
from sim.flight import fly_batch

CHUNK = 25
"""Runs of one task."""
FORM = "KEY=START:STOP:COUNT or KEY=VALUE,VALUE,..."
SEED_MAX = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Axis:
    """One key of the scenario, and the values it takes.

    Where one value is to change other keys, or several, `changes` has these for each value, and the
    key and its values are but what they are called.
    """

    key: str
    values: tuple[Any, ...]
    changes: tuple[Mapping[str, Any], ...] = ()

    def __str__(self) -> str:
        """As `parse_axis` reads it; with what each value changes where that is something else."""
        values = self.changes or self.values
        return f"{self.key}={','.join(msgspec.json.encode(value).decode() for value in values)}"

    def points(self) -> list[tuple[Any, Mapping[str, Any]]]:
        """Each value, and the keys that it changes."""
        changes = self.changes or [{self.key: value} for value in self.values]
        return list(zip(self.values, changes, strict=True))


def parse_axis(text: str) -> Axis:
    """A grid as the user writes it: `control.epsilon=0.5:8:10` or `control.scheme=committed,none`.

    Raises:
        ConfigError: it is none.
    """
    key, equals, given = (part.strip() for part in text.partition("="))
    wrong = ConfigError(f"--grid: got {text!r}, expected {FORM}")
    if not (key and equals and given):
        raise wrong
    ends = given.split(":")
    try:
        values = _linear(*ends) if len(ends) == 3 else _listed(given)
    except ValueError:
        raise wrong from None
    if key == "seed":
        raise ConfigError("--grid: got 'seed', expected another key: it counts the runs of a cell")
    if not values:
        raise wrong
    for value in values:
        if values.count(value) > 1:
            raise ConfigError(f"--grid: {key}: got {value!r} twice, expected values that differ")
    return Axis(key, tuple(values))


def _linear(start: str, stop: str, count: str) -> list[float]:
    """Evenly spaced, ends included; whole numbers where both ends and all between are."""
    first, last, n = float(start), float(stop), int(count)
    if n < 2 or not math.isfinite(first - last):
        raise ValueError
    values = [first + (last - first) * i / (n - 1) for i in range(n)]
    whole = all(value.is_integer() for value in values) and not {*".eE"} & {*start, *stop}
    return [int(value) for value in values] if whole else values


def _listed(given: str) -> list[Any]:
    """Values as TOML has them; a bare word is a text."""
    try:
        return tomllib.loads(f"values = [{given}]")["values"]
    except ValueError:
        return [_value(part.strip()) for part in given.split(",")]


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        # A text that needs no quotes: a name, or a path.
        if not text or {*text} & {*"\"'[]{}=:"}:
            raise
        return text


class Task(msgspec.Struct, frozen=True):
    """Some runs of a cell."""

    cell: int
    chunk: int
    name: str
    """Of the scenario."""
    scenario: Scenario
    seeds: tuple[int, ...]


class Done(msgspec.Struct, frozen=True):
    """A task's flights."""

    cell: int
    chunk: int
    runs: tuple[Summary, ...]


def fly(task: Task) -> Done:
    """All runs of a task, in virtual time."""
    return Done(task.cell, task.chunk, summaries(task.name, task.scenario, task.seeds))


def summaries(name: str, scenario: Scenario, seeds: Sequence[int]) -> tuple[Summary, ...]:
    """What a scenario of some name gives, seed by seed, in virtual time."""
    return tuple(
        summarise(
            msgspec.structs.replace(scenario, seed=seed),
            *(name, flight.client, flight.server, flight.netem),
        )
        for seed, flight in zip(seeds, fly_batch(scenario, seeds), strict=True)
    )


class Sweep:
    """What is to be flown.

    Args:
        name: of the scenario.
        scenario: what is the same everywhere.
        axes: what is not; the last changes fastest.
        runs: of each cell.

    Raises:
        ConfigError: a cell that cannot be flown, or a key given twice.
    """

    def __init__(self, name: str, scenario: Scenario, axes: Sequence[Axis], runs: int) -> None:
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
        """The values of each, in the order of the axes."""
        self.chunks = -(-runs // CHUNK)
        """Of each cell."""
        self._scenarios = [
            self._scenario({key: value for _, changes in cell for key, value in changes.items()})
            for cell in points
        ]

    def _scenario(self, changes: Mapping[str, Any]) -> Scenario:
        table = config.to_table(self.scenario)
        lay(changes, table)
        where = ", ".join(f"{key}={value}" for key, value in changes.items())
        return config.check(table, f"{self.name} with {where}" if where else self.name)

    def tasks(self) -> Iterator[Task]:
        """All of it, cell by cell."""
        first = self.scenario.seed
        for cell, scenario in enumerate(self._scenarios):
            for chunk in range(self.chunks):
                runs = range(chunk * CHUNK, min(self.runs, (chunk + 1) * CHUNK))
                seeds = tuple(first + run for run in runs)
                yield Task(cell, chunk, self.name, scenario, seeds)

    def todo(self, done: Container[tuple[int, int]]) -> list[Task]:
        """What is not done yet."""
        return [task for task in self.tasks() if (task.cell, task.chunk) not in done]

    def settings(self) -> dict[str, Any]:
        """All that its results follow from, as plain values."""
        return {
            "name": self.name,
            "runs": self.runs,
            "grid": list(map(str, self.axes)),
            "scenario": config.to_table(self.scenario),
        }

    def runs_csv(self, done: Mapping[tuple[int, int], Done]) -> str:
        """A row for each run, cell by cell and by its seed."""
        keys = [axis.key for axis in self.axes]
        rows = (
            [*values, *map(_plain, msgspec.structs.astuple(run))]
            for cell, values in enumerate(self.cells)
            for run in self.of_cell(done, cell)
        )
        return to_csv([*keys, *Summary.__struct_fields__], rows)

    def cells_csv(self, done: Mapping[tuple[int, int], Done]) -> str:
        """A row for each cell: mean of each figure, and half the width of its 95 % interval."""
        keys = [axis.key for axis in self.axes]
        names = [name for figure in FIGURES for name in (figure, f"{figure}_ci95")]
        rows = []
        for cell, values in enumerate(self.cells):
            runs = self.of_cell(done, cell)
            flown = sum(run.rmse_xy is not None for run in runs)
            means = [_plain(part) for figure in FIGURES for part in estimate(runs, figure)]
            rows.append([*values, len(runs), flown, *means])
        return to_csv([*keys, "runs", "flown", *names], rows)

    def scenario_of(self, *values: Any) -> Scenario:
        """What a cell flies."""
        return self._scenarios[self.cells.index(values)]

    def of_cell(self, done: Mapping[tuple[int, int], Done], cell: int) -> list[Summary]:
        """Its runs, by seed."""
        return [run for chunk in range(self.chunks) for run in done[cell, chunk].runs]


def lay(changes: Mapping[str, Any], table: dict[str, Any]) -> None:
    """Put values where their keys say, as in `control.epsilon`.

    Raises:
        ConfigError: there cannot be such a key.
    """
    for path, value in changes.items():
        *sections, key = path.split(".")
        section = table
        for name in sections:
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                raise ConfigError(f"--grid: {path}: no such key")
        section[key] = value


FIGURES = (
    *("rmse_x", "rmse_y", "rmse_z", "rmse_xy", "event_ratio", "uplink_packets", "uplink_bytes"),
    *("downlink_packets", "downlink_bytes", "lost", "reordered", "stale"),
    *("age_ms_p50", "age_ms_p99", "deadline_misses"),
)
"""Of a summary, those that make sense as a mean."""


def estimate(runs: Iterable[Summary], figure: str) -> tuple[float | None, float | None]:
    """Mean of a figure over the runs that have it, and half the width of its 95 % interval."""
    return interval([value for run in runs if (value := getattr(run, figure)) is not None])


def interval(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Mean of some values, and half the width of its 95 % interval.

    Student's t; the first is None where there are no values, the second where fewer than two.
    """
    if not values:
        return None, None
    mean, n = float(np.mean(values)), len(values)
    if n < 2:
        return mean, None
    return mean, float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n))


def _plain(value: Any) -> Any:
    """As CSV has it: true and false as in TOML, nothing for None."""
    return str(value).lower() if isinstance(value, bool) else value


def to_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as text."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(list(map(_plain, row)) for row in rows)
    return file.getvalue()
