"""Sweeps from Python: `sweep` flies every combination of some keys' values."""

import multiprocessing
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from skytether.lab.engine import sweep as lab
from skytether.lab.engine.intervals import Estimate
from skytether.library.flight import values
from skytether.library.flying import Given, named, prepare
from skytether.shared.base import extras
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Summary

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, slots=True)
class Swept:
    """Flights of one combination of a sweep's values, or of one contender at one packet budget."""

    keys: Mapping[str, Any]
    """Value of each swept key. `skytether.compare` lists the keys of a comparison."""
    scenario: Scenario
    """Scenario of the flights, with the seed of the first flight."""
    runs: tuple[Summary, ...]
    """Summaries of the flights, in the order of their seeds."""

    def mean(self, figure: str) -> Estimate:
        """Mean of a figure over the flights, and half the width of its 95 % confidence interval.

        The mean is None if no flight has the figure; the half-width, if fewer than two have it.

        Raises:
            KeyError: `figure` is not a numeric figure of a summary.
        """
        if figure not in lab.FIGURES:
            raise KeyError(f"no figure {figure!r}; {hint(str(figure), lab.FIGURES)}")
        return lab.estimate(self.runs, figure)

    @extras.named()
    def to_pandas(self) -> "pandas.DataFrame":
        """Table with a row for each flight.

        The first columns are the swept keys, the other columns are those of `skytether.table`.

        Raises:
            ExtraMissing: pandas is not installed.
        """
        import pandas as pd

        return pd.DataFrame([dict(self.keys) | values(run) for run in self.runs])


def sweep(
    scenario: Given,
    grid: Mapping[str, Iterable[Any]],
    /,
    *,
    runs: int = 50,
    workers: int = 1,
    **keys: Any,
) -> list[Swept]:
    """Fly every combination of the swept keys' values in virtual time, each with several seeds.

        skytether.sweep("demo", {"control.trigger": ["always", "cost_gap"]}, runs=20)

    Args:
        scenario: name of a scenario, path of a .toml file, or a scenario.
        grid: values of each swept key; in the result, the last key's value changes fastest.
        runs: number of flights of each combination; seeds count up from the scenario's seed.
        workers: number of processes that fly; with 1, the calling process flies. With more, a
            script needs `if __name__ == "__main__":`, as with `multiprocessing`. The results do not
            depend on the number of processes.
        keys: see `skytether.load`.

    Raises:
        ConfigError: a combination cannot be flown.
        TypeError: an argument is of another type.
    """
    for argument, value in (("runs", runs), ("workers", workers)):
        if not isinstance(value, int) or value < 1:
            raise ConfigError(f"{argument}: got {value!r}, expected a whole number from 1 on")
    name, flown = named(scenario, keys)
    axes = [_axis(key, values) for key, values in _items(grid)]
    plan = lab.Sweep(name, flown, axes, runs)
    tasks = list(plan.tasks())
    prepare()
    if workers == 1:
        results = list(map(lab.fly, tasks))
    else:
        # Not forked, because a forked child could inherit a lock that is never released.
        spawned = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, spawned) as pool:
            results = list(pool.map(lab.fly, tasks))
    done = {(task.cell, task.chunk): runs for task, runs in zip(tasks, results, strict=True)}
    names = [axis.key for axis in axes]
    return [
        Swept(
            dict(zip(names, values, strict=True)),
            plan.scenario_of(*values),
            tuple(plan.of_cell(done, number)),
        )
        for number, values in enumerate(plan.cells)
    ]


def _items(grid: Mapping[str, Iterable[Any]]) -> Iterable[tuple[str, Iterable[Any]]]:
    if not isinstance(grid, Mapping):
        raise TypeError(f"grid: got {grid!r}, expected a mapping from keys to lists of values")
    return grid.items()


def _axis(key: str, values: Iterable[Any]) -> lab.GridAxis:
    """Axis of a sweep: a key of the grid and its values.

    Raises:
        ConfigError: the key cannot be swept, or has no values, or a value twice.
        TypeError: the values are not a list.
    """
    if key == "seed":
        raise ConfigError("grid: got 'seed', expected another key: the seed counts the runs")
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise TypeError(f"grid: {key}: got {values!r}, expected a list of values")
    plain = [msgspec.to_builtins(value, enc_hook=lambda each: each.tolist()) for value in values]
    if not plain:
        raise ConfigError(f"grid: {key}: got no values, expected at least one")
    for value in plain:
        if plain.count(value) > 1:
            raise ConfigError(f"grid: {key}: got {value!r} twice, expected values that differ")
    return lab.GridAxis(key, tuple(plain))
