"""Table of the schemes' code: the module of a scheme is loaded when a scenario flies with it.

Each built-in scheme is the module of its name in this package; missions and plug-ins have their own
packages.
"""

from skytether.server.planning.scheme import Fleet, Given, Scheme, SchemeCode
from skytether.shared.scenario import schemes
from skytether.shared.scenario.registry import SCHEMES, load
from skytether.shared.scenario.rooms import SCHEME_APART
from skytether.shared.scenario.schema import Scenario

PLUGINS = f"{__package__}.plugins"


def code_of(scenario: Scenario, *, apart: bool = True) -> SchemeCode:
    """Code of a scenario's scheme; code of missions if `apart` is True and it is a mission."""
    if apart and scenario.keeps_apart:
        module = load(SCHEME_APART, "missions")
    else:
        name = schemes.call(scenario.control.scheme).name
        at = f"{__package__}.{name}" if SCHEMES[name].is_ours else PLUGINS
        module = load(at, f"control.scheme {name}")
    code: SchemeCode = module.CODE
    return code


def make(fleet: Fleet) -> Scheme:
    """Make the scheme, or the mission planner, of a scenario.

    Raises:
        ConfigError: a plug-in's scheme cannot be made.
    """
    return code_of(fleet.scenario, apart=fleet.references is not None).make(fleet)


def references(scenario: Scenario, given: Given, most: int) -> Given:
    """Desired trajectories of vehicles for the scheme, or the missions, of a scenario.

    Args:
        given: desired trajectories from outside, or None.
        most: largest number of vehicles.
    """
    return code_of(scenario).references(scenario, given, most)
