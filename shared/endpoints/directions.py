"""Names of the two directions of a network, for whoever reads or writes them.

A flight has an uplink, to the vehicle, and a downlink. To other programs these are words of modems,
and the other way round, so netem names their directions by the ends.
"""

from collections.abc import Mapping

Directions = tuple[str, str]
"""Names of the direction to the vehicle, or to what takes its place, and of that from it."""
FLIGHT: Directions = ("uplink", "downlink")
RELAY: Directions = ("to_client", "to_server")
"""Packets between clients and a server that are no part of Skytether."""
RUN: Directions = ("to_program", "from_program")
"""Packets of one program."""
KEYS = ("network.uplink", "network.downlink")
"""Keys of a scenario with the impairments of both directions."""


NAMES = {directions: dict(zip(KEYS, directions, strict=True)) for directions in (RELAY, RUN)}
"""What operators call these keys, by key, where it is not a flight."""


def named(text: str, names: Mapping[str, str]) -> str:
    """Sentence with keys replaced by their names."""
    for key, name in names.items():
        text = text.replace(key, name)
    return text
