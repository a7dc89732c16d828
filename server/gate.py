"""The server's side of the link: authenticates the sender of a datagram, and encodes answers.

`PlainGate` accepts everybody. `server.secure` decrypts packets with the vehicles' keys.
"""

from typing import NamedTuple, Protocol

from skytether.shared.endpoints.endpoint import Datagram


class ReplyPath(Protocol):
    """Encoder of the answers to one peer."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries a message to the peer."""


class GateCall(NamedTuple):
    """Message of a vehicle, and its sender."""

    payload: bytes
    vehicle: int | None
    """Number of the vehicle whose key encrypted the message; None without keys."""
    line: ReplyPath
    """Encoder of the answers to the sender."""
    moves: bool
    """Whether this is the vehicle's newest packet, which sets the vehicle's address."""


class Gate(Protocol):
    """Converts datagrams of vehicles to messages."""

    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall | None:
        """Message in a datagram; None if the datagram was part of a handshake.

        Raises:
            ProtocolError: the datagram is not from a vehicle.
        """

    def repeated(self, datagram: Datagram) -> int | None:
        """Number of the vehicle whose recent packet a datagram repeats; None if it repeats no
        packet.
        """

    def admit(self, call: GateCall, *, now_ns: int) -> None:
        """Accept the sender of this HELLO: from now on the gate decrypts the sender's packets."""

    def outbox(self) -> list[Datagram]:
        """Datagrams that the gate itself has to send; each datagram is returned only once."""


class PlainGate:
    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall:  # noqa: ARG002 - interface of `Gate`
        return GateCall(datagram.payload, None, _PLAIN_REPLY, moves=True)

    def repeated(self, datagram: Datagram) -> int | None:  # noqa: ARG002 - as of any `Gate`
        return None

    def admit(self, call: GateCall, *, now_ns: int) -> None:
        """See `Gate`."""

    def outbox(self) -> list[Datagram]:
        return []


class _PlainReply:
    def seal(self, payload: bytes) -> bytes:
        return payload


_PLAIN_REPLY = _PlainReply()
