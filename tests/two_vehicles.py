"""Missions of a few vehicles, and two that swap places, for tests of what is planned for them."""

import numpy as np

from skytether.server.common.clock import ClockMap
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState
from skytether.server.missions.vehicle_motions import SentMotion
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.motion import Motion, resting
from skytether.shared.scenario import reading
from skytether.shared.scenario.mission import swap
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import NO_HORIZON, NO_INPUT, Observation

DT_S = 0.05


def scenario(
    vehicles: int, losses: float | str = 0.1, duration: float = 60.0, seed: int = 1
) -> Scenario:
    """Vehicles that swap places."""
    table = reading.to_table(reading.load("swap"))
    table |= {"duration": duration, "seed": seed}
    lost = losses if isinstance(losses, str) else f"loss({losses})"
    table["reference"]["shape"] = f"swap({vehicles})"
    for way in ("uplink", "downlink"):
        table["network"][way] = f"paper(0.4, 0.02, 2.0) & {lost}"
    return reading.check(table, "swap")


def observation(step: int, in_force: int, place: tuple[float, float]) -> Observation:
    """An observation of a vehicle at rest."""
    state = np.array([[place[0], 0.0], [place[1], 0.0]])
    return Observation(1, 1, step, in_force, max(in_force, 0), 0, 0, 3, 1, state, NO_INPUT)


def alone() -> MissionPlanner:
    """Decision for two vehicles that swap places."""
    flown = scenario(2)
    goals = swap(2, 4.0, 2)
    state = MissionState(flown, flown.terms(), 2, 2, goals.of, lambda row: row + 1, exact(2))
    return MissionPlanner(flown, flown.terms(), 2, state)


def exact(vehicles: int) -> ClockMap:
    """Clocks that show what the server's does, for certain."""
    clock = ClockMap(vehicles, round(DT_S * SECOND_NS))
    for row in range(vehicles):
        clock.observe(row, 0, 0, heard=1, now_ns=0)
    return clock


def ready() -> MissionPlanner:
    """Decision for two vehicles that rest where they begin, each on a motion of step 90."""
    made = alone()
    for row, x in ((0, 4.0), (1, -4.0)):
        made.observe(row, observation(100, NO_HORIZON, (x, 0.0)))
        made._state.vehicles[row].in_force = SentMotion(90, resting(100, np.array([x, 0.0])))
        made.observe(row, observation(101, 90, (x, 0.0)))
    return made


def planned(made: MissionPlanner) -> Motion:
    """Motion that is decided for the first vehicle at step 101."""
    made.plan(np.arange(2), np.array([101, 101]), None)  # type: ignore[arg-type]
    motion = made._state.vehicles[0].next
    assert motion is not None
    return motion
