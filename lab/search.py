"""CMA-ES over some keys of a scenario.

The free keys live on logarithmic scales between bounds. A generation of points is proposed, and how
each did is told. A search is a function of its settings and of what it was told: told the same
again, from a log, it goes on where it was broken off.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shared import config
from shared.config import ConfigError, Scenario


@dataclass(frozen=True, slots=True)
class Free:
    """One key of a scenario, as in `control.state_weight.0`, and the bounds of its value."""

    key: str
    low: float
    high: float

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"{self.key}={self.low:g}:{self.high:g}"

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
        here = (np.log([key.of(plain(start)) for key in free]) - low) / self._range
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
        return {key.key: key.of(plain(scenario)) for key in self._free}


def put(scenario: Scenario, values: Mapping[Free, float]) -> Scenario:
    """A scenario with other values of some keys."""
    table = plain(scenario)
    for key, value in values.items():
        key.put(table, value)
    return config.check(table, "calibration")


def check_free(free: Sequence[Free], start: Scenario) -> None:
    """Refuse keys that cannot be searched for.

    Raises:
        ConfigError: with the key, and what is there.
    """
    for key in free:
        try:
            value = key.of(plain(start))
        except (KeyError, IndexError, TypeError, ValueError):
            raise ConfigError(
                f"--free: got {key.key}, expected the key of a number, as in model.tau_s.0"
            ) from None
        if not key.low <= value <= key.high:
            raise ConfigError(
                f"--free: {key.key}: got the bounds {key.low:g} to {key.high:g}, "
                f"expected them to hold {value:g}, where the search starts"
            )


def plain(table: Any) -> Any:
    """A table whose parts may be changed, of a scenario or of such a table."""
    if isinstance(table, Scenario):
        table = config.to_table(table)
    if isinstance(table, Mapping):
        return {name: plain(value) for name, value in table.items()}
    return [plain(value) for value in table] if isinstance(table, list | tuple) else table
