"""Growth of the cost of a tick with the horizon and the axes, for one vehicle and many.

The number of vehicles is varied in `bench.tick`. Here it is fixed, and each column of the
table is fitted by a line over the horizon, cost = a + b H: planning makes a fixed number of passes
along the horizon, so a is what a tick costs whatever it plans, and b what each stage adds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from bench.airspace import Airspace
from bench.harness import HOT, Lateness, Pace, TextTable, figures_us, interleave, us
from bench.problems import derive
from bench.tick import waker
from skytether.shared.scenario.schema import Scenario


@dataclass(frozen=True)
class GrowthCounts:
    """Horizons, axes, vehicles and number of ticks to measure."""

    horizons: tuple[int, ...] = (10, 20, 40, 60, 90)
    """Horizons; 90 inputs are as many as one datagram holds for three axes."""
    axes: tuple[int, ...] = (2, 3)
    vehicles: tuple[int, ...] = (1, 200)
    ticks: int = 100


FULL = GrowthCounts()
QUICK = GrowthCounts((10, 40), (2,), (1, 50), 20)


class CostLine(NamedTuple):
    """Least-squares line through the costs of a tick over the horizon."""

    fixed_us: float
    """Cost a of a vehicle's tick without a horizon [µs]."""
    stage_us: float
    """Cost b of each further stage [µs]."""
    off: float
    """Largest distance of a measured cost from the line, as a share of that cost."""


def scenario(horizon: int, axes: int) -> Scenario:
    """The paper's circle with a horizon at every step, in the plane or in space."""
    control = {"dt": 0.05, "horizon": horizon}
    return derive("paper-every-step", control=control, model={"axes": axes})


def fit(horizons: list[int], costs_us: list[float]) -> CostLine:
    """Fit the costs of a tick [µs] over the horizon.

    Each cost counts by its relative distance from the line, so that the long horizons do not decide
    alone.
    """
    H, cost = np.array(horizons, dtype=float), np.array(costs_us)
    rows = np.stack([np.ones_like(H), H], axis=1) / cost[:, None]
    (fixed, stage), *_ = np.linalg.lstsq(rows, np.ones_like(H), rcond=None)
    off = np.abs(rows @ [fixed, stage] - 1.0).max()
    return CostLine(float(fixed), float(stage), float(off))


def measure(counts: GrowthCounts) -> dict[str, Any]:
    """Median CPU time of a tick, by vehicles, axes and horizon [µs a vehicle]."""
    lateness, columns = Lateness(), {}
    for vehicles, axes in product(counts.vehicles, counts.axes):
        spaces = {str(H): Airspace(scenario(H, axes), vehicles) for H in counts.horizons}
        spent = interleave(
            {H: waker(space) for H, space in spaces.items()},
            counts.ticks,
            Pace(turn=10, pause_s=HOT.pause_s),
            lateness,
            f"{vehicles} vehicles, {axes} axes",
            prepare={H: space.prepare for H, space in spaces.items()},
        )
        columns[f"{vehicles}, {axes}"] = {
            H: figures_us(durations, per=vehicles)["p50_us"] for H, durations in spent.items()
        }
    return {"costs_us": columns, "wake": lateness.figures()}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    """Table of the cost of a vehicle's tick over the horizon, with the fitted lines below it."""
    columns = result["costs_us"]
    horizons = list(next(iter(columns.values())))
    rows = [[f"H = {H}", *(us(each[H]) for each in columns.values())] for H in horizons]
    lines = [fit([int(H) for H in each], list(each.values())) for each in columns.values()]
    rows += [
        ["fit: a [µs]", *(us(line.fixed_us) for line in lines)],
        ["fit: b [µs a stage]", *(f"{line.stage_us:.3f}" for line in lines)],
        ["furthest from the fit", *(f"{line.off:.0%}" for line in lines)],
    ]
    headings = ["a vehicle's tick [µs]"]
    for name in columns:
        vehicles, axes = name.split(", ")
        headings.append(f"{vehicles} vehicle{'s' * (vehicles != '1')}, {axes} axes")
    return {"growth": TextTable(headings, rows)}
