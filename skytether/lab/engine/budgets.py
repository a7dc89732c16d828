"""Choice of thresholds and reporting policies for contenders, within budgets of packets.

Each contender first flies scouting flights at several thresholds and reporting policies, with its
weights (`contenders`), on the seeds of the search. More thresholds are tried near each budget,
until the budget is almost used up. The comparison then flies the threshold and policy with the
smallest error within each budget.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec.structs import replace

from skytether.lab.engine.contenders import (
    SEARCH_SEED,
    Case,
    ComparisonSize,
    Contender,
    differences,
    tuned,
)
from skytether.lab.engine.sweep import GridAxis, Results, Sweep
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import value
from skytether.shared.scenario.whole import Scenario

BUDGETS = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
"""Budgets: largest numbers of packets per second, both directions together, with heartbeats."""
SOUGHT = tuple(sorted((*BUDGETS, 4.5)))
"""Budgets for which points are chosen [packets/s]: BUDGETS, and 4.5 for `comparison.CLAIMS`. 4.5 is
slightly less than 12 % of the packets of the paper's scheme with the trigger `always`.
"""
CLOSE = 1.05
"""A threshold between two neighbouring thresholds is tried if their ratio is at least this."""
EFFORT_RATIO_MAX = 1.05
"""Largest ratio of a chosen point's effort to the effort limit of its case."""
REPORTS: Mapping[str, Mapping[str, Any]] = {
    "every step": {"vehicle.report": "always"},
    "by event": {"vehicle.report": "deviation(0.05) | silence(1)"},
    "each second": {"vehicle.report": "silence(1)"},
    "every 4 s": {
        "vehicle.report": "silence(4)",
        "link.heartbeat_s": 4.0,
        "link.timeout_s": 20.0,
        "link.age_max_s": 10.0,
    },
    "every 12 s": {
        "vehicle.report": "silence(12)",
        "link.heartbeat_s": 12.0,
        "link.timeout_s": 60.0,
        "link.age_max_s": 30.0,
    },
}
"""Policies for the vehicle's reports, and the keys that each policy changes."""
EVERY = "every step"
"""Reporting policy with which the searches for weights fly."""
ITS_OWN = "its own"
"""Name of the reporting policy that a user's contender sets itself."""


@dataclass(frozen=True, slots=True)
class FlownContender:
    """Contender in a case, at one threshold and with one reporting policy."""

    contender: Contender
    threshold: float | None
    """Threshold of the trigger; None for a contender without a threshold."""
    report: str
    """Reporting policy, a key of REPORTS, or ITS_OWN."""
    tuned: bool
    """Whether the threshold is the result of the search for weights."""
    keys: Mapping[str, Any]
    """Dotted keys that differ from the plant's scenario, and their values."""

    @property
    def name(self) -> tuple[str, float | None, str]:
        return self.contender.name, self.threshold, self.report

    def at(self, threshold: float) -> "FlownContender":
        keys = {**self.keys, f"control.{self.contender.threshold}": threshold}
        return FlownContender(self.contender, threshold, self.report, False, keys)


def flying(contender: Contender, case: Case, tuned: Scenario) -> list[FlownContender]:
    """Points of a contender: for each reporting policy all thresholds, in rising order."""
    keys, key = differences(tuned, case.plant), contender.threshold
    keys = {path: value for path, value in keys.items() if path not in case.keys}
    keys |= contender.keys
    values: list[float | None] = [None]
    tuned_threshold = value(reading.to_table(tuned), f"control.{key}") if key else None
    if tuned_threshold is not None:
        scaled = [tuned_threshold * factor for factor in contender.factors]
        if isinstance(tuned_threshold, int):  # a period in steps
            scaled = [max(1, round(value)) for value in scaled]
        values = sorted({*scaled})
    reports_by_itself = any(key.startswith(("vehicle.", "link.")) for key in contender.keys)
    reports = {ITS_OWN: {}} if reports_by_itself else REPORTS
    return [
        FlownContender(
            contender,
            value,
            report,
            value == tuned_threshold,
            {**keys, **({f"control.{key}": value} if key else {}), **changes},
        )
        for value in values
        for report, changes in reports.items()
    ]


Chosen = Mapping[tuple[str, float], FlownContender]
"""Best point of each contender within each budget, by the contender's name and the budget [1/s]."""


@dataclass(frozen=True, slots=True)
class Scouted:
    point: FlownContender
    rmse_xy_m: float
    packets_per_s: float
    """Mean number of packets in both directions together [1/s]."""
    is_valid: bool
    """Whether the effort is within the limit of the case."""

    def is_within(self, budget: float) -> bool:
        """Whether the point may be chosen for a budget [1/s]."""
        return self.is_valid and self.packets_per_s <= budget and math.isfinite(self.rmse_xy_m)


