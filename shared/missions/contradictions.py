"""Contradictions of a mission: values that are each valid, but not together."""

import math
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, speed_bounds
from skytether.shared.missions.derived import clearances, lands, rest_scale, zones
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.missions.mission import Mission, format_goals, parse_goals
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import MPC, PLANNERS, SCHEMES, TRIGGERS, PluginTable
from skytether.shared.scenario.schema import Contradiction, Scenario

TINY = 1e-9
"""Rounding tolerance of times and heights."""
PLACES_MAX = 100_000_000
"""Largest number of positions that are checked in a show, which takes about ten seconds."""


def of_keys(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of keys with which vehicles might not keep apart if packets are lost."""
    control, link, vehicle = scenario.control, scenario.link, scenario.vehicle
    if not _is_one(SCHEMES, control.scheme, "trajectory"):
        yield "control.scheme", repr(control.scheme), "'trajectory' on a mission"
    if not _is_one(PLANNERS, control.planner, MPC):
        expected = f"{MPC!r} on a mission, whose vehicles keep apart by motions of the server's own"
        yield "control.planner", repr(control.planner), expected
    if not _is_one(TRIGGERS, control.trigger, "expected_gap"):
        yield "control.trigger", repr(control.trigger), "'expected_gap' on a mission"
    if vehicle.exhausted != "brake":
        yield "vehicle.exhausted", repr(vehicle.exhausted), "'brake' on a mission"
    most_s = JOIN_MAX * SPACING * control.dt
    if not 0.0 < link.join_s <= most_s + TINY:
        yield "link.join_s", link.join_s, f"more than 0, and at most {most_s:g} s, on a mission"
    mission = scenario.section(MissionConfig)
    if 0.0 < mission.height_m < mission.separation_m - TINY:
        # Heights are scaled by separation_m / height_m. A tube is as high as wide, so that a factor
        # above 1 would make tubes too high.
        expected = f"0, or at least mission.separation_m ({mission.separation_m:g})"
        yield "mission.height_m", mission.height_m, expected
    if vehicle.on_loss == "return":
        expected = "'land' on a mission: all other vehicles expect a vertical landing"
        yield "vehicle.on_loss", repr(vehicle.on_loss), expected
    # A vehicle without packets flies its motion to the end before it brakes.
    longest_s = (INTERVALS + JOIN_MAX) * SPACING * control.dt
    for key, value in (("link.timeout_s", link.timeout_s), ("link.age_max_s", link.age_max_s)):
        if value < longest_s - TINY:
            yield key, value, f"at least {longest_s:g} s on a mission: no motion is longer"


def _is_one(table: PluginTable, text: str, name: str) -> bool:
    """Whether a text consists of the entry `name` alone. Other code reports an invalid text."""
    with suppress(GrammarError):
        return table.one(text).name == name
    return table is PLANNERS


def of_changes(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of zones and goals, the keys of a mission that may change in flight."""
    wrong = list(_no_zones(scenario))
    yield from wrong or _no_goals(scenario)


def _no_zones(scenario: Scenario) -> Iterator[Contradiction]:
    least_m = scenario.section(MissionConfig).tube_m
    try:
        for zone in zones(scenario).zones:
            long_m = float(np.ptp(zone.corners, axis=0).max())
            if long_m < least_m:
                what = f"zones of at least mission.tube_m = {least_m:g} m; this is {long_m:.2g} m"
                yield "mission.zones", zone.name, f"{what} long, in metres"
    except GrammarError as error:
        yield "mission.zones", repr(error.given), error.expected


def _no_goals(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of `mission.goals`: a goal of an unknown vehicle, in a zone, or too near to
    another goal.
    """
    mission = scenario.section(MissionConfig)
    if not mission.goals:
        return
    try:
        goals = parse_goals(mission.goals, scenario.model.axes)
        flown = scenario.unallocated_reference()
    except GrammarError as error:
        yield "mission.goals", repr(error.given), error.expected
        return
    except ValueError:  # reported by `_no_reference`
        return
    assert isinstance(flown, Mission)
    apart_m, clear_m = clearances(scenario).planned_apart_m, clearances(scenario).planned_clear_m
    # Last goals of the other vehicles; with `allocate` they are unknown here, because the server
    # assigns goals to vehicles.
    others = () if mission.allocate else flown.vehicles
    ends = {each: flown.goals(each)[-1] for each in others if each not in goals}
    beside = " to the side" if lands(scenario) else ""
    for vehicle, place in goals.items():
        named = format_goals({vehicle: place})
        near = [each for each, at in ends.items() if _away_m(scenario, at - place) < apart_m]
        ends[vehicle] = place
        if vehicle not in flown.vehicles:
            yield "mission.goals", named, f"vehicles {', '.join(map(str, flown.vehicles))}"
        elif zone := zones(scenario).in_the_way(place[None], clear_m):
            yield "mission.goals", named, f"a place {clear_m:g} m from {zone}"
        elif near:
            yield (
                "mission.goals",
                named,
                f"a place {apart_m:g} m{beside} from the goal of vehicle {near[0]}",
            )


def _away_m(scenario: Scenario, off: Array) -> float:
    return math.hypot(*off[:2], *(rest_scale(scenario) * off[2:]))


def of_places(scenario: Scenario) -> Iterator[Contradiction]:
    """Contradictions of the goals of a mission's shape: too near to each other, or to zones."""
    mission, goals = scenario.section(MissionConfig), scenario.unallocated_reference()
    assert isinstance(goals, Mission)
    if mission.allocate and (goals.is_show or not goals.in_step):
        others = (
            "a mission of goals" if goals.is_show else "goals of all vehicles at the same times"
        )
        yield "mission.allocate", "true", f"false, or {others}"
        return
    wrong = list(_too_fast(scenario, goals))
    yield from wrong
    if wrong:
        return
    around, clear_m = zones(scenario), clearances(scenario).planned_clear_m
    for vehicle in goals.vehicles if around else ():
        places = goals.goals(vehicle)
        if goals.is_show and (zone_name := around.in_the_way(places, clear_m)):
            yield (
                "mission.zones",
                zone_name,
                f"none within {clear_m:g} m of the path of vehicle {vehicle}",
            )
            return
        near = np.argwhere(around.clearance(places) < clear_m)
        if len(near):
            goal, zone = near[0]
            at = ", ".join(f"{each:.3g}" for each in places[goal])
            expected = f"none within {clear_m:g} m of the goal ({at}) of vehicle {vehicle}"
            if around.zones[zone].is_fence:
                expected = (
                    f"a fence {clear_m:g} m around the goal ({at}) of vehicle {vehicle}: "
                    "vehicles stay within all fences"
                )
            yield "mission.zones", around.zones[zone].name, expected
            return
    too_near = goals.nearest(clearances(scenario).planned_apart_m, rest_scale(scenario))
    if too_near:
        one, other, at_s, away_m = too_near
        margin_m = clearances(scenario).margin_m
        most = f"with 2 · mission.tube_m and {margin_m:g} m at most {away_m:.3g} m"
        what = "paths" if goals.is_show else "goals"
        expected = f"{most}, as the {what} of vehicles {one} and {other} at {at_s:.6g} s"
        if lands(scenario):
            expected += " side by side: both may land (vehicle.land_after_s = 0: never)"
        yield "mission.separation_m", mission.separation_m, expected


def _too_fast(scenario: Scenario, show: Mission) -> Iterator[Contradiction]:
    """Contradictions of a show that is too fast for its vehicles, or too large to be checked."""
    asked_mps = scenario.section(MissionConfig).speed_mps
    most_mps = speed_bounds(scenario.u_max, scenario.model_gain, asked_mps)
    if show.is_show and (found := show.too_fast(most_mps)):
        vehicle, at_s, axis, speed_mps = found
        bound = f"{most_mps[axis]:.3g} m/s on an axis, by model.u_max and mission.speed_mps"
        asked = f"vehicle {vehicle} to fly {speed_mps:.3g} m/s from {at_s:.6g} s on"
        expected = f"a show of at most {bound}; this one requires {asked}"
        yield "reference.file", repr(scenario.reference.file), expected
    if show.is_show and (places := show.count_places()) > PLACES_MAX:
        most = f"at most {PLACES_MAX} different times of all points, times vehicles"
        yield "reference.file", repr(scenario.reference.file), f"a show of {most}, got {places}"
