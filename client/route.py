"""The route from a vehicle to a server over one link; with several paths see `client.paths`."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from skytether.client.link import ClientLink
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import address_text
from skytether.shared.law.heartbeat import Hearing
from skytether.shared.wire.framing import Report
from skytether.shared.wire.protocol import Message, encode


class Conversation(Protocol):
    """Session to which a route belongs."""

    vehicle: int
    number: int | None
    link: ClientLink
    hearing: Hearing

    def note_heard(self, now_ns: int) -> None:
        """Note a packet of the session."""


class Route:
    """One link: an address, and the socket from which it is reached.

    Args:
        addresses: the single address of the server, or of the netem in front of it.
        sockets: number of the socket for each address.
        out: list to which datagrams are appended.
    """

    def __init__(
        self, addresses: Sequence[Address], sockets: Sequence[int], out: list[Datagram]
    ) -> None:
        self.addresses, self._sockets, self._out = addresses, sockets, out

    @property
    def others(self) -> tuple[str, ...]:
        """All addresses except the first, as text."""
        return tuple(address_text(*each) for each in self.addresses[1:])

    @property
    def ends(self) -> Iterable[tuple[int, Address]]:
        """Number of the socket, and address, of each path."""
        return zip(self._sockets, self.addresses, strict=False)

    def put(self, datagram: bytes, path: int = 0) -> None:
        self._out.append(Datagram(datagram, self.addresses[path], self._sockets[path]))

    def greet(self, hello: bytes) -> None:
        """Send a HELLO."""
        self.put(hello)

    def post(self, seal: Callable[[bytes], bytes], message: Message, now_ns: int) -> None:
        """Seal a message and send it."""
        self.put(seal(encode(message)))

    # -- for routes over several paths ----------------------------------------------------------

    def begin(self) -> None:
        """Begin a new session."""

    def is_copy(self, datagram: bytes, path: int) -> bool:
        """Whether the same datagram has already arrived, for example on another path."""
        return False

    def heard(
        self, report: Report, message: Message, datagram: bytes, path: int, now_ns: int
    ) -> None:
        """Note the loss report at the beginning of a datagram of the session."""

    def take(self, session: Conversation, message: Message, path: int, now_ns: int) -> bool:
        """Process a message about paths; False if the message is about something else."""
        return False

    def watch(self, session: Conversation, now_ns: int) -> None:
        """Send the packets that are due; called once a step."""

    def figures(self, now_ns: int) -> dict[str, Any]:
        return {}
