"""Table of the schemes of delay compensation, with their properties.

The code of a built-in scheme is the module of its name in `server.schemes`. A plug-in's scheme is a
class that extends a class of `skytether.plugin_scheme` and has `properties`.
"""

from typing import NamedTuple

from skytether.shared.law.terms import ALONG_SPLINES, COMMITTING, FLOWN_AS
from skytether.shared.scenario.grammar import Call, GrammarError
from skytether.shared.scenario.registry import SCHEMES, Entry

scheme = SCHEMES
"""Decorator of a scheme."""

HELD = "held"
"""Value of `needs` for a trigger that uses the inputs that the vehicle flies without a new plan."""
FIGURES = ("state_gap", "cost_gap", "expected_gap", "deviation_m")
"""Figures of a plan that a scheme may compute; also names of columns in the record."""


class SchemeProperties(NamedTuple):
    """Properties of a scheme that other modules depend on."""

    flown_as: str = "predictive"
    """Built-in scheme with which the vehicle flies the plans of this scheme, one of
    `shared.law.terms.FLOWN_AS`."""
    figures: tuple[str, ...] = ()
    """Figures of a plan that the scheme computes, from FIGURES."""
    feedback: bool | None = None
    """Value of `control.feedback` that the scheme needs; None if both are possible."""
    observes: bool = False
    """Whether the scheme estimates a disturbance, with the time constant `control.observer_s`."""

    @property
    def splines(self) -> bool:
        return self.flown_as in ALONG_SPLINES

    @property
    def computes(self) -> tuple[str, ...]:
        """Figures that the scheme provides to triggers, and HELD if the scheme computes the inputs
        that the vehicle flies without a new plan.
        """
        return (*self.figures, HELD) if self.flown_as in COMMITTING else self.figures


@scheme
def committed() -> SchemeProperties:
    """Horizons of inputs that begin with committed inputs, fixed by horizons sent before."""
    return SchemeProperties("committed", FIGURES, observes=True)


@scheme
def predictive() -> SchemeProperties:
    """The paper's scheme: horizons of inputs, planned from the predicted present state."""
    return SchemeProperties("predictive", ("state_gap",), observes=True)


@scheme
def trajectory() -> SchemeProperties:
    """Desired trajectory as a spline, which a regulator aboard follows."""
    return SchemeProperties("trajectory", FIGURES[1:], feedback=True)


@scheme
def none() -> SchemeProperties:
    """Horizons of inputs, planned from the newest observation without delay compensation."""
    return SchemeProperties("none", ("state_gap",), feedback=False)


def call(text: str) -> Call:
    """Name and arguments of the scheme in `control.scheme`.

    Raises:
        GrammarError: there is no such scheme, or a plug-in's properties are invalid.
    """
    entry = SCHEMES.get(text.partition("(")[0].strip())
    if entry is None:
        raise GrammarError(text, " or ".join(map(repr, SCHEMES)))
    _properties_of(entry)
    return SCHEMES.one(text)


def properties(text: str) -> SchemeProperties:
    """Properties of the scheme in `control.scheme`.

    Raises:
        GrammarError: see `call`.
    """
    return _properties_of(SCHEMES[call(text).name])


def that_compute(need: str) -> list[str]:
    """Names of the schemes that compute the figure a trigger needs."""
    return [name for name, each in SCHEMES.items() if need in _properties_of(each).computes]


def _properties_of(entry: Entry) -> SchemeProperties:
    if entry.is_ours:
        return entry.make()
    name, properties = entry.make.__name__, getattr(entry.make, "properties", None)
    if not isinstance(properties, SchemeProperties):
        raise GrammarError(name, "a class that extends one of skytether.plugin_scheme")
    if properties.flown_as not in FLOWN_AS or not set(properties.figures) <= set(FIGURES):
        expected = f"flown_as from {', '.join(FLOWN_AS)}, and figures from {', '.join(FIGURES)}"
        raise GrammarError(f"{name}: {properties}", expected)
    return properties
