"""The vehicle's side of a secured link: handshakes with the server, and the channels they create.

A handshake is one attempt with one ephemeral key. Its INITIATION is repeated with the newest cookie
until the resulting WELCOME is adopted, or for ATTEMPT_NS. An answer that belongs to no open attempt
is dropped: otherwise an attacker could open the same channel again and reset its counters.

An attacker who copies an INITIATION to the server from another address receives a cookie that is
valid for that address only. If the attacker forwards this cookie, the vehicle cannot distinguish it
from its own. So the vehicle tries each cookie at once and never relies on a single cookie, but
tries the same cookie no more often than it sends HELLOs.
"""

from collections.abc import Callable

from skytether.client.link import AGAIN_NS
from skytether.shared.base.units import SECOND_NS
from skytether.shared.wire import channel, handshake
from skytether.shared.wire.channel import Channel, kind
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.handshake import (
    NO_COOKIE,
    check_place,
    pad,
    prologue,
    read_challenge,
    read_response,
    write_initiation,
)
from skytether.shared.wire.keys import VehicleKey
from skytether.shared.wire.noise_nnpsk0 import KEY_BYTES, Initiator, NoiseError

ATTEMPT_NS = 60 * SECOND_NS
"""Time for which a handshake attempt is repeated before a new attempt begins."""
COOKIES_MAX = 64
"""Number of cookies stored per attempt; the cookie tried longest ago is replaced."""


class _Attempt:
    def __init__(self, noise: Initiator, hello: bytes, began_ns: int) -> None:
        self.noise = noise
        self.hello = hello
        self.began_ns = began_ns
        self.tried_ns: dict[bytes, int] = {}
        """Time at which each cookie was last tried, oldest first [ns]."""


class SecureLink:
    """Link that only the holder of the vehicle's key can read or write.

    Args:
        entropy: function that returns the given number of unpredictable bytes.
    """

    secure = True
    hello_ns = AGAIN_NS

    def __init__(self, key: VehicleKey, *, entropy: Callable[[int], bytes]) -> None:
        self._key = key
        self._entropy = entropy
        self._cookie = NO_COOKIE
        """Newest cookie, also from earlier attempts."""
        self._answers: list[bytes] = []
        """INITIATIONs to be sent, each as the answer to a CHALLENGE."""
        self._attempt: _Attempt | None = None
        self._candidate: Channel | None = None
        self._current: Channel | None = None
        self._previous: Channel | None = None

    def hello(self, payload: bytes, *, now_ns: int) -> bytes:
        """Datagram that carries a HELLO; a different message starts a new attempt."""
        attempt = self._attempt
        # Noise encrypts one message per ephemeral key: a second HELLO with the same key would reuse
        # a nonce.
        if attempt is None or attempt.hello != payload or now_ns - attempt.began_ns > ATTEMPT_NS:
            key, private = self._key, self._entropy(KEY_BYTES)
            # Padded to the length of the longest answer, so that an attacker cannot use the server
            # for amplification.
            noise = Initiator(key.psk, prologue(key), private, pad(payload))
            self._attempt = attempt = _Attempt(noise, payload, now_ns)
            self._candidate = None
        return self._initiation(attempt, now_ns)

    def seal(self, payload: bytes) -> bytes:
        """Datagram that carries any message except a HELLO; needs an adopted WELCOME."""
        assert self._current is not None
        return self._current.seal(payload)

    def open(self, datagram: bytes, *, now_ns: int) -> bytes | None:
        """Message in a datagram; None for a CHALLENGE, whose answer is in the outbox.

        Raises:
            ProtocolError: the datagram is not from the server, is a repeat, or answers no open
                attempt.
        """
        match kind(datagram):
            case channel.DATA:
                return self._data(datagram, now_ns)
            case handshake.RESPONSE:
                return self._response(datagram, now_ns)
            case handshake.CHALLENGE:
                self._challenge(datagram, now_ns)
                return None
        raise ProtocolError(Drop.NOT_FOR_A_CLIENT)

    def outbox(self) -> list[bytes]:
        answers, self._answers = self._answers, []
        return answers

    def adopt(self, *, now_ns: int) -> None:
        assert self._candidate is not None
        if self._current is not None:
            self._current.retire(now_ns=now_ns)
        # The old channel is kept for packets that the server sent before it used the new channel.
        self._previous, self._current = self._current, self._candidate
        self._attempt = self._candidate = None

    def wants_hello(self, now_ns: int) -> bool:
        """Whether the channel is due for replacement; False without a channel."""
        return self._current is not None and self._current.wants_successor(now_ns)

    def _data(self, packet: bytes, now_ns: int) -> bytes:
        _, number = channel.address(packet)
        for open_channel in (self._current, self._previous):
            if open_channel is not None and open_channel.number == number:
                payload = open_channel.open(packet, now_ns=now_ns).payload
                check_place(payload, in_handshake=False)
                return payload
        raise ProtocolError(Drop.UNKNOWN_CHANNEL)

    def _challenge(self, packet: bytes, now_ns: int) -> None:
        """Try the cookie of a CHALLENGE, unless it was tried just now."""
        attempt = self._open_attempt()
        cookie = read_challenge(self._key, packet, attempt.noise.public)
        tried_ns = attempt.tried_ns.get(cookie)
        if tried_ns is not None and now_ns - tried_ns < AGAIN_NS:
            raise ProtocolError(Drop.REPLAYED)
        self._cookie = cookie
        self._answers.append(self._initiation(attempt, now_ns))

    def _initiation(self, attempt: _Attempt, now_ns: int) -> bytes:
        tried_ns = attempt.tried_ns
        # Removed and inserted again, because the dictionary is ordered by time.
        tried_ns.pop(self._cookie, None)
        tried_ns[self._cookie] = now_ns
        if len(tried_ns) > COOKIES_MAX:
            del tried_ns[next(iter(tried_ns))]
        return write_initiation(self._key, self._cookie, attempt.noise.message)

    def _response(self, packet: bytes, now_ns: int) -> bytes:
        attempt = self._open_attempt()
        number, message = read_response(self._key, packet, attempt.noise.public)
        try:
            welcome, keys = attempt.noise.open(message)
        except NoiseError:
            raise ProtocolError(Drop.FORGED) from None
        check_place(welcome, in_handshake=True)
        self._candidate = Channel(
            self._key.vehicle, number, seal=keys.forth, open_=keys.back, born_ns=now_ns
        )
        return welcome

    def _open_attempt(self) -> _Attempt:
        if self._attempt is None:
            raise ProtocolError(Drop.UNASKED)
        return self._attempt
