"""Disturbance observer: what else acts on a vehicle, as an input that nobody gave.

Each observation shows by how much the velocity has come away from where the one before leads with
the inputs flown since. That much of it is taken for a disturbance w that has acted all the time:

    w <- w + (1 - e^(-m dt / T)) (w' - w)          w': that which explains the m steps since

with T = `control.observer_s`. Both schemes of delay compensation learn it so, each with the inputs
that it knows of.
"""

import numpy as np

from skytether.server.common.compiled import bounded
from skytether.shared.base.kernel import inline
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig

TRIP_NS = 1_500_000_000
"""Longest trip, from an observation to the plan made from it, that `control.observer_s` is meant
for [ns]; over a longer one an observer as fast as that makes the plans swing."""


def decay_of(terms: Terms, control: ControlConfig) -> float:
    """Share of the error that is left in a step; 1 where nothing is learned."""
    return float(np.exp(-terms.dt_s / control.observer_s)) if control.observer_s else 1.0


@inline
def learned(
    w: float, off: float, m: int, a11: float, decay: float, trip_ns: int, bound: float
) -> float:
    """Disturbance after another observation [m/s], within the bound of inputs.

    Args:
        w: that before [m/s].
        off: how far the velocity is from where w leads in the steps since [m/s].
        m: number of these steps.
        a11: share of the velocity that is left after a step.
        decay: see `decay_of`.
        trip_ns: time from the observation to where planning starts; a long trip makes it slower.
        bound: u_max [m/s].
    """
    # A change of w changes the velocity after m steps by 1 - a11^m of it.
    missing = off / (1.0 - a11**m)
    # Tried at the full speed: the loop swings at round trips beyond 1.5 s (docs/schemes.md).
    slower = max(1.0, trip_ns / TRIP_NS)
    return bounded(w + (1.0 - decay ** (m / slower)) * missing, bound)
