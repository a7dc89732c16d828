"""A standby server: the first server dies at a random time, and the vehicle flies on."""

import sys
from collections.abc import Sequence

import msgspec
import numpy as np

from bench.harness import Study, TextTable
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.standby import LeaderChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.sim.flight import SERVER, fly

FLIGHT_S, SEEDS = 30.0, 50
DIES_S = 8.0, 25.0
"""First and last time at which the server dies [s]."""
TASKS = ("demo", "demo-committed", "target", "paper")


class Cell(msgspec.Struct, frozen=True):
    task: str
    seed: int


class FlownCell(msgspec.Struct, frozen=True):
    cell: Cell
    changed_s: float
    """Time from the death to the change of the leader [s]."""
    planned_s: float
    """Time from the death to the first plan in force of the new leader [s]."""
    brakes: int
    rmse_m: tuple[float, float]
    """RMSE in the plane of the flight whose first server dies, and of the same flight with a single
    server that does not [m]."""
    error_m: tuple[float, float]
    """Largest error of these two flights [m]."""


def fly_cell(cell: Cell) -> FlownCell:
    table = reading.to_table(reading.load(cell.task))
    set_keys({"duration": FLIGHT_S, "seed": cell.seed, "settle": 6.0}, table)
    scenario = reading.check(table, "bench")
    dies_s = float(stream(cell.seed, "dies").uniform(*DIES_S))
    record = fly(scenario, standby=True, actions=[(dies_s, lambda world: world.stop(SERVER[0]))])
    undisturbed = fly(scenario)
    changed = [each.time_ns for each in record.events if isinstance(each.event, LeaderChanged)]
    changed_s = max(changed, default=np.inf) / SECOND_NS
    brakes = record.client["mode"] == Mode.BRAKE
    figures = [
        summarise(scenario, cell.task, each.client, each.server, each.netem)
        for each in (record, undisturbed)
    ]
    rmse_m, error_m = zip(*((each.rmse_xy, each.error_max) for each in figures), strict=True)
    return FlownCell(
        cell,
        changed_s - dies_s,
        _planned_s(record, changed_s, scenario.control.dt) - dies_s,
        int(np.count_nonzero(brakes[1:] & ~brakes[:-1])),
        rmse_m,
        error_m,
    )


def _planned_s(record: Record, changed_s: float, dt_s: float) -> float:
    """Time at which the first plan made after the change of the leader is in force [s]."""
    rows = record.client
    began_s = record.figures["client"]["by_vehicle"]["1"]["began_s"] % 86_400
    times_s = began_s + rows["step"] * dt_s
    before = rows["in_force"][times_s < changed_s][-1]
    later = times_s[(times_s >= changed_s) & (rows["in_force"] > before)]
    return float(later[0]) if len(later) else np.inf


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    rows = []
    for task in TASKS:
        flown = [each for each in flights if each.cell.task == task]
        changed, planned = ([getattr(each, name) for each in flown] for name in TIMES)
        rmse, error = (np.array([getattr(each, name) for each in flown]) for name in ERRORS)
        rows.append(
            [
                f"`{task}`",
                str(len(flown)),
                str(sum(each.brakes for each in flown)),
                *(_times(each) for each in (changed, planned)),
                " / ".join(f"{each:.3f}" for each in np.sqrt((rmse**2).mean(axis=0))),
                " / ".join(f"{each:.3f}" for each in error.max(axis=0)),
            ]
        )
    headings = ["scenario", "flights", "brakes", "changed", "planned", "RMSE xy", "largest error"]
    return {"standby": TextTable(headings, rows)}


TIMES, ERRORS = ("changed_s", "planned_s"), ("rmse_m", "error_m")


def _times(times_s: Sequence[float]) -> str:
    return ", ".join(f"{each:.2f}" for each in np.quantile(times_s, (0.5, 0.99)))


def cells(seeds: int) -> list[Cell]:
    return [Cell(task, seed) for task in TASKS for seed in range(1, seeds + 1)]


STUDY = Study(__doc__, cells, fly_cell, FlownCell, tables, SEEDS)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "standby"))
