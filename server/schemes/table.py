"""Table of the schemes of delay compensation, by their names in `control.scheme`."""

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

from skytether.server.common import splines
from skytether.server.common.clock import ClockMap
from skytether.server.common.desired import Desired
from skytether.server.common.scheme import Scheme
from skytether.server.mpc import exact, hierarchical
from skytether.server.mpc.hierarchical import Planner
from skytether.server.schemes import (
    committed,
    horizons,
    knots,
    predictive,
    sent_horizons,
    trajectory,
)
from skytether.server.schemes.committed import Replay
from skytether.server.schemes.horizons import HorizonScheme, Predictor
from skytether.server.schemes.predictive import Estimator
from skytether.server.schemes.trajectory import Guidance
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.gain import feedback_gain, regulator
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario


class Fleet(NamedTuple):
    """What a scheme is made for."""

    scenario: Scenario
    terms: Terms
    """The same, as far as both ends agree on it."""
    capacity: int
    """Largest number of vehicles."""
    block: int
    """Largest number of them that are decided on together."""
    clock: ClockMap
    desired: Desired
    """Desired trajectories as far as they are known."""
    references: Callable[[int], Reference] | None
    """Where each vehicle of a mission wants to be, by its number."""
    stopwatch: Stopwatch


class Entry(NamedTuple):
    """A scheme."""

    make: Callable[[Fleet], Scheme]
    kernels: tuple[ModuleType, ...]
    """Modules and packages whose kernels it calls, beside those that all call."""


def _with_planner(fleet: Fleet, predictor: Predictor) -> Scheme:
    control, terms = fleet.scenario.control, fleet.terms
    planner = Planner(control, terms, fleet.desired, fleet.capacity, fleet.block, fleet.stopwatch)
    return HorizonScheme(predictor, planner, terms)


def _predictive(fleet: Fleet) -> Scheme:
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return _with_planner(fleet, Estimator(fleet.terms, control, gain, fleet.capacity))


def _committed(fleet: Fleet) -> Scheme:
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return _with_planner(fleet, Replay(fleet.terms, control, gain, fleet.capacity, fleet.clock))


def _trajectory(fleet: Fleet) -> Scheme:
    return Guidance(
        fleet.terms,
        fleet.scenario.control,
        regulator(fleet.scenario),
        fleet.desired,
        fleet.clock,
        fleet.capacity,
        fleet.block,
    )


SCHEMES = {
    "predictive": Entry(_predictive, (predictive, horizons, hierarchical, exact)),
    "none": Entry(_predictive, (predictive, horizons, hierarchical, exact)),
    "committed": Entry(_committed, (committed, sent_horizons, horizons, hierarchical, exact)),
    "trajectory": Entry(_trajectory, (trajectory, knots, splines, exact)),
}
