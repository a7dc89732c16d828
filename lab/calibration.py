"""Numbers that the paper does not print, searched for: flown until they give its Table 1.

The free keys of a scenario live on logarithmic scales between bounds. CMA-ES proposes a generation
of points, each is flown with the same seeds in all columns of the table, and the squares of how far
the entries are off, relatively, are what it is told. A search is a function of its settings and of
what it was told: told the same again, from a log, it goes on where it was broken off.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shared import config
from shared.config import ConfigError, Scenario
from shared.summary import summarise
from sim.flight import fly_batch

COLUMNS: Mapping[str, Mapping[str, str]] = {
    "no compensation": {"scheme": "none", "trigger": "always"},
    "compensation": {"trigger": "always"},
    "compensation and trigger": {},
}
"""Of Table 1: what each changes in `control`; all else is the same."""

TABLE_1: Mapping[str, Mapping[str, float]] = {
    "no compensation": {"rmse_x": 0.3724, "rmse_y": 0.3719, "rmse_xy": 0.5263},
    "compensation": {"rmse_x": 0.1068, "rmse_y": 0.1057, "rmse_xy": 0.1502},
    "compensation and trigger": {
        "rmse_x": 0.1762,
        "rmse_y": 0.1761,
        "rmse_xy": 0.2492,
        "event_ratio": 0.1,
    },
}
"""[m]; and the event ratio that "10 times smaller" means."""

TOLERANCE = 0.1
"""Relative, of every entry; for the event ratio twice that."""
UNFLYABLE = 1e3
"""Score of a point that no flight survives."""

Values = Mapping[str, Mapping[str, float]]
"""Entries of the table, by column and name."""


@dataclass(frozen=True, slots=True)
class Free:
    """One key of a scenario, as in `control.state_weight.0`, and the bounds of its value."""

    key: str
    low: float
    high: float

    @classmethod
    def parse(cls, text: str) -> "Free":
        """KEY=LOW:HIGH.

        Raises:
            ConfigError: it is none.
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
        """Its value in the table of a scenario."""
        for name in self._path():
            table = table[name]
        return float(table)

    def put(self, table: Any, value: float) -> None:
        """Change its value in the table of a scenario."""
        *path, last = self._path()
        for name in path:
            table = table[name]
        table[last] = value

    def _path(self) -> list[str | int]:
        return [int(name) if name.isdigit() else name for name in self.key.split(".")]


FREE = (
    Free("control.state_weight.0", 0.5, 100.0),
    Free("control.state_weight.1", 0.5, 100.0),
    Free("control.terminal_weight.0", 5.0, 2000.0),
    Free("control.terminal_weight.1", 5.0, 5000.0),
    Free("control.input_weight", 0.1, 20.0),
    Free("control.change_weight", 0.001, 2.0),
    Free("model.tau_s.0", 0.2, 2.0),
    Free("model.u_max.0", 0.8, 5.0),
    Free("reference.radius_m", 0.5, 5.0),
)
"""What is searched for unless something else is asked for (E4)."""


class Search:
    """CMA-ES over free keys, from the values of a scenario.

    Args:
        sigma: first step, as a share of the (logarithmic) range of each key.
    """

    def __init__(
        self, start: Scenario, free: Sequence[Free], *, population: int, sigma: float, seed: int
    ) -> None:
        import cma  # takes half a second to import

        self._start = start
        self._free = free
        low, high = np.log([key.low for key in free]), np.log([key.high for key in free])
        self._low, self._range = low, high - low
        here = (np.log([key.of(_plain(start)) for key in free]) - low) / self._range
        rng = np.random.default_rng(seed)  # its own dice: numpy's global ones are anybody's
        options = {
            "bounds": [0, 1],
            "popsize": population,
            "verbose": -9,
            "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
        }
        self._search = cma.CMAEvolutionStrategy(np.clip(here, 0.01, 0.99), sigma, options)
        self._points: list[Any] = []

    def ask(self) -> list[Scenario]:
        """The next generation; the first begins with the start itself."""
        first = self._search.countiter == 0
        self._points = self._search.ask()
        if first:
            self._points[0] = self._search.x0.copy()
        return [self._scenario(point) for point in self._points]

    def tell(self, scores: Sequence[float]) -> None:
        """How each of them did."""
        self._search.tell(self._points, scores)

    def _scenario(self, point: Any) -> Scenario:
        values = np.exp(self._low + self._range * point)
        # Rounded, so that people can read the file, before it is flown.
        return put(
            self._start,
            {key: float(f"{value:.4g}") for key, value in zip(self._free, values, strict=True)},
        )

    def values(self, scenario: Scenario) -> dict[str, float]:
        """The free keys of a scenario."""
        return {key.key: key.of(_plain(scenario)) for key in self._free}


def put(scenario: Scenario, values: Mapping[Free, float]) -> Scenario:
    """A scenario with other values of some keys."""
    table = _plain(scenario)
    for key, value in values.items():
        key.put(table, value)
    return config.check(table, "calibration")


def fly_table(scenario: Scenario, seeds: Sequence[int]) -> Values:
    """Table 1 as a scenario flies it: means over seeds."""
    values: dict[str, dict[str, float]] = {}
    for column, changes in COLUMNS.items():
        table = _plain(scenario)
        table["control"] |= changes
        flown = config.check(table, column)
        runs = [
            summarise(flown, column, flight.client, flight.server, flight.netem)
            for flight in fly_batch(flown, seeds)
        ]
        values[column] = {
            name: float(np.mean([getattr(run, name) for run in runs])) for name in TABLE_1[column]
        }
    return values


def deviations(values: Values) -> dict[tuple[str, str], float]:
    """How far each entry is off, relatively, by column and name."""
    return {
        (column, name): values[column][name] / target - 1.0
        for column, targets in TABLE_1.items()
        for name, target in targets.items()
    }


def score(values: Values) -> float:
    """Sum of the squares of the deviations; an entry out of tolerance weighs ten times as much."""
    off = deviations(values)
    if not np.isfinite(list(off.values())).all():
        return UNFLYABLE
    weights = [1.0 if within(name, value) else 10.0 for (_, name), value in off.items()]
    return float(np.dot(weights, np.square(list(off.values()))))


def within(name: str, deviation: float) -> bool:
    """Whether an entry is as near to the paper's as is asked for."""
    return abs(deviation) <= TOLERANCE * (2.0 if name == "event_ratio" else 1.0)


def is_admissible(values: Values) -> bool:
    """Whether every entry is."""
    return all(within(name, value) for (_, name), value in deviations(values).items())


def check_free(free: Sequence[Free], start: Scenario) -> None:
    """Refuse keys that cannot be searched for.

    Raises:
        ConfigError: with the key, and what is there.
    """
    for key in free:
        try:
            value = key.of(_plain(start))
        except (KeyError, IndexError, TypeError, ValueError):
            raise ConfigError(
                f"--free: got {key.key}, expected the key of a number, as in model.tau_s.0"
            ) from None
        if not key.low <= value <= key.high:
            raise ConfigError(
                f"--free: {key.key}: got the bounds {key.low:g} to {key.high:g}, "
                f"expected them to hold {value:g}, where the search starts"
            )


def _plain(table: Any) -> Any:
    """A table whose parts may be changed, of a scenario or of such a table."""
    if isinstance(table, Scenario):
        table = config.to_table(table)
    if isinstance(table, Mapping):
        return {name: _plain(value) for name, value in table.items()}
    return [_plain(value) for value in table] if isinstance(table, list | tuple) else table
