"""Largest number of vehicles on one shared network, for each scheme.

`python -m bench.crowd` flies the scenario `crowd`: its vehicles share the rates and queues of one
network, one for each direction. They fly, in the sense of this module, if all reach the end, none
brakes after `settle`, and the root mean square of all distances from the targets is within a limit.
For each scheme more and more are flown until they fail, then numbers between the largest that flies
and the smallest that fails.
"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, get_args

import msgspec
import numpy as np
import tyro

from bench.harness import TextTable
from skytether.cli import processes
from skytether.figures.flights import save
from skytether.figures.page import blank
from skytether.lab.commands.pool import Flags, crew, writing
from skytether.shared.base.units import HEADER_BYTES
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import position_error
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.shell.host import temporary
from skytether.sim import flight

Scheme = Literal["paper", "threshold", "budget"]
TITLES: Mapping[Scheme, str] = {
    "paper": "the paper's scheme, a packet at every step",
    "threshold": "trajectories, a threshold for each vehicle",
    "budget": "trajectories, one budget for all vehicles",
}
COLOURS: Mapping[Scheme, str] = {"paper": "#c1272d", "threshold": "#e69f00", "budget": "#0072b2"}
BUDGET_BYTES_PER_S = 10_000.0
"""Rate of the budget, four fifths of the link of the scenario `crowd` [B/s]."""
STEP = 4.0 / 3.0
EXACT = 0.05
"""Relative accuracy of the largest number of vehicles."""


def scenario_of(scheme: Scheme) -> Scenario:
    """Scenario `crowd` with a scheme; the paper's has its best weights (docs/compare.md)."""
    table = reading.to_table(reading.load("crowd"))
    if scheme == "paper":
        best = reading.to_table(reading.load(f"{reading.COMPARED}/paper-every-step-target"))
        table["control"] = best["control"] | {"dt": table["control"]["dt"]}
        table["vehicle"]["report"] = "always"
    table["control"]["shared_bytes_per_s"] = BUDGET_BYTES_PER_S if scheme == "budget" else 0.0
    return reading.check(table, "crowd")


class Cell(NamedTuple):
    scheme: Scheme
    vehicles: int


class CrowdPoint(msgspec.Struct, frozen=True):
    """Results of a flight, stored in the journal. `up` and `down` are directions of the network."""

    scheme: Scheme
    vehicles: int
    rmse_m: float | None
    """Root mean square distance of all vehicles from their targets from `settle` on [m]; None if a
    vehicle did not fly so long.
    """
    rmse_worst_m: float | None
    ended: int
    """Number of vehicles that did not fly to the end."""
    braked: int
    """Number of vehicles that braked, from `settle` on."""
    up_queueing_ms_p50: float
    """Median queueing delay of an uplink packet at the finite rate [ms]."""
    up_queueing_ms_p99: float
    down_queueing_ms_p50: float
    down_queueing_ms_p99: float
    up_lost: float
    """Share of uplink packets lost at random, or dropped by a full queue."""
    down_lost: float
    up_bytes_per_s: float
    """Uplink rate, with headers [B/s]."""
    down_bytes_per_s: float

    def flies(self, limit_m: float) -> bool:
        """Whether all vehicles fly, within this error [m]."""
        return not (self.ended or self.braked) and (self.rmse_m or np.inf) <= limit_m


def judge(
    scenario: Scenario, scheme: Scheme, vehicles: int, client: Rows, netem: Mapping[str, Any]
) -> CrowdPoint:
    """Figures of a flight, from the rows of all vehicles and the figures of netem."""
    squares, ended, braked = [], vehicles, 0
    for vehicle in np.unique(client["vehicle"]):
        rows = client[client["vehicle"] == vehicle]
        settled = rows["step"] * scenario.control.dt >= scenario.settled_s
        error: Array = position_error(scenario, rows)[settled]
        mode = rows["mode"][settled]
        ended -= int(rows["step"][-1]) + 1 >= scenario.steps
        braked += bool(((mode >= Mode.BRAKE) & (mode < Mode.MANUAL)).any())
        if len(error):
            squares.append(float((error**2).sum(axis=1).mean()))
    whole = len(squares) == vehicles
    duration_s = (int(client["step"].max()) + 1) * scenario.control.dt if len(client) else np.inf
    ways = {}
    for way in ("up", "down"):
        link = netem[f"{way}link"]
        packets, lost = link["packets"], link["lost"] + link["dropped"] + link["overflowed"]
        for quantile in ("p50", "p99"):
            ways[f"{way}_queueing_ms_{quantile}"] = link[f"queueing_ms_{quantile}"]
        ways[f"{way}_lost"] = lost / max(packets, 1)
        ways[f"{way}_bytes_per_s"] = (link["bytes"] + HEADER_BYTES * packets) / duration_s
    return CrowdPoint(
        scheme=scheme,
        vehicles=vehicles,
        rmse_m=float(np.sqrt(np.mean(squares))) if whole else None,
        rmse_worst_m=float(np.sqrt(max(squares))) if whole else None,
        ended=ended,
        braked=braked,
        **ways,
    )


