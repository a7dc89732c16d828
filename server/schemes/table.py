"""Table of the schemes' code: the module of a scheme is loaded when a scenario flies with it.

Each built-in scheme is the module of its name in this package; missions and plug-ins have a room
each. The module of a scheme has

- `make`, which makes the scheme from a `Fleet`, and
- perhaps `references`, which makes the desired trajectories of several vehicles, and
- KERNELS, the other modules and packages whose kernels it calls, or `kernels`, if these depend on
  the scheme's text. Kernels that every scheme calls are left out.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import Any

from skytether.server.planning.scheme import Fleet, Scheme
from skytether.shared.base.kernel import KERNELS
from skytether.shared.scenario import schemes
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import SCHEMES, load
from skytether.shared.scenario.schema import Scenario

MISSIONS = "skytether.server.missions.planning"
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


def _module(scenario: Scenario, *, missions: bool = True) -> Any:
    """Module that flies a scenario."""
    if missions and scenario.is_mission:
        return load(MISSIONS, "missions")
    name = schemes.call(scenario.control.scheme).name
    return import_module(f"{__package__}.{name}" if SCHEMES[name].is_ours else PLUGINS)


def _called(scenario: Scenario) -> Iterator[ModuleType]:
    """Module that flies a scenario, and the others whose kernels it calls."""
    module = _module(scenario)
    yield module
    text = scenario.control.scheme
    yield from module.kernels(text) if hasattr(module, "kernels") else module.KERNELS


def load_all() -> None:
    """Load every built-in scheme, and missions: what is flown is not known yet."""
    for name, entry in SCHEMES.items():
        if entry.is_ours:
            import_module(f"{__package__}.{name}")
    import_module(MISSIONS)


def make(fleet: Fleet) -> Scheme:
    """Make the scheme that flies a scenario.

    Raises:
        ConfigError: a plug-in's scheme cannot be made.
    """
    scheme: Scheme = _module(fleet.scenario, missions=fleet.references is not None).make(fleet)
    return scheme


def references(
    scenario: Scenario, given: Callable[[int], Reference] | None, most: int
) -> Callable[[int], Reference] | None:
    """Desired trajectory of each vehicle by its number, as what flies the scenario sees it; None if
    all vehicles have the scenario's.

    Args:
        given: desired trajectories from outside, or None.
        most: largest number of vehicles.
    """
    module = _module(scenario)
    if hasattr(module, "references"):
        seen: Callable[[int], Reference] = module.references(scenario, given, most)
        return seen
    if given is None and scenario.reference.shape == "target":
        return lru_cache(most)(scenario.measured_reference)
    return given


def others(*scenarios: Scenario) -> set[str]:
    """Names of the loaded modules whose kernels none of these scenarios calls.

    What they do call is loaded here, before a process compiles it or forks.
    """
    own = tuple(f"{each.__name__}." for one in scenarios for each in _called(one))
    names = {f"{each.__module__}." for each in KERNELS}
    return {
        each.removesuffix(".")
        for each in names
        if each.startswith(OF_SOME) and not each.startswith(own)
    }
