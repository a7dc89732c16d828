"""A channel: the sealed packets of one handshake, both ways, each opened at most once.

    DATA    version u8 | type u8 | vehicle u16 | channel u32 | counter u64 | sealed message

Integers are little-endian. The header is authenticated with the message; the counter, which counts
the packets of one direction from 0, is the nonce as in Noise: four zero bytes, then the counter.
Each direction has a key of its own, so that no packet comes back to its sender as the peer's.
Counters lie in memory alone: after a restart there is a new handshake, and with it other keys.

The end that opens watches over the limits (LIFE_NS, PACKETS_MAX). The one that seals has nothing to
refuse: what it seals too late is not opened.
"""

import struct
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from skytether.shared.base.units import SECOND_NS
from skytether.shared.wire.drop import Drop, ProtocolError

VERSION = 1
"""First byte of every sealed packet; no message in plaintext begins with it."""
DATA = 4
"""Type of a packet of a channel; those of the handshake are in `shared.wire.handshake`."""
HEADER = struct.Struct("<BBHIQ")
"""Version, type, vehicle, channel and counter."""
OVERHEAD_BYTES = HEADER.size + 16
"""Length of header and tag of a packet [B]."""

WINDOW = 2048
"""Number of newest counters that are told apart; an older one is not opened."""
FRESH_NS, FRESH_PACKETS = 300 * SECOND_NS, 2**22
"""Age [ns] and number of packets of a channel from which on another one is wanted."""
LIFE_NS, PACKETS_MAX = 600 * SECOND_NS, 2**32
"""Age [ns] and number of packets from which on nothing is opened any more."""
OVERLAP_NS = 10 * SECOND_NS
"""Time for which a channel that has a successor is still opened [ns]."""

_PREFIX = struct.Struct("<BBHI")
_COUNTER = struct.Struct("<Q")
_NONCE = struct.Struct("<4xQ")
_MASK = 2**WINDOW - 1


def kind(packet: bytes) -> int:
    """Type of a sealed packet, of a channel or of a handshake.

    Raises:
        ProtocolError: it is none.
    """
    if len(packet) < 2 or packet[0] != VERSION:
        raise ProtocolError(Drop.NOT_SEALED)
    return packet[1]


def address(packet: bytes) -> tuple[int, int]:
    """Numbers of the vehicle and of the channel in a packet of type DATA.

    Raises:
        ProtocolError: it is too short for one.
    """
    if len(packet) < OVERHEAD_BYTES:
        raise ProtocolError(Drop.LENGTH)
    _, _, vehicle, number = _PREFIX.unpack_from(packet)
    return vehicle, number


class OpenedPacket(NamedTuple):
    """Content of a packet."""

    payload: bytes
    """The message."""
    newest: bool
    """Whether no later packet has come before it."""


class ReplayWindow:
    """Counters that have come."""

    __slots__ = ("_seen", "newest")

    def __init__(self) -> None:
        self.newest = -1
        """Highest counter that has come; -1 before the first."""
        self._seen = 0
        """Bit i stands for the counter `newest` - i."""

    def is_new(self, counter: int) -> bool:
        """Whether a counter has not come, and is not too old to be told."""
        back = self.newest - counter
        return back < 0 or (back < WINDOW and not self._seen >> back & 1)

    def add(self, counter: int) -> None:
        """Note that a new counter has come."""
        back = self.newest - counter
        if back >= 0:
            self._seen |= 1 << back
            return
        # Shifting by more would make a number as long as the jump.
        self._seen = (self._seen << min(-back, WINDOW) | 1) & _MASK
        self.newest = counter


class Channel:
    """End of a channel, which seals what it sends and opens what it hears.

    Args:
        vehicle: number of the vehicle.
        number: number of the channel.
        seal: key of the packets that this end sends.
        open_: key of the packets that it receives.
        born_ns: time of the handshake.
    """

    __slots__ = (
        "_fresh_until_ns",
        "_open",
        "_opens_until_ns",
        "_prefix",
        "_seal",
        "_sent",
        "_window",
        "number",
    )

    def __init__(
        self, vehicle: int, number: int, *, seal: bytes, open_: bytes, born_ns: int
    ) -> None:
        self.number = number
        """Number of the channel."""
        self._prefix = _PREFIX.pack(VERSION, DATA, vehicle, number)
        self._seal = ChaCha20Poly1305(seal).encrypt
        self._open = ChaCha20Poly1305(open_).decrypt
        self._sent = 0
        self._window = ReplayWindow()
        self._fresh_until_ns = born_ns + FRESH_NS
        self._opens_until_ns = born_ns + LIFE_NS

    def seal(self, payload: bytes) -> bytes:
        """Packet that carries a message."""
        header = self._prefix + _COUNTER.pack(self._sent)
        sealed = self._seal(_NONCE.pack(self._sent), payload, header)
        self._sent += 1
        return header + sealed

    def open(self, packet: bytes, *, now_ns: int) -> OpenedPacket:
        """Message in a packet.

        Raises:
            ProtocolError: it is not the peer's, has come before, or comes too late.
        """
        if len(packet) < OVERHEAD_BYTES:
            raise ProtocolError(Drop.LENGTH)
        if packet[: _PREFIX.size] != self._prefix:
            raise ProtocolError(Drop.UNKNOWN_CHANNEL)
        counter: int = _COUNTER.unpack_from(packet, _PREFIX.size)[0]
        if now_ns > self._opens_until_ns or counter >= PACKETS_MAX:
            raise ProtocolError(Drop.EXPIRED)
        window = self._window
        # Before the tag is checked: a repeated packet costs no cryptography.
        if not window.is_new(counter):
            raise ProtocolError(Drop.REPLAYED)
        try:
            payload = self._open(_NONCE.pack(counter), packet[HEADER.size :], packet[: HEADER.size])
        except InvalidTag:
            raise ProtocolError(Drop.FORGED) from None
        # Only after the tag was checked: a forged counter must not move the window.
        newest = counter > window.newest
        window.add(counter)
        return OpenedPacket(payload, newest)

    def retire(self, *, now_ns: int) -> None:
        """Open what is still under way to this end, and then nothing more."""
        # The smaller of both: retiring never prolongs the life of a channel.
        self._opens_until_ns = min(self._opens_until_ns, now_ns + OVERLAP_NS)

    def wants_successor(self, now_ns: int) -> bool:
        """Whether this channel needs a successor, because of its age or the packets behind it."""
        # Both directions count, for one handshake renews the keys of both.
        packets = max(self._sent, self._window.newest + 1)
        return now_ns >= self._fresh_until_ns or packets >= FRESH_PACKETS
