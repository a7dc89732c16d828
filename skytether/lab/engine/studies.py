"""Studies of `skytether reproduce`: the paper's Table 1 and Fig. 5, and further usual studies.

A study is a sweep of all methods over the values of one parameter. For a fair comparison, a second
sweep flies periodic sending at each value, with the period nearest to the event trigger's rate in
the first sweep.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from skytether.lab.engine.calibration import COLUMNS, TABLE_1, deviations
from skytether.lab.engine.intervals import Estimate, interval
from skytether.lab.engine.sweep import GridAxis, Results, Sweep, estimate
from skytether.shared.scenario.registry import IMPAIRMENTS, TRIGGERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Summary

SCENARIO = "paper"
NONE, EVERY, EVENT = COLUMNS
PERIODIC = "periodic at equal rate"
METHODS = GridAxis(
    "method",
    tuple(COLUMNS),
    tuple({f"control.{key}": value for key, value in keys.items()} for keys in COLUMNS.values()),
)
"""Methods of Table 1, one per column; PERIODIC is flown for comparison."""


@dataclass(frozen=True, slots=True)
class ReproductionSize:
    """Number and length of the flights of a reproduction."""

    runs: int
    """Number of flights of each column of Table 1."""
    curve_runs: int
    """Number of flights of each point of a curve."""
    map_runs: int
    """Number of flights of each cell of Fig. 5."""
    points: int
    cells: int
    """Number of cells along each side of Fig. 5."""
    periods: tuple[int, ...]
    """Periods with which periodic sending is flown for the curves of Fig. 5 [steps]."""
    duration: float
    """Length of a flight in virtual time [s]."""
    real_s: float
    real_settle_s: float
    """Initial part of a flight over UDP that RMSE leaves out [s]."""
    sample_runs: int
    """Number of flights of each method whose complete records are kept, for figures."""
    delay_packets: int
    """Number of packets sent through netem in each direction, to measure their delay."""


def full(runs: int) -> ReproductionSize:
    return ReproductionSize(
        runs=runs,
        curve_runs=-(-runs // 2),
        map_runs=-(-runs // 4),
        points=9,
        cells=10,
        periods=(1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40),
        duration=60.0,
        real_s=30.0,
        real_settle_s=5.0,
        sample_runs=10,
        delay_packets=10_000,
    )


QUICK = ReproductionSize(
    runs=4,
    curve_runs=2,
    map_runs=2,
    points=3,
    cells=3,
    periods=(1, 5, 10, 20),
    duration=32.5,
    real_s=4.0,
    real_settle_s=1.0,
    sample_runs=2,
    delay_packets=500,
)


@dataclass(frozen=True, slots=True)
class Study:
    """Study of all methods over the values of one parameter."""

    name: str
    label: str
    """Label of the axis, with its unit."""
    scenario: Scenario
    """Scenario to fly, whose parameter is replaced."""
    axis: GridAxis
    """Values of the parameter, and the keys that each value changes."""
    runs: int
    here: float

    def first(self) -> Sweep:
        return Sweep(SCENARIO, self.scenario, [self.axis, METHODS], self.runs)

    def second(self, flown: "CellSummaries") -> Sweep:
        """Sweep of periodic sending at the event trigger's rate in the first sweep."""
        changes = tuple(
            {**keys, **periodic(period(flown[value, EVENT]))} for value, keys in self.axis.points()
        )
        return Sweep(
            SCENARIO, self.scenario, [GridAxis(self.axis.key, self.axis.values, changes)], self.runs
        )


def periodic(steps: int) -> Mapping[str, Any]:
    """Keys of periodic sending with this number of steps between packets."""
    return {"control.trigger": f"periodic({steps})"}


def period(runs: Sequence[Summary]) -> int:
    """Period whose rate is nearest to the mean event ratio of some runs [steps]."""
    ratio = estimate(runs, "event_ratio")[0]
    if not ratio:  # no flight succeeded
        return 1
    below = max(1, math.floor(1.0 / ratio))
    return min(below, below + 1, key=lambda steps: abs(1.0 / steps - ratio))


def table_study(scenario: Scenario, scale: ReproductionSize) -> Study:
    """Study of Table 1, and for comparison a study of flights as short as those over UDP."""
    short = {"duration": scale.real_s, "settle": scale.real_settle_s}
    values = (scenario.duration, scale.real_s)
    axis = GridAxis("duration", values, ({}, short))
    return Study("table1", "duration [s]", scenario, axis, scale.runs, scenario.duration)


