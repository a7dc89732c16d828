"""The planner of missions, as the table of schemes sees it."""

from skytether.server import missions
from skytether.server.common import splines
from skytether.server.common.scheme import Fleet, Scheme
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState

KERNELS = (missions, splines)
"""Package and module whose kernels are called on missions."""


def make(fleet: Fleet) -> Scheme:
    assert fleet.references is not None
    state = MissionState(
        fleet.scenario,
        fleet.terms,
        fleet.capacity,
        fleet.block,
        fleet.references,
        fleet.desired.number,
        fleet.clock,
    )
    return MissionPlanner(fleet, state)
