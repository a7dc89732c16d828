"""Entry of plug-ins' schemes in the table of schemes."""

from types import ModuleType

from skytether.server.planning import splines
from skytether.server.planning.scheme import Fleet, Scheme, SchemeCode
from skytether.server.planning.splines import SplineScheme
from skytether.server.schemes import horizons
from skytether.server.schemes.guarded import GuardedScheme
from skytether.server.schemes.horizons import InputScheme
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import schemes
from skytether.shared.scenario.registry import SCHEMES


def make(fleet: Fleet) -> Scheme:
    """Make the scheme that a scenario names.

    Raises:
        ConfigError: the scheme cannot be made.
    """
    text = fleet.scenario.control.scheme
    other = InputScheme if fleet.terms.splines else SplineScheme
    try:
        inner = SCHEMES.make(schemes.call(text), (), fleet)
        if isinstance(inner, other):
            flown_as = f"flown_as={fleet.terms.scheme!r}"
            raise TypeError(f"a scheme with {flown_as} must not extend {other.__name__}")
        return GuardedScheme(text, inner, fleet)
    except Exception as error:
        wrong = f"a scheme that can be made ({type(error).__name__}: {error})"
        raise ConfigError(f"control.scheme: got {text!r}, expected {wrong}") from error


def _kernels(text: str) -> tuple[ModuleType, ...]:
    return (splines if schemes.properties(text).splines else horizons,)


CODE = SchemeCode(make, _kernels)
