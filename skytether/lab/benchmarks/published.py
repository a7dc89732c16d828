"""Tasks of published planners, flown by Skytether: success, time to finish, time to plan.

    python -m skytether.lab.benchmarks.published

The tasks are as the authors' own code has them: places, distances, bounds, noise. Skytether plans
motions as far apart as they do, for vehicles of the paper's time constant. Each task is flown over
a network that is near (20 ms, nothing lost) and over the paper's with 30 % of all packets lost.

- Luis, Vukosavljev and Schoellig (RA-L, 2020), github.com/carlosluis/online_dmpc: `config.json`
  (four cross), `sim_params.m` and `comp_dmpc_bvc.m` (random places), `run_algorithm.m` (a crash).
- Gräfe et al. (DMPC-Swarm, 2025), github.com/Data-Science-in-Mechanical-Engineering/DMPC-Swarm:
  `setpoint_creator.py` (a circle of 1.5 m), `batch_simulation.yaml` (fifteen random places).
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from skytether.lab.benchmarks.harness import TextTable, progress
from skytether.server.control.scheme import Foresight
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.shared.base import files
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import MARGIN_M
from skytether.shared.scenario import reading
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.summary import least_separation
from skytether.sim import flight

GOAL_AT_S = 2.0
"""Time from which on all want to be at their goals [s]."""
TOLD_S = 20.0
"""Length of a simulation of `sim_params.m` [s]."""
ARRIVED_M = 0.1
"""Distance from its goal at which a vehicle has arrived, of `comp_dmpc_bvc.m` [m]."""
NETWORKS = {
    "20 ms": ("constant(0.02)", 0.5),
    "paper, 30 %": ("paper(0.4, 0.02, 2) & loss(0.3)", 1.0),
}
"""Network each way, and `link.join_s` [s]."""


class Task(NamedTuple):
    """A published task."""

    vehicles: int
    separation_m: float
    """Distance below which two vehicles count as crashed [m]."""
    tube_m: float
    """Half of what the plans of the authors keep beyond that [m]."""
    stretch: float
    """Factor of the distance between vehicles that fly one above the other."""
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    """Corners of the box of random places [m]."""
    circle_m: float = 0.0
    """Radius of the circle on which vehicles swap places, in place of that [m]."""


TASKS = {
    "Luis 2020: four cross": Task(4, 0.2, 0.05, 2.0, (0, 0, 1), (0, 0, 1), np.sqrt(2.0)),
    "Luis 2020: 20 in 4 m³": Task(
        20, 0.2, 0.05, 2.0, (-0.7937, -0.7937, 0.2), (0.7937, 0.7937, 1.7874)
    ),
    "Luis 2020: 30 in 18 m³": Task(30, 0.2, 0.05, 2.0, (-1.5, -1.5, 0.2), (1.5, 1.5, 2.2)),
    "DMPC-Swarm: 6 on a circle": Task(6, 0.2, 0.1, 4.0, (0, 0, 1), (0, 0, 1), 1.5),
    "DMPC-Swarm: 15 random": Task(15, 0.2, 0.1, 4.0, (-1.9, -1.9, 0.4), (1.9, 1.9, 2.9)),
}


@dataclass(frozen=True)
class PublishedOptions:
    """Amount to fly."""

    flights: int = 10
    """Flights of each task over each network."""
    duration: float = 90.0
    """Length of a flight [s]."""
    markdown: Path | None = None
    """File for the table as Markdown."""


class TaskFlight(NamedTuple):
    """Result of a flight."""

    least_m: float
    """Smallest distance between two vehicles, heights stretched [m]."""
    arrived_s: float
    """Time from the goals to the last arrival [s]; NaN if a vehicle has not arrived."""
    plan_ms: float
    """Time that the server planned for a motion that it sent, on average [ms]."""


def places(task: Task, rng: np.random.Generator) -> tuple[Array, Array]:
    """Starts and goals of the vehicles [m]; two of shape (vehicles, 3)."""
    if task.circle_m:
        angle = 2.0 * np.pi * (np.arange(task.vehicles) / task.vehicles) + np.pi / 4.0
        on = task.circle_m * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        return on + np.array(task.low_m), -on + np.array(task.low_m)
    keep_m = task.separation_m + 2.0 * task.tube_m
    scale = np.array([1.0, 1.0, 1.0 / task.stretch])
    return _spread(task, rng, keep_m, scale), _spread(task, rng, keep_m, scale)


def _spread(task: Task, rng: np.random.Generator, keep_m: float, scale: Array) -> Array:
    """Random places of a box that are so far apart; begun anew where no more fit."""
    while True:
        found = np.zeros((0, 3))
        for _ in range(20_000):
            place = rng.uniform(task.low_m, task.high_m)
            if (np.linalg.norm((found - place) * scale, axis=1) > keep_m + 1e-3).all():
                found = np.append(found, place[None], axis=0)
            if len(found) == task.vehicles:
                return found


def scenario(task: Task, network: str, duration: float, seed: int, folder: Path) -> Scenario:
    """A flight of a task; its table of goals is put into a folder."""
    begins, ends = places(task, stream(seed, "published"))
    file = folder / "goals.csv"
    rows = [
        f"{number},{at_s},{x:.4f},{y:.4f},{z:.4f}\n"
        for number, both in enumerate(zip(begins, ends, strict=True), start=1)
        for at_s, (x, y, z) in zip((0.0, GOAL_AT_S), both, strict=True)
    ]
    files.write(file, ("vehicle,t,x,y,z\n" + "".join(rows)).encode())
    table = reading.to_table(reading.load("sphere"))
    table |= {"seed": seed, "duration": duration, "settle": 1.0}
    table["reference"] |= {"shape": "mission", "file": str(file)}
    table["mission"] |= {
        "separation_m": task.separation_m,
        "height_m": task.separation_m * task.stretch,
        "tube_m": task.tube_m - 0.5 * MARGIN_M,  # which Skytether plans with besides
        "acceleration_mps2": 1.0,
    }
    # Places one above the other are no places to land from.
    table["vehicle"] |= {"wind": 0.0, "land_after_s": 0.0}
    table["sensor"] |= {"position_noise_m": 0.00228682, "velocity_noise_mps": 0.0109302}
    way, table["link"]["join_s"] = NETWORKS[network]
    table["network"] |= {"uplink": way, "downlink": way}
    return reading.check(table, "published")


@contextmanager
def timed() -> Iterator[list[float]]:
    """Time that servers plan meanwhile [s], one item a tick."""
    real, spent = MissionPlanner.plan, list[float]()

    def plan(self: MissionPlanner, rows: Indices, step: Indices, found: Foresight) -> None:
        began = time.perf_counter()
        real(self, rows, step, found)
        spent.append(time.perf_counter() - began)

    MissionPlanner.plan = plan  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        MissionPlanner.plan = real  # type: ignore[method-assign]


def fly(task: Task, network: str, duration: float, seed: int) -> TaskFlight:
    """Fly one."""
    with tempfile.TemporaryDirectory() as folder, timed() as spent:
        flown = scenario(task, network, duration, seed, Path(folder))
        goals = flown.make_reference()
        assert isinstance(goals, Mission)
        record = flight.fly(flown, vehicles=task.vehicles)
    told, client, dt_s = record.figures["client"]["by_vehicle"], record.client, flown.control.dt
    each = [client[client["vehicle"] == number] for number in goals.vehicles]
    began_s = [told[str(number)]["began_s"] for number in goals.vehicles]
    least = least_separation(each, began_s, dt_s, flown.mission.height_scale)
    assert least is not None
    arrived_s = []
    for number, rows in zip(goals.vehicles, each, strict=True):
        off = rows["state"][:, :, 0] - goals.goals(number)[-1]
        away = np.flatnonzero(np.linalg.norm(off, axis=1) > ARRIVED_M)
        last = int(away.max(initial=-1)) + 1
        arrived_s.append(last * dt_s - GOAL_AT_S if last < len(rows) else np.nan)
    sent = record.figures["server"]["counts"]["events"]
    return TaskFlight(least, float(np.max(arrived_s)), 1e3 * sum(spent) / max(sent, 1))


def table(options: PublishedOptions) -> TextTable:
    """Fly all."""
    rows = []
    for (name, task), network in progress(list(product(TASKS.items(), NETWORKS)), "cells"):
        seeds = range(1, options.flights + 1)
        done = [fly(task, network, options.duration, seed) for seed in seeds]
        arrived = np.array([each.arrived_s for each in done])
        finite = arrived[np.isfinite(arrived)]
        rows.append(
            [
                f"{name}, {network}",
                f"{min(each.least_m for each in done):.3f}",
                f"{sum(each.least_m < task.separation_m for each in done)} of {len(done)}",
                f"{int((finite <= TOLD_S).sum())}, {len(finite)}",
                f"{np.median(finite):.1f}, {finite.max():.1f}" if len(finite) else "-",
                f"{np.mean([each.plan_ms for each in done]):.2f}",
            ]
        )
    headings = [
        "task, network",
        "least separation\n[m]",
        "flights nearer than\na crash",
        f"all arrived in\n{TOLD_S:g} s, {options.duration:g} s",
        "last arrival\np50, max [s]",
        "planning\na motion [ms]",
    ]
    return TextTable(headings, rows)


def main() -> int:
    """Fly as the command line says, and print a table."""
    options = tyro.cli(PublishedOptions, description=__doc__)
    found = table(options)
    found.show(f"published tasks, {options.flights} flights each")
    if options.markdown:
        files.write(options.markdown, found.markdown().encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
