"""The planners of docs/planners.md beside the MPC, over the paper's network: two scenarios, several
seeds, and a stopwatch of CPU time.
"""

import re
import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from bench.harness import Study, TextTable
from skytether.lab.engine.intervals import interval
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.registry import MPC
from skytether.shared.telemetry.summary import summarise
from skytether.shell.commandline import command, plugins
from skytether.shell.commandline.plugins import Plugin
from skytether.sim.flight import fly

PAGE = Path(__file__).parents[1] / "docs" / "planners.md"
SCENARIOS = "demo", "target"
PLANNERS = (MPC, "steer", "convex", "nonlinear")
SEEDS = 20


class Cell(NamedTuple):
    planner: str
    scenario: str
    seed: int


class FlownCell(msgspec.Struct, frozen=True):
    cell: Cell
    rmse_m: float
    packets_per_s: float
    """Packets both ways together [1/s]."""
    plan_ms_p50: float
    plan_ms_p99: float


def documented() -> dict[str, str]:
    """Files of the page by the names of their planners."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return {re.findall(r'@planner\(name="(\w+)"\)', block)[0]: block for block in blocks}


def fly_cell(cell: Cell) -> FlownCell:
    table = reading.to_table(reading.load(cell.scenario))
    set_keys({"seed": cell.seed, "control.planner": cell.planner}, table)
    scenario = reading.check(table, "bench")
    flown = fly(scenario, stopwatch=Stopwatch(time.process_time_ns))
    found = summarise(scenario, cell.scenario, flown.client, flown.server, flown.netem)
    figures = found.rmse_xy, found.packets_per_s, found.solve_ms_p50, found.solve_ms_p99
    assert None not in figures
    return FlownCell(cell, *figures)  # type: ignore[arg-type]


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    rows = []
    for planner in PLANNERS:
        own = [each for each in flights if each.cell.planner == planner]
        row = [f"`{planner}`"]
        for scenario in SCENARIOS:
            runs = [each for each in own if each.cell.scenario == scenario]
            mean, half = interval([each.rmse_m for each in runs])
            packets = np.mean([each.packets_per_s for each in runs])
            row.append(f"{mean:.3f} ± {half or 0.0:.3f}, {packets:.1f}")
        quick, slow = (
            np.median([getattr(f, name) for f in own]) for name in FlownCell.__struct_fields__[3:]
        )
        rows.append([*row, f"{quick:.2f}, {slow:.2f}"])
    headings = ["planner", *(f"`{each}`" for each in SCENARIOS), "a plan"]
    return {"planners": TextTable(headings, rows)}


def cells(seeds: int) -> list[Cell]:
    """Cells; the planners of the page are loaded for them, also in the workers."""
    plugins.use(
        Plugin(str(PAGE.with_name(f"{name}.py")), code.encode())
        for name, code in documented().items()
    )
    kinds = product(SCENARIOS, PLANNERS, range(1, seeds + 1))
    return [Cell(planner, scenario, seed) for scenario, planner, seed in kinds]


STUDY = Study(__doc__, cells, fly_cell, FlownCell, tables, SEEDS)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "planners"))
