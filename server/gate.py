"""The server's side of the link: who sent a datagram, and how to answer.

`PlainGate` accepts everybody. `server.secure` decrypts packets with the vehicles' keys.
"""

from typing import NamedTuple, Protocol

from skytether.shared.core.endpoint import Datagram


class ReplyPath(Protocol):
    """Encoder of the answers to one peer."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries a message to the peer."""


class GateCall(NamedTuple):
    """A message and its sender."""

    payload: bytes
    """The message."""
    vehicle: int | None
    """Number of the vehicle whose key encrypted it; None without keys."""
    line: ReplyPath
    """Encoder of the answers to it."""
    moves: bool
    """Whether it is the newest packet of the vehicle, which may then change the vehicle's
    address."""


class Gate(Protocol):
    """Converts datagrams of vehicles to messages."""

    secure: bool
    """Whether messages returned by `open` are authenticated."""

    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall | None:
        """Message in a datagram; None if it was part of a handshake.

        Raises:
            ProtocolError: it is not from a vehicle.
        """

    def admit(self, call: GateCall, *, now_ns: int) -> None:
        """Accept the vehicle whose HELLO is in this call: its further packets are opened."""

    def outbox(self) -> list[Datagram]:
        """Datagrams of the gate itself; each is returned once."""


class PlainGate:
    """Gate without keys: accepts everybody."""

    secure = False

    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall:  # noqa: ARG002 - as of any `Gate`
        """See `Gate`."""
        return GateCall(datagram.payload, None, _PLAIN_REPLY, moves=True)

    def admit(self, call: GateCall, *, now_ns: int) -> None:
        """See `Gate`."""

    def outbox(self) -> list[Datagram]:
        """See `Gate`."""
        return []


class _PlainReply:
    """Encoder without encryption."""

    def seal(self, payload: bytes) -> bytes:
        """See `ReplyPath`."""
        return payload


_PLAIN_REPLY = _PlainReply()
