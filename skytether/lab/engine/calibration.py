"""Objectives of searches: to reproduce the paper's Table 1, or to minimise the error within limits.

A point of a search is a scenario. An objective (`search.Objective`) flies every point with the same
seeds, and scores the flights. A smaller score is better.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from skytether.lab.engine import sweep
from skytether.lab.engine.search import Free, Values, plain
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import leaves
from skytether.shared.scenario.registry import TRIGGERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Summary

COLUMNS: Mapping[str, Mapping[str, str]] = {
    "no compensation": {"scheme": "none", "trigger": "always"},
    "compensation": {"trigger": "always"},
    "compensation and trigger": {},
}
"""Keys of `control` that each column of Table 1 changes; other keys are equal in all columns."""

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
"""Entries of the paper's Table 1: errors [m], and the event ratio ("10 times smaller")."""

TOLERANCE = 0.1
"""Relative deviation up to which an entry counts as reproduced; twice that for event ratios."""
UNFLYABLE = 1e9
"""Score of a point if one of its flights failed."""


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
"""Default free keys of a search for Table 1."""


@dataclass(frozen=True, slots=True)
class Table1:
    def settings(self) -> Mapping[str, Any]:
        return {"objective": "table1"}

    def free(self) -> Sequence[Free]:
        return FREE

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        values: dict[str, dict[str, float | None]] = {}
        for column, changes in COLUMNS.items():
            table = plain(scenario)
            table["control"] |= changes
            runs = sweep.summaries(column, reading.check(table, column), seeds)
            values[column] = {name: _mean(runs, name) for name in TABLE_1[column]}
        return values

    def score(self, values: Values) -> float:
        """Sum of squared deviations; deviations out of tolerance weigh ten times as much."""
        off = deviations(values)
        if not np.isfinite(list(off.values())).all():
            return UNFLYABLE
        weights = [1.0 if within(name, value) else 10.0 for (_, name), value in off.items()]
        return float(np.dot(weights, np.square(list(off.values()))))


def deviations(values: Values) -> dict[tuple[str, str], float]:
    """Relative deviation of each entry from Table 1, by column and name; NaN if a flight failed."""
    found = {
        (column, name): (values[column][name], target)
        for column, targets in TABLE_1.items()
        for name, target in targets.items()
    }
    return {
        key: math.nan if value is None else value / target - 1.0
        for key, (value, target) in found.items()
    }


def within(name: str, deviation: float) -> bool:
    return abs(deviation) <= TOLERANCE * (2.0 if name == "event_ratio" else 1.0)


def is_admissible(values: Values) -> bool:
    return all(within(name, value) for (_, name), value in deviations(values).items())


WEIGHTS = (
    Free("control.state_weight.1", 1e-4, 1e4),
    Free("control.terminal_weight.0", 1e-2, 1e6),
    Free("control.terminal_weight.1", 1e-2, 1e6),
    Free("control.input_weight", 1e-4, 1e4),
    Free("control.change_weight", 1e-4, 1e4),
)
"""Weights that a search varies; the position's weight is fixed, because only ratios matter."""
REGULATOR = (WEIGHTS[0], *WEIGHTS[3:])
"""Weights that a trajectory scheme uses: for planning, and for the regulator aboard."""
SPLINE_KEYS = (Free("control.spline_error_m", 1e-3, 1e-1),)
"""Key that a trajectory scheme's search also varies if the reference is known in advance."""
TRIGGER_KEYS: Mapping[str, Sequence[Free]] = {
    "state_gap": (
        Free("control.trigger.state_gap.epsilon", 1e-4, 1e8),
        Free("control.trigger.state_gap.decay_rate", 1e-2, 1e2),
    ),
    "cost_gap": (Free("control.trigger.cost_gap", 1e-6, 1e6),),
    "expected_gap": (Free("control.trigger.expected_gap", 1e-6, 1e6),),
    "deviation": (Free("control.trigger.deviation", 1e-4, 1e1),),
}
"""Parameters of triggers that use the state; searched for together with the weights."""
OBSERVER_KEYS = (Free("control.observer_s", 0.05, 50.0),)
MEANS = ("rmse_xy", "event_ratio", "effort_mps", "saturated")
ONLY = "here"
"""Name of the only column of an objective without named columns."""


def trigger_keys(trigger: str) -> Sequence[Free]:
    names = (each.name for each in leaves(TRIGGERS.parse(trigger)))
    keys = (key for name in names for key in TRIGGER_KEYS.get(name, ()))
    return list(dict.fromkeys(keys))


@dataclass(frozen=True, slots=True)
class SearchLimits:
    packets: float = 1.0
    """Largest event ratio; only for triggers that use the state."""
    effort_mps: float = math.inf
    """Largest effort, the RMS change of the command from step to step [m/s]."""
    saturated: float = 1.0
    """Largest share of steps with an input at its bound."""


@dataclass(frozen=True, slots=True)
class Rmse:
    """Objective of the smallest RMSE xy within limits."""

    scenario: Scenario
    limits: SearchLimits

    def settings(self) -> Mapping[str, Any]:
        return {"objective": "rmse", **asdict(self.limits)}

    def free(self) -> Sequence[Free]:
        """Keys that the search varies: weights, and keys of the scheme, the trigger and the
        observer. A key with the value 0, which means off, is left out.
        """
        control, table = self.scenario.control, plain(self.scenario)
        observer = OBSERVER_KEYS if control.properties.observes else ()
        weights: Sequence[Free] = WEIGHTS
        if control.properties.splines:
            ahead = self.scenario.reference.preview != "none"
            weights = (*REGULATOR, *SPLINE_KEYS) if ahead else REGULATOR
        keys = [*weights, *trigger_keys(control.trigger), *observer]
        return [key for key in keys if key.of(table) > 0.0]

    def fly(self, scenario: Scenario, seeds: Sequence[int]) -> Values:
        """Means over seeds, and the upper end of the 95 % interval of the event ratio."""
        runs = sweep.summaries(ONLY, scenario, seeds)
        means = {name: _mean(runs, name) for name in MEANS}
        _, half = sweep.estimate(runs, "event_ratio")
        ratio = means["event_ratio"]
        most = None if ratio is None else ratio + (half or 0.0)
        return {ONLY: {**means, "event_ratio_most": most}}

    def score(self, values: Values) -> float:
        """RMSE xy [m], times the cube of the ratio by which each limit is exceeded."""
        means = values[ONLY]
        rmse, most = means["rmse_xy"], means["event_ratio_most"]
        effort, saturated = means["effort_mps"], means["saturated"]
        if rmse is None or most is None or effort is None or saturated is None:
            return UNFLYABLE
        over = [effort / self.limits.effort_mps, saturated / self.limits.saturated]
        if self._binds():
            over.append(most / self.limits.packets)
        return rmse * math.prod(max(1.0, each) ** 3 for each in over)

    def _binds(self) -> bool:
        """Whether the event ratio is limited: only if the trigger is one of TRIGGER_KEYS."""
        named = leaves(TRIGGERS.parse(self.scenario.control.trigger))
        return any(each.name in TRIGGER_KEYS for each in named)


def _mean(runs: Sequence[Summary], name: str) -> float | None:
    """Mean of a figure; None if a flight failed."""
    values = [getattr(run, name) for run in runs]
    return None if None in values else float(np.mean(values))
