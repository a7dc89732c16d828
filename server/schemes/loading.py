"""Loads the code of schemes before a process compiles kernels, forks or flies."""

from collections.abc import Iterator
from contextlib import suppress

from skytether.server.schemes.table import code_of
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.kernel import KERNELS
from skytether.shared.scenario.registry import SCHEMES, load
from skytether.shared.scenario.rooms import SCHEME_APART
from skytether.shared.scenario.schema import Scenario

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
"""Prefixes of the names of modules whose kernels only some schemes call."""


def load_all() -> None:
    """Load all installed built-in schemes and missions, because the scenario is not known yet."""
    ours = [f"{__package__}.{name}" for name, entry in SCHEMES.items() if entry.is_ours]
    for module in (*ours, SCHEME_APART):
        with suppress(ConfigError):
            load(module, module)


def _with_kernels(scenario: Scenario) -> Iterator[str]:
    code = code_of(scenario)
    yield code.make.__module__
    yield from (each.__name__ for each in code.kernels(scenario.control.scheme))


def others(*scenarios: Scenario) -> set[str]:
    """Names of the loaded modules whose kernels none of these scenarios calls.

    Modules that the scenarios need are loaded here, before a process compiles kernels or forks.
    """
    own = [f"{each}." for one in scenarios for each in _with_kernels(one)]
    names = {f"{each.__module__}." for each in KERNELS}
    return {
        each.removesuffix(".")
        for each in names
        if each.startswith(OF_SOME) and not each.startswith(tuple(own))
    }
