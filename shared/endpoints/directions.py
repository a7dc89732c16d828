"""Names of the two directions of a network, for whoever reads or writes them.

A flight has an uplink, to the vehicle, and a downlink. To other programs these are words of modems,
and the other way round, so netem names their directions by the ends, see `other_directions`.
"""

Directions = tuple[str, str]
"""Names of the direction to the vehicle, or to what takes its place, and of that from it."""
FLIGHT: Directions = ("uplink", "downlink")
