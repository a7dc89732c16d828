"""The server's side of secured links: who has a key, and which channel is whose.

A HELLO is answered in two steps. Without a cookie of this server for the sender's address it draws
a CHALLENGE that brings one, and nothing is kept. With it, it draws a RESPONSE with the WELCOME, and
the channel that comes with it is pending until the vehicle's first packet in it: only then does it
replace the live one. So a HELLO that somebody has recorded and repeats ends no flight.
"""

import hashlib
import hmac
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from skytether.server.gate import Call
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram, Form
from skytether.shared.wire import channel, handshake
from skytether.shared.wire.channel import OVERHEAD_BYTES, VERSION, Channel, kind
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.handshake import (
    CHANNEL,
    COOKIE_BYTES,
    INITIATION_BYTES,
    check_place,
    prologue,
    read_initiation,
    unpad,
    write_challenge,
    write_response,
)
from skytether.shared.wire.keys import Keyring, VehicleKey
from skytether.shared.wire.noise_nnpsk0 import KEY_BYTES, NoiseError, Responder
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX, Hello

COOKIE_NS = 60 * SECOND_NS
"""Time for which cookies are alike; each is good for this time and the next [ns]."""
HANDSHAKES = 5
"""Number of attempts of a vehicle, and of answers to what is repeated of them, in a second."""
PENDING_MAX = 64
"""Number of pending channels of a vehicle. It uses the first that it hears of, and within a round
trip of 12 s no more are made, even of HELLOs that somebody repeats: five a second."""
DONE_MAX = 16
"""Number of a vehicle's newest attempts that have brought a channel and are answered no more."""
OUT_MAX = 1024
"""Number of answers of the gate's own that wait to be sent; older ones give way."""


class _Pending(NamedTuple):
    """Channel that no packet has come in."""

    channel: Channel
    public: bytes
    """Ephemeral key of the attempt that it came from."""
    response: bytes
    """RESPONSE that has brought it."""


FORMS = (
    Form(bytes((VERSION, channel.DATA)), OVERHEAD_BYTES, PAYLOAD_BYTES_MAX + OVERHEAD_BYTES),
    Form(bytes((VERSION, handshake.INITIATION)), INITIATION_BYTES, INITIATION_BYTES),
    Form(bytes((0x92 + len(Hello._fields),)), 1, PAYLOAD_BYTES_MAX),
)
"""Forms of what vehicles send: packets of a channel, and INITIATIONs. A HELLO in plaintext (an
array of msgpack) is dropped as well, but the operator is to be told of it."""


class _HandshakeRate:
    """Number of handshakes in a second.

    Args:
        now_ns: time now; all of them are left.
    """

    __slots__ = ("_granted_ns",)

    def __init__(self, now_ns: int) -> None:
        self._granted_ns = now_ns - SECOND_NS
        """Time up to which they have been granted, each a share of a second [ns]."""

    def grant(self, now_ns: int) -> bool:
        """Whether one more is granted."""
        # A bucket of one second: what was not used before that is gone.
        begun_ns = max(self._granted_ns, now_ns - SECOND_NS)
        if begun_ns + SECOND_NS // HANDSHAKES > now_ns:
            return False
        self._granted_ns = begun_ns + SECOND_NS // HANDSHAKES
        return True


class _KeyedVehicle:
    """Channels and attempts of one vehicle."""

    __slots__ = ("attempts", "done", "live", "pending", "previous", "repeats")

    def __init__(self, now_ns: int) -> None:
        self.attempts = _HandshakeRate(now_ns)
        """Attempts, which nobody else can make: repeats, which anybody can, take none of them."""
        self.repeats = _HandshakeRate(now_ns)
        """Limit of further answers to an attempt that has been answered."""
        self.live: Channel | None = None
        """Channel that the vehicle sends in."""
        self.previous: Channel | None = None
        """Channel that it has sent in before."""
        self.pending: dict[int, _Pending] = {}
        """Channels by number that it may send in next, the oldest first."""
        self.done: deque[bytes] = deque(maxlen=DONE_MAX)
        """Ephemeral keys of the newest attempts that have brought a channel."""

    def find(self, number: int) -> Channel | None:
        """Channel with a number."""
        for each in (self.live, self.previous):
            if each is not None and each.number == number:
                return each
        pending = self.pending.get(number)
        return None if pending is None else pending.channel

    def response(self, public: bytes) -> bytes | None:
        """Newest RESPONSE to an attempt, whose channel is pending; None where there is none."""
        answered = (each for each in reversed(self.pending.values()) if each.public == public)
        newest = next(answered, None)
        return None if newest is None else newest.response

    def add(self, pending: _Pending) -> None:
        """Keep a channel as pending; the oldest gives way where there are too many."""
        self.pending[pending.channel.number] = pending
        if len(self.pending) > PENDING_MAX:
            del self.pending[next(iter(self.pending))]

    def promote(self, number: int, now_ns: int) -> None:
        """Make a pending channel the live one; those that were pending before it go."""
        channel, public, _ = self.pending[number]
        self.done.append(public)
        for each in list(self.pending):
            del self.pending[each]
            if each == number:
                break
        # For a while both are opened: packets of the old channel are still under way.
        if self.live is not None:
            self.live.retire(now_ns=now_ns)
        self.previous, self.live = self.live, channel


