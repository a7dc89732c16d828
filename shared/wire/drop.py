"""Reasons for dropping a datagram, and the error that contains the reason.

A dropped datagram is an error of the peer or the network. Dropped datagrams are counted by reason
and never answered. Message codec (`protocol`), encryption (`channel`, `handshake`) and both ends
raise the same error. Optional packages define further reasons in their own modules.
"""

from enum import StrEnum


class Drop(StrEnum):
    """Reason for dropping a datagram; the value is its text in logs and its name in metrics."""

    # The datagram is no valid message.
    TOO_LONG = "too long"
    NOT_MSGPACK = "not msgpack"
    NOT_A_MESSAGE = "not a message"
    VERSION = "version"
    TYPE = "type"
    FIELD = "field"
    SHAPE = "shape"
    NOT_FINITE = "not finite"
    INPUT_OUT_OF_RANGE = "input out of range"

    # The message is for another end, or another session.
    ELSEWHERE = "not from the server's address"
    NOT_FOR_A_SERVER = "not for a server"
    NOT_FOR_A_CLIENT = "not for a client"
    OF_ANOTHER_VEHICLE = "of another vehicle"
    """The message names one vehicle, but was encrypted with the key of another."""
    FOR_ANOTHER_LIFE = "for another life"
    """The message answers an earlier run of the client."""
    UNKNOWN_SESSION = "unknown session"
    OTHER_TERMS = "other terms"
    FULL = "full"
    TAKEN = "taken"

    # The packet is not sealed correctly, see `wire.channel` and `wire.handshake`.
    NOT_SEALED = "not sealed"
    LENGTH = "length"
    UNKNOWN_KEY = "unknown key"
    UNKNOWN_CHANNEL = "unknown channel"
    FORGED = "forged"
    REPLAYED = "replayed"
    EXPIRED = "expired"
    UNASKED = "unasked"
    OUT_OF_PLACE = "out of place"
    TOO_MANY_HANDSHAKES = "too many handshakes"

    OVERTAKEN = "overtaken"
    """A message that was sent more than a time-out later has already arrived."""
    COPY = "copy"
    """The message has already arrived over another path."""

    # The observation is impossible, see `server.plausibility`.
    IMPLAUSIBLE_CLOCK = "implausible: clock"
    IMPLAUSIBLE_HORIZON = "implausible: horizon"
    IMPLAUSIBLE_JUMP = "implausible: jump"

    # The horizon is not flown, see `client.compensator`.
    FROM_THE_FUTURE = "from the future"
    OBSERVATION = "observation"
    """The observation from which the horizon was planned is impossible."""
    TOO_OLD = "too old"
    TOO_EARLY = "too early"
    """A mission's motion begins at a step that is in the future of the vehicle."""
    TOO_LATE = "too late"
    """The horizon arrived after its end or `link.join_s`, or too late for its committed inputs."""
    NOT_TAKEN = "not taken"


class ProtocolError(Exception):
    """Error of the peer: its datagram is to be dropped."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
