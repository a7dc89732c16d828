"""Laws to fly an autopilot over a network by set-points alone: the set-point of each step.

With the desired trajectory r, the newest received position y, and its time of measurement t_m:

    velocity   u(t) = r'(t) + k (r(t) - y)
    targets    p(t) = r(t + T), u(t) = r'(t + T): the autopilot regulates
    led        u(t) = r'(t + T) + k (r(t_m) - y(t_m))

T is the time by which set-points lead: delay, dead time and lag together, estimated by hand.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array
from skytether.shared.scenario.reference import Reference

LawName = Literal["velocity", "targets", "led"]
LEAD_MAX_S, GAIN_MAX = 10.0, 10.0
"""Largest lead [s] and gain [1/s]."""


@dataclass(frozen=True)
class LawOptions:
    """Options that choose a law."""

    law: LawName = "led"
    """Law that chooses set-points. velocity: desired velocity plus a share of the distance from the
    newest position; targets: desired position and velocity, which the autopilot regulates; led:
    desired velocity some time ahead, plus a share of the distance at the time of measurement."""
    lead: float | None = None
    """Time by which set-points lead [s], for targets and led; 0 and 1.1 unless given."""
    gain: float | None = None
    """Gain from distance to velocity [1/s], for velocity and led; 0.3 and 0.5 unless given."""


@dataclass(frozen=True, slots=True)
class Law:
    """Law with its numbers; None for a number that it does not use."""

    name: LawName
    lead_s: float | None
    """Time by which set-points lead, T [s]."""
    gain: float | None
    """Gain from the distance to the desired trajectory to velocity, k [1/s]."""


LAWS: dict[LawName, Law] = {
    "velocity": Law("velocity", None, 0.3),
    "targets": Law("targets", 0.0, None),
    "led": Law("led", 1.1, 0.5),
}
"""Laws by name, with the numbers that were fitted by hand to ArduCopter over the paper's network:
`targets` was best with a lead of 0.55 s."""


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
    """Arguments of `skytether station` that choose a law."""
    numbers = {"--lead": law.lead_s, "--gain": law.gain}
    given = [f"{flag}={number}" for flag, number in numbers.items() if number is not None]
    return [f"--law={law.name}", *given]


class Heard(NamedTuple):
    """Position received from the vehicle."""

    time_s: float
    """Time of flight at which it was measured [s]."""
    position: Array
    """Position [m]; shape (axes,)."""


class Setpoint(NamedTuple):
    """Set-point sent to the autopilot."""

    velocity: Array
    """Velocity [m/s]; shape (axes,)."""
    position: Array | None
    """Position [m], shape (axes,); None: only the velocity is set."""


def setpoint(law: Law, reference: Reference, time_s: float, heard: Heard | None) -> Setpoint:
    """Set-point of a step.

    Args:
        law: law that chooses it.
        reference: desired trajectory r.
        time_s: time of flight t [s].
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
