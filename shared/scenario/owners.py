"""Owners of a scenario's keys, stored as metadata in the type of each key.

    dt: Annotated[float, Meta(ge=0.001, le=1), Key(Owner.BOTH, term="dt_ns")] = 0.05
    observer_s: OfServer[Duration] = 4.0

msgspec and tyro ignore this metadata. `catalogue.py` reads from it which keys are terms of the
flight, and which keys may change in flight.
"""

from enum import Enum, StrEnum, auto
from typing import Annotated, TypeVar

import msgspec


class Owner(Enum):
    """Owner of a key: the end or ends that use the key, and whether their values may differ."""

    BOTH = "both ends"
    """A term of the flight: both ends predict with it, so both must have the same value."""
    EACH = "each end"
    """Key that each end reads from its own scenario."""
    SERVER = "server"
    VEHICLE = "vehicle"
    NETEM = "netem"
    VIRTUAL_TIME = "virtual time"
    """A property of simulated computers and clocks. It has no effect in real time."""


class InFlight(StrEnum):
    """Groups of keys that change together in flight; optional packages add further groups."""

    TRIGGER = auto()
    POINT = auto()
    """Position and velocity of a live point."""
    ARMED = auto()
    LEAP = auto()
    """Operator's choice after a leap of the position."""
    WIND = auto()
    IMPAIRMENT = auto()


class Key(msgspec.Struct, frozen=True):
    owner: Owner
    in_flight: str = ""
    """Group of keys with which this key may change in flight; empty if this key may not change."""
    term: str = ""
    """Field of `Terms` for a key of both ends; empty if the field has the key's name."""
    is_decision: bool = False
    """Whether the key is set in flight only, and forgotten when the process restarts."""


T = TypeVar("T")
Term = Annotated[T, Key(Owner.BOTH)]
OfEach = Annotated[T, Key(Owner.EACH)]
OfServer = Annotated[T, Key(Owner.SERVER)]
OfTrigger = Annotated[T, Key(Owner.SERVER, InFlight.TRIGGER)]
OfVehicle = Annotated[T, Key(Owner.VEHICLE)]
OfWind = Annotated[T, Key(Owner.VEHICLE, InFlight.WIND)]
OfNetem = Annotated[T, Key(Owner.NETEM)]
OfImpairment = Annotated[T, Key(Owner.NETEM, InFlight.IMPAIRMENT)]
OfVirtualTime = Annotated[T, Key(Owner.VIRTUAL_TIME)]