class _Answer:
    """Line of a HELLO: its answer brings a channel."""

    def __init__(self, gate: "SecureGate", key: VehicleKey, noise: Responder, now_ns: int) -> None:
        self._gate = gate
        self._noise = noise
        self.public = noise.public
        self._now_ns = now_ns
        self.key = key
        self.pending: _Pending | None = None
        """Channel that the answer has brought; each answer has another."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries a WELCOME.

        Raises:
            ProtocolError: no secret can be agreed upon with the vehicle's ephemeral key.
        """
        gate, vehicle = self._gate, self.key.vehicle
        try:
            message, keys = self._noise.answer(gate.entropy(KEY_BYTES), payload)
        except NoiseError:
            raise ProtocolError(Drop.FORGED) from None
        number = gate.number(vehicle)
        brought = Channel(vehicle, number, seal=keys.back, open_=keys.forth, born_ns=self._now_ns)
        response = write_response(self.key, number, message, self.public)
        self.pending = _Pending(brought, self.public, response)
        return response


class SecureGate:
    """Gate that only vehicles with a key pass.

    Args:
        keyring: keys of all vehicles that may come.
        entropy: gives so many bytes that nobody else can know.
    """

    secure = True

    def __init__(self, keyring: Keyring, *, entropy: Callable[[int], bytes]) -> None:
        self._keyring = keyring
        self.entropy = entropy
        self._secret = entropy(hashlib.blake2s.MAX_KEY_SIZE)
        """Secret that cookies are made of in this life of the server."""
        self._vehicles: dict[int, _KeyedVehicle] = {}
        """Vehicles that have a key and have come back with a cookie."""
        self._out: deque[Datagram] = deque(maxlen=OUT_MAX)

    def open(self, datagram: Datagram, *, now_ns: int) -> Call | None:
        """Message in a datagram; None of an INITIATION whose answer is in the outbox.

        Raises:
            ProtocolError: no vehicle that has a key made it, or it has come before or too late.
        """
        match kind(datagram.payload):
            case channel.DATA:
                return self._data(datagram.payload, now_ns)
            case handshake.INITIATION:
                return self._initiation(datagram, now_ns)
        raise ProtocolError(Drop.NOT_FOR_A_SERVER)

    def admit(self, call: Call, *, now_ns: int) -> None:  # noqa: ARG002 - as of any `Gate`
        """Keep the channel that came with the answer to the HELLO in this call as pending."""
        answer = call.line
        assert isinstance(answer, _Answer)
        assert answer.pending is not None
        self._vehicles[answer.key.vehicle].add(answer.pending)

    def outbox(self) -> list[Datagram]:
        """See `Gate`."""
        out = list(self._out)
        self._out.clear()
        return out

    def number(self, vehicle: int) -> int:
        """Number for a new channel of a vehicle, which nobody can guess."""
        known = self._vehicles[vehicle]
        # Drawn again where the vehicle has a channel of this number, once in 2^32.
        while True:
            (number,) = CHANNEL.unpack(self.entropy(CHANNEL.size))
            if known.find(number) is None:
                return int(number)

    def _data(self, packet: bytes, now_ns: int) -> Call:
        vehicle, number = channel.address(packet)
        known = self._vehicles.get(vehicle)
        used = None if known is None else known.find(number)
        if known is None or used is None:
            raise ProtocolError(Drop.UNKNOWN_CHANNEL)
        payload, newest = used.open(packet, now_ns=now_ns)
        check_place(payload, in_handshake=False)
        if number in known.pending:
            known.promote(number, now_ns)
        return Call(payload, vehicle, used, moves=newest and used is known.live)

    def _initiation(self, datagram: Datagram, now_ns: int) -> Call | None:
        """Call of a HELLO with a cookie; without one it draws a CHALLENGE.

        An attempt is answered anew as long as repeats are granted, and then as before: nobody who
        repeats what a vehicle has sent can use up the answers that it needs.
        """
        packet, peer = datagram.payload, datagram.peer
        vehicle, number = handshake.address(packet)
        key = self._keyring.find(vehicle, number)
        if key is None:
            raise ProtocolError(Drop.UNKNOWN_KEY)
        cookie, message = read_initiation(key, packet)
        if not self._is_valid(cookie, peer, now_ns):
            # Nothing is kept of a sender before a cookie has shown that it hears at its address.
            fresh = self._cookie(peer, now_ns // COOKIE_NS)
            challenge = write_challenge(key, fresh, message[:KEY_BYTES])
            self._out.append(Datagram(challenge, peer))
            return None
        known = self._vehicles.get(vehicle)
        if known is None:
            known = self._vehicles[vehicle] = _KeyedVehicle(now_ns)
        public = message[:KEY_BYTES]
        if public in known.done:  # the vehicle has closed this attempt
            raise ProtocolError(Drop.REPLAYED)
        response = known.response(public)
        # A new attempt needs the key, a repeated one only ears: so the two do not share a limit.
        if response is None:
            if not known.attempts.grant(now_ns):
                raise ProtocolError(Drop.TOO_MANY_HANDSHAKES)
        elif not known.repeats.grant(now_ns):
            self._out.append(Datagram(response, peer))
            return None
        try:
            noise = Responder(key.psk, prologue(key), message)
        except NoiseError:
            raise ProtocolError(Drop.FORGED) from None
        hello = unpad(noise.payload)
        check_place(hello, in_handshake=True)
        return Call(hello, vehicle, _Answer(self, key, noise, now_ns), moves=False)

    def _is_valid(self, cookie: bytes, peer: Address, now_ns: int) -> bool:
        """Whether a cookie is this server's, for the sender, of this time or the last."""
        time = now_ns // COOKIE_NS
        return any(
            hmac.compare_digest(cookie, self._cookie(peer, each)) for each in (time, time - 1)
        )

    def _cookie(self, peer: Address, time: int) -> bytes:
        """Cookie for an address in the given one of the times of COOKIE_NS."""
        host, port = peer
        # Made anew to be compared and never stored: any number of strangers costs no memory.
        told = f"{host} {port} {time}".encode()
        return hashlib.blake2s(told, key=self._secret, digest_size=COOKIE_BYTES).digest()
