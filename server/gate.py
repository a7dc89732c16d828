"""The server's side of the link: who sent a datagram, and how that peer is answered.

`PlainGate` believes everybody. `server.secure` opens what was sealed with a vehicle's key.
"""

from typing import NamedTuple, Protocol

from skytether.shared.core.endpoint import Datagram


class WayBack(Protocol):
    """Way to answer one peer."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries a message to the peer."""


class Call(NamedTuple):
    """A message, and who sent it."""

    payload: bytes
    """The message."""
    vehicle: int | None
    """Number of the vehicle whose key it was sealed with; None where there are no keys."""
    line: WayBack
    """Way to answer it."""
    moves: bool
    """Whether nothing newer has come from the vehicle, so that it may have a new address."""


class Gate(Protocol):
    """Turns datagrams of vehicles into messages."""

    secure: bool
    """Whether what comes out of `open` is known to come from a vehicle with a key."""

    def open(self, datagram: Datagram, *, now_ns: int) -> Call | None:
        """Message in a datagram; None of a step towards one.

        Raises:
            ProtocolError: it is no vehicle's.
        """

    def admit(self, call: Call, *, now_ns: int) -> None:
        """Admit the vehicle that says HELLO in this call: its further packets are opened."""

    def outbox(self) -> list[Datagram]:
        """Datagrams of the gate's own to be sent; each is handed out once."""


class PlainGate:
    """Gate without keys: everybody may pass."""

    secure = False

    def open(self, datagram: Datagram, *, now_ns: int) -> Call:  # noqa: ARG002 - as of any `Gate`
        """See `Gate`."""
        return Call(datagram.payload, None, _AS_IT_IS, moves=True)

    def admit(self, call: Call, *, now_ns: int) -> None:
        """See `Gate`."""

    def outbox(self) -> list[Datagram]:
        """See `Gate`."""
        return []


class _Open:
    """Line without keys."""

    def seal(self, payload: bytes) -> bytes:
        """See `WayBack`."""
        return payload


_AS_IT_IS = _Open()
