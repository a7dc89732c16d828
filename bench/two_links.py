"""Two links with outages: what a second link buys, and what its packets cost.

Each flight takes a minute, with delays of 50 to 150 ms each way. In an outage a link is out both
ways. Outages have a mean length and cover a share of the time: independently on each link, or half
of them, or all of them, on both links at the same time.
"""

import sys
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Literal, NamedTuple, get_args

import msgspec
import numpy as np

from bench.harness import Study, TextTable
from skytether.shared.base.chance import stream
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.sim.flight import fly

DELAYS = "uniform(0.05, 0.15)"
FLIGHT_S, SEEDS = 60.0, 40
Common = Literal["none", "half", "all"]
Links = Literal["one", "auto", "all"]
"""One link, or two links and `link.spread`."""
TASKS = ("demo", "target")
LENGTHS_S, SHARES = (2.0, 5.0), (0.05, 0.1, 0.2)


class Cell(NamedTuple):
    task: str
    length_s: float
    share: float
    """Share of the time for which a link is out."""
    common: Common
    """Which part of the outages both links have at the same time."""
    links: Links
    seed: int


class FlownCell(msgspec.Struct, frozen=True):
    cell: Cell
    rmse_m: float
    brakes: int
    packets_per_s: float
    """Packets that entered all links, both ways together [1/s]."""


def outages(share: float, length_s: float, seed: int, *names: str | int) -> Iterator[str]:
    """Impairments: outages at random times that cover a share of the flight on average."""
    rng, at_s = stream(seed, "outages", *names), 0.0
    while share:
        at_s += rng.exponential(length_s * (1.0 - share) / share)
        if at_s > FLIGHT_S + 10.0:
            return
        for_s = rng.exponential(length_s)
        yield f"outage({at_s:.2f}, {for_s:.2f})"
        at_s += for_s


def network(cell: Cell) -> dict[str, object]:
    shared = {"none": 0.0, "half": 0.5, "all": 1.0}[cell.common] * cell.share
    common = list(outages(shared, cell.length_s, cell.seed, "both"))
    paths = []
    for link in range(1 if cell.links == "one" else 2):
        own = outages(cell.share - shared, cell.length_s, cell.seed, link)
        text = " & ".join([DELAYS, *common, *own])
        paths.append({"uplink": text, "downlink": text})
    return {"network.paths": paths}


def fly_cell(cell: Cell) -> FlownCell:
    table = reading.to_table(reading.load(cell.task))
    spread = "auto" if cell.links == "one" else cell.links
    set_keys({"duration": FLIGHT_S, "seed": cell.seed, "link.spread": spread}, table)
    set_keys(network(cell), table)
    scenario = reading.check(table, "bench", any_network=True)
    flown = fly(scenario)
    brakes = flown.client["mode"] == Mode.BRAKE
    rmse_m = summarise(scenario, cell.task, flown.client, flown.server, flown.netem).rmse_xy
    return FlownCell(
        cell,
        np.nan if rmse_m is None else rmse_m,
        int(np.count_nonzero(brakes[1:] & ~brakes[:-1])),
        len(flown.netem) / FLIGHT_S,
    )


def cells(seeds: int) -> list[Cell]:
    numbers = range(1, seeds + 1)
    without: tuple[float, float, Common] = (2.0, 0.0, "none")
    kinds = [without, *product(LENGTHS_S, SHARES, get_args(Common))]
    return [
        Cell(task, length_s, share, common, links, seed)
        for task, (length_s, share, common), links, seed in product(
            TASKS, kinds, get_args(Links), numbers
        )
    ]


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    found: dict[tuple[object, ...], list[FlownCell]] = {}
    for each in flights:
        found.setdefault(each.cell[:-1], []).append(each)
    shown = {}
    for task in TASKS:
        rows = []
        for kind in dict.fromkeys(key[1:4] for key in found if key[0] == task):
            length_s, share, common = kind
            row = [f"{share:.0%} of {length_s:g} s, {common} common" if share else "none"]
            rows.append(row + [_figures(found[task, *kind, links]) for links in get_args(Links)])
        headings = ["outages", "one link", "two, `auto`", "two, all copied"]
        shown[f"two links {task}"] = TextTable(headings, rows)
    return shown


def _figures(flown: Sequence[FlownCell]) -> str:
    """RMSE [m], its median, brakes a minute, and packets a second."""
    errors = [each.rmse_m for each in flown]
    brakes, packets = (
        np.mean([getattr(each, name) for each in flown]) for name in ("brakes", "packets_per_s")
    )
    return f"{np.mean(errors):.3f} ({np.median(errors):.3f}), {brakes:.2f}, {packets:.1f}"


STUDY = Study(__doc__, cells, fly_cell, FlownCell, tables, SEEDS)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "two links"))
