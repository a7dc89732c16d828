"""Packets of a measurement: four messages, each one msgpack array in one UDP datagram.

    [version, type, ...]

| type | message | sent by  | fields                                              |
|------|---------|----------|-----------------------------------------------------|
| 1    | HELLO   | prober   | nonce, padding                                      |
| 2    | WELCOME | listener | nonce, cookie, is_granted                           |
| 3    | PROBE   | prober   | session, number, train, held, padding               |
| 4    | ANSWER  | listener | session, number, sent_ns, first, logged, arrivals,  |
|      |         |          | padding                                             |

HELLO and WELCOME have the types that a handshake of `shared.wire.handshake` may carry. The session
id is the nonce, then the cookie. A PROBE is padded to the requested size; its ANSWER is at most as
long.
"""

from struct import Struct
from typing import Any, NamedTuple

import msgpack

from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX

VERSION = 64
"""Protocol version. It differs from that of flights, so that endpoints of flights reject probes."""
NONCE_BYTES = COOKIE_BYTES = 8
SESSION_BYTES = NONCE_BYTES + COOKIE_BYTES
MESSAGE_BYTES_MIN = 96
"""Smallest size of a PROBE [B]: an ANSWER of this size has space for two arrivals."""
TRAIN_MAX = 64
NO_NUMBER = 2**32 - 1
"""Packet number in a PROBE that only requests a report of arrivals, and in its ANSWER."""

_ARRIVAL = Struct("<IQ")
_PADDING = bytes(PAYLOAD_BYTES_MAX)


class ProbeHello(NamedTuple):
    """HELLO: the prober asks for a session."""

    nonce: bytes


class ProbeWelcome(NamedTuple):
    """WELCOME: the listener grants or refuses a session."""

    nonce: bytes
    cookie: bytes
    is_granted: bool
    """Whether the listener grants the session."""


class Probe(NamedTuple):
    """PROBE: packet from the prober to the listener."""

    session: bytes
    number: int
    """Number of the packet, from 0; NO_NUMBER in a request for a report of arrivals."""
    train: int
    """Number of packets of the train that the packet belongs to; 0 for a packet sent alone."""
    held: int
    """Number of arrivals whose reports the prober has received."""


class ProbeAnswer(NamedTuple):
    """ANSWER: packet from the listener to the prober."""

    session: bytes
    number: int
    """Number of the answered arrival, from 0; NO_NUMBER in an answer to a request for a report."""
    sent_ns: int
    """Time of sending the answer, on the listener's clock [ns]."""
    first: int
    """Number of the first arrival in `arrivals`."""
    logged: int
    """Number of arrivals at the listener so far."""
    arrivals: tuple[tuple[int, int], ...]
    """Reported arrivals: PROBE's number, and time of arrival on the listener's clock [ns]."""


Message = ProbeHello | ProbeWelcome | Probe | ProbeAnswer
_TYPES: tuple[type[Message], ...] = (ProbeHello, ProbeWelcome, Probe, ProbeAnswer)


def encode(message: Message, size: int = 0) -> bytes:
    """Encoded message.

    Args:
        size: size of the padded message [B]; the result may be one byte shorter. An ANSWER omits
            arrivals that do not fit.
    """
    fields: tuple[Any, ...] = message
    if isinstance(message, ProbeAnswer):
        free_bytes = size - len(_packed(ProbeAnswer, (*message[:-1], b""), b"")) - 1
        arrivals = message.arrivals[: max(0, free_bytes // _ARRIVAL.size)]
        fields = *message[:-1], b"".join(_ARRIVAL.pack(*each) for each in arrivals)
    if isinstance(message, ProbeWelcome):
        return msgpack.packb((VERSION, 2, *message))
    bare = _packed(type(message), fields, b"")
    free_bytes = size - len(bare)
    # The msgpack header of more than 255 padding bytes is one byte longer.
    return _packed(type(message), fields, _PADDING[: max(0, free_bytes - (free_bytes > 255))])


def _packed(kind: type[Message], fields: tuple[Any, ...], padding: bytes) -> bytes:
    packed: bytes = msgpack.packb((VERSION, _TYPES.index(kind) + 1, *fields, padding))
    return packed


def decode(payload: bytes) -> Message:
    """Decode the message in a datagram, and check every field.

    Raises:
        ProtocolError: the datagram is not one of these messages.
    """
    if len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(Drop.TOO_LONG)
    try:
        fields = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError(Drop.NOT_MSGPACK) from error
    if type(fields) is not tuple or len(fields) < 2:
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    version, number, *body = fields
    if type(version) is not int or version != VERSION:
        raise ProtocolError(Drop.VERSION)
    match number, body:
        case 1, [bytes(nonce), bytes()] if len(nonce) == NONCE_BYTES:
            return ProbeHello(nonce)
        case 2, [bytes(nonce), bytes(cookie), bool(is_granted)] if (
            len(nonce) == NONCE_BYTES and len(cookie) == COOKIE_BYTES
        ):
            return ProbeWelcome(nonce, cookie, is_granted)
        case 3, [bytes(session), int(probe), int(train), int(held), bytes()]:
            _check(session, (probe, held))
            if not 0 <= train <= TRAIN_MAX or isinstance(train, bool):
                raise ProtocolError(Drop.FIELD)
            return Probe(session, probe, train, held)
        case 4, [
            bytes(session),
            int(answer),
            int(sent_ns),
            int(first),
            int(logged),
            bytes(arrived),
            bytes(),
        ]:
            _check(session, (answer, first, logged))
            if not 0 <= sent_ns < 2**63 or len(arrived) % _ARRIVAL.size:
                raise ProtocolError(Drop.FIELD)
            arrivals = tuple(_ARRIVAL.iter_unpack(arrived))
            if first + len(arrivals) > logged or any(at_ns >= 2**63 for _, at_ns in arrivals):
                raise ProtocolError(Drop.FIELD)
            return ProbeAnswer(session, answer, sent_ns, first, logged, arrivals)
    raise ProtocolError(Drop.TYPE if number not in (1, 2, 3, 4) else Drop.FIELD)


def _check(session: bytes, numbers: tuple[int, ...]) -> None:
    """Refuse a session id of wrong length, and numbers out of range.

    Raises:
        ProtocolError: the session id or a number is invalid.
    """
    wrong = any(isinstance(each, bool) or not 0 <= each <= NO_NUMBER for each in numbers)
    if wrong or len(session) != SESSION_BYTES:
        raise ProtocolError(Drop.FIELD)
