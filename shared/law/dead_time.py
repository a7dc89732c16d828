"""Dead time: an input issued at the time t acts from t + θ on.

θ = n Δt + r: n whole steps, and a remainder r shorter than a step. So two inputs act within a step:
first, for the time r, the input of n + 1 steps ago, then the input of n steps ago:

    x(k+1) = A x(k) + B u(k-n) + L (u(k-n-1) - u(k-n))

where A and B belong to a step of length Δt, B' to a step of length Δt - r, and L = B - B'.

Planning does not have to consider a dead time (Artstein's reduction). The vehicle knows the inputs
that it has issued and that do not act yet. From these inputs the vehicle predicts the state z in
which its next input takes effect:

    z(k) = x at k Δt + θ             z(k+1) = A z(k) + B u(k), which is eq. (4)

exactly, for any θ. So a vehicle uses z in its feedback and its observations, and the server plans
for z, along the desired trajectory at k Δt + θ. Each axis has its own dead time.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Array, Axis, advance, discretise
from skytether.shared.law.terms import Terms


class DeadTime(NamedTuple):
    steps: int
    rest: Axis | None
    """Model of eq. (4) for a step as long as the remainder r; None without a remainder."""
    late: tuple[float, float]
    """Matrix L, for position [s] and velocity; 0 without a remainder."""


def dead_time(tau_s: float, dead_time_s: float, dt_ns: int, gain: float = 1.0) -> DeadTime:
    """Dead time of an axis; arguments as in `shared.law.model.discretise`."""
    steps, rest_ns = divmod(seconds_to_ns(dead_time_s), dt_ns)
    if not rest_ns:
        return DeadTime(steps, None, (0.0, 0.0))
    # B is not linear in time, so B' of the time Δt - r is discretised, not taken as a share of B.
    times_s = (dt_ns / SECOND_NS, (dt_ns - rest_ns) / SECOND_NS, rest_ns / SECOND_NS)
    whole, after, rest = (discretise([tau_s], time_s, gain).axes()[0] for time_s in times_s)
    return DeadTime(steps, rest, (whole.b0 - after.b0, whole.b1 - after.b1))


def dead_times(terms: Terms) -> list[DeadTime]:
    axes = zip(terms.tau_s, terms.dead_time_s, terms.gain, strict=True)
    return [dead_time(tau_s, late_s, terms.dt_ns, gain) for tau_s, late_s, gain in axes]


class PendingInputs:
    """Inputs issued by one vehicle that still act or will act; the arguments have one item per
    axis.
    """

    def __init__(self, model: Sequence[Axis], dead_times: Sequence[DeadTime]) -> None:
        self._axes = list(zip(model, dead_times, strict=True))
        # n + 2 inputs: from the newest input, which does not act yet, back to the input of n + 1
        # steps ago, which still acts for r.
        self._issued = [
            deque([0.0] * (axis_dead_time.steps + 2), axis_dead_time.steps + 2)
            for axis_dead_time in dead_times
        ]
        """Inputs of each axis, oldest (n + 1 steps ago) first [m/s]; 0 before the flight."""
        self._has_rest = any(axis_dead_time.rest for axis_dead_time in dead_times)

    def issue(self, command: Array) -> tuple[Array, Array | None]:
        """Issue the input of a step, of each axis [m/s].

        Returns:
            input that acts on each axis at the end of this step [m/s]; and the input that acts
            before it, for the remainder r, minus this input [m/s], or None if no axis has a
            remainder.
        """
        for issued, u in zip(self._issued, command.tolist(), strict=True):
            issued.append(u)
        due = np.array([issued[1] for issued in self._issued])
        if not self._has_rest:
            return due, None
        return due, np.array([issued[0] for issued in self._issued]) - due

    def predict(self, states: Array, disturbance: Array) -> Array:
        """State z in which the next input takes effect [m, m/s]; shape (axes, 2).

        Args:
            states: state at the end of the step whose input was issued last [m, m/s]; shape
                (axes, 2).
            disturbance: disturbance of each axis until then, as an input [m/s].
        """
        predicted = []
        axes = zip(self._axes, self._issued, states.tolist(), disturbance.tolist(), strict=True)
        for (model, late), issued, (p, v), w in axes:
            # The input of n + 1 steps ago no longer acts at the end of this step.
            inputs = iter(issued)
            next(inputs)
            first = next(inputs)
            if late.rest is not None:
                p, v = advance(late.rest, p, v, first + w)  # noqa: PLW2901 - predicted step by step
            for u in inputs:
                p, v = advance(model, p, v, u + w)  # noqa: PLW2901
            predicted.append((p, v))
        return np.array(predicted)
