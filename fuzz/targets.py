"""What is fuzzed: the decoder, and a server and a client in a flight, with keys and without."""

from collections.abc import Callable
from math import isfinite

from client import secure as client_secure
from client.plant import FirstOrderPlant
from client.vehicle import Client
from server import secure as server_secure
from server.endpoint import Server
from shared import config
from shared.chance import stream
from shared.config import Scenario
from shared.endpoint import EVENTS_MAX, MILLISECOND_NS, SECOND_NS, Datagram, Endpoint
from shared.protocol import ProtocolError, decode, encode
from sim.flight import make_keys

Target = Callable[[bytes], None]
"""Takes a payload, and raises where something is wrong with what happens to it."""

SCENARIOS = (
    config.load("playback"),
    config.check(
        {
            "model": {"axes": 3, "tau_s": [0.5, 0.5, 0.4], "u_max": [3.0, 3.0, 2.0]},
            "control": {"scheme": "committed", "feedback": True, "horizon": 20},
        },
        "fuzz",
    ),
)
"""A flight in the plane with committed inputs, and one in space with feedback aboard."""

STRANGER = ("stranger", 6)
STEP_NS = MILLISECOND_NS
"""Time that passes in a flight from one payload to the next [ns]."""
LIFE = 10_000
"""Number of payloads after which a flight begins anew."""


def decoder(scenario: Scenario) -> Target:
    """Decoder with the terms of a scenario: a payload is none of ours, or a message that keeps."""
    terms = scenario.terms()

    def target(payload: bytes) -> None:
        try:
            message = decode(payload, terms)
        except ProtocolError:
            return
        again = encode(message)
        assert encode(decode(again, terms)) == again, payload.hex()

    return target


class InFlight:
    """A server and a client that fly a scenario, and hear a payload each beside their own.

    Args:
        scenario: what to fly.
        sealed: whether they have keys; then each payload is sealed by the other end, as a faulty
            peer would, and stands behind all that keeps strangers out.
    """

    def __init__(self, scenario: Scenario, *, sealed: bool = False) -> None:
        self._scenario = scenario
        self._keyring = make_keys(1, 1) if sealed else None
        self._begin()

    def _begin(self) -> None:
        scenario = self._scenario
        self._now_ns = SECOND_NS
        self.heard = 0
        """Number of payloads heard since the flight began."""
        self.newest: dict[int, bytes] = {}
        """Newest of their own datagrams of each type."""
        plant = FirstOrderPlant(scenario, stream(1, "wind"))
        entropy, keyring = stream(1, "entropy").bytes, self._keyring
        link = client_secure.Secure(keyring.of(1), entropy=entropy) if keyring else None
        gate = server_secure.Secure(keyring, entropy=entropy) if keyring else None
        self.client = Client(
            scenario, plant, server=("server", 0), vehicle=1, boot_id=2**50, link=link
        )
        self.server = Server(scenario, boot_id=2**40, entropy=entropy, gate=gate, room=4)
        for _ in range(200):
            self._pass()

    def _pass(self) -> None:
        """Let a step of time pass; what they send arrives at once."""
        self._now_ns += STEP_NS
        ends = ((self.client, self.server, "client"), (self.server, self.client, "server"))
        for sender, receiver, name in ends:
            due_ns = sender.next_wake_ns()
            if due_ns is not None and due_ns <= self._now_ns:
                sender.wake(now_ns=self._now_ns)
            for datagram in sender.outbox():
                self._note(datagram)
                told = Datagram(datagram.payload, (name, 0))
                receiver.receive(told, now_ns=self._now_ns)
            assert len(sender.events()) <= EVENTS_MAX + 20

    def __call__(self, payload: bytes) -> None:
        """Let both ends hear a payload."""
        if self.heard == LIFE or self.client.finished:
            self._begin()
        self.heard += 1
        for end in (self.server, self.client):
            self._hear(end, payload)
        self._pass()

    def _note(self, datagram: Datagram) -> None:
        if self._keyring is None:
            self.newest[datagram.payload[2]] = datagram.payload

    def _seal(self, end: Endpoint, payload: bytes) -> bytes:
        """Datagram that brings a payload to an end, from the other one where they have keys."""
        session = next(iter(self.server.sessions), None)
        if self._keyring is None or session is None:
            return payload
        return (self.client._link if end is self.server else session.line).seal(payload)

    def _hear(self, end: Endpoint, payload: bytes) -> None:
        peer = ("client" if end is self.server else "server", 0)
        end.receive(Datagram(self._seal(end, payload), peer), now_ns=self._now_ns)
        answers = end.outbox()
        assert len(answers) <= 1, payload.hex()
        state = self.client._plant.state()
        assert all(map(isfinite, state.ravel().tolist())), payload.hex()
        for answer in answers:
            self._note(answer)


def targets() -> dict[str, Target]:
    """All targets, by name."""
    decoders = {f"decode {s.model.axes}-D": decoder(s) for s in SCENARIOS}
    flights = {f"flight {s.model.axes}-D": InFlight(s) for s in SCENARIOS}
    sealed = {f"sealed {s.model.axes}-D": InFlight(s, sealed=True) for s in SCENARIOS}
    return {**decoders, **flights, **sealed}
