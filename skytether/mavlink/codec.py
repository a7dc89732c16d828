"""Encoder and decoder of MAVLink messages; the decoder accepts any bytes.

A frame begins with 0xFD (MAVLink 2) or 0xFE (MAVLink 1), and has its length and a checksum. Bytes
that fit no frame are skipped one at a time, so a truncated frame does not lose the frames after it.

The checksum includes a byte that depends on the type of the message. PX4 sends several frames a
second of types that the dialect lacks. A frame counts as a frame of such a type if its checksum is
right for some value of this byte. The checksum of one in 256 damaged frames is right, too.
"""

from typing import Any

from skytether.mavlink.dialect import dialect

Message = Any
"""Message of pymavlink, whose attributes are the message's fields, without types."""

FRAME_BYTES_MAX = 280
"""Longest frame [B]: 10 of header, 255 of payload, 2 of checksum and 13 of signature."""
SIGNED = 0x01


class Codec:
    """Encoder and decoder of frames, for one end of a link.

    Args:
        stream: whether frames may arrive in pieces, as over a serial line or TCP. Over UDP, a
            datagram contains only whole frames.
    """

    def __init__(self, system: int, component: int, *, stream: bool = False) -> None:
        self._mavlink = dialect.MAVLink(None, system, component)
        self._stream = stream
        self._rest = bytearray()
        self.garbage_bytes = 0
        """Number of bytes received so far that belong to no frame."""
        self.unknown = 0
        """Number of frames received so far of types that the dialect lacks."""

    def encode(self, message: Message) -> bytes:
        """Frame of a message, with the next sequence number."""
        mavlink = self._mavlink
        frame: bytes = message.pack(mavlink)
        mavlink.seq = (mavlink.seq + 1) % 256
        return bytes(frame)

    def decode(self, data: bytes) -> list[Message]:
        """Messages in received bytes, in their order. Invalid bytes raise no exception."""
        waiting = self._rest + data
        messages, at, end = [], 0, len(waiting)
        while at < end:
            length = _length(waiting, at)
            if length and at + length > end and self._stream:
                break  # the rest of the frame has not arrived yet
            frame = waiting[at : at + length] if length <= end - at else b""
            message = self._one(frame)
            if message is not None:
                messages.append(message)
                at += length
            elif _is_unknown(frame):
                self.unknown += 1
                at += length
            else:
                self.garbage_bytes += 1
                at += 1
        self._rest = waiting[at:]
        return messages

    def _one(self, frame: bytes | bytearray) -> Message | None:
        if not frame or _number(frame) not in dialect.mavlink_map:
            return None
        try:
            return self._mavlink.decode(frame)
        except (dialect.MAVError, UnicodeDecodeError):
            return None


def _length(data: bytearray, at: int) -> int:
    """Length of the frame that begins at index `at` [B]; 0 if no frame begins there.

    If the header is incomplete, the length of the longest frame is returned.
    """
    remaining = len(data) - at
    if data[at] == 0xFD:
        if remaining < 3:
            return FRAME_BYTES_MAX
        return 12 + data[at + 1] + (13 if data[at + 2] & SIGNED else 0)
    if data[at] == 0xFE:
        return FRAME_BYTES_MAX if remaining < 2 else 8 + data[at + 1]
    return 0


def _number(frame: bytes | bytearray) -> int:
    """Number of a frame's message type."""
    return int.from_bytes(frame[7:10], "little") if frame[0] == 0xFD else frame[5]


def _is_unknown(frame: bytes | bytearray) -> bool:
    """Whether this is a frame of a type that the dialect lacks."""
    if not frame or _number(frame) in dialect.mavlink_map:
        return False
    ends = (10 if frame[0] == 0xFD else 6) + frame[1]
    wanted = int.from_bytes(frame[ends : ends + 2], "little")
    # One more byte changes the checksum c to (c >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4), where t
    # depends on both. So the high byte of the result determines t, and the low byte must fit.
    mixed = wanted ^ dialect.x25crc(frame[1:ends]).crc >> 8
    t = mixed >> 8 ^ mixed >> 13
    return mixed & 0xFF == (t << 3 ^ t >> 4) & 0xFF
