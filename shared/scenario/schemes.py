"""Table of the schemes of delay compensation, with the properties of each.

One of ours has its code in the module of its name in `server.schemes`. One of a plug-in is a class
of `skytether.plugin_scheme` with `properties`.
"""

from typing import NamedTuple

from skytether.shared.law.terms import ALONG_SPLINES, COMMITTING, FLOWN_AS, INDEXED
from skytether.shared.scenario.grammar import Call, GrammarError
from skytether.shared.scenario.registry import SCHEMES, Entry

scheme = SCHEMES
"""Decorator of a scheme."""

HELD = "held"
"""Need of a trigger that reads the inputs which the vehicle flies if nothing is sent."""
FIGURES = ("state_gap", "cost_gap", "expected_gap", "deviation_m")
"""Figures of a plan that a scheme may compute, and the columns of the record that have them."""


class SchemeProperties(NamedTuple):
    """Properties of a scheme that other modules depend on."""

    flown_as: str = "predictive"
    """How a vehicle flies its messages, one of `shared.law.terms.FLOWN_AS`."""
    figures: tuple[str, ...] = ()
    """Figures of a plan that it computes, some of FIGURES."""
    feedback: bool | None = None
    """The one value of `control.feedback` that it can be flown with; None: either."""
    observes: bool = False
    """Whether it estimates a disturbance, with the time constant `control.observer_s`."""
    missions: bool = False
    """Whether a mission may name it: the motions of a mission are sent and flown likewise."""

    @property
    def indexed(self) -> bool:
        """See `Terms.indexed`."""
        return self.flown_as in INDEXED

    @property
    def commits(self) -> bool:
        """See `Terms.commits`."""
        return self.flown_as in COMMITTING

    @property
    def splines(self) -> bool:
        """See `Terms.splines`."""
        return self.flown_as in ALONG_SPLINES

    @property
    def computes(self) -> tuple[str, ...]:
        """Needs of triggers that it meets: its figures, and HELD."""
        return (*self.figures, HELD) if self.commits else self.figures


@scheme
def committed() -> SchemeProperties:
    """Plans of inputs that begin with the committed ones, which the vehicle already flies."""
    return SchemeProperties("committed", FIGURES, observes=True)


@scheme
def predictive() -> SchemeProperties:
    """The paper's: plans of inputs from a state predicted with the inputs of all plans."""
    return SchemeProperties("predictive", ("state_gap",), observes=True)


@scheme
def trajectory() -> SchemeProperties:
    """Desired trajectory as a spline, along which the vehicle regulates itself."""
    return SchemeProperties("trajectory", FIGURES[1:], feedback=True, missions=True)


@scheme
def none() -> SchemeProperties:
    """Plans of inputs from the newest observation, without compensation of any delay."""
    return SchemeProperties("none", ("state_gap",), feedback=False)


def call(text: str) -> Call:
    """The scheme that `control.scheme` names, with its arguments.

    Raises:
        GrammarError: there is none such, or what a plug-in's says of itself cannot be.
    """
    found = SCHEMES.get(text.partition("(")[0].strip())
    if found is None:
        raise GrammarError(text, " or ".join(map(repr, SCHEMES)))
    _said(found)
    return SCHEMES.one(text)


def properties(text: str) -> SchemeProperties:
    """Properties of the scheme that `control.scheme` names.

    Raises:
        GrammarError: see `call`.
    """
    return _said(SCHEMES[call(text).name])


def that_compute(need: str) -> list[str]:
    """Names of the schemes that compute what a trigger needs."""
    return [name for name, each in SCHEMES.items() if need in _said(each).computes]


def _said(entry: Entry) -> SchemeProperties:
    if entry.is_ours:
        return entry.make()
    name, said = entry.make.__name__, getattr(entry.make, "properties", None)
    if not isinstance(said, SchemeProperties):
        raise GrammarError(name, "a class of skytether.plugin_scheme")
    if said.flown_as not in FLOWN_AS or not set(said.figures) <= set(FIGURES):
        known = f"flown_as of {', '.join(FLOWN_AS)}, and figures of {', '.join(FIGURES)}"
        raise GrammarError(f"{name}: {said}", known)
    return said
