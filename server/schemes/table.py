"""Table of the schemes' code. Each built-in scheme is the module of its name in this package.

The module of a scheme has

- `make`, which makes the scheme from a `Fleet`, and
- KERNELS, the other modules and packages whose kernels it calls. Kernels that every scheme calls
  are left out.
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


def make(fleet: Fleet) -> Scheme:
    """Make the scheme that a scenario names.

    Raises:
        ConfigError: a plug-in's scheme cannot be made.
    """
    text = fleet.scenario.control.scheme
    call = schemes.call(text)
    if SCHEMES[call.name].is_ours:
        scheme: Scheme = OURS[text].make(fleet)
        return scheme
    other = InputScheme if fleet.terms.splines else SplineScheme
    try:
        inner = SCHEMES.make(call, (), fleet)
        if isinstance(inner, other):
            flown_as = f"flown_as={fleet.terms.scheme!r}"
            raise TypeError(f"a scheme with {flown_as} must not extend {other.__name__}")
        return GuardedScheme(text, inner, fleet)
    except Exception as error:
        wrong = f"a scheme that can be made ({type(error).__name__}: {error})"
        raise ConfigError(f"control.scheme: got {text!r}, expected {wrong}") from error


def kernels(text: str) -> tuple[ModuleType, ...]:
    """Modules and packages whose kernels a scheme calls, without those that every scheme calls."""
    if text in OURS:
        return (OURS[text], *OURS[text].KERNELS)
    return (splines if schemes.properties(text).splines else horizons,)
