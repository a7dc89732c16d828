"""Last clamp before the plant: bounds any input, whichever part of the client chose it.

It shares no code with what reads a packet or chooses an input, so that a mistake there ends here.
"""

import math
from collections.abc import Sequence

ROUNDING = 1e-9
"""Excess of speed that is rounding alone [m/s]."""


def clamped(
    wanted: Sequence[float],
    before: Sequence[float],
    u_max: Sequence[float],
    change_max: float,
    *,
    told: Sequence[float],
    speed_max: float = math.inf,
) -> list[float] | None:
    """The input that may be flown [m/s], or None where it is not finite on some axis.

    Args:
        wanted: input that was chosen, of each axis [m/s].
        before: input that was flown until now, of each axis, within `u_max` [m/s].
        u_max: bound of each axis [m/s].
        change_max: largest change from `before` on an axis [m/s]; may be infinite.
        told: part of it that is no feedback, of each axis [m/s].
        speed_max: bound of the magnitude of this part over all axes, within `ROUNDING` [m/s].
    """
    # Before any min and max: with a NaN their result depends on the order of their arguments.
    if not all(map(math.isfinite, (*wanted, *told))):
        return None
    excess = 0.0
    if speed_max < math.inf:
        speed = math.hypot(*told)
        excess = 1.0 - speed_max / speed if speed > speed_max + ROUNDING else 0.0
    flown = []
    for u, part, last, most in zip(wanted, told, before, u_max, strict=True):
        near = min(max(u - excess * part, last - change_max), last + change_max)
        # The bound comes last and so always holds; `before` is within it, so that the largest
        # change holds too.
        flown.append(min(max(near, -most), most))
    return flown
