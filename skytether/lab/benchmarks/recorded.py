"""Schemes over five recorded 5G links: following a target, and on a route known ahead to the
server.

    python -m skytether.lab.benchmarks.recorded

Contenders fly at the weights that `skytether compare` found for them on the paper's network, in
virtual time. Without compensation the server plans from the last observation as if it were of the
present, at every step, with the weights of committed inputs sent at every step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import tyro

from skytether.lab.benchmarks.harness import CONSOLE, TextTable, progress
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import NetworkConfig, Scenario
from skytether.shared.telemetry.summary import summarise
from skytether.sim.flight import fly_batch

LINKS = ("5g-urban", "5g-edge-of-cell", "5g-outage", "5g-rural", "5g-rural-queue")
CASES = ("target", "route")
BY_EVENT = "; reports by event"
NONE = "no compensation, every step"
CONTENDERS = {
    NONE: "feedback-every-step",
    "paper, every step": "paper-every-step",
    "paper, eq. (16)": "paper-event",
    "committed, cost gap": "committed-gap",
    "feedback, every step": "feedback-every-step",
    "feedback, cost gap": "feedback-gap",
    "trajectory, every step": "trajectory-every-step",
    "trajectory, once in a while": "trajectory-periodic",
    "trajectory, expected gap": "trajectory-expected",
    "feedback, cost gap; reports by event": "feedback-gap",
    "trajectory, expected gap; reports by event": "trajectory-expected",
}
"""Contenders, and the tables of compare.toml with their weights."""


@dataclass(frozen=True)
class RecordedBenchmarkOptions:
    """Options of this benchmark."""

    seeds: int = 20
    """Number of flights of each contender over each link."""
    duration: float = 60.0
    """Length of each [s]."""


@dataclass(frozen=True)
class FlownLink:
    """Flights of one contender over one link."""

    rmse_m: float
    """Mean RMSE xy [m]; NaN if it cannot fly."""
    packets: float
    """Mean number of packets a second, both ways."""


def contender(name: str, case: str, link: str, duration_s: float) -> Scenario:
    """Scenario of a contender.

    Raises:
        ConfigError: the scenario cannot be flown over this link.
    """
    scenario = reading.load(f"compare/{CONTENDERS[name]}-{case}")
    table = reading.to_table(scenario)
    if name == NONE:
        table["control"] |= {"scheme": "none", "feedback": False, "observer_s": 0.0}
    if name.endswith(BY_EVENT):
        table["vehicle"]["report"] = "deviation(0.05) | silence(1)"
    table["network"] = msgspec.to_builtins(network(link))
    table["duration"] = duration_s
    return reading.check(table, f"{name}, {case}, {link}")


def network(link: str) -> NetworkConfig:
    """Network texts of a scenario."""
    return reading.load(link).network


def flown(scenario: Scenario, seeds: Sequence[int]) -> FlownLink:
    """Fly a scenario with each seed."""
    rmse, packets = [], []
    for seed, flight in zip(seeds, fly_batch(scenario, seeds), strict=True):
        own = msgspec.structs.replace(scenario, seed=seed)  # the seed also determines the target
        summary = summarise(own, "", flight.client, flight.server, flight.netem)
        rmse.append(np.nan if summary.rmse_xy is None else summary.rmse_xy)
        sent = (summary.uplink_packets or 0) + (summary.downlink_packets or 0)
        packets.append(sent / summary.duration_s)
    return FlownLink(float(np.mean(rmse)), float(np.mean(packets)))


def main() -> int:
    """Fly all, and print a table for each case."""
    options = tyro.cli(RecordedBenchmarkOptions, description=__doc__)
    seeds = range(1, options.seeds + 1)
    for case in CASES:
        table = TextTable(["contender", *(link.removeprefix("5g-") for link in LINKS)], [])
        for name in progress(list(CONTENDERS), case):
            row = []
            for link in LINKS:
                try:
                    cell = flown(contender(name, case, link, options.duration), seeds)
                    row.append(f"{cell.rmse_m:.3f} @ {cell.packets:.1f}")
                except ConfigError as error:
                    CONSOLE.print(str(error))
                    row.append("-")
            table.rows.append([name, *row])
        table.show(f"{case}: RMSE xy [m] @ packets a second, both ways")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
