"""The server's side of secured links: keys, handshakes and channels of the vehicles.

A HELLO is answered in two steps. Without a valid cookie for the sender's address, the server
answers with a CHALLENGE that contains a cookie, and stores nothing. With the cookie, it answers
with a RESPONSE that contains the WELCOME and opens a new channel. This channel is pending until the
vehicle's first packet in it, and only then replaces the live channel. So an attacker who replays a
recorded HELLO cannot end a flight.
"""

import hashlib
import hmac
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from skytether.server.gate import GateCall
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Form
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
"""Length of a cookie's period; each cookie is valid in its period and the next period [ns]."""
HANDSHAKES = 5
"""Largest number per second of a vehicle's handshake attempts, and of answers to repeats."""
PENDING_MAX = 64
"""Largest number of pending channels of a vehicle; the vehicle uses the first RESPONSE to arrive.
Even if an attacker replays the vehicle's HELLOs, five per second, round trips up to 12 s stay
within this limit."""
COMPLETED_MAX = 16
"""Number of stored completed attempts of a vehicle; repeats of them are not answered."""
OUT_MAX = 1024
"""Largest number of the gate's answers waiting to be sent; older answers are dropped."""


class _Pending(NamedTuple):
    """Channel in which no packet has arrived yet."""

    channel: Channel
    public: bytes
    """Ephemeral key of the handshake attempt."""
    response: bytes
    """RESPONSE that created the channel."""


FORMS = (
    Form(bytes((VERSION, channel.DATA)), OVERHEAD_BYTES, PAYLOAD_BYTES_MAX + OVERHEAD_BYTES),
    Form(bytes((VERSION, handshake.INITIATION)), INITIATION_BYTES, INITIATION_BYTES),
    Form(bytes((0x92 + len(Hello._fields),)), 1, PAYLOAD_BYTES_MAX),
)
"""Formats of vehicles' datagrams: packets of a channel, and INITIATIONs. A plaintext HELLO (a
msgpack array) passes this filter too, so that it can be reported when it is dropped."""


class _HandshakeRate:
    """Rate limit of handshakes, HANDSHAKES per second."""

    __slots__ = ("_granted_ns",)

    def __init__(self, now_ns: int) -> None:
        self._granted_ns = now_ns - SECOND_NS
        """Earliest time of the next handshake minus 1 / HANDSHAKES s [ns]."""

    def grant(self, now_ns: int) -> bool:
        """Whether another handshake is granted."""
        # Unused handshakes add up for at most one second.
        begun_ns = max(self._granted_ns, now_ns - SECOND_NS)
        if begun_ns + SECOND_NS // HANDSHAKES > now_ns:
            return False
        self._granted_ns = begun_ns + SECOND_NS // HANDSHAKES
        return True


class _KeyedVehicle:
    __slots__ = ("attempts", "completed", "live", "pending", "previous", "repeats")

    def __init__(self, now_ns: int) -> None:
        self.attempts = _HandshakeRate(now_ns)
        """Rate limit of new handshake attempts, which only a holder of the key can make."""
        self.repeats = _HandshakeRate(now_ns)
        """Rate limit of answers to repeated INITIATIONs, which every eavesdropper can send."""
        self.live: Channel | None = None
        """Channel in which the vehicle sends."""
        self.previous: Channel | None = None
        """Channel in which the vehicle sent before the live channel."""
        self.pending: dict[int, _Pending] = {}
        """Pending channels by number, oldest first."""
        self.completed: deque[bytes] = deque(maxlen=COMPLETED_MAX)
        """Ephemeral keys of the newest completed attempts."""

    def find(self, number: int) -> Channel | None:
        for open_channel in (self.live, self.previous):
            if open_channel is not None and open_channel.number == number:
                return open_channel
        pending = self.pending.get(number)
        return None if pending is None else pending.channel

    def response(self, public: bytes) -> bytes | None:
        """Newest RESPONSE to an attempt whose channel is pending; None if there is none."""
        answered = (each for each in reversed(self.pending.values()) if each.public == public)
        newest = next(answered, None)
        return None if newest is None else newest.response

    def add(self, pending: _Pending) -> None:
        self.pending[pending.channel.number] = pending
        if len(self.pending) > PENDING_MAX:
            del self.pending[next(iter(self.pending))]

    def promote(self, number: int, now_ns: int) -> None:
        """Make a pending channel the live channel, and drop the channels pending before it."""
        channel, public, _ = self.pending[number]
        self.completed.append(public)
        for older in list(self.pending):
            del self.pending[older]
            if older == number:
                break
        # Packets of the previous channel are opened for a while, because some are still in flight.
        if self.live is not None:
            self.live.retire(now_ns=now_ns)
        self.previous, self.live = self.live, channel


