"""Cost of planning missions, per tick.

Half of the vehicles of each fleet fly near another: in pairs that swap places repeatedly, 20 m from
the next pair; the others fly to and fro alone. The CPU time of a tick's whole planning is measured,
from the possible motions to the motions that are sent, in ticks with vehicles to plan for.
"""

import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec
import numpy as np

from bench.harness import TextTable, progress
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.trajectory_qp import TrajectoryQP
from skytether.shared.base import files
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.sim import flight

LEG_M, APART_M = 3.0, 20.0
"""Length of a vehicle's way to and fro, and distance to the next vehicle [m]."""
LEG_S = 5.0
"""Time between successive goals [s]."""


@dataclass(frozen=True)
class MotionsCounts:
    fleets: tuple[int, ...] = (16, 64, 200)
    duration: float = 30.0
    """Length of a flight [s]."""


FULL, QUICK = MotionsCounts(), MotionsCounts((16,), 12.0)


class PlannedTick(NamedTuple):
    solved: int
    """Number of QPs solved."""
    spent_ms: float


def shared_space(vehicles: int, duration: float, folder: Path) -> Scenario:
    """Scenario of a fleet in which half of the vehicles fly in pairs that swap places."""
    near = 2 * round(vehicles / 4)
    lines = ["vehicle,t,x,y"]
    for vehicle in range(1, vehicles + 1):
        # Both vehicles of a pair fly along the same line, in opposite directions.
        place = (vehicle - 1) // 2 if vehicle <= near else vehicle
        side = 1.0 if vehicle > near or vehicle % 2 else -1.0
        for leg in range(math.ceil(duration / LEG_S) + 1):
            x = side * LEG_M / 2 * (-1.0) ** leg
            lines.append(f"{vehicle},{leg * LEG_S:g},{x:g},{APART_M * place:g}")
    file = folder / f"fleet-{vehicles}.csv"
    files.write(file, "\n".join(lines).encode())
    table = reading.to_table(reading.load("swap"))
    table |= {"duration": duration, "settle": 1.0}
    table["reference"] |= {"shape": "mission", "file": str(file)}
    return reading.check(table, "swap")


@contextmanager
def timed() -> Iterator[list[PlannedTick]]:
    """Ticks planned within the block."""
    plan, solve, solved = MissionPlanner.plan, TrajectoryQP.solve, 0
    ticks: list[PlannedTick] = []

    def timed_plan(*given: Any) -> None:
        before, began_ns = solved, time.thread_time_ns()
        plan(*given)
        ticks.append(PlannedTick(solved - before, (time.thread_time_ns() - began_ns) / 1e6))

    def counted_solve(*given: Any) -> Any:
        nonlocal solved
        solved += 1
        return solve(*given)

    with (
        patch.object(MissionPlanner, "plan", timed_plan),
        patch.object(TrajectoryQP, "solve", counted_solve),
    ):
        yield ticks


def measure(counts: MotionsCounts) -> dict[str, Any]:
    """Planning time of ticks [ms], by the number of vehicles."""
    fleets = []
    with tempfile.TemporaryDirectory() as folder:
        for vehicles in progress(counts.fleets, "fleets"):
            scenario = shared_space(vehicles, counts.duration, Path(folder))
            # The first flight loads machine code.
            flight.fly(msgspec.structs.replace(scenario, duration=2 * LEG_S), vehicles=vehicles)
            with timed() as ticks:
                flight.fly(scenario, vehicles=vehicles)
            spent_ms = [each.spent_ms for each in ticks if each.solved]
            p50, p99 = np.quantile(spent_ms, (0.5, 0.99)).tolist()
            fleets.append({"vehicles": vehicles, "p50_ms": p50, "p99_ms": p99})
    return {"fleets": fleets}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    rows = [
        [str(each["vehicles"]), f"{each['p50_ms']:.2f}", f"{each['p99_ms']:.2f}"]
        for each in result["fleets"]
    ]
    return {"motions": TextTable(["vehicles", "planning of a tick, p50 [ms]", "p99"], rows)}
