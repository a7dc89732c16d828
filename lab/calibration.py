"""What a search is after: the paper's Table 1, or the smallest error at a share of packets.

An objective flies a point of a search, a scenario, with the same seeds as every other, and says of
what came out how good it is: the smaller the score, the better.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from lab import sweep
from lab.search import Free, plain
from shared import config, policy
from shared.config import Scenario
from shared.summary import Summary

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
UNFLYABLE = 1e9
"""Score of a point that no flight survives."""

Values = Mapping[str, Mapping[str, float]]
"""Figures of a point, by column and name."""


class Objective(Protocol):
    """What is searched for."""

    def free(self) -> Sequence[Free]:
        """Keys to change unless others are asked for."""

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        """The figures of a point; runs in a worker."""

    def score(self, values: Values) -> float:
        """How far they are from what is searched for."""


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


@dataclass(frozen=True, slots=True)
class Table1:
    """Every entry of Table 1 as the paper has it."""

    def free(self) -> Sequence[Free]:
        """See `Objective`."""
        return FREE

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        """All columns: means over seeds."""
        values: dict[str, dict[str, float]] = {}
        for column, changes in COLUMNS.items():
            table = plain(scenario)
            table["control"] |= changes
            runs = sweep.summaries(column, config.check(table, column), seeds)
            values[column] = {name: _mean(runs, name) for name in TABLE_1[column]}
        return values

    def score(self, values: Values) -> float:
        """Squares of all deviations; of an entry out of tolerance ten times as much."""
        off = deviations(values)
        if not np.isfinite(list(off.values())).all():
            return UNFLYABLE
        weights = [1.0 if within(name, value) else 10.0 for (_, name), value in off.items()]
        return float(np.dot(weights, np.square(list(off.values()))))


def deviations(values: Values) -> dict[tuple[str, str], float]:
    """How far each entry is off, relatively, by column and name."""
    return {
        (column, name): values[column][name] / target - 1.0
        for column, targets in TABLE_1.items()
        for name, target in targets.items()
    }


def within(name: str, deviation: float) -> bool:
    """Whether an entry is as near to the paper's as is asked for."""
    return abs(deviation) <= TOLERANCE * (2.0 if name == "event_ratio" else 1.0)


def is_admissible(values: Values) -> bool:
    """Whether every entry is."""
    return all(within(name, value) for (_, name), value in deviations(values).items())


WEIGHTS = (
    Free("control.state_weight.1", 1e-4, 1e4),
    Free("control.terminal_weight.0", 1e-2, 1e6),
    Free("control.terminal_weight.1", 1e-2, 1e6),
    Free("control.input_weight", 1e-4, 1e4),
    Free("control.change_weight", 1e-4, 1e4),
)
"""Only ratios matter: the weight on the position stays what it is."""
TRIGGER_KEYS: Mapping[str, Sequence[Free]] = {
    "state_gap": (Free("control.epsilon", 1e-4, 1e4), Free("control.decay_rate", 1e-2, 1e2)),
    "cost_gap": (Free("control.cost_gap", 1e-6, 1e3),),
    "deviation": (Free("control.deviation_m", 1e-4, 1e1),),
}
"""Of the policies that look at the flight, so that weights and thresholds decide what they send."""
OBSERVER_KEYS = (Free("control.observer_s", 0.05, 50.0),)
"""Of the schemes that have one."""
HERE = "here"
"""The one column of a point that is flown as it is."""


def trigger_keys(trigger: str) -> Sequence[Free]:
    """The keys of the policies in a trigger; one that is told its numbers has none."""
    bare = (each.name for each in policy.policies(policy.parse(trigger)) if not each.values)
    return [key for name in dict.fromkeys(bare) for key in TRIGGER_KEYS.get(name, ())]


@dataclass(frozen=True, slots=True)
class Rmse:
    """The smallest RMSE xy, where the trigger has a say at no more than a share of packets.

    Args:
        scenario: what is flown, but for the keys that are searched for.
        packets: most steps that may send, as a share.
    """

    scenario: Scenario
    packets: float

    def free(self) -> Sequence[Free]:
        """Weights, and the keys of scheme and trigger; what is 0 is switched off and stays so."""
        control, table = self.scenario.control, plain(self.scenario)
        observer = OBSERVER_KEYS if control.commits else ()
        keys = [*WEIGHTS, *trigger_keys(control.trigger), *observer]
        return [key for key in keys if key.of(table) > 0.0]

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        """Means over seeds, and how large the share of packets may be with others (95 %)."""
        runs = sweep.summaries(HERE, scenario, seeds)
        values = {name: _mean(runs, name) for name in ("rmse_xy", "event_ratio")}
        _, half = sweep.estimate(runs, "event_ratio")
        return {HERE: values | {"event_ratio_most": values["event_ratio"] + (half or 0.0)}}

    def score(self, values: Values) -> float:
        """RMSE xy [m], times the cube of how many times too many packets there may be."""
        here = values[HERE]
        over = here["event_ratio_most"] / self.packets if self._binds() else 1.0
        score = here["rmse_xy"] * max(1.0, over) ** 3
        return score if math.isfinite(score) else UNFLYABLE

    def _binds(self) -> bool:
        """Whether the share of packets follows from what is flown."""
        named = policy.policies(policy.parse(self.scenario.control.trigger))
        return any(each.name in TRIGGER_KEYS for each in named)


ObjectiveName = Literal["table1", "rmse"]


def objective(name: ObjectiveName, scenario: Scenario, packets: float) -> Objective:
    """The objective of a name, see `Rmse` for the rest."""
    return Rmse(scenario, packets) if name == "rmse" else Table1()


def _mean(runs: Sequence[Summary], name: str) -> float:
    """Mean of a figure; not a number where a run has none, for it did not fly."""
    values = [getattr(run, name) for run in runs]
    return math.nan if None in values else float(np.mean(values))
