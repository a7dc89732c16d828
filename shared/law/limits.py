"""Limits of a mission's motions; a vehicle checks that its two servers have the same."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Limits(NamedTuple):
    """Limits of the motions that a server plans for a mission. They may change in flight, and must
    be the same in both servers of a vehicle.
    """

    speed_mps: float
    acceleration_mps2: float
    asymmetry_s: float
    """Value of `link.asymmetry_s` [s], which bounds the error of the clocks."""
    zones: str
    """Digest of the zones."""


LIMITS: Mapping[str, str] = MappingProxyType(
    {
        "speed_mps": "mission.speed_mps",
        "acceleration_mps2": "mission.acceleration_mps2",
        "asymmetry_s": "link.asymmetry_s",
        "zones": "mission.zones",
    }
)
"""Dotted key of each limit of a mission's motions, by the field in `Limits`."""
