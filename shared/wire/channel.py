"""Channel: encrypted packets in both directions after a handshake. No packet is opened twice.

    DATA    version u8 | type u8 | vehicle u16 | channel u32 | counter u64 | sealed message

Integers are little-endian. The header is authenticated with the message. The counter counts the
packets of one direction from 0. The nonce is four zero bytes, then the counter, as in Noise. Each
direction has its own key, so that a packet sent back to its sender is not accepted. Counters are in
memory only: after a restart there is a new handshake with new keys.

Only the receiving end enforces the limits LIFE_NS and PACKETS_MAX.
"""

import struct
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from skytether.shared.base.units import SECOND_NS
from skytether.shared.wire.drop import Drop, ProtocolError

VERSION = 1
"""First byte of every sealed packet; no plaintext message begins with it."""
DATA = 4
"""Type of a packet of a channel; the handshake's types are in `shared.wire.handshake`."""
HEADER = struct.Struct("<BBHIQ")
"""Version, type, vehicle, channel and counter."""
OVERHEAD_BYTES = HEADER.size + 16
"""Length of a packet's header and authentication tag [B]."""

WINDOW = 2048
"""Number of newest counters that are tracked; a packet with an older counter is not opened."""
RECENT, REPEATS = 64, 2
"""Number of newest counters whose repeats are checked, and largest number of checks until a newer
packet arrives, see `Channel.repeats`."""
FRESH_NS, FRESH_PACKETS = 300 * SECOND_NS, 2**22
"""Age and number of packets of a channel after which a new channel is needed."""
LIFE_NS, PACKETS_MAX = 600 * SECOND_NS, 2**32
"""Age and number of packets after which no packet of the channel is opened."""
OVERLAP_NS = 10 * SECOND_NS
"""Time for which packets of a replaced channel are still opened."""

_PREFIX = struct.Struct("<BBHI")
_COUNTER = struct.Struct("<Q")
_NONCE = struct.Struct("<4xQ")
_MASK = 2**WINDOW - 1


def kind(packet: bytes) -> int:
    """Type of a sealed packet; raises ProtocolError if the packet is not sealed."""
    if len(packet) < 2 or packet[0] != VERSION:
        raise ProtocolError(Drop.NOT_SEALED)
    return packet[1]


def address(packet: bytes) -> tuple[int, int]:
    """Numbers of the vehicle and of the channel in a packet of type DATA; raises ProtocolError if
    the packet is too short.
    """
    if len(packet) < OVERHEAD_BYTES:
        raise ProtocolError(Drop.LENGTH)
    _, _, vehicle, number = _PREFIX.unpack_from(packet)
    return vehicle, number


class OpenedPacket(NamedTuple):
    payload: bytes
    newest: bool


class ReplayWindow:
    """Counters that have been received."""

    __slots__ = ("_seen", "newest")

    def __init__(self) -> None:
        self.newest = -1
        """Highest counter received; -1 before the first."""
        self._seen = 0
        """Bits of the received counters: bit i is set if `newest` - i was received."""

    def is_new(self, counter: int) -> bool:
        """Whether a counter has not been received; False if it is too old to be tracked."""
        back = self.newest - counter
        return back < 0 or (back < WINDOW and not self._seen >> back & 1)

    def add(self, counter: int) -> None:
        back = self.newest - counter
        if back >= 0:
            self._seen |= 1 << back
            return
        # A larger shift would make a number with as many bits as the counter has advanced.
        self._seen = (self._seen << min(-back, WINDOW) | 1) & _MASK
        self.newest = counter


class Channel:
    """One end of a channel: it seals packets to send, and opens received ones.

    Args:
        seal: key for packets that this end sends.
        open_: key for packets that this end receives.
        born_ns: time of the handshake.
    """

    __slots__ = (
        "_fresh_until_ns",
        "_open",
        "_opens_until_ns",
        "_prefix",
        "_repeats",
        "_seal",
        "_sent",
        "_window",
        "number",
    )

    def __init__(
        self, vehicle: int, number: int, *, seal: bytes, open_: bytes, born_ns: int
    ) -> None:
        self.number = number
        self._prefix = _PREFIX.pack(VERSION, DATA, vehicle, number)
        self._seal = ChaCha20Poly1305(seal).encrypt
        self._open = ChaCha20Poly1305(open_).decrypt
        self._sent = 0
        self._window = ReplayWindow()
        self._repeats = 0
        """Number of repeats checked since the newest packet."""
        self._fresh_until_ns = born_ns + FRESH_NS
        self._opens_until_ns = born_ns + LIFE_NS

    def seal(self, payload: bytes) -> bytes:
        header = self._prefix + _COUNTER.pack(self._sent)
        sealed = self._seal(_NONCE.pack(self._sent), payload, header)
        self._sent += 1
        return header + sealed

    def open(self, packet: bytes, *, now_ns: int) -> OpenedPacket:
        """Message in a packet.

        Raises:
            ProtocolError: the packet is not from the peer, is a repeat, or arrives too late.
        """
        if len(packet) < OVERHEAD_BYTES:
            raise ProtocolError(Drop.LENGTH)
        if packet[: _PREFIX.size] != self._prefix:
            raise ProtocolError(Drop.UNKNOWN_CHANNEL)
        counter: int = _COUNTER.unpack_from(packet, _PREFIX.size)[0]
        if now_ns > self._opens_until_ns or counter >= PACKETS_MAX:
            raise ProtocolError(Drop.EXPIRED)
        window = self._window
        # This check precedes that of the tag, so that a repeated packet needs no cryptography.
        if not window.is_new(counter):
            raise ProtocolError(Drop.REPLAYED)
        try:
            payload = self._open(_NONCE.pack(counter), packet[HEADER.size :], packet[: HEADER.size])
        except InvalidTag:
            raise ProtocolError(Drop.FORGED) from None
        # The window moves after the check of the tag, so that no forged counter can move it.
        newest = counter > window.newest
        window.add(counter)
        self._repeats = 0 if newest else self._repeats
        return OpenedPacket(payload, newest)

    def repeats(self, packet: bytes) -> bool:
        """Whether a packet is authentic and repeats one of the newest packets.

        The check needs cryptography, so at most REPEATS packets are checked until a newer arrives.
        """
        (counter,) = _COUNTER.unpack_from(packet, _PREFIX.size)
        back = self._window.newest - counter
        if not 0 <= back < RECENT or self._repeats == REPEATS:
            return False
        self._repeats += 1
        try:
            self._open(_NONCE.pack(counter), packet[HEADER.size :], packet[: HEADER.size])
        except InvalidTag:
            return False
        return True

    def retire(self, *, now_ns: int) -> None:
        """Open packets of this channel for OVERLAP_NS more, because some are still in flight."""
        # The minimum, because `retire` must never prolong the life of a channel.
        self._opens_until_ns = min(self._opens_until_ns, now_ns + OVERLAP_NS)

    def wants_successor(self, now_ns: int) -> bool:
        """Whether a new channel is needed, because of age or number of packets."""
        # Packets of both directions count, because one handshake renews the keys of both.
        packets = max(self._sent, self._window.newest + 1)
        return now_ns >= self._fresh_until_ns or packets >= FRESH_PACKETS
