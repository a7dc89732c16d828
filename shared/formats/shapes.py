"""Desired trajectories from files: a timed path, or the goals or paths of a mission."""

from skytether.shared.formats import tracks
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import REFERENCES
from skytether.shared.scenario.whole import Scenario


@REFERENCES
def csv(scenario: Scenario) -> Reference:
    """Timed path of one vehicle from `file`, straight from point to point."""
    keys = scenario.reference
    return tracks.path(scenario.table, scenario.model.axes, keys.origin, keys.speed_mps)


@REFERENCES
def mission(scenario: Scenario) -> Reference:
    """Mission with timed goals from `file`; a vehicle rests at each goal."""
    return _mission(scenario, is_show=False)


@REFERENCES
def show(scenario: Scenario) -> Reference:
    """Mission of timed paths from `file`: each point is reached exactly at its time."""
    return _mission(scenario, is_show=True)


def _mission(scenario: Scenario, *, is_show: bool) -> Reference:
    axes, keys = scenario.model.axes, scenario.reference
    found = tracks.tracks(scenario.table, axes, keys.origin, keys.speed_mps)
    return Mission(found, axes, 1, is_show=is_show)
