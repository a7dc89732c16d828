"""Packets of the handshake that opens a channel. Integers are little-endian.

| type | packet     | sent by | header | then                                            | bytes |
|------|------------|---------|--------|-------------------------------------------------|-------|
| 1    | INITIATION | client  | 5      | cookie 16, Noise message 1 (475), MAC 16        | 512   |
| 2    | CHALLENGE  | server  | 5      | cookie 16, MAC 16                               | 37    |
| 3    | RESPONSE   | server  | 5      | channel u32, Noise message 2 (48 + WELCOME),    | < 512 |
|      |            |         |        | MAC 16                                          |       |

The header is version u8, type u8, vehicle u16 and the number of the vehicle's key u8. The MAC is a
keyed BLAKE2s over everything before the MAC; in an answer also over the client's ephemeral key. So
a packet from another peer, or for another attempt, is dropped before any costly computation. The
HELLO in message 1 is padded, so that no answer is longer than its request.
"""

import hashlib
import hmac
import struct
from typing import NamedTuple

from skytether.shared.wire.channel import VERSION
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import split
from skytether.shared.wire.keys import VehicleKey
from skytether.shared.wire.noise_nnpsk0 import MESSAGE_BYTES
from skytether.shared.wire.protocol import kind_of

INITIATION, CHALLENGE, RESPONSE = 1, 2, 3

HEADER = struct.Struct("<BBHB")
"""Version, type, vehicle and number of the key."""
CHANNEL = struct.Struct("<I")
COOKIE_BYTES = 16
MAC_BYTES = 16
INITIATION_BYTES = 512
"""Size of an INITIATION [B]. No answer is larger."""
CHALLENGE_BYTES = HEADER.size + COOKIE_BYTES + MAC_BYTES
RESPONSE_BYTES_MIN = HEADER.size + CHANNEL.size + MESSAGE_BYTES + MAC_BYTES
NO_COOKIE = bytes(COOKIE_BYTES)
"""Cookie in the INITIATION of a client that has not received a cookie."""

_GREETINGS = (1, 2)
_PROLOGUE = b"skytether 1"
_COOKIE_END = HEADER.size + COOKIE_BYTES
_PADDED_BYTES = INITIATION_BYTES - _COOKIE_END - MESSAGE_BYTES - MAC_BYTES
HELLO_BYTES_MAX = _PADDED_BYTES - 1
WELCOME_BYTES_MAX = INITIATION_BYTES - RESPONSE_BYTES_MIN


class Initiation(NamedTuple):
    cookie: bytes
    message: bytes


class Response(NamedTuple):
    channel: int
    message: bytes


def check_place(message: bytes, *, in_handshake: bool) -> None:
    """Refuse a HELLO or WELCOME in a channel, and any other message in a handshake.

    An attacker may replay a packet of the handshake, so it must contain no other message.

    Raises:
        ProtocolError: the message is in the wrong place, even if its sender has the key.
    """
    kind = kind_of(split(message)[1])
    if kind is None or (kind in _GREETINGS) != in_handshake:
        raise ProtocolError(Drop.OUT_OF_PLACE)


def prologue(key: VehicleKey) -> bytes:
    """Prologue of a handshake, the same at both ends: protocol, vehicle and number of the key."""
    return _PROLOGUE + _header(key, INITIATION)


def pad(hello: bytes) -> bytes:
    """HELLO padded for message 1: followed by a byte 0x80, then zeros."""
    assert len(hello) <= HELLO_BYTES_MAX
    return (hello + b"\x80").ljust(_PADDED_BYTES, b"\0")


def unpad(padded: bytes) -> bytes:
    # The byte 0x80 marks the end of the message, because a HELLO itself may end with zeros.
    return padded.rstrip(b"\0")[:-1]


def write_initiation(key: VehicleKey, cookie: bytes, message: bytes) -> bytes:
    packet = _sealed(key, _header(key, INITIATION) + cookie + message)
    assert len(packet) == INITIATION_BYTES
    return packet


def write_challenge(key: VehicleKey, cookie: bytes, public: bytes) -> bytes:
    """CHALLENGE from its parts; `public` is the client's ephemeral key."""
    return _sealed(key, _header(key, CHALLENGE) + cookie, public)


def write_response(key: VehicleKey, channel: int, message: bytes, public: bytes) -> bytes:
    """RESPONSE from its parts; `public` is the client's ephemeral key."""
    packet = _sealed(key, _header(key, RESPONSE) + CHANNEL.pack(channel) + message, public)
    assert len(packet) <= INITIATION_BYTES
    return packet


def address(packet: bytes) -> tuple[int, int]:
    """Numbers of the vehicle and of its key in an INITIATION; raises ProtocolError if the packet's
    length is wrong.
    """
    if len(packet) != INITIATION_BYTES:
        raise ProtocolError(Drop.LENGTH)
    _, _, vehicle, number = HEADER.unpack_from(packet)
    return vehicle, number


def read_initiation(key: VehicleKey, packet: bytes) -> Initiation:
    """Parts of an INITIATION; raises ProtocolError if the sender does not have the key."""
    if not is_authentic(key, packet):
        raise ProtocolError(Drop.FORGED)
    return Initiation(packet[HEADER.size : _COOKIE_END], packet[_COOKIE_END:-MAC_BYTES])


def read_challenge(key: VehicleKey, packet: bytes, public: bytes) -> bytes:
    """Cookie in a CHALLENGE; raises ProtocolError if the packet answers another ephemeral key."""
    if len(packet) != CHALLENGE_BYTES:
        raise ProtocolError(Drop.LENGTH)
    if not is_authentic(key, packet, public):
        raise ProtocolError(Drop.UNASKED)
    return packet[HEADER.size : _COOKIE_END]


def read_response(key: VehicleKey, packet: bytes, public: bytes) -> Response:
    """Parts of a RESPONSE; raises ProtocolError if the packet answers another ephemeral key."""
    if not RESPONSE_BYTES_MIN <= len(packet) <= INITIATION_BYTES:
        raise ProtocolError(Drop.LENGTH)
    if not is_authentic(key, packet, public):
        raise ProtocolError(Drop.UNASKED)
    (channel,) = CHANNEL.unpack_from(packet, HEADER.size)
    return Response(channel, packet[HEADER.size + CHANNEL.size : -MAC_BYTES])


def is_authentic(key: VehicleKey, packet: bytes, public: bytes = b"") -> bool:
    """Whether a packet's sender has the key. `public`: the client's ephemeral key, for answers."""
    # The comparison takes constant time; otherwise its time would reveal how many bytes are right.
    return hmac.compare_digest(packet[-MAC_BYTES:], _mac(key, packet[:-MAC_BYTES] + public))


def _header(key: VehicleKey, type_: int) -> bytes:
    return HEADER.pack(VERSION, type_, key.vehicle, key.number)


def _sealed(key: VehicleKey, packet: bytes, public: bytes = b"") -> bytes:
    return packet + _mac(key, packet + public)


def _mac(key: VehicleKey, data: bytes) -> bytes:
    return hashlib.blake2s(data, key=key.mac, digest_size=MAC_BYTES).digest()
