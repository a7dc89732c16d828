"""Values of a mission computed from the keys of its scenario."""

import numpy as np

from skytether.shared.law.limits import Limits
from skytether.shared.law.motion import Clearances, bend_m
from skytether.shared.missions import zone_texts
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.schema import Scenario, digest


def clearances(scenario: Scenario) -> Clearances:
    mission = scenario.section(MissionConfig)
    most_mps2 = float(np.sqrt(scenario.model.axes)) * mission.acceleration_mps2
    return Clearances(
        mission.separation_m + 2.0 * mission.tube_m,
        mission.tube_m,
        bend_m(most_mps2, scenario.control.dt),
    )


def lands(scenario: Scenario) -> bool:
    """Whether vehicles of a mission land if no packets arrive; with two axes they never land."""
    return scenario.keeps_apart and scenario.model.axes > 2 and scenario.vehicle.land_after_s > 0.0


def rest_scale(scenario: Scenario) -> float:
    """Factor on vertical distances of resting vehicles; 0 if vehicles may land past each other."""
    return 0.0 if lands(scenario) else scenario.section(MissionConfig).height_scale


def zones(scenario: Scenario) -> Zones:
    """Zones of a mission. If vehicles may land, zones have no upper limit, so that no vehicle lands
    in a zone.

    Raises:
        GrammarError: the text is invalid.
    """
    text = scenario.section(MissionConfig).zones
    parsed = zone_texts.parse(text, scenario.model.axes, scenario.files)
    return parsed.to_the_sky() if lands(scenario) else parsed


def limits(scenario: Scenario) -> Limits:
    """Limits of the motions of a mission."""
    mission = scenario.section(MissionConfig)
    plain = [(zone.corners.tolist(), *zone[2:]) for zone in zones(scenario).zones]
    return Limits(
        speed_mps=mission.speed_mps,
        acceleration_mps2=mission.acceleration_mps2,
        asymmetry_s=scenario.link.asymmetry_s,
        zones=digest(repr(plain).encode() if plain else b""),
    )
