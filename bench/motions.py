"""Cost of planning missions, per tick, compared with OSQP.

In each fleet a share of the vehicles flies near another: pairs that swap places repeatedly, 20 m
from the next pair; the others fly to and fro alone. The whole planning of each tick, from the
possible motions to the motion that is sent, is compared with OSQP on one QP for each vehicle
planned for in that tick: the QP of its last iteration, with the constraints added so far. OSQP is
set up once for each problem size and then updated, with tolerances of 1e-4, equivalent to about a
millimetre, and without polishing. Both are CPU time.
"""

import itertools
import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np
import osqp
from scipy import sparse

from bench.harness import TextTable, progress
from skytether.server.missions.dual_active_set import DualActiveSet
from skytether.server.missions.half_planes import HalfPlanes
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.trajectory_qp import TrajectoryQP
from skytether.shared.base import files
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.sim import flight

ROWS = 64
"""OSQP's problems are padded to a multiple of this number with constraints that always hold, so
that OSQP is set up for a few sizes only."""
FLEETS = (16, 64, 200)
SHARES = (0.0, 0.1, 0.5)
"""Shares of vehicles near others."""
LEG_M, APART_M = 3.0, 20.0
"""Length of a vehicle's way to and fro, and distance to the next vehicle [m]."""
LEG_S = 5.0
"""Time between successive goals [s]."""
RIVALS = 60
"""Number of ticks whose problems OSQP solves."""


@dataclass(frozen=True)
class MotionsCounts:
    fleets: tuple[int, ...] = FLEETS
    shares: tuple[float, ...] = SHARES
    duration: float = 30.0
    """Length of a flight [s]."""


FULL, QUICK = MotionsCounts(), MotionsCounts((16,), (0.5,), 12.0)


class MotionProblem(NamedTuple):
    """A QP in the form of `DualActiveSet`."""

    solver: DualActiveSet
    linear: Array
    columns: Array
    least: Array
    equal: int


@contextmanager
def kept(problems: list[MotionProblem]) -> Iterator[None]:
    real = TrajectoryQP.solve

    def solve(
        self: TrajectoryQP, p: Array, v: Array, targets: Array, planes: HalfPlanes | None = None
    ) -> Any:
        linear, columns, least = self.problem(p[-1], v[-1], targets, planes)
        problems.append(MotionProblem(self.solver, linear, columns, least, p.shape[1]))
        return real(self, p, v, targets, planes)

    plan = cast(Any, TrajectoryQP)
    plan.solve = solve
    try:
        yield
    finally:
        plan.solve = real


