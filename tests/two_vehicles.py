"""Missions of few vehicles: their figures, and a planner for two vehicles that swap places."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState
from skytether.server.missions.vehicle_motions import SentMotion
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.desired import Desired
from skytether.server.planning.scheme import Fleet
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.motion import SPACING, Motion, resting
from skytether.shared.missions.mission import Mission, swap
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record, Rows
from skytether.shared.telemetry.summary import least_separation
from skytether.shared.wire.protocol import NO_HORIZON, NO_INPUT, Mode, Observation

DT_S = 0.05
KEY = frozenset({"mission.zones"})
"""Key that `with_zones` changes."""


def scenario(
    vehicles: int, losses: float | str = 0.1, duration: float = 60.0, seed: int = 1
) -> Scenario:
    table = reading.to_table(reading.load("swap"))
    table |= {"duration": duration, "seed": seed}
    lost = losses if isinstance(losses, str) else f"loss({losses})"
    table["reference"]["shape"] = f"swap({vehicles})"
    for way in ("uplink", "downlink"):
        table["network"][way] = f"paper(0.4, 0.02, 2.0) & {lost}"
    return reading.check(table, "swap")


def with_zones(text: str) -> Scenario:
    """Scenario of two vehicles with zones, which may be in the way of their goals."""
    flown = scenario(2)
    return msgspec.structs.replace(
        flown, mission=msgspec.structs.replace(flown.mission, zones=text)
    )


def observation(step: int, in_force: int, place: tuple[float, float]) -> Observation:
    state = np.array([[place[0], 0.0], [place[1], 0.0]])
    return Observation(1, 1, step, in_force, max(in_force, 0), 0, 0, 3, 1, state, NO_INPUT)


def along(start: list[float], velocity: list[float], *, first: int = 0) -> Motion:
    """Motion over 11 knots with constant velocity between its ends, where it rests."""
    v = np.vstack([np.zeros(len(start)), *[velocity] * 9, np.zeros(len(start))])
    moved = np.cumsum(0.5 * SPACING * DT_S * (v[1:] + v[:-1]), axis=0)
    return Motion(first, np.array(start) + np.vstack([np.zeros(len(start)), moved]), v)


class Decision(MissionPlanner):
    """Mission planner for two vehicles, with its inputs."""

    def __init__(self, fleet: Fleet, state: MissionState) -> None:
        super().__init__(fleet, state)
        self.state, self.vehicles = state, state.vehicles

    def hear(self, row: int, step: int, in_force: int, x: float, speed: float = 0.0) -> None:
        said = observation(step, in_force, (x, 0.0))
        said.state[0, 1] = speed
        self.observe(row, said)

    def align(self, step: int) -> None:
        self.state.align(np.arange(2), np.array([step, step]))

    def decide(self, step: int) -> None:
        self.plan(np.arange(2), np.array([step, step]), None)  # type: ignore[arg-type]


def alone() -> Decision:
    flown = scenario(2)
    goals = swap(2, 4.0, 2)
    terms, clock = flown.terms(), exact(2)
    state = MissionState(flown, terms, 2, 2, goals.of, lambda row: row + 1, clock)
    desired = Desired(flown, terms, 2, 2, goals.of)
    fleet = Fleet(flown, terms, 2, 2, clock, desired, goals.of, Stopwatch(), print)
    return Decision(fleet, state)


def exact(vehicles: int) -> ClockMap:
    """Clock maps with zero offset and no uncertainty."""
    clock = ClockMap(vehicles, round(DT_S * SECOND_NS))
    for row in range(vehicles):
        clock.observe(row, 0, 0, heard=1, now_ns=0)
    return clock


def ready() -> Decision:
    """Planner for two vehicles that rest at their starts, each on a motion of step 90."""
    made = alone()
    for row, x in ((0, 4.0), (1, -4.0)):
        made.hear(row, 100, NO_HORIZON, x)
        made.vehicles[row].in_force = SentMotion(90, resting(100, np.array([x, 0.0])))
        made.hear(row, 101, 90, x)
    return made


def planned(made: Decision) -> Motion:
    made.decide(101)
    motion = made.vehicles[0].next
    assert motion is not None
    return motion


def with_goals(
    folder: Path, rows: str, scenario: Scenario | str = "swap", **mission: Any
) -> dict[str, Any]:
    """Table of a scenario with other goals, whose file is written to a folder.

    Args:
        rows: lines of the file: vehicle, time [s], and place [m]; of three numbers in space.
        scenario: base scenario, or the name of a packaged one.
        mission: keys of the section `mission` to change.
    """
    table = reading.to_table(reading.load(scenario) if isinstance(scenario, str) else scenario)
    table["model"]["axes"] = rows.partition("\n")[0].count(",") - 1
    file = folder / "goals.csv"
    file.write_text(f"vehicle,t,x,y{',z' * (table['model']['axes'] - 2)}\n{rows}")
    table["reference"] |= {"shape": "mission", "file": str(file)}
    table["mission"] |= mission
    return table


def each_of(flown: Record) -> list[Rows]:
    numbers = np.unique(flown.client["vehicle"])
    return [flown.client[flown.client["vehicle"] == number] for number in numbers]


def separation_m(flown: Record, height_scale: float = 1.0) -> float:
    figures = flown.figures["client"]["by_vehicle"]
    began_s = [figures[str(rows["vehicle"][0])]["began_s"] for rows in each_of(flown)]
    least = least_separation(each_of(flown), began_s, DT_S, height_scale)
    assert least is not None
    return least


def left_m(flown: Record, scenario: Scenario) -> list[float]:
    goals = scenario.make_reference()
    assert isinstance(goals, Mission)
    return [
        float(np.linalg.norm(rows["state"][-1, :, 0] - goals.of(number)(np.array(1e3))[:, 0]))
        for rows in each_of(flown)
        for number in [int(rows["vehicle"][0])]
    ]


def clear_m(flown: Record, kept: Zones) -> float:
    """Smallest distance of a vehicle from a zone, from its first motion on [m]."""
    least = np.inf
    for rows in each_of(flown):
        begins = int(np.argmax(rows["mode"] == Mode.TRACK))
        least = min(least, kept.clearance(rows["state"][begins:, :, 0]).min())
    return float(least)


def drawn(rng: np.random.Generator, axes: int = 2, knots: int = 0) -> Motion:
    """Random motion from a place within 4 m, with accelerations up to 0.6 m/s² on an axis."""
    T, knots = SPACING * DT_S, knots or int(rng.integers(1, 17))
    velocity = np.cumsum(rng.uniform(-0.6 * T, 0.6 * T, (knots, axes)), axis=0)
    velocity[-1] = 0.0
    moved = np.cumsum(0.5 * T * (velocity[1:] + velocity[:-1]), axis=0)
    position = rng.uniform(-4.0, 4.0, axes) + np.vstack([np.zeros((1, axes)), moved])
    return Motion(int(rng.integers(10)) * SPACING, position, velocity)
