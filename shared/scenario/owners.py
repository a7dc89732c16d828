"""Owners of a scenario's keys, which stand beside each key in its type.

    dt: Annotated[float, Meta(ge=0.001, le=1), Key(Owner.BOTH, term="dt_ns")] = 0.05
    observer_s: OfServer[Duration] = 4.0

msgspec and tyro pass over this metadata. `catalogue.py` collects it: there the terms of a flight
find their keys, and each endpoint the keys that may change in flight.
"""

from enum import Enum, auto
from typing import Annotated, TypeVar

import msgspec


class Owner(Enum):
    """Owner of a key: which end uses its value, and so whether two ends may have different ones."""

    BOTH = "both ends"
    """Value with which both ends predict: a term of the flight, which must be equal."""
    EACH = "each end"
    """Value that each end has for itself."""
    SERVER = "server"
    VEHICLE = "vehicle"
    NETEM = "netem"
    VIRTUAL_TIME = "virtual time"
    """Value that describes the computers in virtual time; real ones are as they are."""


class InFlight(Enum):
    """Group of keys that may get other values in flight, and take effect together."""

    TRIGGER = auto()
    """Rule for sending horizons."""
    POINT = auto()
    """Position and velocity of a live point."""
    ARMED = auto()
    """Whether plans may be flown."""
    ORIGIN = auto()
    """Where the scenario's origin is, of a vehicle in the air that does not know."""
    LEAP = auto()
    """Choice after a leap of the position."""
    WIND = auto()
    """Wind and gusts."""
    IMPAIRMENT = auto()
    """Delay and loss of packets."""
    ZONES = auto()
    """Zones of a mission."""
    GOALS = auto()
    """Goals of a mission that are given in flight."""


class Key(msgspec.Struct, frozen=True):
    """Metadata of a key."""

    owner: Owner
    in_flight: InFlight | None = None
    """Group with which the key may change in flight; None: it may not."""
    term: str = ""
    """Field of `Terms` for a key of both ends; empty: the field has the key's name."""


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
