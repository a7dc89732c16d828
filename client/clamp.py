"""Last bound on every input, independent of the part of the client that chose the input.

The clamp shares no code with packet decoding or the choice of the input, so an error in these does
not disable the clamp. Only the fence acts later, because an input that leads back inside the fence
may have to change faster than this bound allows.
"""

import math
from collections.abc import Sequence
from typing import Protocol

ROUNDING = 1e-9
"""Excess over the largest speed that counts as a rounding error [m/s]."""


class Guard(Protocol):
    """Limit on inputs that is applied after the bound u_max, such as a fence."""

    holds: bool
    """Whether the guard limited the latest requested input."""

    def limited(
        self, wanted: Sequence[float], state: Sequence[tuple[float, float]], u_max: Sequence[float]
    ) -> list[float]:
        """Input of each axis that the guard allows [m/s].

        Args:
            wanted: chosen input of each axis [m/s].
            state: state in which the input will take effect, of each axis [m, m/s]; the
                position of the first call is home.
            u_max: bound of each axis [m/s].
        """


def clamped(
    wanted: Sequence[float],
    before: Sequence[float],
    u_max: Sequence[float],
    change_max: float,
    *,
    without_feedback: Sequence[float],
    speed_max: float = math.inf,
) -> list[float] | None:
    """Bounded input of each axis [m/s]; None if a number of the chosen input is not finite.

    Args:
        wanted: chosen input of each axis [m/s].
        before: input flown at the previous step, of each axis, within `u_max` [m/s].
        change_max: largest change from `before` on an axis [m/s]; may be infinite.
        without_feedback: part of `wanted` that is not feedback, of each axis [m/s].
        speed_max: largest magnitude of the vector `without_feedback` [m/s].
    """
    # Checked before min and max: with NaN, their results depend on the order of the arguments.
    if not all(map(math.isfinite, (*wanted, *without_feedback))):
        return None
    excess = 0.0
    if speed_max < math.inf:
        speed = math.hypot(*without_feedback)
        excess = 1.0 - speed_max / speed if speed > speed_max + ROUNDING else 0.0
    flown = []
    for u, part, last, most in zip(wanted, without_feedback, before, u_max, strict=True):
        near = min(max(u - excess * part, last - change_max), last + change_max)
        # The bound u_max is applied last, so it always holds. As `before` is within u_max, too,
        # this does not increase the change from `before`.
        flown.append(min(max(near, -most), most))
    return flown
