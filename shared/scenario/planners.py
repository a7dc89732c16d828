"""Planners of `control.planner`. A plug-in's planner replaces the MPC of eq. (9).

The server makes one planner for each vehicle, and calls its `plan` at every step;
`server.mpc.plugin_planners` checks the result. Prediction, acknowledgements, trigger and failsafe
remain those of the scheme.
"""

from typing import NamedTuple, Protocol, Self

from skytether.shared.law.model import Array, Model
from skytether.shared.scenario.registry import PLANNERS
from skytether.shared.scenario.schema import Scenario

planner = PLANNERS
"""Decorator of a planner: a class with the method `plan`, see `Planner`. Its constructor takes a
`Problem`, and the numbers in brackets after the planner's name."""


class Problem(NamedTuple):
    """Planning problem of one vehicle, passed to the planner's constructor."""

    model: Model
    """Model of the vehicle: `model.step(x, u)` is the state one step later, `model.roll(x, inputs)`
    the states under several inputs; A and B of eq. (4) are `model.A` and `model.B`."""
    dt_s: float
    """Length of a step [s]."""
    horizon: int
    """Number of steps planned ahead, H."""
    axes: int
    u_max: Array
    """Bound of the input on each axis [m/s]; shape (axes,)."""
    scenario: Scenario
    """All keys of the flight; `scenario.control` has the weights of eq. (5)."""

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        terms = scenario.terms()
        model, u_max = Model(*map(_read_only, terms.model)), _read_only(scenario.u_max)
        return cls(model, terms.dt_s, terms.horizon, terms.axes, u_max, scenario)


def _read_only(array: Array) -> Array:
    """Read-only copy of an array, so that no planner can change data that others use."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


class Planner(Protocol):
    """Planner of one vehicle."""

    def plan(self, state: Array, reference: Array, previous: Array) -> Array:
        """Plan of the next H steps.

        A planner may ignore wind: the estimated disturbance is subtracted from its inputs
        afterwards.

        Args:
            state: predicted state of the vehicle at the start of the plan [m, m/s]; shape (axes,
                2). With the scheme "trajectory": state on the trajectory in force.
            reference: desired states from the start of the plan on, extrapolated where unknown
                [m, m/s]; shape (H + 1, axes, 2).
            previous: inputs of the vehicle's previous plan from the start of this plan on, the last
                input repeated [m/s]; 0 if there is no previous plan; shape (axes, H).

        Returns:
            inputs [m/s], shape (axes, H), which are limited to ±u_max; or, with the scheme
            "trajectory", states to follow [m, m/s], shape (H + 1, axes, 2).
        """


@planner
def mpc(problem: Problem) -> None:
    """The MPC of the paper, with the weights of `control`, solved by `control.solver`."""
