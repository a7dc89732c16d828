"""Targets for the handshake: strangers without a key, and a faulty peer with one.

No sender without a key is accepted by a server, by a client that waits for its first session, or by
a client in flight. A holder of a vehicle's key is accepted only as this vehicle. The state kept for
either is bounded, and no answer is longer than its request.
"""

from collections.abc import Sequence
from random import Random

from fuzz.datagrams import SCENARIOS, Datagrams, EndpointInFlight
from fuzz.mutators import bytes_changed
from skytether.client import secure as client_secure
from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.server import gate
from skytether.server import secure as server_secure
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Address, Datagram, Endpoint
from skytether.shared.wire import channel, handshake, noise_nnpsk0, protocol
from skytether.shared.wire.noise_nnpsk0 import KEY_BYTES, Initiator, Responder
from skytether.shared.wire.protocol import Hello, Welcome, encode
from skytether.sim.sealed import make_keys

CODE = (channel, handshake, noise_nnpsk0, client_secure, server_secure, gate)
SERVER: Address = ("server", 0)
CLIENT: Address = ("client", 0)
STRANGER: Address = ("stranger", 6)
NEWCOMER = 2
"""Number of a vehicle that has a key, and no session yet."""
NEWCOMER_BOOT_ID = 2**51
FIRST_BYTES = noise_nnpsk0.MESSAGE_BYTES + handshake.HELLO_BYTES_MAX + 1
"""Size of the first message of a handshake, with a HELLO and its padding [B]."""
CHANNEL = 9
"""Number of the channels that a key's holder opens."""
HOLDER_STEP_NS = 250 * MILLISECOND_NS
"""Time between two packets of a key's holder [ns]; so long that the rate limit never applies."""
HOLDER_LIFE = 500
"""Number of payloads after which server and client of a key's holder are replaced by new ones."""


class Strangers(EndpointInFlight):
    """Target for raw datagrams to both ends of an encrypted flight, and to a client alone."""

    code = CODE

    def __init__(self) -> None:
        super().__init__(SCENARIOS[0], sealed=True)

    def _begin(self) -> None:
        super()._begin()
        assert self._keyring is not None
        self.newcomer = Client(
            self._scenario,
            simulated(self._scenario, NEWCOMER),
            server=SERVER,
            vehicle=NEWCOMER,
            boot_id=NEWCOMER_BOOT_ID,
            link=client_secure.SecureLink(self._keyring.of(NEWCOMER), entropy=self._entropy),
        )
        self._session = self.client._session.number
        assert self._session is not None

    def seeds(self) -> Sequence[bytes]:
        return list(self.newest.values())

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        draw, head = rng.random(), channel.HEADER.size
        if draw < 0.1:
            return payload
        if draw < 0.4:
            at = rng.randrange(head)
            return payload[:at] + rng.randbytes(1) + payload[at + 1 :]
        return bytes_changed(rng, payload)

    def _note(self, sender: str, payload: bytes) -> None:
        if sender != "answer":  # a stranger may forward all packets of both ends
            self.newest[sender, payload[1]] = payload

    def _attack(self, payload: bytes) -> None:
        if self.newcomer.finished:  # the client has given up
            self._begin()
        due_ns = self.newcomer.next_wake_ns()
        if due_ns is not None and due_ns <= self._now_ns:
            self.newcomer.wake(now_ns=self._now_ns)
            for datagram in self.newcomer.outbox():
                self._note("newcomer", datagram.payload)
        for peer in (STRANGER, CLIENT):
            self._unheard(self.server, payload, peer)
        for client in (self.client, self.newcomer):
            self._unheard(client, payload, SERVER)
        assert [each.vehicle for each in self.server.sessions] == [1], payload.hex()
        assert not self.server.sessions.welcomed_vehicles, payload.hex()
        assert self.client._session.number == self._session, payload.hex()
        assert self.newcomer._session.number is None, payload.hex()

    def _unheard(self, end: Server | Client, payload: bytes, peer: Address) -> None:
        """Send a datagram that no peer has sealed to an end, where it must be dropped, or answered
        by a cookie.
        """
        dropped = end.dropped.total()
        end.receive(Datagram(payload, peer), now_ns=self._now_ns)
        answers = end.outbox()
        assert end.dropped.total() - dropped + len(answers) == 1, payload.hex()
        assert sum(len(each.payload) for each in answers) <= len(payload), payload.hex()


