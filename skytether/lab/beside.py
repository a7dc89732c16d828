"""Baselines beside the contenders of a case: floors, and flights that need no network."""

from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from skytether.lab import floor
from skytether.lab.budgets import Plan
from skytether.lab.contenders import BESIDE, REGULATED
from skytether.lab.journal import digests
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import UPLINK
from skytether.shared.telemetry.summary import Summary
from skytether.sim.flight import fly_batch

PERIODS = (1, 3, 10, 30)
"""Steps between two packets at which the floor is computed."""
RUNS = 4
"""Number of flights for one point of the floor."""


class Floor(msgspec.Struct, frozen=True):
    """Point of a floor, for packets that are sent at fixed times."""

    packets_per_s: float
    """Packets up per second."""
    rmse_m: float
    """Floor of RMSE xy [m]."""


class Baselines(msgspec.Struct, frozen=True):
    """Baselines beside the contenders of a case."""

    floor: list[Floor] = []
    """Points of the floor: for all contenders if only the server sees the target; in wind, for
    those without feedback aboard."""
    aboard: list[Summary] = []
    """Flights with the reference aboard, and no packets; none if only the server knows the
    reference."""


class Work:
    """Flights for the baselines of a case.

    Args:
        plan: plan of the contenders.
    """

    def __init__(self, plan: Plan) -> None:
        scenario, aboard = plan.tuned(BESIDE), plan.tuned(REGULATED)
        self.regular = [
            replace(scenario, control=replace(scenario.control, trigger=f"periodic({period})"))
            for period in PERIODS
        ]
        """Scenarios for the points of the floor."""
        first, runs = scenario.seed, 0 if _is_unknown(scenario) else plan.runs
        self.aboard = [replace(aboard, seed=seed) for seed in range(first, first + runs)]
        """Scenarios with the reference aboard."""

    def settings(self) -> dict[str, Any]:
        """Settings that determine the results, as plain values."""
        return {
            "files": digests(self.regular),
            "periods": list(PERIODS),
            "runs": [RUNS, len(self.aboard)],
            "scenario": reading.to_table(self.regular[0]),
            "aboard": [reading.to_table(each) for each in self.aboard[:1]],
        }


def _is_unknown(scenario: Scenario) -> bool:
    return scenario.reference.shape in floor.UNKNOWN


def floor_of(scenario: Scenario) -> Floor:
    """Floor of a scenario, from the ages in a few flights; called in a worker."""
    flights = fly_batch(scenario, range(scenario.seed, scenario.seed + RUNS))
    floor_m = floor.target_floor_m if _is_unknown(scenario) else floor.wind_floor_m
    packets = sum(int((flight.netem["direction"] == UPLINK).sum()) for flight in flights)
    floors = [floor_m(scenario, flight.client) for flight in flights]
    return Floor(packets / RUNS / scenario.duration, float(np.mean(floors)))


def fly_aboard(scenario: Scenario) -> Summary:
    """Summary of a flight with the reference aboard; called in a worker."""
    return floor.summarise_aboard(scenario, "aboard")
