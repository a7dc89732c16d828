"""Missions with goals computed from the keys of a scenario: vehicles change places."""

from typing import Annotated

from msgspec import Meta

from skytether.shared.missions import mission
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.schema import Scenario


@REFERENCES
def swap(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: vehicles on a circle of `radius_m`; each vehicle goes to the opposite place."""
    config = scenario.reference
    return mission.swap(vehicles, config.radius_m, scenario.model.axes, config.altitude_m)


@REFERENCES
def sphere(scenario: Scenario, vehicles: Annotated[int, Meta(ge=2, le=1000)] = 16) -> Reference:
    """Mission: vehicles on a sphere of `radius_m`; each vehicle goes to the opposite place."""
    config = scenario.reference
    return mission.sphere(vehicles, config.radius_m, config.altitude_m)