class Holder(Datagrams):
    """Target for a holder of a vehicle's key, which seals arbitrary content in handshake packets.

    The first byte of a payload chooses the packet: an INITIATION, a CHALLENGE, or a RESPONSE. The
    rest of the payload is the handshake message of the INITIATION or RESPONSE, or is carried in a
    valid handshake message.
    """

    code = (*CODE, protocol)

    def __init__(self) -> None:
        self._scenario = SCENARIOS[0]
        keyring = make_keys(1, NEWCOMER)
        self._keyring, self._key = keyring, keyring.of(NEWCOMER)
        self._entropy = stream(3, "entropy").bytes
        self._begin()

    def _begin(self) -> None:
        self._now_ns, self._heard = SECOND_NS, 0
        self._gate = server_secure.SecureGate(self._keyring, entropy=self._entropy)
        self.server = Server(
            self._scenario, boot_id=2**40, entropy=self._entropy, gate=self._gate, capacity=4
        )
        self._link = client_secure.SecureLink(self._key, entropy=self._entropy)
        self.client = Client(
            self._scenario,
            simulated(self._scenario, NEWCOMER),
            server=SERVER,
            vehicle=NEWCOMER,
            boot_id=NEWCOMER_BOOT_ID,
            link=self._link,
        )

    def seeds(self) -> Sequence[bytes]:
        """Packets of each kind, those with content carrying a valid message."""
        terms = self._scenario.terms()
        hello = encode(Hello(NEWCOMER, NEWCOMER_BOOT_ID, terms))
        welcome = encode(Welcome(NEWCOMER, 7, NEWCOMER_BOOT_ID, 3, 10, 0, terms))
        return (b"\0" + hello, b"\1" + hello, b"\2" + bytes(16), b"\3" + welcome, b"\4" + welcome)

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        kind = payload[:1] if rng.random() < 0.9 else rng.randbytes(1)
        return kind + super().mutated(rng, payload[1:])

    def __call__(self, payload: bytes) -> None:
        if self._heard == HOLDER_LIFE or self.client.finished:
            self._begin()
        self._heard += 1
        self._now_ns += HOLDER_STEP_NS
        for end in (self.server, self.client):
            due_ns = end.next_wake_ns()
            if due_ns is not None and due_ns <= self._now_ns:
                end.wake(now_ns=self._now_ns)
            end.outbox()
        kind, rest = (payload[0] % 5, payload[1:]) if payload else (0, b"")
        if kind < 2:
            self._hear(self.server, self._initiation(rest, carried=kind == 1), CLIENT)
        elif (answer := self._answer(kind, rest)) is not None:
            self._hear(self.client, answer, SERVER)

    def _hear(self, end: Endpoint, packet: bytes, peer: Address) -> None:
        end.receive(Datagram(packet, peer), now_ns=self._now_ns)
        question = max(len(packet), handshake.INITIATION_BYTES if end is self.client else 0)
        assert sum(len(each.payload) for each in end.outbox()) <= question, packet.hex()
        assert len(end.events()) <= EVENTS_MAX + 20
        assert {each.vehicle for each in self.server.sessions} <= {NEWCOMER}, packet.hex()
        assert {*self.server.sessions.welcomed_vehicles} <= {NEWCOMER}, packet.hex()
        vehicles = self._gate._vehicles
        assert {*vehicles} <= {NEWCOMER}
        assert all(len(each.pending) <= server_secure.PENDING_MAX for each in vehicles.values())
        attempt = self._link._attempt
        assert attempt is None or len(attempt.tried_ns) <= client_secure.COOKIES_MAX

    def _initiation(self, rest: bytes, *, carried: bool) -> bytes:
        """INITIATION with a valid cookie; `rest` is its message, or is carried in a valid one."""
        key = self._key
        cookie = self._gate._cookie(CLIENT, self._now_ns // server_secure.COOKIE_NS)
        message = rest[:FIRST_BYTES].ljust(FIRST_BYTES)
        if carried:
            padded = handshake.pad(rest[: handshake.HELLO_BYTES_MAX])
            private = self._entropy(KEY_BYTES)
            message = Initiator(key.psk, handshake.prologue(key), private, padded).message
        return handshake.write_initiation(key, cookie, message)

    def _answer(self, kind: int, rest: bytes) -> bytes | None:
        """CHALLENGE or RESPONSE to the client's attempt; None if there is no attempt."""
        key, attempt = self._key, self._link._attempt
        if attempt is None:
            return None
        public, message = attempt.noise.public, rest[: handshake.WELCOME_BYTES_MAX]
        if kind == 2:
            return handshake.write_challenge(key, rest[: handshake.COOKIE_BYTES], public)
        if kind == 4:
            noise = Responder(key.psk, handshake.prologue(key), attempt.noise.message)
            message, _ = noise.answer(self._entropy(KEY_BYTES), message)
        return handshake.write_response(key, CHANNEL, message, public)
