"""Dead time: an input that is issued at the time t acts from t + θ on.

θ = n Δt + r: n whole steps, and a rest r shorter than a step. So two inputs act within a step, for
the time r still the one of n + 1 steps ago, then that of n steps ago:

    x(k+1) = A x(k) + B u(k-n) + L (u(k-n-1) - u(k-n))          L = B - B(Δt - r)

Nobody has to plan for a dead time (Artstein's reduction). The vehicle knows the inputs that it has
issued and that act later, and with them the state z in which the next one will meet it:

    z(k) = x at k Δt + θ             z(k+1) = A z(k) + B u(k), which is eq. (4)

exactly, for any θ. So z is what a vehicle reports and flies by, and the server plans for z, along
the desired trajectory at k Δt + θ. Each axis has a dead time of its own.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.law.model import Array, Axis, advance, discretise


class DeadTime(NamedTuple):
    """Dead time of one axis."""

    steps: int
    """Number of whole steps n."""
    rest: Axis | None
    """Model over the rest r, eq. (4) with r for Δt; None where there is no rest."""
    late: tuple[float, float]
    """L, for position [s] and velocity; 0 without a rest."""


def dead_time(tau_s: float, dead_time_s: float, dt_ns: int, gain: float = 1.0) -> DeadTime:
    """The dead time of an axis with these numbers; see `shared.law.model.discretise`."""
    steps, rest_ns = divmod(seconds_to_ns(dead_time_s), dt_ns)
    if not rest_ns:
        return DeadTime(steps, None, (0.0, 0.0))
    # B is not linear in time, so B(Δt - r) is discretised anew and not taken as a share of B.
    times_s = (dt_ns / SECOND_NS, (dt_ns - rest_ns) / SECOND_NS, rest_ns / SECOND_NS)
    whole, after, rest = (discretise([tau_s], time_s, gain).axes()[0] for time_s in times_s)
    return DeadTime(steps, rest, (whole.b0 - after.b0, whole.b1 - after.b1))


class OnTheirWay:
    """Inputs that one vehicle has issued, as far back as they still act.

    Args:
        model: eq. (4) of each axis.
        dead_times: dead time of each axis.
    """

    def __init__(self, model: Sequence[Axis], dead_times: Sequence[DeadTime]) -> None:
        self._axes = list(zip(model, dead_times, strict=True))
        # n + 2 inputs: the newest, which is not due yet, back to that of n + 1 steps ago, which
        # still acts for r.
        self._issued = [deque([0.0] * (each.steps + 2), each.steps + 2) for each in dead_times]
        """Inputs of each axis, those of n + 1 steps ago first [m/s]; before the flight 0."""
        self._has_rest = any(each.rest for each in dead_times)

    def issue(self, command: Array) -> tuple[Array, Array | None]:
        """Issue the input of a step, of each axis [m/s].

        Returns:
            what acts at the end of this step on each axis [m/s], and by how much more acts before,
            until the rest r has passed [m/s]; the latter None where no axis has a rest.
        """
        for issued, u in zip(self._issued, command.tolist(), strict=True):
            issued.append(u)
        due = np.array([issued[1] for issued in self._issued])
        if not self._has_rest:
            return due, None
        return due, np.array([issued[0] for issued in self._issued]) - due

    def predict(self, known: Array, disturbance: Array) -> Array:
        """State z in which the next input will meet the vehicle [m, m/s]; shape (axes, 2).

        Args:
            known: state at the end of the step whose input was issued last [m, m/s]; shape (axes,
                2).
            disturbance: what else acts on each axis like an input meanwhile [m/s].
        """
        predicted = []
        axes = zip(self._axes, self._issued, known.tolist(), disturbance.tolist(), strict=True)
        for (model, late), issued, (p, v), w in axes:
            # The input of n + 1 steps ago has ceased to act by the end of this step.
            inputs = iter(issued)
            next(inputs)
            first = next(inputs)
            if late.rest is not None:
                p, v = advance(late.rest, p, v, first + w)  # noqa: PLW2901 - rolled along
            for u in inputs:
                p, v = advance(model, p, v, u + w)  # noqa: PLW2901
            predicted.append((p, v))
        return np.array(predicted)
