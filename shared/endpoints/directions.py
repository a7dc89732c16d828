"""Names of the two directions of a network, for input and output.

A flight has an uplink, to the vehicle, and a downlink. For other programs these terms often mean
the opposite, so netem names directions by the ends, see `other_directions`.
"""

Directions = tuple[str, str]
"""Names of two directions: towards the vehicle or another program, and away from it."""
FLIGHT: Directions = ("uplink", "downlink")
