"""The vehicle's side of the link: conversion of messages to datagrams, and back.

`PlainLink` does not encrypt messages. `client.secure` encrypts them with the vehicle's key.
"""

from typing import Protocol

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

HELLO_NS = SECOND_NS
"""Time between two HELLOs without keys, until the server first answers."""
AGAIN_NS = 400 * MILLISECOND_NS
"""Time between two HELLOs after the first answer, or with keys; a server allows five a second."""


class ClientLink(Protocol):
    """Converts messages to datagrams for the server, and its datagrams to messages."""

    secure: bool
    """Whether messages returned by `open` are authenticated."""
    hello_ns: int
    """Time between two HELLOs until the server first answers [ns]."""

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:
        pass

    def seal(self, payload: bytes) -> bytes:
        """Datagram with a message of any type except HELLO."""

    def open(self, datagram: bytes, *, now_ns: int) -> bytes | None:
        """Message in a datagram; None for a datagram of the handshake, whose answer is in `outbox`.

        Raises:
            ProtocolError: the datagram is not from the server.
        """

    def outbox(self) -> list[bytes]:
        """Datagrams of the handshake to send to the server; each is returned once."""

    def adopt(self, *, now_ns: int) -> None:
        """Use the keys of the latest WELCOME from now on."""

    def wants_hello(self, now_ns: int) -> bool:
        """Whether a HELLO is needed to get new keys."""


class PlainLink:
    """Link without keys: anybody on the path can read and write."""

    secure = False
    hello_ns = HELLO_NS

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:  # noqa: ARG002 - same signature as in any `ClientLink`
        return payload

    def seal(self, payload: bytes) -> bytes:
        return payload

    def open(self, datagram: bytes, *, now_ns: int) -> bytes:  # noqa: ARG002
        return datagram

    def outbox(self) -> list[bytes]:
        return []

    def adopt(self, *, now_ns: int) -> None:
        pass

    def wants_hello(self, now_ns: int) -> bool:  # noqa: ARG002
        return False
