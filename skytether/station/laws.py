"""Laws for flying an autopilot over a network by set-points only: the set-point of each step.

With the desired trajectory r, the newest received position y, and its time of measurement t_m:

    velocity   u(t) = r'(t) + k (r(t) - y)
    targets    p(t) = r(t + T), u(t) = r'(t + T): the autopilot regulates
    led        u(t) = r'(t + T) + k (r(t_m) - y(t_m))

T is the lead time of set-points: delay, dead time and lag together, estimated by hand.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import Reference

LawName = Literal["velocity", "targets", "led"]
LEAD_MAX_S, GAIN_MAX = 10.0, 10.0


@dataclass(frozen=True)
class LawOptions:
    law: LawName = "led"
    """Law that chooses set-points. velocity: desired velocity, plus gain times the error of the
    newest position; targets: desired position and velocity, which the autopilot regulates; led:
    desired velocity some time ahead, plus gain times the error at the time of measurement.
    """
    lead: float | None = None
    """Lead time of set-points [s], for targets and led; by default 0 and 1.1."""
    gain: float | None = None
    """Gain from position error to velocity [1/s], for velocity and led; by default 0.3 and 0.5."""


@dataclass(frozen=True, slots=True)
class Law:
    """Law with its numbers; None for a number that it does not use."""

    name: LawName
    lead_s: float | None
    """Lead time of set-points, T [s]."""
    gain: float | None
    """Gain from position error to velocity, k [1/s]."""


LAWS: dict[LawName, Law] = {
    "velocity": Law("velocity", None, 0.3),
    "targets": Law("targets", 0.0, None),
    "led": Law("led", 1.1, 0.5),
}
"""Laws by name, with numbers fitted by hand to ArduCopter over the paper's network; `targets` was
best with a lead of 0.55 s.
"""


def make(name: LawName, lead_s: float | None = None, gain: float | None = None) -> Law:
    """Law with the given numbers, or its defaults.

    Raises:
        ConfigError: a number is out of bounds, or the law does not use it.
    """
    law = LAWS[name]
    return Law(
        name,
        _number("--lead", lead_s, law.lead_s, LEAD_MAX_S, law),
        _number("--gain", gain, law.gain, GAIN_MAX, law),
    )


def _number(
    flag: str, given: float | None, default: float | None, largest: float, law: Law
) -> float | None:
    if given is None:
        return default
    if default is None:
        raise ConfigError(f"{flag}: got {given:g}, expected none with {law.name}")
    if not 0.0 <= given <= largest:
        raise ConfigError(f"{flag}: got {given:g}, expected 0 to {largest:g}")
    return given


def flags(law: Law) -> list[str]:
    numbers = {"--lead": law.lead_s, "--gain": law.gain}
    arguments = [f"{flag}={number}" for flag, number in numbers.items() if number is not None]
    return [f"--law={law.name}", *arguments]


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
    ahead = reference(np.array(time_s + (law.lead_s or 0.0)))
    position, velocity = ahead[:, 0], ahead[:, 1]
    if law.name == "targets":
        return Setpoint(velocity, position)
    if heard is not None and law.gain:
        then_s = heard.time_s if law.name == "led" else time_s
        desired = reference(np.array(then_s))[:, 0]
        velocity = velocity + law.gain * (desired - heard.position)
    return Setpoint(velocity, None)
