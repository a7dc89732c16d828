"""Largest number of vehicles on one shared network, for each scheme.

The vehicles of a flight share one network with the scenario's finite rate. They fly, in the sense
of this module, if all reach the end, none brakes after `settle`, and the root mean square of all
distances from the targets is within a limit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, Literal, Self

import msgspec
import numpy as np

from skytether.figures.tables import to_csv
from skytether.lab.journal import digests
from skytether.shared.base.units import HEADER_BYTES
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import position_error
from skytether.shared.wire.protocol import Mode

Scheme = Literal["paper", "threshold", "budget"]
TITLES: Mapping[Scheme, str] = {
    "paper": "the paper's scheme, a packet at every step",
    "threshold": "trajectories, a threshold for each vehicle",
    "budget": "trajectories, one budget for all vehicles",
}
"""Schemes that are compared, and their titles."""
PAPER = f"{reading.COMPARED}/paper-every-step-target"
"""Scenario with the best weights of the paper's scheme (docs/compare.md)."""
BUDGET_BYTES_PER_S = 10_000.0
"""Rate of the budget, four fifths of the link of the scenario `crowd` [B/s]."""
STEP = 4.0 / 3.0
EXACT = 0.05
"""Relative accuracy of the largest number of vehicles."""


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


@dataclass(frozen=True, slots=True)
class Crowd:
    """Scenario that different numbers of vehicles fly, in virtual time or over real UDP."""

    name: str
    scenario: Scenario
    udp: bool

    def settings(self) -> dict[str, Any]:
        files, table = digests([self.scenario]), reading.to_table(self.scenario)
        return {"name": self.name, "udp": self.udp, "files": files, "scenario": table}

    def of(self, scheme: Scheme) -> Scenario:
        """Scenario of a scheme.

        Raises ConfigError if the scenario cannot be flown with the scheme.
        """
        table = reading.to_table(self.scenario)
        if scheme == "paper":
            best = reading.to_table(reading.load(PAPER))
            table["control"] = best["control"] | {"dt": table["control"]["dt"]}
            table["vehicle"]["report"] = "always"
        table["control"]["shared_bytes_per_s"] = 0.0
        if scheme == "budget":
            rate = self.scenario.control.shared_bytes_per_s
            table["control"]["shared_bytes_per_s"] = rate or BUDGET_BYTES_PER_S
        return reading.check(table, self.name)


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


def points_csv(points: Sequence[CrowdPoint]) -> str:
    return to_csv(CrowdPoint.__struct_fields__, map(msgspec.structs.astuple, points))
