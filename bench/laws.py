"""Laws for flying an autopilot over a network by set-points only: the set-point of each step.

With the desired trajectory r, the newest received position y, and its time of measurement t_m:

    velocity   u(t) = r'(t) + k (r(t) - y)
    targets    p(t) = r(t + T), u(t) = r'(t + T): the autopilot regulates
    lead       u(t) = r'(t + T) + k (r(t_m) - y(t_m))

T is the lead time of set-points: delay, dead time and lag together, estimated by hand.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import Reference


@dataclass(frozen=True, slots=True)
class Law:
    name: Literal["velocity", "targets", "lead"]
    lead_s: float = 0.0
    """Lead time of set-points, T [s]; `velocity` has none."""
    gain: float = 0.0
    """Gain from position error to velocity, k [1/s]; `targets` has none."""


class Heard(NamedTuple):
    time_s: float
    """Time of flight at the measurement [s]."""
    position: Array
    """Position [m]; shape (axes,)."""


class Setpoint(NamedTuple):
    velocity: Array
    """Velocity [m/s]; shape (axes,)."""
    position: Array | None
    """Position [m]; shape (axes,); None if only the velocity is set."""


def setpoint(law: Law, reference: Reference, time_s: float, heard: Heard | None) -> Setpoint:
    """Set-point of a step.

    Args:
        reference: desired trajectory r.
        time_s: time of flight t.
        heard: newest position; None before the first.
    """
    ahead = reference(np.array(time_s + law.lead_s))
    position, velocity = ahead[:, 0], ahead[:, 1]
    if law.name == "targets":
        return Setpoint(velocity, position)
    if heard is not None:
        then_s = heard.time_s if law.name == "lead" else time_s
        desired = reference(np.array(then_s))[:, 0]
        velocity = velocity + law.gain * (desired - heard.position)
    return Setpoint(velocity, None)
