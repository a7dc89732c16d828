"""Targets for datagrams: the decoder, and server and client in flight, with and without keys."""

from collections.abc import Hashable, Sequence
from math import isfinite
from random import Random
from types import ModuleType

from fuzz.mutators import bytes_changed, corpus, fields_changed, seeds
from fuzz.target import Target
from skytether.client import endpoint as client_endpoint
from skytether.client import secure as client_secure
from skytether.client import session as client_session
from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.server import endpoint as server_endpoint
from skytether.server import reception, sessions
from skytether.server import secure as server_secure
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Datagram, Endpoint
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire import lead, protocol
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.lead import decode_led, with_leadership
from skytether.shared.wire.protocol import encode, kind_of
from skytether.sim.sealed import make_keys

SCENARIOS = (
    reading.load("playback"),
    reading.check(
        {
            "model": {"axes": 3, "tau_s": [0.5, 0.5, 0.4], "u_max": [3.0, 3.0, 2.0]},
            "control": {"scheme": "committed", "feedback": True, "horizon": 20},
        },
        "fuzz",
    ),
    reading.check({"control": {"scheme": "trajectory", "trigger": "expected_gap"}}, "fuzz"),
)
"""Scenarios: a flight in the plane with committed inputs, one in 3-D with feedback aboard, and one
along trajectories."""

KNOWN = (*corpus().values(), *(seed for each in SCENARIOS for seed in seeds(each.terms())))
"""Odd payloads, and one message of each type."""

STEP_NS = MILLISECOND_NS
"""Time in a flight between two payloads [ns]."""
LIFE = 10_000
"""Number of payloads after which a flight starts again."""


class Datagrams(Target):
    def seeds(self) -> Sequence[bytes]:
        return KNOWN

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        change = fields_changed if rng.random() < 0.5 else bytes_changed
        return change(rng, payload)


class Decoder(Datagrams):
    """Decoder of a scenario's messages: a payload is rejected, or its message can be encoded
    again.
    """

    code = (protocol, lead)

    def __init__(self, scenario: Scenario) -> None:
        self._terms = scenario.terms()

    def __call__(self, payload: bytes) -> None:
        try:
            message, number = decode_led(payload, self._terms)
        except ProtocolError:
            return
        again = with_leadership(number, encode(message))
        read, number = decode_led(again, self._terms)
        assert with_leadership(number, encode(read)) == again, payload.hex()


class EndpointInFlight(Datagrams):
    """Server and client in flight, which each receive a payload besides their own messages.

    Args:
        sealed: whether they have keys; then each payload is encrypted by the other end, as a faulty
            peer would, and so passes all checks against senders without a key.
    """

    code: Sequence[ModuleType] = (
        protocol,
        client_endpoint,
        client_session,
        server_endpoint,
        reception,
        sessions,
    )

    def __init__(self, scenario: Scenario, *, sealed: bool = False) -> None:
        self._scenario = scenario
        self._keyring = make_keys(1, 2) if sealed else None
        # Continues from flight to flight, so that no flight has the keys of an earlier flight.
        self._entropy = stream(1, "entropy").bytes
        self._begin()

    def _begin(self) -> None:
        scenario = self._scenario
        self._now_ns = SECOND_NS
        self.heard = 0
        """Number of payloads in the present flight."""
        self.newest: dict[Hashable, bytes] = {}
        self._vehicle = simulated(scenario, 1)
        entropy, keyring = self._entropy, self._keyring
        link = client_secure.SecureLink(keyring.of(1), entropy=entropy) if keyring else None
        gate = server_secure.SecureGate(keyring, entropy=entropy) if keyring else None
        self.client = Client(
            scenario, self._vehicle, server=("server", 0), vehicle=1, boot_id=2**50, link=link
        )
        self.server = Server(scenario, boot_id=2**40, entropy=entropy, gate=gate, capacity=4)
        for _ in range(200):
            self._pass()

    def _pass(self) -> None:
        self._now_ns += STEP_NS
        ends = ((self.client, self.server, "client"), (self.server, self.client, "server"))
        for sender, receiver, name in ends:
            due_ns = sender.next_wake_ns()
            if due_ns is not None and due_ns <= self._now_ns:
                sender.wake(now_ns=self._now_ns)
            for datagram in sender.outbox():
                self._note(name, datagram.payload)
                arriving = Datagram(datagram.payload, (name, 0))
                receiver.receive(arriving, now_ns=self._now_ns)
            assert len(sender.events()) <= EVENTS_MAX + 20

    def __call__(self, payload: bytes) -> None:
        if self.heard == LIFE or self.client.finished:
            self._begin()
        self.heard += 1
        self._attack(payload)
        self._pass()

    def seeds(self) -> Sequence[bytes]:
        """Messages of each type, odd payloads, and, twice as often, both ends' newest datagrams."""
        newest = list(self.newest.values())
        return (*KNOWN, *newest * (2 * len(KNOWN) // max(1, len(newest))))

    def _attack(self, payload: bytes) -> None:
        for end in (self.server, self.client):
            self._hear(end, payload)

    def _note(self, sender: str, payload: bytes) -> None:  # noqa: ARG002 - see `Strangers`
        if self._keyring is None:
            self.newest[kind_of(payload)] = payload

    def _seal(self, end: Endpoint, payload: bytes) -> bytes:
        """Datagram that carries a payload to an end; with keys, encrypted by the other end."""
        session = next(iter(self.server.sessions), None)
        if self._keyring is None or session is None:
            return payload
        return (self.client._session.link if end is self.server else session.line).seal(payload)

    def _hear(self, end: Endpoint, payload: bytes) -> None:
        peer = ("client" if end is self.server else "server", 0)
        end.receive(Datagram(self._seal(end, payload), peer), now_ns=self._now_ns)
        answers = end.outbox()
        assert len(answers) <= 1, payload.hex()
        state = self._vehicle.truth()
        assert all(map(isfinite, state.ravel().tolist())), payload.hex()
        for answer in answers:
            self._note("answer", answer.payload)
