"""Margin maps: flights of vehicles that differ from the model, over a grid of differences.

Each point of the grid is flown without wind in two ways: hovering, from a start START_M beside the
hover point, and along the scenario's reference. In a stable loop the hovering vehicle comes to
rest. It is in a limit cycle, an oscillation between the bounds of its input, if its RMS distance
from the hover point is above REST_M in the last quarter of the flight, and above SUSTAINED times
that of the quarter before. The table also has the growth after a push (`lab.margins`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from skytether.figures.flights import save
from skytether.figures.page import blank
from skytether.figures.tables import to_csv
from skytether.lab.journal import digests
from skytether.lab.margins import Differing, growth_of, hovering, windless
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import IMPAIRMENTS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import Summary, position_error, summarise
from skytether.sim.flight import fly_batch

START_M = 1.0
"""Initial distance from the hover point, along the first axis [m]."""
REST_S = 60.0
REST_M = 0.05
"""RMS distance from the hover point below which a vehicle counts as at rest [m]."""
SUSTAINED = 0.7
"""Ratio of the last quarter's RMS distance to that of the quarter before, above which the
oscillation does not decay.
"""
RUNS = 2
"""Number of flights of each kind at a point, with seeds that count up from the scenario's."""
PUSHES = 4


class Place(NamedTuple):
    burst_s: float
    """Mean burst length of loss, both ways [s]; 0 for independent losses."""
    dead_time_s: float
    """Dead time of the vehicle minus that of the model [s]."""
    gain: float
    """Gain of the vehicle relative to that of the model."""
    tau: float
    """Time constants of the vehicle relative to those of the model."""


class MapPoint(msgspec.Struct, frozen=True):
    cycles: bool
    rest_m: float
    """Largest RMS distance in the last quarter of the hovering flights [m]."""
    rmse_m: float | None
    """RMSE along the reference, over all axes of the plane [m]."""
    saturated: float | None
    """Share of the steps along the reference with an input at its bound."""
    event_ratio: float | None
    """Share of the server's steps along the reference that sent a plan."""
    growth: float
    """Growth of the mean square per step after a push."""


@dataclass(frozen=True, slots=True)
class Box:
    name: str
    scenario: Scenario
    trigger: str
    """Trigger of the pushes, see `lab.margins.clocked_trigger`."""
    tau: tuple[float, ...]
    gain: tuple[float, ...]
    dead_time_s: tuple[float, ...]
    burst_s: tuple[float, ...]

    @property
    def places(self) -> list[Place]:
        return [Place(*at) for at in product(self.burst_s, self.dead_time_s, self.gain, self.tau)]

    def settings(self) -> dict[str, Any]:
        files, table = digests([self.scenario]), reading.to_table(self.scenario)
        box = {
            "tau": self.tau,
            "gain": self.gain,
            "dead_time_s": self.dead_time_s,
            "burst_s": self.burst_s,
            "trigger": self.trigger,
        }
        return {"name": self.name, "box": box, "files": files, "scenario": table}

    def scenario_of(self, number: int) -> Scenario:
        burst_s, dead_time_s, gain, tau = self.places[number]
        scenario = windless(self.scenario)
        if burst_s:
            scenario = scenario.impaired(lambda each: _in_bursts(each, burst_s))
        return Differing(tau, gain, dead_time_s).of(scenario)

    def fly(self, number: int) -> MapPoint:
        """Fly a point in virtual time and evaluate it; called in a worker."""
        scenario = self.scenario_of(number)
        seeds = range(scenario.seed, scenario.seed + RUNS)
        rest = at_rest(scenario)
        rests = [resting(rest, flight.client) for flight in fly_batch(rest, seeds)]
        flown: list[Summary] = []
        for seed, flight in zip(seeds, fly_batch(scenario, seeds), strict=True):
            seeded = replace(scenario, seed=seed)
            flown.append(summarise(seeded, self.name, flight.client, flight.server))
        return MapPoint(
            cycles=any(before * SUSTAINED < last > REST_M for before, last in rests),
            rest_m=max(last for _, last in rests),
            rmse_m=_mean(each.rmse_xy for each in flown),
            saturated=_mean(each.saturated for each in flown),
            event_ratio=_mean(each.event_ratio for each in flown),
            growth=growth_of(scenario, self.trigger, PUSHES)[0],
        )

    def csv(self, points: Iterable[MapPoint]) -> str:
        each = enumerate(zip(self.places, points, strict=True))
        rows = [
            [number, *place, *msgspec.structs.astuple(point)] for number, (place, point) in each
        ]
        return to_csv(["number", *Place._fields, *MapPoint.__struct_fields__], rows)


