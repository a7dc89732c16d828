"""Short flight, for targets that read the results of a flight."""

from functools import cache

import msgspec

from skytether.shared.scenario import reading
from skytether.shared.telemetry.record import Record
from skytether.sim.flight import fly

SCENARIO = msgspec.structs.replace(reading.load("demo"), duration=1.0, settle=0.0)
"""Scenario that is flown."""


@cache
def flown() -> Record:
    """Record of the flight."""
    return fly(SCENARIO)
