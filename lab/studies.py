"""What `skytether reproduce` flies: the paper's Table 1 and Fig. 5, and the literature's usual set.

A study flies all methods over the values of one thing that changes. Its second sweep is the honest
baseline: at each value, periodic sending with the period nearest to the event trigger's own rate
there, which the first sweep has to tell.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from lab.calibration import COLUMNS, TABLE_1, deviations
from lab.sweep import Axis, Estimate, Results, Sweep, estimate, interval
from shared.config import Scenario
from shared.summary import Summary

SCENARIO = "paper"
NONE, EVERY, EVENT = COLUMNS
PERIODIC = "periodic at equal rate"
METHODS = Axis(
    "method",
    tuple(COLUMNS),
    tuple({f"control.{key}": value for key, value in keys.items()} for keys in COLUMNS.values()),
)
"""As in Table 1; PERIODIC comes beside them."""


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is flown."""

    runs: int
    """Of each column of Table 1."""
    curve_runs: int
    """Of each point of a curve."""
    map_runs: int
    """Of each cell of Fig. 5."""
    points: int
    """Of each curve."""
    cells: int
    """Of Fig. 5, along each side."""
    periods: tuple[int, ...]
    """Of the periodic curve beside it [steps]."""
    duration: float
    """Of a flight [s]."""
    real_s: float
    """Length of a flight over UDP."""
    real_settle_s: float
    """Start of it that RMSE leaves out."""
    sample_runs: int
    """Flights whose records are looked into."""
    delay_packets: int
    """Sent through netem, each way, to see how long it takes."""


