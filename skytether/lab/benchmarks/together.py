"""Vehicles that swap places over bad networks, and what happens without the guarantee.

    python -m skytether.lab.benchmarks.together

Each cell is so many flights of the scenario `swap` in virtual time: how near two vehicles came, how
often nearer than asked for, and when the last arrived. Beside it fly two planners that forget what
may be flown: one keeps apart from the newest motion of each vehicle, as if every packet arrived,
and one from nothing, as vehicles do that fly to their goals by themselves.
"""

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import tyro

from skytether.lab.benchmarks.harness import TextTable, progress
from skytether.server.control.together import Known
from skytether.shared.law.motion import Motion
from skytether.shared.scenario import reading
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import DirectionConfig, NetworkConfig, Scenario
from skytether.shared.telemetry.summary import least_separation
from skytether.sim import flight

NETWORKS = {
    "no loss": "paper(0.4, 0.02, 2)",
    "10 % lost": "paper(0.4, 0.02, 2) & loss(0.1)",
    "30 %": "paper(0.4, 0.02, 2) & loss(0.3)",
    "50 %": "paper(0.4, 0.02, 2) & loss(0.5)",
    "30 %, bursts of 2 s": "paper(0.4, 0.02, 2) & gilbert_elliott(0.3, 2)",
}
"""Networks, both ways alike."""
PLANNERS: dict[str, Callable[[list[Motion]], list[Motion]]] = {
    "all that may be flown": lambda motions: motions,
    "the newest alone": lambda motions: motions[-1:],
    "nothing": lambda _: [],
}
"""What of the motions of others a planner keeps apart from."""
ARRIVED_M = 0.3
"""Distance from its goal at which a vehicle has arrived [m]."""


@dataclass(frozen=True)
class TogetherOptions:
    """How much to fly."""

    flights: int = 30
    """Flights of each cell."""
    vehicles: int = 16
    duration: float = 120.0
    """Length of a flight [s]."""
    workers: int = 2
    """Number of processes."""
    markdown: Path | None = None
    """File for the table as Markdown."""


class Swap(NamedTuple):
    """What came of a flight."""

    least_m: float
    """Smallest distance between two vehicles [m]."""
    arrived_s: float
    """Time at which the last vehicle was at its goal for good [s]; NaN if one never was."""
    packets: float
    """Packets a second both ways, of a vehicle."""
    left: int
    """Observations of a vehicle outside its tube."""


@contextmanager
def planning(planner: str) -> Iterator[None]:
    """Have the server keep apart from some motions alone."""
    real, some = Known.motions, PLANNERS[planner]

    def motions(self: Known) -> list[Motion]:
        return some(real(self))

    Known.motions = motions  # type: ignore[method-assign]
    try:
        yield
    finally:
        Known.motions = real  # type: ignore[method-assign]


def scenario(network: str, options: TogetherOptions, seed: int) -> Scenario:
    """A flight of a cell."""
    swap = reading.load("swap")
    way = DirectionConfig(impairments=NETWORKS[network])
    reference = msgspec.structs.replace(swap.reference, shape=f"swap({options.vehicles})")
    return msgspec.structs.replace(
        swap,
        seed=seed,
        duration=options.duration,
        reference=reference,
        network=NetworkConfig(uplink=way, downlink=way),
    )


def fly(options: TogetherOptions, cell: tuple[str, str, int]) -> Swap:
    """Fly one."""
    network, planner, seed = cell
    flown = scenario(network, options, seed)
    with planning(planner):
        record = flight.fly(flown, vehicles=options.vehicles)
    told = record.figures["client"]["by_vehicle"]
    client, dt_s = record.client, flown.control.dt
    each = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    began_s = [told[str(rows["vehicle"][0])]["began_s"] for rows in each]
    least = least_separation(each, began_s, dt_s)
    goals = flown.make_reference()
    assert isinstance(goals, Mission)
    assert least is not None
    arrived_s = []
    for rows, began in zip(each, began_s, strict=True):
        goal = goals.of(int(rows["vehicle"][0]))(np.array(options.duration))[:, 0]
        away = np.flatnonzero(np.linalg.norm(rows["state"][:, :, 0] - goal, axis=1) > ARRIVED_M)
        last = int(away.max(initial=-1))
        arrived_s.append(began + (last + 1) * dt_s if last + 1 < len(rows) else np.nan)
    packets = sum(record.figures["netem"][way]["packets"] for way in ("uplink", "downlink"))
    left = record.figures["server"]["counts"].get("left_tube", 0)
    share = options.vehicles * options.duration
    return Swap(least, float(np.max(arrived_s) - min(began_s)), packets / share, left)


def table(options: TogetherOptions) -> TextTable:
    """Fly every cell."""
    kinds = list(product(PLANNERS, NETWORKS))
    rows = []
    with ProcessPoolExecutor(options.workers) as pool:
        for planner, network in progress(kinds, "cells"):
            cells = [(network, planner, seed) for seed in range(1, options.flights + 1)]
            flown = list(pool.map(partial(fly, options), cells))
            least = np.array([each.least_m for each in flown])
            arrived = np.array([each.arrived_s for each in flown])
            asked = reading.load("swap").mission.separation_m
            done = arrived[np.isfinite(arrived)]
            rows.append(
                [
                    f"{planner}, {network}",
                    f"{least.min():.3f}",
                    f"{int((least < asked).sum())} of {len(flown)}",
                    f"{len(done)}",
                    f"{np.median(done):.0f}, {done.max():.0f}" if len(done) else "-",
                    f"{np.mean([each.packets for each in flown]):.2f}",
                    f"{sum(each.left for each in flown)}",
                ]
            )
    headings = [
        "kept apart from, network",
        "least separation\n[m]",
        "flights\nnearer than asked",
        "flights\nin which all arrived",
        "last arrival\np50, max [s]",
        "packets/s\na vehicle",
        "out of a tube",
    ]
    return TextTable(headings, rows)


def main() -> int:
    """Fly as the command line says, and print a table."""
    options = tyro.cli(TogetherOptions, description=__doc__)
    found = table(options)
    found.show(f"{options.vehicles} vehicles swap places, {options.flights} flights a cell")
    if options.markdown:
        options.markdown.write_text(found.markdown())
    return 0


if __name__ == "__main__":
    sys.exit(main())
