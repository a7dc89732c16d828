"""PATH, the message that names a session's paths and proves their addresses.

`protocol` has the type number of PATH, and imports this module when such a message is sent or
arrives. Processes in real time import this module before the first packet (`protocol.preload`).
"""

from typing import NamedTuple

from skytether.shared.law.terms import Terms
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shared.wire.protocol import U16, U32, U64, add

PRICE = range(1, 10**9)


class PathProof(NamedTuple):
    """PATH: names the path over which it is sent. The server answers with a proof, and uses the
    path once the client has sent the proof back over this path.
    """

    vehicle: int
    session: int
    path: int
    """Number of the path, from 0."""
    proof: int
    """Number that the server sends only to the address to be proven, and that the client returns; 0
    from a client that has not received it."""
    prices: tuple[int, ...]
    """Price of a packet on each path of the session, in thousandths of the lowest price."""


def _prices(value: object, ours: Terms) -> tuple[int, ...]:  # noqa: ARG001
    if type(value) is not tuple or not 2 <= len(value) <= PATHS_MAX:
        raise ProtocolError(Drop.FIELD)
    if not all(type(price) is int and price in PRICE for price in value):
        raise ProtocolError(Drop.FIELD)
    return value


add(9, PathProof, (U16, U32, range(PATHS_MAX), U64, _prices))
