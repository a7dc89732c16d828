"""Disturbance observer: estimates wind and model errors as an equivalent input ŵ.

From one observation the model predicts the velocity m steps later, with the inputs flown and ŵ. The
observed velocity minus this prediction updates the estimate:

    ŵ ← ŵ + (1 - e^(-m Δt / T)) (w' - ŵ)          w': constant input that explains the difference

with T = `control.observer_s`. The schemes "predictive" and "committed" use this observer, each with
its own record of the flown inputs.
"""

import numpy as np

from skytether.server.planning.compiled import bounded
from skytether.shared.base.kernel import inline
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig

TRIP_NS = 1_500_000_000
"""Longest time from an observation to the start of the plan for which the observer's time constant
is T = `control.observer_s` [ns]. For longer times the observer is slower: with T the control loop
would oscillate."""


def decay_of(terms: Terms, control: ControlConfig) -> float:
    """Share e^(-Δt / T) of the observer's error that remains after a step; 1 without observer."""
    return float(np.exp(-terms.dt_s / control.observer_s)) if control.observer_s else 1.0


@inline
def updated_disturbance(
    w: float, off: float, m: int, a11: float, decay: float, trip_ns: int, bound: float
) -> float:
    """Estimate ŵ after another observation [m/s], limited to ±u_max.

    Args:
        w: previous estimate [m/s].
        off: observed minus predicted velocity [m/s].
        m: number of steps predicted.
        a11: share of the velocity that remains after a step.
        decay: see `decay_of`.
        trip_ns: time from the observation to the start of planning [ns], see `TRIP_NS`.
        bound: u_max [m/s].
    """
    # An input of 1 m/s for m steps changes the velocity by 1 - a11^m.
    missing = off / (1.0 - a11**m)
    # Without this factor the loop oscillates at round trips above 1.5 s (measured,
    # docs/schemes.md).
    slower = max(1.0, trip_ns / TRIP_NS)
    return bounded(w + (1.0 - decay ** (m / slower)) * missing, bound)