def _in_bursts(direction: str, burst_s: float) -> str:
    """Impairments of a direction, with its losses in bursts of a mean length [s]."""
    calls = IMPAIRMENTS.calls(direction)
    share = next((call.values[0] for call in calls if call.name == "loss"), 0.0)
    others = [call.text for call in calls if call.name != "loss"]
    return " & ".join([*others, f"gilbert_elliott({share}, {burst_s})"])


def at_rest(scenario: Scenario) -> Scenario:
    beside, still = (START_M,) + (0.0,) * (scenario.model.axes - 1), hovering(scenario, REST_S)
    return replace(still, vehicle=replace(still.vehicle, start_m=beside))


def resting(scenario: Scenario, client: Rows) -> tuple[float, float]:
    """RMS distance from the hover point in each of the last two quarters [m]."""
    squares: Array = (position_error(scenario, client) ** 2).sum(axis=1)
    if not len(squares):
        return 0.0, 0.0
    quarter = max(1, len(squares) // 4)
    before, last = squares[-2 * quarter : -quarter], squares[-quarter:]
    return float(np.sqrt(before.mean())), float(np.sqrt(last.mean()))


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


def draw(path: Path, title: str, box: Box, points: Sequence[MapPoint]) -> None:
    """Draw the RMSE over time constant and gain, a map for each dead time and length of bursts.

    `points` are all points of the box, by number.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.lines import Line2D

    shape = (len(box.burst_s), len(box.dead_time_s), len(box.gain), len(box.tau))
    rmse = np.array([point.rmse_m or np.nan for point in points]).reshape(shape)
    cycles = np.array([point.cycles for point in points]).reshape(shape)
    grows = np.array([point.growth >= 1.0 for point in points]).reshape(shape)
    figure = blank(1.2 + 2.5 * shape[1], 1.4 + 2.3 * shape[0])
    planes = figure.subplots(shape[0], shape[1], squeeze=False, sharex=True, sharey=True)
    finite = rmse[np.isfinite(rmse)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.01, 0.1)
    norm = LogNorm(low, max(high, 1.01 * low))
    across, up = (np.arange(len(values)) for values in (box.tau, box.gain))
    for row, burst_s in enumerate(box.burst_s):
        for column, dead_time_s in enumerate(box.dead_time_s):
            plane, cell = planes[row, column], (row, column)
            mesh = plane.pcolormesh(across, up, rmse[cell], norm=norm, shading="nearest")
            for marks, style in ((grows[cell], GROWS), (cycles[cell], CYCLES)):
                y, x = np.nonzero(marks)
                plane.plot(x, y, **style)
            bursts = f"bursts of {burst_s:g} s" if burst_s else "no bursts"
            plane.set_title(f"dead time {dead_time_s:g} s, {bursts}", fontsize=8)
            plane.set_xticks(across, [f"{value:.2g}" for value in box.tau])
            plane.set_yticks(up, [f"{value:.2g}" for value in box.gain])
    for plane in planes[-1]:
        plane.set_xlabel("τ over the model's")
    for plane in planes[:, 0]:
        plane.set_ylabel("gain")
    figure.colorbar(mesh, ax=planes, label="RMSE xy without wind [m]")
    handles = [Line2D([], [], **style) for style in (CYCLES, GROWS)]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8)
    figure.suptitle(title, fontsize=10)
    save(figure, path, dpi=110)


CYCLES: dict[str, Any] = {
    "linestyle": "none",
    "marker": "x",
    "color": "#c1272d",
    "markeredgewidth": 2.0,
    "label": "limit cycle",
}
GROWS: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 10,
    "markerfacecolor": "none",
    "color": "black",
    "label": "grows after a push",
}