@dataclass(frozen=True, slots=True)
class FlownScheme:
    points: tuple[CrowdPoint, ...]
    limit_m: float
    """RMSE above which vehicles count as failed [m]."""

    @classmethod
    def of(cls, points: Sequence[CrowdPoint], scheme: Scheme, limit_m: float) -> Self:
        own = sorted((each for each in points if each.scheme == scheme), key=lambda p: p.vehicles)
        return cls(tuple(own), limit_m)

    @property
    def too_many(self) -> int | None:
        """Smallest number of vehicles that fails; None if all fly."""
        return next((p.vehicles for p in self.points if not p.flies(self.limit_m)), None)

    @property
    def flying(self) -> int:
        """Largest number of vehicles below `too_many` that flies; 0 if none does."""
        below = self.too_many or np.inf
        return max((p.vehicles for p in self.points if p.vehicles < below), default=0)

    def next(self, most: int) -> int | None:
        """Number of vehicles to fly next, at most `most`; None once the largest number is found."""
        low, high = self.flying, self.too_many
        if high is None:
            return None if low >= most else min(ceil(low * STEP) or 1, most)
        return None if high - low <= max(1.0, EXACT * high) else (low + high) // 2


@dataclass(frozen=True)
class CrowdOptions:
    out: Path
    """Folder for the flights and crowd.png: after Ctrl-C the same command continues."""
    schemes: tuple[Scheme, ...] = get_args(Scheme)
    vehicles: tuple[int, ...] = ()
    """Numbers of vehicles to fly; unless given, the largest that flies is searched."""
    most: int = 256
    """Largest number of vehicles that is tried in a search."""
    limit: float = 1.0
    """Root mean square error above which vehicles count as failed [m]."""
    udp: bool = False
    """Fly over real UDP on loopback, in real time, instead of virtual time."""


def main(argv: Sequence[str]) -> None:
    options = tyro.cli(CrowdOptions, args=argv, description=__doc__)
    # One after the other over UDP: parallel flights would compete for the processor.
    flags = Flags(1 if options.udp else None)
    points: dict[Cell, CrowdPoint] = {}
    with writing(options.out), crew(flags, "flying", len(options.schemes), "schemes") as flyers:
        while cells := missing(options, list(points.values())):
            left = len({cell.scheme for cell in cells})
            flyers.advance(len(options.schemes) - left - flyers.done)
            points |= flyers.study(
                partial(fly, options.udp),
                {cell: cell for cell in cells},
                CrowdPoint,
                {"udp": options.udp},
                options.out,
                size=lambda _: 0.0,
            )
    flown = {
        scheme: FlownScheme.of(list(points.values()), scheme, options.limit)
        for scheme in options.schemes
    }
    table_of(flown).show("over UDP" if options.udp else "in virtual time")
    for scheme, each in flown.items():
        beyond = f"{each.too_many} do not" if each.too_many else "no more were tried"
        print(f"{TITLES[scheme]}: {each.flying} fly, {beyond}")
    draw(options.out / "crowd.png", flown, options.limit)


def missing(options: CrowdOptions, points: Sequence[CrowdPoint]) -> list[Cell]:
    """Flights to fly next; empty when every scheme's limit is found."""
    cells: list[Cell] = []
    for scheme in options.schemes:
        flown = FlownScheme.of(points, scheme, options.limit)
        numbers = options.vehicles or (flown.next(options.most),)
        flown_numbers = {None, *(point.vehicles for point in flown.points)}
        cells += [Cell(scheme, each) for each in numbers if each and each not in flown_numbers]
    return cells


