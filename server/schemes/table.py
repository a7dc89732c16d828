"""Code of the schemes: that of ours is the module of its name in this package.

Such a module has

- `make`, which makes the scheme of a `Fleet`, and
- KERNELS, modules and packages whose kernels it calls, beside its own and those that all call.
"""

from importlib import import_module
from types import ModuleType

from skytether.server.common import splines
from skytether.server.common.scheme import Fleet, Scheme
from skytether.server.common.splines import SplineScheme
from skytether.server.schemes import horizons
from skytether.server.schemes.guarded import GuardedScheme
from skytether.server.schemes.horizons import InputScheme
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import schemes
from skytether.shared.scenario.registry import SCHEMES

OURS = {
    name: import_module(f"{__package__}.{name}") for name, entry in SCHEMES.items() if entry.is_ours
}
"""Module of each of our schemes."""


def make(fleet: Fleet) -> Scheme:
    """The scheme that a scenario names.

    Raises:
        ConfigError: a plug-in's scheme cannot be made.
    """
    text = fleet.scenario.control.scheme
    call = schemes.call(text)
    if SCHEMES[call.name].is_ours:
        made: Scheme = OURS[text].make(fleet)
        return made
    other = InputScheme if fleet.terms.splines else SplineScheme
    try:
        inner = SCHEMES.made(call, (), fleet)
        if isinstance(inner, other):
            raise TypeError(f"flown as {fleet.terms.scheme!r}, it is no {other.__name__}")
        return GuardedScheme(text, inner, fleet)
    except Exception as error:
        wrong = f"a scheme that can be made ({type(error).__name__}: {error})"
        raise ConfigError(f"control.scheme: got {text!r}, expected {wrong}") from error


def kernels(text: str) -> tuple[ModuleType, ...]:
    """Modules and packages whose kernels a scheme calls, beside those that all call."""
    if text in OURS:
        return (OURS[text], *OURS[text].KERNELS)
    return (splines if schemes.properties(text).splines else horizons,)
