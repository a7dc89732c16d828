"""Names of the two directions where no flight is: packets of other programs."""

from collections.abc import Mapping

from skytether.shared.endpoints.directions import Directions

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