def full(runs: int) -> Scale:
    """For print."""
    return Scale(
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


QUICK = Scale(
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
"""For a first look."""


@dataclass(frozen=True, slots=True)
class Study:
    """All methods over the values of one thing."""

    name: str
    label: str
    """Of the axis, with its unit."""
    scenario: Scenario
    axis: Axis
    runs: int
    here: float
    """The value of the scenario itself."""

    def first(self) -> Sweep:
        """The methods of Table 1."""
        return Sweep(SCENARIO, self.scenario, [self.axis, METHODS], self.runs)

    def second(self, flown: "Flown") -> Sweep:
        """Periodic sending, as often as the event trigger did in the first."""
        changes = tuple(
            {**keys, **periodic(period(flown[value, EVENT]))} for value, keys in self.axis.points()
        )
        return Sweep(
            SCENARIO, self.scenario, [Axis(self.axis.key, self.axis.values, changes)], self.runs
        )


def periodic(steps: int) -> Mapping[str, Any]:
    """The keys of a scenario that sends every so many steps."""
    return {"control.trigger": "periodic", "control.period": steps}


def period(runs: Sequence[Summary]) -> int:
    """Steps between packets, at the rate nearest to the mean event ratio of some runs."""
    ratio = estimate(runs, "event_ratio")[0]
    if not ratio:  # none of them flew
        return 1
    below = max(1, math.floor(1.0 / ratio))
    return min(below, below + 1, key=lambda steps: abs(1.0 / steps - ratio))


def table_study(scenario: Scenario, scale: Scale) -> Study:
    """Table 1; and as long as a real flight, to stand beside it."""
    short = {"duration": scale.real_s, "settle": scale.real_settle_s}
    values = (scenario.duration, scale.real_s)
    axis = Axis("duration", values, ({}, short))
    return Study("table1", "duration [s]", scenario, axis, scale.runs, scenario.duration)


def curve_studies(scenario: Scenario, scale: Scale) -> list[Study]:
    """The literature's usual set: loss, delay, jitter, a wrong model, clocks that differ."""
    up, n = scenario.network.uplink, scale.points
    slots_s = up.slot_s * up.slots_mean

    def study(
        name: str,
        label: str,
        values: Any,
        here: float,
        changes: Callable[[float], Mapping[str, Any]],
    ) -> Study:
        rounded = tuple(float(f"{value:.6g}") for value in values)
        axis = Axis(name, rounded, tuple(map(changes, rounded)))
        return Study(name, label, scenario, axis, scale.curve_runs, here)

    def both_ways(**keys: float) -> dict[str, Any]:
        directions = ("uplink", "downlink")
        return {f"network.{way}.{key}": keys[key] for way in directions for key in keys}

    def jitter(std_ms: float) -> Mapping[str, Any]:
        # A Poisson number of slots has its mean as variance; the mean delay stays what it is.
        slots = (std_ms / 1e3 / up.slot_s) ** 2
        return both_ways(slots_mean=slots, minimum_s=round(up.mean_s - up.slot_s * slots, 9))

    return [
        study(
            "loss",
            "share of packets lost, each way",
            np.linspace(0.0, 0.9, n if n < 9 else 10),
            up.loss,
            lambda loss: both_ways(loss=loss),
        ),
        study(
            "delay",
            "mean delay, each way [s]",
            np.linspace(slots_s, 2 * up.mean_s - slots_s, n),
            up.mean_s,
            lambda mean_s: both_ways(minimum_s=round(mean_s - slots_s, 9)),
        ),
        study(
            "jitter",
            "standard deviation of the delay, each way [ms]",
            np.linspace(0.0, 90.0, n if n < 9 else 10),
            up.slot_s * math.sqrt(up.slots_mean) * 1e3,
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


def map_sweep(scenario: Scenario, scale: Scale) -> Sweep:
    """Fig. 5: λ × ε."""
    decay = np.linspace(0.5, 5.0, scale.cells).tolist()
    epsilon = np.linspace(0.9, 9.0, scale.cells).tolist()
    axes = [
        Axis("control.decay_rate", tuple(round(value, 9) for value in decay)),
        Axis("control.epsilon", tuple(round(value, 9) for value in epsilon)),
    ]
    return Sweep(SCENARIO, scenario, axes, scale.map_runs)


def period_sweep(scenario: Scenario, scale: Scale) -> Sweep:
    """Beside it: periodic sending, from every step to hardly ever."""
    axis = Axis("control.period", scale.periods, tuple(map(periodic, scale.periods)))
    return Sweep(SCENARIO, scenario, [axis], scale.map_runs)


Flown = Mapping[tuple[Any, ...], Sequence[Summary]]
"""Runs of each cell of a sweep, by its values."""


def flown(plan: Sweep, done: Results) -> Flown:
    """The runs of each cell, by its values."""
    return {values: plan.of_cell(done, cell) for cell, values in enumerate(plan.cells)}


@dataclass(frozen=True, slots=True)
class Cell:
    """What one method did at one value."""

    runs: Sequence[Summary]
    period: int | None = None
    """Steps between its packets, where it is periodic."""

    def estimate(self, figure: str) -> Estimate:
        """Mean and half interval; `total_packets` and `total_bytes` count both directions."""
        if not figure.startswith("total_"):
            return estimate(self.runs, figure)
        what = figure.removeprefix("total_")
        return interval(
            [getattr(run, f"uplink_{what}") + getattr(run, f"downlink_{what}") for run in self.runs]
        )


def periodic_wins(event: Cell, periodic: Cell) -> int:
    """1 where periodic sending has the smaller RMSE xy, -1 where it has the larger.

    0 where their 95 % intervals meet, or nothing was flown.
    """
    (ours, ours_half), (theirs, theirs_half) = (
        cell.estimate("rmse_xy") for cell in (event, periodic)
    )
    if ours is None or theirs is None:
        return 0
    margin = (ours_half or 0.0) + (theirs_half or 0.0)
    return (ours - theirs > margin) - (theirs - ours > margin)


Cells = Mapping[tuple[float, str], Cell]
"""Of a study, by value and method; PERIODIC is one of them."""


def cells(study: Study, first: Sweep, firstly: Any, second: Sweep, secondly: Any) -> Cells:
    """Both sweeps of a study together.

    Args:
        firstly, secondly: what is done of each.
    """
    found = {key: Cell(runs) for key, runs in flown(first, firstly).items()}
    periods = [keys["control.period"] for _, keys in second.axes[0].points()]
    for steps, ((value,), runs) in zip(periods, flown(second, secondly).items(), strict=True):
        found[value, PERIODIC] = Cell(runs, steps)
    return {
        (value, method): found[value, method]
        for value in study.axis.values
        for method in (*COLUMNS, PERIODIC)
    }


class Entry(msgspec.Struct, frozen=True):
    """One of Table 1."""

    column: str
    entry: str
    paper: float | None
    here: float | None
    ci95: float | None
    deviation: float | None
    """Relative."""


ENTRIES = ("rmse_x", "rmse_y", "rmse_xy", "event_ratio")
WAYS = ("uplink", "downlink", "total")
TRAFFIC = tuple(f"{way}_{what}" for way in WAYS for what in ("packets", "bytes"))


def table_1(columns: Mapping[str, Cell]) -> list[Entry]:
    """Table 1, the paper's figures beside ours; PERIODIC is not in the paper."""
    found = {
        (column, name): cell.estimate(name) for column, cell in columns.items() for name in ENTRIES
    }
    off = deviations(
        {
            column: {name: found[column, name][0] or math.nan for name in targets}
            for column, targets in TABLE_1.items()
        }
    )
    return [
        Entry(column, name, TABLE_1.get(column, {}).get(name), *pair, off.get((column, name)))
        for (column, name), pair in found.items()
    ]