class _Answer:
    """Encoder of the answer to a HELLO; encoding creates a channel."""

    def __init__(self, gate: "SecureGate", key: VehicleKey, noise: Responder, now_ns: int) -> None:
        self._gate = gate
        self._noise = noise
        self.public = noise.public
        self._now_ns = now_ns
        self.key = key
        self.pending: _Pending | None = None
        """Channel created by the answer; each answer creates another channel."""

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries a WELCOME.

        Raises:
            ProtocolError: the vehicle's ephemeral key gives no shared secret.
        """
        gate, vehicle = self._gate, self.key.vehicle
        try:
            message, keys = self._noise.answer(gate.entropy(KEY_BYTES), payload)
        except NoiseError:
            raise ProtocolError(Drop.FORGED) from None
        number = gate.number(vehicle)
        created = Channel(vehicle, number, seal=keys.back, open_=keys.forth, born_ns=self._now_ns)
        response = write_response(self.key, number, message, self.public)
        self.pending = _Pending(created, self.public, response)
        return response


class SecureGate:
    """Gate that accepts only vehicles of the keyring; `entropy` returns unpredictable bytes."""

    def __init__(self, keyring: Keyring, *, entropy: Callable[[int], bytes]) -> None:
        self._keyring = keyring
        self.entropy = entropy
        self._secret = entropy(hashlib.blake2s.MAX_KEY_SIZE)
        """Secret of the cookies, new in each run of the server."""
        self._vehicles: dict[int, _KeyedVehicle] = {}
        """Vehicles with a key that have returned a valid cookie."""
        self._out: deque[Datagram] = deque(maxlen=OUT_MAX)

    def open(self, datagram: Datagram, *, now_ns: int) -> GateCall | None:
        """Message in a datagram; None for an INITIATION whose answer is in the outbox.

        Raises:
            ProtocolError: no vehicle with a key sent it, or it is a repeat or too old.
        """
        match kind(datagram.payload):
            case channel.DATA:
                return self._data(datagram.payload, now_ns)
            case handshake.INITIATION:
                return self._initiation(datagram, now_ns)
        raise ProtocolError(Drop.NOT_FOR_A_SERVER)

    def repeated(self, datagram: Datagram) -> int | None:
        packet = datagram.payload
        if channel.kind(packet) != channel.DATA:
            return None
        vehicle, number = channel.address(packet)
        keyed = self._vehicles.get(vehicle)
        live = keyed and keyed.live
        return vehicle if live and live.number == number and live.repeats(packet) else None

    def admit(self, call: GateCall, *, now_ns: int) -> None:  # noqa: ARG002 - interface of `Gate`
        """Keep the channel created by the answer to this HELLO as pending."""
        answer = call.line
        assert isinstance(answer, _Answer)
        assert answer.pending is not None
        self._vehicles[answer.key.vehicle].add(answer.pending)

    def outbox(self) -> list[Datagram]:
        out = list(self._out)
        self._out.clear()
        return out

    def number(self, vehicle: int) -> int:
        """Unpredictable number for a new channel of a vehicle."""
        keyed = self._vehicles[vehicle]
        # The number is drawn again if a channel of the vehicle already has it: one case in 2^32.
        while True:
            (number,) = CHANNEL.unpack(self.entropy(CHANNEL.size))
            if keyed.find(number) is None:
                return int(number)

    def _data(self, packet: bytes, now_ns: int) -> GateCall:
        vehicle, number = channel.address(packet)
        keyed = self._vehicles.get(vehicle)
        used = None if keyed is None else keyed.find(number)
        if keyed is None or used is None:
            raise ProtocolError(Drop.UNKNOWN_CHANNEL)
        payload, newest = used.open(packet, now_ns=now_ns)
        check_place(payload, in_handshake=False)
        if number in keyed.pending:
            keyed.promote(number, now_ns)
        return GateCall(payload, vehicle, used, moves=newest and used is keyed.live)

    def _initiation(self, datagram: Datagram, now_ns: int) -> GateCall | None:
        """HELLO of an INITIATION with a valid cookie; otherwise answers with a CHALLENGE.

        A repeated attempt gets a new answer while the rate limit allows, and then the previous
        answer. So an attacker who replays a vehicle's packets cannot use up the answers that the
        vehicle needs.
        """
        packet, peer = datagram.payload, datagram.peer
        vehicle, number = handshake.address(packet)
        key = self._keyring.find(vehicle, number)
        if key is None:
            raise ProtocolError(Drop.UNKNOWN_KEY)
        cookie, message = read_initiation(key, packet)
        if not self._is_valid(cookie, peer, now_ns):
            # Nothing is stored for a sender before a cookie has proven that it receives at its
            # address.
            fresh = self._cookie(peer, now_ns // COOKIE_NS)
            challenge = write_challenge(key, fresh, message[:KEY_BYTES])
            self._out.append(Datagram(challenge, peer, datagram.socket))
            return None
        keyed = self._vehicles.get(vehicle)
        if keyed is None:
            keyed = self._vehicles[vehicle] = _KeyedVehicle(now_ns)
        public = message[:KEY_BYTES]
        if public in keyed.completed:  # the vehicle has completed this handshake attempt
            raise ProtocolError(Drop.REPLAYED)
        response = keyed.response(public)
        # Anybody who eavesdrops can repeat an attempt, but only a vehicle with the key can make a
        # new one. So repeats and new attempts have separate limits.
        if response is None:
            if not keyed.attempts.grant(now_ns):
                raise ProtocolError(Drop.TOO_MANY_HANDSHAKES)
        elif not keyed.repeats.grant(now_ns):
            self._out.append(Datagram(response, peer, datagram.socket))
            return None
        try:
            noise = Responder(key.psk, prologue(key), message)
        except NoiseError:
            raise ProtocolError(Drop.FORGED) from None
        hello = unpad(noise.payload)
        check_place(hello, in_handshake=True)
        return GateCall(hello, vehicle, _Answer(self, key, noise, now_ns), moves=False)

    def _is_valid(self, cookie: bytes, peer: Address, now_ns: int) -> bool:
        time = now_ns // COOKIE_NS
        return any(
            hmac.compare_digest(cookie, self._cookie(peer, period)) for period in (time, time - 1)
        )

    def _cookie(self, peer: Address, period: int) -> bytes:
        host, port = peer
        # The cookie is computed for each comparison, not stored: unknown senders use no memory.
        text = f"{host} {port} {period}".encode()
        return hashlib.blake2s(text, key=self._secret, digest_size=COOKIE_BYTES).digest()
