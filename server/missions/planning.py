"""Entry of the mission planner in the table of schemes."""

from collections.abc import Callable

from skytether.server import missions
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState
from skytether.server.planning import splines
from skytether.server.planning.scheme import Fleet, Scheme, SchemeCode
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.missions.mission import Guided, parse_goals
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario


def references(
    scenario: Scenario, given: Callable[[int], Reference] | None, most: int
) -> Callable[[int], Reference]:
    """Function from a vehicle's number to its reference, whose goals may be replaced in flight.

    Args:
        given: references without the scenario's goals; None: the scenario's references.
        most: largest number of vehicles.
    """
    goals = parse_goals(scenario.section(MissionConfig).goals, scenario.model.axes)
    return Guided(given or scenario.measured_reference, goals, most)


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


CODE = SchemeCode(make, lambda _: (missions, splines), references)
