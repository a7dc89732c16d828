"""Table of the schemes' code: the module of a scheme is loaded when a scenario flies with it.

Each built-in scheme is the module of its name in this package; missions and plug-ins have a room
each.
"""

from collections.abc import Iterator
from contextlib import suppress

from skytether.server.planning.scheme import Fleet, Given, Scheme, SchemeCode
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.kernel import KERNELS
from skytether.shared.scenario import schemes
from skytether.shared.scenario.registry import SCHEMES, load
from skytether.shared.scenario.rooms import SCHEME_APART
from skytether.shared.scenario.schema import Scenario

PLUGINS = f"{__package__}.plugins"
OF_SOME = tuple(
    f"skytether.server.{each}."
    for each in (
        "schemes",
        "missions",
        "planning.splines",
        "mpc.exact",
        "mpc.hierarchical",
        "mpc.riccati",
    )
)
"""Beginnings of the names of modules whose kernels only some schemes call."""


def _code(scenario: Scenario, *, apart: bool = True) -> SchemeCode:
    if apart and scenario.keeps_apart:
        module = load(SCHEME_APART, "missions")
    else:
        name = schemes.call(scenario.control.scheme).name
        at = f"{__package__}.{name}" if SCHEMES[name].is_ours else PLUGINS
        module = load(at, f"control.scheme {name}")
    code: SchemeCode = module.CODE
    return code


def load_all() -> None:
    """Load every built-in scheme and missions, as far as they are installed: what is flown is not
    known yet.
    """
    ours = [f"{__package__}.{name}" for name, entry in SCHEMES.items() if entry.is_ours]
    for module in (*ours, SCHEME_APART):
        with suppress(ConfigError):
            load(module, module)


def make(fleet: Fleet) -> Scheme:
    """Make the scheme that flies a scenario.

    Raises:
        ConfigError: a plug-in's scheme cannot be made.
    """
    return _code(fleet.scenario, apart=fleet.references is not None).make(fleet)


def references(scenario: Scenario, given: Given, most: int) -> Given:
    """Desired trajectories of vehicles, as what flies the scenario sees them.

    Args:
        given: desired trajectories from outside, or None.
        most: largest number of vehicles.
    """
    return _code(scenario).references(scenario, given, most)


def _with_kernels(scenario: Scenario) -> Iterator[str]:
    code = _code(scenario)
    yield code.make.__module__
    yield from (each.__name__ for each in code.kernels(scenario.control.scheme))


def others(*scenarios: Scenario) -> set[str]:
    """Names of the loaded modules whose kernels none of these scenarios calls.

    What they do call is loaded here, before a process compiles it or forks.
    """
    own = [f"{each}." for one in scenarios for each in _with_kernels(one)]
    names = {f"{each.__module__}." for each in KERNELS}
    return {
        each.removesuffix(".")
        for each in names
        if each.startswith(OF_SOME) and not each.startswith(tuple(own))
    }
