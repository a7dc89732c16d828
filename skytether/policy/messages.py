"""Datagram format: one msgpack array in each UDP datagram, of four types, encrypted or plaintext.

    HELLO    [1, 1, robot, boot_id, name]                         to the policy end, until answered
    WELCOME  [1, 2, robot, session, boot_id, server_boot_id, refusal]
    PART     [1, 20, session, stream, number, size, blocks, parity, block, place, sent_us, data]
    REPORT   [1, 21, session, stream, number, came, bytes, first_us, last_us, spread_us, sent_us,
              held_us, counted, counted_came]

The first two fields, version and type, are those of `shared.wire.protocol`, so that the same
channels encrypt the datagrams. Times are in microseconds modulo 2^32.

The parts of a message join to a msgpack array, in the format of `values`:

    OBSERVATION  [call, left, delay, held, observation]
    CHUNK        [call, reply, error]
    METADATA     [wants_rows, metadata]
"""

from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from skytether.policy import values
from skytether.policy.committed import RobotRows
from skytether.policy.form import PARITY_MAX, PART_BYTES_MAX
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX, VERSION, Refusal, kind_of

STAMPS = 2**32
"""Modulus of timestamps [µs]."""
OBSERVATION, CHUNK, METADATA = STREAMS = range(3)
"""Streams: observations to the policy end; action chunks and metadata to the robot end."""

U8 = Annotated[int, Meta(ge=0, lt=2**8)]
U16 = Annotated[int, Meta(ge=0, lt=2**16)]
U32 = Annotated[int, Meta(ge=0, lt=2**32)]
U63 = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Stream = Annotated[int, Meta(ge=0, lt=len(STREAMS))]


class Hello(NamedTuple):
    robot: U16
    boot_id: U63
    """Random number of the robot end's run; a new run gets a new session."""
    name: Literal["policy"] = "policy"
    """Makes servers for vehicles ignore the HELLO."""


class Welcome(NamedTuple):
    robot: U16
    session: U32
    """Session number; 0 if refused."""
    boot_id: U63
    """`boot_id` of the HELLO."""
    server_boot_id: U63
    refusal: Annotated[int, Meta(ge=0, lt=len(Refusal))] = Refusal.ACCEPTED


class Part(NamedTuple):
    """Part of a message."""

    session: U32
    stream: Stream
    """Number of the stream; a newer message of a stream replaces an older one."""
    number: U63
    """Sequence number of the message in its stream."""
    size: U32
    """Size of the message [B]."""
    blocks: U8
    parity: Annotated[int, Meta(ge=0, le=PARITY_MAX)]
    """Number of parity parts of each block."""
    block: U8
    place: U8
    """Index of the part in its block; data parts come before parity parts."""
    sent_us: U32
    """Send time by the sender's clock [µs]."""
    data: Annotated[bytes, Meta(min_length=1, max_length=PART_BYTES_MAX)]


class Report(NamedTuple):
    """Report on a message, sent when all its parts have arrived or no further part is expected."""

    session: U32
    stream: Stream
    number: U63
    came: U16
    """Number of received parts; 0 marks a keep-alive, whose `number` is 1 if the robot end has the
    metadata."""
    bytes: U32
    """Bytes of the received parts, headers included [B]."""
    first_us: U32
    """One-way delay of the part sent first, plus the unknown clock offset, see `pace.fit` [µs]."""
    last_us: U32
    """Same of the part sent last [µs]."""
    spread_us: U32
    """Time between receiving the two [µs]."""
    sent_us: U32
    """`sent_us` of the last received part [µs]."""
    held_us: U32
    """Time between receiving that part and sending this report [µs]."""
    counted: U16
    """Number of parts sent of the messages counted since the last report, see `pace.Tally`."""
    counted_came: U16
    """Number of parts received of them."""


Message = Hello | Welcome | Part | Report
KINDS: dict[int, type[Any]] = {1: Hello, 2: Welcome, 20: Part, 21: Report}
_NUMBERS = {kind: number for number, kind in KINDS.items()}
_DECODERS = {number: msgspec.msgpack.Decoder(kind) for number, kind in KINDS.items()}
_ENCODER = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    return _ENCODER.encode([VERSION, _NUMBERS[type(message)], *message])


def decode(payload: bytes) -> Message:
    """Decode a datagram.

    Raises:
        ProtocolError: the datagram is invalid.
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
    # Decode the fields after version and type as an array, with a new one-byte header.
    header = bytes((0x90 | max((payload[0] & 0x0F) - 2, 0),))
    try:
        return _DECODERS[kind].decode(header + payload[3:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ProtocolError(Drop.FIELD) from None


ObservationContent = tuple[int, int, int, RobotRows | None, bytes]
"""Number of the call, number of rows that the robot has, delay bound d [steps], these rows (None if
the policy end does not want rows), and serialized observation."""
ChunkContent = tuple[int, bytes, str]
"""Number of the call, serialized reply of the policy, and error; the reply or the error is empty.
"""
MetadataContent = tuple[bool, bytes]
"""Whether observations are to include the robot's rows, and serialized metadata of the policy."""


def content(kind: Any, message: bytes) -> Any:
    """Content of a complete message; `kind` is the type of the content.

    Raises:
        ProtocolError: the message is no valid content of this kind.
    """
    try:
        return msgspec.convert(values.unpack(message), kind)
    except (values.ValueRefused, msgspec.ValidationError):
        raise ProtocolError(Drop.FIELD) from None
