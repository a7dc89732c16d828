"""Search for values of some keys of a scenario by CMA-ES.

Free keys are searched on logarithmic scales between bounds. Each generation of points is proposed,
flown by a function passed in, and scored by an objective. The proposals depend only on the settings
and the earlier scores, so an interrupted search continues from its journal.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from skytether.lab.engine.journal import digests
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import dotted, reading
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.whole import Scenario

SIGMA = 0.1


@dataclass(frozen=True, slots=True)
class Free:
    """Key of a scenario, as in `control.state_weight.0`, and the bounds of its value."""

    key: str
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.key}={self.low:g}:{self.high:g}"

    @classmethod
    def parse(cls, text: str) -> "Free":
        """Free key from the text KEY=LOW:HIGH.

        Raises ConfigError if the text has another form, or the bounds are impossible.
        """
        key, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split(":"))
        except ValueError:
            raise ConfigError(f"--free: got {text!r}, expected KEY=LOW:HIGH") from None
        if not 0.0 < low < high < np.inf:
            raise ConfigError(f"--free: {key}: got the bounds {bounds}, expected 0 < LOW < HIGH")
        return cls(key, low, high)

    def of(self, table: Any) -> float:
        *sections, last = self.key.split(".")
        if last.isdigit():
            return float(dotted.value(table, ".".join(sections))[int(last)])
        return float(dotted.value(table, self.key))

    def put(self, table: Any, value: float) -> None:
        *sections, last = self.key.split(".")
        if last.isdigit():
            dotted.value(table, ".".join(sections))[int(last)] = value
        else:
            dotted.set_keys({self.key: value}, table)


def check_free(free: Sequence[Free], start: Scenario) -> None:
    """Raise ConfigError if a key is not a number of the scenario, or its value is out of bounds."""
    for key in free:
        try:
            value = key.of(plain(start))
        except (KeyError, IndexError, TypeError, ValueError, GrammarError):
            raise ConfigError(
                f"--free: got {key.key}, expected the key of a number, as in model.tau_s.0"
            ) from None
        if not key.low <= value <= key.high:
            raise ConfigError(
                f"--free: {key.key}: got the bounds {key.low:g} to {key.high:g}, "
                f"expected bounds around {value:g}, where the search starts"
            )


def put(scenario: Scenario, values: Mapping[Free, float]) -> Scenario:
    table = plain(scenario)
    for key, value in values.items():
        key.put(table, value)
    return reading.check(table, "search")


def plain(table: Any) -> Any:
    """Scenario, or one of its tables, as dictionaries and lists that can be changed."""
    if isinstance(table, Scenario):
        table = reading.to_table(table)
    if isinstance(table, Mapping):
        return {name: plain(value) for name, value in table.items()}
    return [plain(value) for value in table] if isinstance(table, list | tuple) else table


class Optimiser:
    """CMA-ES over free keys, starting at the values of a scenario.

    `sigma` is the initial step size, as a share of the logarithmic range of each key.
    """

    def __init__(
        self, start: Scenario, free: Sequence[Free], *, population: int, sigma: float, seed: int
    ) -> None:
        import cma  # the import takes 0.5 s

        self._start = start
        self._free = free
        low, high = np.log([key.low for key in free]), np.log([key.high for key in free])
        self._low, self._range = low, high - low
        start_point = (np.log([key.of(plain(start)) for key in free]) - low) / self._range
        # A separate random generator, because other code may use numpy's global generator.
        rng = np.random.default_rng(seed)
        options = {
            "bounds": [0, 1],
            "popsize": population,
            "verbose": -9,
            "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
        }
        self._search = cma.CMAEvolutionStrategy(np.clip(start_point, 0.01, 0.99), sigma, options)
        self._points: list[Any] = []

    def ask(self) -> list[Scenario]:
        """Scenarios of the next generation; the first scenario of a search is its start."""
        first = self._search.countiter == 0
        self._points = self._search.ask()
        if first:
            self._points[0] = self._search.x0.copy()
        return [self._scenario(point) for point in self._points]

    def tell(self, scores: Sequence[float]) -> None:
        self._search.tell(self._points, scores)

    def _scenario(self, point: Any) -> Scenario:
        values = np.exp(self._low + self._range * point)
        # Rounded before the flight, so that the file has short numbers that are exact.
        return put(
            self._start,
            {key: float(f"{value:.4g}") for key, value in zip(self._free, values, strict=True)},
        )

    def values(self, scenario: Scenario) -> dict[str, float]:
        table = plain(scenario)
        return {key.key: key.of(table) for key in self._free}


Values = Mapping[str, Mapping[str, float | None]]
"""Figures of a point, by column and name; None if a flight failed."""


class Objective(Protocol):
    def settings(self) -> Mapping[str, Any]:
        """Name and settings of the objective, as plain values."""

    def free(self) -> Sequence[Free]:
        """Keys that are searched unless the user names others."""

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        """Figures of a point; called in a worker."""

    def score(self, values: Values) -> float:
        """Score of a point with these figures; smaller is better."""


@dataclass(frozen=True, slots=True)
class SearchPoint:
    keys: Mapping[str, float]
    values: Values
    score: float


Point = tuple[float, ...]
"""Values of the free keys, in order; they identify a point in the journal."""
FlyAll = Callable[[Mapping[Point, Scenario]], Mapping[Point, Values]]
"""Function that flies scenarios without stored figures, and returns the figures of all."""


@dataclass(frozen=True, slots=True)
class Search:
    start: Scenario
    objective: Objective
    free: Sequence[Free]
    runs: int
    """Number of flights of each point, with seeds that count up from the scenario's."""
    population: int
    sigma: float = SIGMA
    """Initial step size, as a share of each key's logarithmic range."""

    def settings(self) -> dict[str, Any]:
        return {
            **self.objective.settings(),
            "free": list(map(str, self.free)),
            "runs": self.runs,
            "population": self.population,
            "sigma": self.sigma,
            "files": digests([self.start]),
            "scenario": reading.to_table(self.start),
        }

    def fly(self, scenario: Scenario) -> Values:
        """Figures of a point; called in a worker."""
        seed = self.start.seed
        return self.objective.fly(scenario, range(seed, seed + self.runs))

    def points(self, generations: int, fly_all: FlyAll) -> Iterator[list[SearchPoint]]:
        """Yield all points so far after each generation."""
        optimiser = Optimiser(
            self.start,
            self.free,
            population=self.population,
            sigma=self.sigma,
            seed=self.start.seed,
        )
        cells: dict[Point, Scenario] = {}
        points: list[SearchPoint] = []
        for _ in range(generations):
            proposed = optimiser.ask()
            keys = [optimiser.values(each) for each in proposed]
            names = [tuple(each.values()) for each in keys]
            cells.update(zip(names, proposed, strict=True))
            flown = fly_all(cells)
            generation = [
                SearchPoint(own, flown[point], self.objective.score(flown[point]))
                for own, point in zip(keys, names, strict=True)
            ]
            optimiser.tell([point.score for point in generation])
            points += generation
            yield points

    def scenario(self, point: SearchPoint) -> Scenario:
        return put(self.start, {key: point.keys[key.key] for key in self.free})


def best(points: Sequence[SearchPoint]) -> SearchPoint:
    return min(points, key=lambda point: point.score)
