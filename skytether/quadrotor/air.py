"""Air around a quadrotor: steady wind, and turbulence by Dryden's model, compiled.

    u: σ √(2T) / (1 + T s)      v, w: σ √T (1 + √3 T s) / (1 + T s)²      T = L / V

Filters of white noise give the velocity of the air along the wind (u), across (v) and upwards (w).
V is the speed at which turbulence moves past the vehicle, here the wind speed 6 m above ground.
Lengths L and standard deviations σ at low height are those of MIL-F-8785C:

    σ_w = 0.1 V      σ_u = σ_v = σ_w / c^0.4      L_w = h      L_u = L_v = h / c^1.2
    c = 0.177 + 0.000823 h                        h: height [ft], 10 to 1000
"""

from typing import NamedTuple

import numpy as np

from skytether.quadrotor.body import STEP_S
from skytether.shared.base.kernel import F1, part

FOOT_M = 0.3048
ROOT_3 = 1.7320508075688772


class Air(NamedTuple):
    steady: F1
    """Velocity of the steady wind [m/s; north, east, down]; shape (3,)."""
    turbulence: F1
    """Wind speed 6 m above ground that determines the gusts [m/s]; 0 for no gusts; shape (1,)."""
    gust: F1
    """States of the gust filters: one for u, two for v, two for w [m/s]; shape (5,)."""


@part
def blow(air: Air, drawn: F1, height: float, out: F1) -> None:
    """Compute the velocity of the air over the next step.

    Args:
        drawn: standard normal numbers; shape (3,).
        height: altitude above ground [m].
        out: velocity [m/s; north, east, down]; shape (3,).
    """
    for axis in range(3):
        out[axis] = air.steady[axis]
    speed = air.turbulence[0]
    if speed == 0.0:
        return
    feet = min(max(height / FOOT_M, 10.0), 1000.0)
    c = 0.177 + 0.000823 * feet
    gust, w = air.gust, 0.1 * speed
    u, length = w / c**0.4, feet / c**1.2 * FOOT_M
    keep = np.exp(-STEP_S * speed / length)
    gust[0] = keep * gust[0] + u * np.sqrt(1.0 - keep * keep) * drawn[0]
    _second_order(gust[1:3], keep, u, drawn[1])
    _second_order(gust[3:5], np.exp(-STEP_S * speed / (feet * FOOT_M)), w, drawn[2])
    north, east = air.steady[0], air.steady[1]
    size = np.sqrt(north * north + east * east)
    if size > 0.0:
        north, east = north / size, east / size
    else:
        north, east = 1.0, 0.0
    across = _passed(gust[1:3])
    out[0] += gust[0] * north - across * east
    out[1] += gust[0] * east + across * north
    out[2] += _passed(gust[3:5])


@part
def _second_order(state: F1, keep: float, strength: float, drawn: float) -> None:
    """Advance two first-order lags in series; `strength` is the output's standard deviation."""
    spread = strength / np.sqrt(2.0) * np.sqrt(1.0 - keep * keep)
    state[1] = keep * state[1] + (1.0 - keep) * state[0]
    state[0] = keep * state[0] + spread * drawn


@part
def _passed(state: F1) -> float:
    """Output of the filter (1 + √3 T s) / (1 + T s)², from its two lags."""
    return ROOT_3 * state[0] + (1.0 - ROOT_3) * state[1]