def fly(udp: bool, cell: Cell) -> CrowdPoint:
    scenario = scenario_of(cell.scheme)
    if not udp:
        flown = flight.fly(scenario, vehicles=cell.vehicles)
        return judge(scenario, *cell, flown.client, flown.figures["netem"])
    with temporary.folder() as parts:
        processes.run(
            scenario,
            parts,
            on_second=lambda _: None,
            interrupted=lambda: False,  # Ctrl-C ends the worker process, and with it the flight
            vehicles=cell.vehicles,
            watched=False,
        )
        client = read(parts / "client")
        netem = json.loads((parts / "netem.json").read_bytes())
    return judge(scenario, *cell, client, netem)


def table_of(flown: Mapping[Scheme, FlownScheme]) -> TextTable:
    rows = [
        [
            p.scheme,
            str(p.vehicles),
            "yes" if p.flies(each.limit_m) else "no",
            "-" if p.rmse_m is None else f"{p.rmse_m:.3f}",
            "-" if p.rmse_worst_m is None else f"{p.rmse_worst_m:.3f}",
            str(p.braked + p.ended),
            f"{p.up_bytes_per_s:.0f}, {p.down_bytes_per_s:.0f}",
            f"{p.up_queueing_ms_p50:.0f}, {p.up_queueing_ms_p99:.0f}",
            f"{p.down_queueing_ms_p50:.0f}, {p.down_queueing_ms_p99:.0f}",
            f"{p.up_lost:.3f}, {p.down_lost:.3f}",
        ]
        for each in flown.values()
        for p in each.points
    ]
    headings = ["scheme", "vehicles", "fly", "RMSE [m]", "worst [m]", "brake or end"]
    ways = ["up, down [B/s]", "queueing up p50, p99 [ms]", "down", "lost up, down"]
    return TextTable(headings + ways, rows)


def draw(path: Path, flown: Mapping[Scheme, FlownScheme], limit_m: float) -> None:
    """Draw error, queueing delay and loss over the number of vehicles, for each scheme."""
    figure = blank(7.0, 8.0)
    panes = figure.subplots(3, 1, sharex=True)
    values: Sequence[tuple[str, Callable[[CrowdPoint], float | None]]] = (
        ("RMSE of all vehicles [m]", lambda p: p.rmse_m),
        ("queueing delay to a vehicle [ms]", lambda p: p.up_queueing_ms_p50),
        ("share lost on the way to a vehicle", lambda p: p.up_lost),
    )
    for pane, (label, value) in zip(panes, values, strict=True):
        for scheme, each in flown.items():
            points = [point for point in each.points if value(point) is not None]
            numbers = [point.vehicles for point in points]
            colour = COLOURS[scheme]
            drawn = np.array([value(point) for point in points], dtype=np.float64)
            if numbers:
                pane.plot(numbers, drawn, color=colour, linewidth=1.0, label=TITLES[scheme])
            for flies, marker in ((True, "o"), (False, "X")):
                has_outcome = [point.flies(limit_m) == flies for point in points]
                pane.scatter(
                    np.array(numbers)[has_outcome], drawn[has_outcome], color=colour, marker=marker
                )
            if pane is panes[1]:
                rare = [point.up_queueing_ms_p99 for point in points]
                pane.plot(numbers, rare, color=colour, linewidth=0.8, linestyle=":")
        pane.set_ylabel(label)
        pane.grid(alpha=0.3)
        pane.set_xscale("log", base=2)
    panes[0].axhline(limit_m, color="k", linewidth=0.8, linestyle="--")
    panes[0].set_yscale("log")
    panes[0].legend(fontsize=8)
    panes[1].set_title(
        "median, and dotted the 99 % quantile; × if the vehicles do not fly", fontsize=9
    )
    panes[-1].set_xlabel("number of vehicles")
    most = max(point.vehicles for each in flown.values() for point in each.points)
    ticks = sorted({2**i for i in range(13)} & set(range(1, most + 1)))
    panes[-1].set_xticks(ticks, list(map(str, ticks)))
    save(figure, path, dpi=110)


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "crowd"))