def curve_studies(scenario: Scenario, scale: ReproductionSize) -> list[Study]:
    """Studies of loss, delay, jitter, model error and clock offset, usual in the literature."""
    up, n = scenario.uplink, scale.points
    (paper, _) = IMPAIRMENTS.calls(scenario.network.uplink)
    _, slot_s, slots_mean, _ = map(float, paper.values)
    slots_s = slot_s * slots_mean

    def study(
        name: str,
        label: str,
        values: Any,
        here: float,
        changes: Callable[[float], Mapping[str, Any]],
    ) -> Study:
        rounded = tuple(float(f"{value:.6g}") for value in values)
        axis = GridAxis(name, rounded, tuple(map(changes, rounded)))
        return Study(name, label, scenario, axis, scale.curve_runs, here)

    def both_ways(keys: Mapping[str, float]) -> dict[str, Any]:
        directions = ("uplink", "downlink")
        return {f"network.{way}.{key}": keys[key] for way in directions for key in keys}

    def jitter(std_ms: float) -> Mapping[str, Any]:
        # A Poisson variable's variance equals its mean, so more jitter means a longer mean delay;
        # the minimum is lowered by as much.
        slots = (std_ms / 1e3 / slot_s) ** 2
        least_s = round(up.mean_s - slot_s * slots, 9)
        return both_ways({"paper.slots_mean": slots, "paper.minimum_s": least_s})

    return [
        study(
            "loss",
            "share of packets lost, each way",
            np.linspace(0.0, 0.9, n if n < 9 else 10),
            up.loss,
            lambda loss: both_ways({"loss": loss}),
        ),
        study(
            "delay",
            "mean delay, each way [s]",
            np.linspace(slots_s, 2 * up.mean_s - slots_s, n),
            up.mean_s,
            lambda mean_s: both_ways({"paper.minimum_s": round(mean_s - slots_s, 9)}),
        ),
        study(
            "jitter",
            "standard deviation of the delay, each way [ms]",
            np.linspace(0.0, 90.0, n if n < 9 else 10),
            slot_s * math.sqrt(slots_mean) * 1e3,
            jitter,
        ),
        study(
            "mismatch",
            "true time constant / the model's",
            np.geomspace(0.5, 2.0, n),
            1.0,
            lambda factor: {"vehicle.tau_s": (scenario.tau_s * factor).tolist()},
        ),
        study(
            "clock",
            "vehicle's clock minus server's [s]",
            np.linspace(-2.0, 2.0, n),
            0.0,
            lambda offset_s: {"simulation.clock_offset_s": offset_s},
        ),
    ]


def map_sweep(scenario: Scenario, scale: ReproductionSize) -> Sweep:
    decay = np.linspace(0.5, 5.0, scale.cells).tolist()
    epsilon = np.linspace(0.9, 9.0, scale.cells).tolist()
    axes = [
        GridAxis("control.trigger.state_gap.decay_rate", tuple(round(value, 9) for value in decay)),
        GridAxis("control.trigger.state_gap.epsilon", tuple(round(value, 9) for value in epsilon)),
    ]
    return Sweep(SCENARIO, scenario, axes, scale.map_runs)


def period_sweep(scenario: Scenario, scale: ReproductionSize) -> Sweep:
    axis = GridAxis("control.trigger.periodic", scale.periods, tuple(map(periodic, scale.periods)))
    return Sweep(SCENARIO, scenario, [axis], scale.map_runs)


CellSummaries = Mapping[tuple[Any, ...], Sequence[Summary]]


def flown(plan: Sweep, done: Results) -> CellSummaries:
    return {values: plan.of_cell(done, cell) for cell, values in enumerate(plan.cells)}


@dataclass(frozen=True, slots=True)
class MethodFlights:
    runs: Sequence[Summary]
    period: int | None = None
    """Number of steps between packets with periodic sending; None for other methods."""

    def estimate(self, figure: str) -> Estimate:
        """Estimate of a figure; `total_packets` and `total_bytes` sum both directions."""
        if not figure.startswith("total_"):
            return estimate(self.runs, figure)
        what = figure.removeprefix("total_")
        return interval(
            [getattr(run, f"uplink_{what}") + getattr(run, f"downlink_{what}") for run in self.runs]
        )


def periodic_wins(event: MethodFlights, periodic: MethodFlights) -> int:
    """Compare RMSE xy: 1 if periodic sending is better, -1 if it is worse.

    0 if the 95 % intervals overlap, or a method has no successful flight.
    """
    (ours, ours_half), (theirs, theirs_half) = (
        cell.estimate("rmse_xy") for cell in (event, periodic)
    )
    if ours is None or theirs is None:
        return 0
    margin = (ours_half or 0.0) + (theirs_half or 0.0)
    return (ours - theirs > margin) - (theirs - ours > margin)


Cells = Mapping[tuple[float, str], MethodFlights]
"""Cells of a study, by value and method, including PERIODIC."""


def cells(study: Study, first: Sweep, firstly: Results, second: Sweep, secondly: Results) -> Cells:
    """Cells of a study, from the results of its two sweeps."""
    found = {key: MethodFlights(runs) for key, runs in flown(first, firstly).items()}
    periods = [
        int(TRIGGERS.one(keys["control.trigger"]).values[0]) for _, keys in second.axes[0].points()
    ]
    for steps, ((value,), runs) in zip(periods, flown(second, secondly).items(), strict=True):
        found[value, PERIODIC] = MethodFlights(runs, steps)
    return {
        (value, method): found[value, method]
        for value in study.axis.values
        for method in (*COLUMNS, PERIODIC)
    }


class TableEntry(msgspec.Struct, frozen=True):
    column: str
    entry: str
    paper: float | None
    """Paper's figure; None if the paper has none."""
    here: float | None
    """Mean of the reproduced flights; None if all failed."""
    ci95: float | None
    deviation: float | None
    """Relative deviation of `here` from `paper`; None without a paper's figure."""


ENTRIES = ("rmse_x", "rmse_y", "rmse_xy", "event_ratio")
WAYS = ("uplink", "downlink", "total")
TRAFFIC = tuple(f"{way}_{what}" for way in WAYS for what in ("packets", "bytes"))


def table_1(columns: Mapping[str, MethodFlights]) -> list[TableEntry]:
    """Entries of Table 1 for all columns, including PERIODIC, which the paper does not have."""
    found = {
        (column, name): cell.estimate(name) for column, cell in columns.items() for name in ENTRIES
    }
    off = deviations(
        {
            column: {name: found[column, name][0] for name in targets}
            for column, targets in TABLE_1.items()
        }
    )
    return [
        TableEntry(
            column, name, TABLE_1.get(column, {}).get(name), mean, half, off.get((column, name))
        )
        for (column, name), (mean, half) in found.items()
    ]
