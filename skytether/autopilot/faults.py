"""Scripted faults of the simulated autopilot, at times counted from arming."""

import re
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from skytether.autopilot.flavours import FlightMode
from skytether.autopilot.flight import REST, PilotedVehicle, Vector
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.base.units import MILLISECOND_NS, seconds_to_ns

FaultName = Literal[
    "silence",
    "pilot",
    "disarm",
    "battery",
    "estimate",
    "drift",
    "leap",
    "shift",
    "fix",
    "commander",
]
NAMES: tuple[str, ...] = get_args(FaultName)
LASTING = ("silence", "estimate", "drift", "leap", "shift", "fix", "commander")
DRIFT: Vector = (3.5, 0.0, 0.0)
"""True velocity minus estimated velocity with the fault `drift` [m/s]."""
COMMANDED: Vector = (3.0, 0.0, 0.0)
"""Velocity that a second commander sends with the fault `commander` [m/s]."""
COMMANDED_NS = 20 * MILLISECOND_NS
"""Interval of the second commander's set-points [ns]."""
LEAP: Vector = (-12.0, 0.0, 0.0)
"""Displacement of the reported position with the fault `leap` [m]."""
SHIFT: Vector = (3.0, 0.0, 0.0)
"""Shift of the receiver's position with the fault `shift` [m]."""
LOW_CHARGE = 0.05
"""Remaining charge from 0 to 1 after the fault `battery`."""


class ScriptedFault(NamedTuple):
    name: str
    from_ns: int
    until_ns: int | None
    """Time after arming at which the fault ends [ns]; None for a fault that does not end."""


def parse(text: str) -> ScriptedFault:
    """Parse a scripted fault: NAME@SECONDS, or NAME@SECONDS-SECONDS for a fault that ends.

    Raises:
        ConfigError: the text does not describe a fault.
    """
    number = r"(\d+(?:\.\d+)?)"
    match = re.fullmatch(rf"(\w+)@{number}(?:-{number})?", text)
    if match is None:
        expected = "expected NAME@SECONDS or NAME@SECONDS-SECONDS, counted from arming"
        raise ConfigError(f"--fault: got {text!r}, {expected}")
    name, begin, end = match.groups()
    if name not in NAMES:
        raise ConfigError(f"--fault: got {name!r}; {hint(name, NAMES)}")
    if end is not None and (name not in LASTING or float(end) <= float(begin)):
        expected = f"expected an end after the beginning; only {', '.join(LASTING)} can have one"
        raise ConfigError(f"--fault: got {text!r}, {expected}")
    return ScriptedFault(
        name, seconds_to_ns(float(begin)), None if end is None else seconds_to_ns(float(end))
    )


class Script:
    def __init__(self, faults: Sequence[ScriptedFault]) -> None:
        self._waiting = sorted(faults, key=lambda fault: fault.from_ns)
        self._lasting: list[ScriptedFault] = []
        self._commands = False
        self.commanded = COMMANDED
        """Velocity that the second commander sends [m/s]."""
        self.silent = False

    def play(self, flight: PilotedVehicle) -> None:
        if flight.armed_ns is None:
            return
        past_ns = flight.now_ns - flight.armed_ns
        while self._waiting and self._waiting[0].from_ns <= past_ns:
            fault = self._waiting.pop(0)
            self._begin(fault, flight)
            if fault.until_ns is not None:
                self._lasting.append(fault)
        if self._commands and flight.now_ns % COMMANDED_NS == 0:
            flight.want(self.commanded, None)
        for fault in list(self._lasting):
            if fault.until_ns is not None and fault.until_ns <= past_ns:
                self._lasting.remove(fault)
                self._change(fault.name, flight, wrong=False)

    def _begin(self, fault: ScriptedFault, flight: PilotedVehicle) -> None:
        match fault.name:
            case "pilot":
                flight.act(FlightMode.PILOT, "Pilot has taken over")
            case "disarm":
                flight.disarm(force=True)
            case "battery":
                flight.quadrotor.discharge(LOW_CHARGE)
            case name:
                self._change(name, flight, wrong=True)

    def _change(self, name: str, flight: PilotedVehicle, *, wrong: bool) -> None:
        match name:
            case "silence":
                self.silent = wrong
            case "drift":
                flight.drift = DRIFT if wrong else REST
            case "commander":
                self._commands = wrong
            case "leap":
                flight.displaced = LEAP if wrong else REST
            case "shift":
                flight.shift = SHIFT if wrong else REST
            case "fix":
                flight.fixes = not wrong
            case _:
                flight.estimates = not wrong
