"""Limits of a mission's motions, which a vehicle with a standby server compares."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Limits(NamedTuple):
    """Limits within which a server plans the motions of a mission. They may change in flight; two
    servers of a vehicle must plan within the same.
    """

    speed_mps: float
    acceleration_mps2: float
    asymmetry_s: float
    """Bound of the error of clocks, as `link.asymmetry_s` [s]."""
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