def filled_up(problem: MotionProblem) -> tuple[Any, Array]:
    """Constraints and their bounds, padded to the next multiple of ROWS."""
    variables, count = problem.columns.shape
    rows = -(-count // ROWS) * ROWS
    least, columns = np.full(rows, -1.0), np.zeros((rows, variables))
    least[:count] = problem.least
    columns[:count] = problem.columns.T
    dense = sparse.csc_matrix(np.ones(columns.shape))
    dense.data = columns.T.ravel()  # every entry, so that the pattern stays the same
    return dense, least


class MotionOsqp:
    def __init__(self, hessian: Array) -> None:
        self._hessian = sparse.csc_matrix(np.triu(hessian))
        self._made: dict[int, Any] = {}

    def solve(self, problem: MotionProblem) -> Array:
        dense, least = filled_up(problem)
        rows, most = len(least), np.full(len(least), np.inf)
        most[: problem.equal] = least[: problem.equal]
        solver = self._made.get(rows)
        if solver is None:
            solver = self._made[rows] = osqp.OSQP()
            solver.setup(
                self._hessian,
                -problem.linear,
                dense,
                least,
                most,
                verbose=False,
                eps_abs=1e-4,
                eps_rel=1e-4,
                polishing=False,
                max_iter=4000,
            )
        else:
            solver.update(q=-problem.linear, l=least, u=most, Ax=dense.data)
        solution: Array = np.asarray(solver.solve(raise_error=False).x)
        return solution


def shared_space(vehicles: int, share: float, duration: float, folder: Path) -> Scenario:
    """Scenario of a fleet in which a share of the vehicles flies in pairs that swap places."""
    near = 2 * round(share * vehicles / 2)
    lines = ["vehicle,t,x,y"]
    for vehicle in range(1, vehicles + 1):
        # Both vehicles of a pair fly along the same line, in opposite directions.
        place = (vehicle - 1) // 2 if vehicle <= near else vehicle
        side = 1.0 if vehicle > near or vehicle % 2 else -1.0
        for leg in range(math.ceil(duration / LEG_S) + 1):
            x = side * LEG_M / 2 * (-1.0) ** leg
            lines.append(f"{vehicle},{leg * LEG_S:g},{x:g},{APART_M * place:g}")
    file = folder / f"fleet-{vehicles}-{near}.csv"
    files.write(file, "\n".join(lines).encode())
    table = reading.to_table(reading.load("swap"))
    table |= {"duration": duration, "settle": 1.0}
    table["reference"] |= {"shape": "mission", "file": str(file)}
    return reading.check(table, "swap")


@contextmanager
def watched(plan_us: list[float], problems: list[list[MotionProblem]] | None) -> Iterator[None]:
    """Measure the planning time of each tick [µs], or record the last QP of each vehicle instead.

    Args:
        plan_us: output: time of each tick, if `problems` is None.
        problems: output: QPs of each tick; None to measure.
    """
    plan, toward = MissionPlanner.plan, MissionPlanner._motion_toward
    of_tick: list[MotionProblem] = []

    def timed(self: MissionPlanner, *given: Any) -> None:
        began = time.thread_time_ns()
        plan(self, *given)
        plan_us.append((time.thread_time_ns() - began) / 1e3)

    def collected(self: MissionPlanner, *given: Any) -> None:
        of_tick.clear()
        plan(self, *given)
        assert problems is not None
        problems.append(list(of_tick))

    def last_of(self: MissionPlanner, *given: Any) -> Any:
        before = len(of_tick)
        motion = toward(self, *given)
        del of_tick[before:-1]
        return motion

    own: Any = MissionPlanner
    if problems is None:
        own.plan = timed
    else:
        own.plan, own._motion_toward = collected, last_of
    try:
        with kept(of_tick) if problems is not None else nullcontext():
            yield
    finally:
        own.plan, own._motion_toward = plan, toward


def measure(counts: MotionsCounts) -> dict[str, Any]:
    """Planning time of whole ticks and OSQP's time, by the share of vehicles near others."""
    fleets = []
    with tempfile.TemporaryDirectory() as folder:
        kinds = list(itertools.product(counts.fleets, counts.shares))
        for vehicles, share in progress(kinds, "fleets"):
            scenario = shared_space(vehicles, share, counts.duration, Path(folder))
            spent: list[float] = []
            problems: list[list[MotionProblem]] = []
            with watched([], None):  # loads machine code
                flight.fly(msgspec.structs.replace(scenario, duration=2 * LEG_S), vehicles=vehicles)
            with watched(spent, None):
                flight.fly(scenario, vehicles=vehicles)
            with watched([], problems):  # the same flight again, bit for bit
                flight.fly(scenario, vehicles=vehicles)
            planned = [tick for tick, each in enumerate(problems) if each]
            beside = _beside_osqp(spent, problems, planned)
            fleets.append({"vehicles": vehicles, "near": share, **beside})
    return {"fleets": fleets}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    rows = []
    for each in result["fleets"]:
        ours, theirs = (
            [each[whose][q] for q in ("p50", "p99")] for whose in ("ours_ms", "osqp_ms")
        )
        ratios = (of_osqp / own for of_osqp, own in zip(theirs, ours, strict=True))
        rows.append(
            [
                f"{each['vehicles']}, {each['near']:.0%}",
                f"{each['planned']:.1f}",
                ", ".join(f"{ms:.2f}" for ms in ours),
                ", ".join(f"{ms:.2f}" for ms in theirs),
                ", ".join(f"{ratio:.1f}" for ratio in ratios),
            ]
        )
    headings = [
        "vehicles, near others",
        "planned for in a tick",
        "planning p50, p99 [ms]",
        "OSQP p50, p99 [ms]",
        "OSQP over it p50, p99",
    ]
    return {"motions": TextTable(headings, rows)}


def _beside_osqp(
    spent: list[float], problems: list[list[MotionProblem]], planned: list[int]
) -> dict[str, Any]:
    root = problems[planned[0]][0].solver.root
    rival = MotionOsqp(np.linalg.inv(root.T @ root).astype(np.float64))
    looked_at = planned[:: max(1, len(planned) // RIVALS)]
    for each in problems[looked_at[0]]:
        rival.solve(each)  # warms up
    osqp_ms = []
    for tick in looked_at:
        began = time.thread_time_ns()
        for each in problems[tick]:
            rival.solve(each)
        osqp_ms.append((time.thread_time_ns() - began) / 1e6)
    ours_ms = [spent[tick] / 1e3 for tick in looked_at]
    return {
        "planned": float(np.mean([len(problems[tick]) for tick in looked_at])),
        "ours_ms": _quantiles(ours_ms),
        "osqp_ms": _quantiles(osqp_ms),
    }


def _quantiles(numbers: list[float]) -> dict[str, float]:
    p50, p99 = np.quantile(numbers, (0.5, 0.99)).tolist()
    return {"p50": p50, "p99": p99}
