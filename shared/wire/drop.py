"""Reasons for dropping a datagram, and the error that carries one.

A dropped datagram is an error of the peer or the network: it is counted by reason and never
answered. Message codec (`protocol`), encryption (`channel`, `handshake`) and both ends raise the
same error. Rooms have further reasons, where they are found.
"""

from enum import StrEnum


class Drop(StrEnum):
    """Why a datagram is dropped; the value is the text for people and the name in metrics."""

    # No message.
    TOO_LONG = "too long"
    NOT_MSGPACK = "not msgpack"
    NOT_A_MESSAGE = "not a message"
    VERSION = "version"
    TYPE = "type"
    FIELD = "field"
    SHAPE = "shape"
    NOT_FINITE = "not finite"
    INPUT_OUT_OF_RANGE = "input out of range"

    # For another end, or another session.
    ELSEWHERE = "not from the server's address"
    NOT_FOR_A_SERVER = "not for a server"
    NOT_FOR_A_CLIENT = "not for a client"
    OF_ANOTHER_VEHICLE = "of another vehicle"
    """The message names another vehicle than the one whose key encrypted it."""
    FOR_ANOTHER_LIFE = "for another life"
    """The message answers an earlier run of the client."""
    UNKNOWN_SESSION = "unknown session"
    OTHER_TERMS = "other terms"
    FULL = "full"
    TAKEN = "taken"

    # Not sealed correctly, see `wire.channel` and `wire.handshake`.
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
    """A message of the session came first that was sent later by more than the time-out."""
    COPY = "copy"
    """The message has come over another path before."""

    # Impossible observations, see `server.plausibility`.
    IMPLAUSIBLE_CLOCK = "implausible: clock"
    IMPLAUSIBLE_HORIZON = "implausible: horizon"
    IMPLAUSIBLE_JUMP = "implausible: jump"

    # Horizons that are not flown, see `client.compensator`:
    FROM_THE_FUTURE = "from the future"
    OBSERVATION = "observation"
    """The observation from which the horizon was planned is impossible."""
    TOO_OLD = "too old"
    TOO_EARLY = "too early"
    """A mission's motion begins at a step that is in the future of the vehicle."""
    TOO_LATE = "too late"
    """Its inputs were due before it came: all of them, or so many that others were flown."""
    NOT_TAKEN = "not taken"


class ProtocolError(Exception):
    """Error of the peer: its datagram is to be dropped."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
