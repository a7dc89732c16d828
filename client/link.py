"""The vehicle's side of the link: how messages become datagrams, and the other way round.

`PlainLink` sends them as they are. `client.secure` seals them with the vehicle's key.
"""

from typing import Protocol

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

HELLO_NS = SECOND_NS
"""Time between two HELLOs in plaintext while nobody has ever answered [ns]."""
AGAIN_NS = 400 * MILLISECOND_NS
"""Time between two HELLOs otherwise [ns]: fewer than the five handshakes a second that a server
grants."""


class ClientLink(Protocol):
    """Turns messages into datagrams for the server, and its datagrams into messages."""

    secure: bool
    """Whether what comes out of `open` is known to come from the server."""
    hello_ns: int
    """Time between two HELLOs while nobody has ever answered [ns]."""

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:
        """Datagram that carries a HELLO."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries any other message."""

    def open(self, datagram: bytes, *, now_ns: int) -> bytes | None:
        """Message in a datagram; None of a step towards one, whose answer is in the outbox.

        Raises:
            ProtocolError: it is not the server's.
        """

    def outbox(self) -> list[bytes]:
        """Datagrams of the link's own for the server; each is handed out once."""

    def adopt(self, *, now_ns: int) -> None:
        """Seal from now on as the WELCOME that was opened last agrees to."""

    def wants_hello(self, now_ns: int) -> bool:
        """Whether new keys are due, which a HELLO gets."""


class PlainLink:
    """Link without keys: anybody may read and write what passes."""

    secure = False
    hello_ns = HELLO_NS

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:  # noqa: ARG002 - as of any `ClientLink`
        """See `ClientLink`."""
        return payload

    def seal(self, payload: bytes) -> bytes:
        """See `ClientLink`."""
        return payload

    def open(self, datagram: bytes, *, now_ns: int) -> bytes:  # noqa: ARG002
        """See `ClientLink`."""
        return datagram

    def outbox(self) -> list[bytes]:
        """See `ClientLink`."""
        return []

    def adopt(self, *, now_ns: int) -> None:
        """See `ClientLink`."""

    def wants_hello(self, now_ns: int) -> bool:  # noqa: ARG002
        """See `ClientLink`."""
        return False