def _between(lower: float | None, upper: float | None) -> float | None:
    """Geometric mean of two thresholds; None if they differ by less than CLOSE."""
    if lower is None or upper is None:
        return None
    mean = math.sqrt(lower * upper)
    if isinstance(upper, int):  # a period in steps
        return round(mean) if lower < round(mean) < upper else None
    return float(f"{mean:.4g}") if upper > CLOSE * lower else None


class Plan:
    """Flights of all contenders in one case.

    Args:
        weights: COMPARED, or the path of a file written by `to_file`.

    Raises:
        ConfigError: the file cannot be read, or a contender is missing, unknown or invalid in it.
    """

    def __init__(self, case: Case, weights: str, scale: ComparisonSize) -> None:
        self.case = case
        self.points: list[FlownContender] = []
        for contender in scale.who(case):
            self.points += flying(contender, case, tuned(contender, case, weights))
        self.runs = -(-scale.runs // 2) if case.weights else scale.runs
        """Number of flights of each chosen contender, threshold and reporting policy; half of the
        usual number, rounded up, if the case uses the weights of another case."""
        self._scenario = scale.scenario(case)
        self._scouting = scale.scouts, replace(self._scenario, seed=SEARCH_SEED)
        self._scouted: list[Scouted] = []
        self._budgets = scale.budgets or SOUGHT

    def scouts(self, points: Sequence[FlownContender]) -> Sweep:
        runs, scenario = self._scouting
        return self._sweep(scenario, points, runs)

    def _sweep(self, scenario: Scenario, points: Sequence[FlownContender], runs: int) -> Sweep:
        names, changes = tuple(each.name for each in points), tuple(each.keys for each in points)
        return Sweep(self.case.name, scenario, [GridAxis("contender", names, changes)], runs)

    def comparison(self, points: Iterable[FlownContender]) -> Sweep:
        each = {point.name: point for point in points}
        return self._sweep(self._scenario, list(each.values()), self.runs)

    def scouted(self, points: Sequence[FlownContender], sweep: Sweep, done: Results) -> None:
        """Store the results of the scouting flights of `points`, flown by the sweep of `scouts`."""
        for cell, point in enumerate(points):
            runs = sweep.of_cell(done, cell)
            packets, effort = (
                float(np.mean([getattr(run, figure) for run in runs]))
                for figure in ("packets_per_s", "effort_mps")
            )
            errors = [math.inf if run.rmse_xy is None else run.rmse_xy for run in runs]
            is_valid = effort <= EFFORT_RATIO_MAX * self.case.effort_mps
            self._scouted.append(Scouted(point, float(np.mean(errors)), packets, is_valid))

    def _best(self) -> dict[tuple[str, float], Scouted]:
        best: dict[tuple[str, float], Scouted] = {}
        for each in self._scouted:
            for budget in SOUGHT:
                name = each.point.contender.name, budget
                if each.is_within(budget) and (
                    name not in best or each.rmse_xy_m < best[name].rmse_xy_m
                ):
                    best[name] = each
        return best

    def halfway(self) -> list[FlownContender]:
        """Points to scout next: thresholds between neighbouring points if one exceeds a budget and
        the other does not.

        A pair is skipped unless the point above the budget has a smaller error than the best point
        within the budget.
        """
        best, points_between = self._best(), {}
        ways: dict[tuple[str, str], list[Scouted]] = {}
        for each in self._scouted:
            ways.setdefault((each.point.contender.name, each.point.report), []).append(each)
        for (contender, _), points in ways.items():
            rising = sorted(points, key=lambda each: each.point.threshold or 0.0)
            for lower, upper in pairwise(rising):
                value = _between(lower.point.threshold, upper.point.threshold)
                if value is not None and any(
                    upper.is_within(budget)
                    and not lower.is_within(budget)
                    and lower.rmse_xy_m < best[contender, budget].rmse_xy_m
                    for budget in SOUGHT
                ):
                    point = upper.point.at(value)
                    points_between[point.name] = point
        return list(points_between.values())

    def chosen(self) -> Chosen:
        """Point with the least RMSE xy within each budget, by contender and budget.

        A contender has no entry for a budget in which every point failed or exceeded the effort
        limit.
        """
        best = self._best().items()
        return {name: each.point for name, each in best if name[1] in self._budgets}

    def tuned(self, name: str) -> Scenario:
        """Scenario of a contender at the threshold from the search, with reports at every step."""
        (point,) = (
            each
            for each in self.points
            if each.contender.name == name and each.tuned and each.report == EVERY
        )
        return self.comparison([point]).scenario_of(point.name)
