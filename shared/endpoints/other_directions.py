"""Names of the two directions of packets of other programs."""

from collections.abc import Mapping

from skytether.shared.endpoints.directions import Directions

RELAY: Directions = ("to_client", "to_server")
"""Directions of packets between a client and a server other than Skytether's."""
RUN: Directions = ("to_program", "from_program")
"""Directions of packets of one program."""
KEYS = ("network.uplink", "network.downlink")
"""Keys of a scenario with the impairments of both directions."""


NAMES = {directions: dict(zip(KEYS, directions, strict=True)) for directions in (RELAY, RUN)}
"""Operator's names of `KEYS`, by key, for packets of other programs."""


def named(text: str, names: Mapping[str, str]) -> str:
    """Sentence with keys replaced by the operator's names, see `NAMES`."""
    for key, name in names.items():
        text = text.replace(key, name)
    return text
