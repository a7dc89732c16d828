"""The wire: four messages, each one msgpack array in one UDP datagram, sealed or plain.

    HELLO    [1, 1, robot, boot_id, name]                         robot → server, until answered
    WELCOME  [1, 2, robot, session, boot_id, server_boot_id, refusal]
    PART     [1, 20, session, stream, number, size, blocks, parity, block, place, sent_us, data]
    SEEN     [1, 21, session, stream, number, came, bytes, delay_us, spread_us, sent_us, held_us]

Array, version and type stand as in `shared.wire.protocol`, so that the same channels seal them.
Times are in microseconds modulo 2^32.
"""

from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from skytether.policy.parts import PARITY_MAX, PART_BYTES_MAX, Part
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX, VERSION, Refusal, kind_of

NAME: Literal["policy"] = "policy"
"""Name in a HELLO: a server of flights does not answer it."""
STAMPS = 2**32
OBSERVATION, CHUNK, METADATA = range(3)
"""Streams: observations to the server; chunks of actions and the policy's metadata to the robot."""
STREAMS = (OBSERVATION, CHUNK, METADATA)

U8 = Annotated[int, Meta(ge=0, lt=2**8)]
U16 = Annotated[int, Meta(ge=0, lt=2**16)]
U32 = Annotated[int, Meta(ge=0, lt=2**32)]
U63 = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Stream = Annotated[int, Meta(ge=0, lt=len(STREAMS))]


class Hello(NamedTuple):
    robot: U16
    boot_id: U63
    """Number of the robot's run: a new one begins a new session."""
    name: Literal["policy"] = NAME


class Welcome(NamedTuple):
    robot: U16
    session: U32
    """Number of the session; 0 for a refusal."""
    boot_id: U63
    """Boot id of the HELLO."""
    server_boot_id: U63
    refusal: Annotated[int, Meta(ge=0, lt=len(Refusal))] = Refusal.ACCEPTED


class PartMessage(NamedTuple):
    """See `parts.Part`."""

    session: U32
    stream: Stream
    number: U63
    size: U32
    blocks: U8
    parity: Annotated[int, Meta(ge=0, le=PARITY_MAX)]
    block: U8
    place: U8
    sent_us: U32
    """Sender's clock when the part was sent [µs]."""
    data: Annotated[bytes, Meta(min_length=1, max_length=PART_BYTES_MAX)]

    @property
    def part(self) -> Part:
        _, stream, number, size, blocks, parity, block, place, _, data = self
        return Part(stream, number, size, blocks, parity, block, place, data)


class Seen(NamedTuple):
    """What has come of a message, sent when nothing more is expected of it."""

    session: U32
    stream: Stream
    number: U63
    came: U16
    """Number of its parts that came."""
    bytes: U32
    """Bytes of these parts."""
    delay_us: U32
    """Receiver's clock minus `sent_us` of the part that came last, in both ends' clocks [µs]."""
    spread_us: U32
    """Time from the first part to the last [µs]."""
    sent_us: U32
    """`sent_us` of the part that came last [µs]."""
    held_us: U32
    """Time from that part until this message [µs]."""


Message = Hello | Welcome | PartMessage | Seen
KINDS: dict[int, type[Any]] = {1: Hello, 2: Welcome, 20: PartMessage, 21: Seen}
_NUMBERS = {kind: number for number, kind in KINDS.items()}
_DECODERS = {number: msgspec.msgpack.Decoder(kind) for number, kind in KINDS.items()}
_ENCODER = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    return _ENCODER.encode([VERSION, _NUMBERS[type(message)], *message])


def decode(payload: bytes) -> Message:
    """Message of a datagram.

    Raises:
        ProtocolError: the datagram is no message.
    """
    if len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(Drop.TOO_LONG)
    kind = kind_of(payload)
    if kind is None:
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    if payload[1] != VERSION:
        raise ProtocolError(Drop.VERSION)
    if kind not in _DECODERS:
        raise ProtocolError(Drop.TYPE)
    count = payload[0] & 0x0F
    try:
        # The rest as an array of its own: a header of one byte, then the fields.
        message: Message = _DECODERS[kind].decode(bytes((0x90 | max(count - 2, 0),)) + payload[3:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ProtocolError(Drop.FIELD) from None
    return message
