"""The route from a vehicle to a server: one link. A room may put another in its place, as
`client.paths` does.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from skytether.client.link import ClientLink
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import address_text
from skytether.shared.law.heartbeat import Hearing
from skytether.shared.wire.framing import Report
from skytether.shared.wire.protocol import Message, encode


class Conversation(Protocol):
    """The session to which a route belongs."""

    vehicle: int
    number: int | None
    link: ClientLink
    hearing: Hearing

    def note_heard(self, now_ns: int) -> None:
        """Note a packet of the session."""


class Route:
    """One link: an address, and the socket from which it is reached.

    Args:
        addresses: addresses of the server, or of the netem in front of it: one.
        sockets: number of the socket of each.
        out: list to which datagrams are appended.
    """

    def __init__(
        self, addresses: Sequence[Address], sockets: Sequence[int], out: list[Datagram]
    ) -> None:
        self.addresses, self._sockets, self._out = addresses, sockets, out

    @property
    def others(self) -> tuple[str, ...]:
        """All addresses but the first, in words."""
        return tuple(address_text(*each) for each in self.addresses[1:])

    @property
    def ends(self) -> Iterable[tuple[int, Address]]:
        """Socket and peer of each address."""
        return zip(self._sockets, self.addresses, strict=False)

    def put(self, datagram: bytes, path: int = 0) -> None:
        self._out.append(Datagram(datagram, self.addresses[path], self._sockets[path]))

    def greet(self, hello: bytes) -> None:
        """Send a HELLO."""
        self.put(hello)

    def post(self, seal: Callable[[bytes], bytes], message: Message, now_ns: int) -> None:
        """Seal a message and send it."""
        self.put(seal(encode(message)))

    # -- what a room may add ---------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a new session."""

    def is_copy(self, datagram: bytes, path: int) -> bool:
        """Whether a datagram has come before."""
        return False

    def heard(
        self, report: Report, message: Message, datagram: bytes, path: int, now_ns: int
    ) -> None:
        """Note a report that stood in front of a message of the session."""

    def take(self, session: Conversation, message: Message, path: int, now_ns: int) -> bool:
        """Take a message of the room; False if it has none."""
        return False

    def watch(self, session: Conversation, now_ns: int) -> None:
        """Send what is due; called once a step."""

    def figures(self, now_ns: int) -> dict[str, Any]:
        return {}
