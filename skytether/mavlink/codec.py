"""Encoder and decoder of MAVLink messages; the decoder accepts any bytes.

A frame begins with 0xFD (MAVLink 2) or 0xFE (MAVLink 1), and has its length and a checksum. Bytes
that fit no frame are skipped one at a time, so a truncated frame does not lose the frames after it.
"""

from typing import Any

from skytether.mavlink.dialect import dialect

Message = Any
"""pymavlink's message, which is untyped: its fields are its attributes."""

FRAME_BYTES_MAX = 280
"""Longest frame [B]: 10 of header, 255 of payload, 2 of checksum and 13 of signature."""
SIGNED = 0x01


class Codec:
    """Encoder and decoder of frames, for one end of a link.

    Args:
        stream: whether frames may come in pieces, as over a serial line or TCP; a datagram has
            whole frames.
    """

    def __init__(self, system: int, component: int, *, stream: bool = False) -> None:
        self._mavlink = dialect.MAVLink(None, system, component)
        self._stream = stream
        self._rest = bytearray()
        self.garbage_bytes = 0
        """Bytes so far that belong to no frame."""

    def encode(self, message: Message) -> bytes:
        """Frame of a message, with the next sequence number."""
        mavlink = self._mavlink
        frame: bytes = message.pack(mavlink)
        mavlink.seq = (mavlink.seq + 1) % 256
        return bytes(frame)

    def decode(self, data: bytes) -> list[Message]:
        """Messages in some bytes, in order; never raises."""
        waiting = self._rest + data
        messages, at, end = [], 0, len(waiting)
        while at < end:
            length = _length(waiting, at)
            if length and at + length > end and self._stream:
                break  # the rest is still to come
            message = self._one(waiting[at : at + length]) if length <= end - at else None
            if message is None:
                self.garbage_bytes += 1
                at += 1
            else:
                messages.append(message)
                at += length
        self._rest = waiting[at:]
        return messages

    def _one(self, frame: bytearray) -> Message | None:
        if not frame:
            return None
        number = int.from_bytes(frame[7:10], "little") if frame[0] == 0xFD else frame[5]
        # without the message's type its checksum cannot be verified
        if number not in dialect.mavlink_map:
            return None
        try:
            return self._mavlink.decode(frame)
        except (dialect.MAVError, UnicodeDecodeError):
            return None


def _length(data: bytearray, at: int) -> int:
    """Length of the frame that begins at `at`; 0 if none does.

    A truncated header counts as the longest frame.
    """
    remaining = len(data) - at
    if data[at] == 0xFD:
        if remaining < 3:
            return FRAME_BYTES_MAX
        return 12 + data[at + 1] + (13 if data[at + 2] & SIGNED else 0)
    if data[at] == 0xFE:
        return FRAME_BYTES_MAX if remaining < 2 else 8 + data[at + 1]
    return 0
