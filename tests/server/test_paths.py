"""Paths from the server to a vehicle: how an address is proven, forgotten and found anew."""

import numpy as np
import pytest

from helpers import packaged
from skytether.server.endpoint import Server
from skytether.server.paths import FORMER_NS, Place, RoutesOverPaths, ServerPaths
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.framing import split
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.paths import Paths
from skytether.shared.wire.protocol import (
    NO_HORIZON,
    Hello,
    Message,
    Mode,
    Observation,
    Welcome,
    decode,
    encode,
)

PRICES = (1000, 1000)
NOW_NS = SECOND_NS
FIRST, SECOND, MOVED = Place(("first", 1), 0), Place(("second", 1), 0), Place(("moved", 1), 0)


def made() -> ServerPaths:
    return ServerPaths(PRICES, "auto", stream(1, "entropy").bytes, SECOND_NS)


def test_an_address_is_proven_by_the_number_sent_to_it_and_by_no_other() -> None:
    paths = made()
    message = PathProof(1, 7, 0, 0, PRICES)
    question, other = paths.prove(message, FIRST, NOW_NS), paths.prove(message, MOVED, NOW_NS)
    assert question
    assert other
    assert question.proof != other.proof
    assert paths.prove(other, FIRST, NOW_NS)
    assert not paths.is_ready
    assert paths.prove(question, FIRST, NOW_NS) is None
    assert [*paths.places] == [FIRST]


def test_questions_to_many_addresses_leave_that_to_the_vehicle_valid() -> None:
    paths = made()
    message = PathProof(1, 7, 0, 0, PRICES)
    question = paths.prove(message, FIRST, NOW_NS)
    assert question
    for port in range(100):
        assert paths.prove(message, Place(("stranger", port), 0), NOW_NS)
    assert paths.prove(question, FIRST, NOW_NS) is None


class Vehicle:
    """Vehicle with two paths whose messages the test writes."""

    def __init__(self) -> None:
        flown = packaged("paper-every-step")
        self.terms, self.dt_ns = flown.terms(), flown.dt_ns
        self.server = Server(flown, boot_id=77, entropy=stream(1, "entropy").bytes)
        self.now_ns = 10 * SECOND_NS
        self.paths: Paths | None = Paths(PRICES, SECOND_NS)
        self.step = self.number = 0
        self.session = 0
        self.open()

    def open(self, place: Place = FIRST) -> None:
        (answer,) = self.send(encode(Hello(1, 5, self.terms)), place)
        welcome = decode(answer.payload, self.terms)
        assert isinstance(welcome, Welcome)
        self.session = welcome.session

    def send(self, payload: bytes, place: Place) -> list[Datagram]:
        """Answers to a datagram."""
        peer, socket = place
        self.server.receive(Datagram(payload, peer, socket), now_ns=self.now_ns)
        return self.server.outbox()

    def say(self, message: Message, place: Place) -> list[tuple[Message, Address]]:
        report = self.paths.report() if self.paths else b""
        answers = self.send(report + encode(message), place)
        return [(decode(split(each.payload)[1], self.terms), each.peer) for each in answers]

    def observe(self, place: Place) -> list[tuple[Message, Address]]:
        self.step += 1
        self.number += 1
        self.now_ns += self.dt_ns
        axes, backward_us = self.terms.axes, (self.step * self.dt_ns - self.now_ns) // 1000 % 2**32
        observation = Observation(
            1,
            self.session,
            self.step,
            NO_HORIZON,
            self.step,
            backward_us,
            0,
            Mode.HOVER,
            True,
            np.zeros((axes, 2)),
            np.zeros(axes),
            self.number % 128,
            0,
        )
        return self.say(observation, place)

    def prove(self, path: int, place: Place) -> None:
        message = PathProof(1, self.session, path, 0, PRICES)
        ((question, peer),) = self.say(message, place)
        assert isinstance(question, PathProof)
        assert peer == place.peer
        assert self.say(message._replace(proof=question.proof), place) == []


def test_a_server_without_the_room_of_paths_refuses_their_reports_and_serves_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("skytether.server.routes.ROOM", "skytether.server.no_paths")
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    assert vehicle.server.dropped[Drop.NOT_FOR_A_SERVER] == 1
    vehicle.paths = None
    vehicle.observe(FIRST)
    assert vehicle.server.dropped.total() == 1


def routes(vehicle: Vehicle) -> RoutesOverPaths:
    found = vehicle.server.sessions.routes
    assert isinstance(found, RoutesOverPaths)
    return found


def test_addresses_that_a_path_has_left_are_forgotten() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    for port in range(20):
        vehicle.prove(0, Place(("vehicle", port), 0))
        vehicle.now_ns += SECOND_NS
    vehicle.prove(1, SECOND)
    newest = {Place(("vehicle", port), 0) for port in (18, 19)}
    assert {*routes(vehicle).at} == {*newest, SECOND}


def test_a_forwarder_of_copies_does_not_take_a_path_away() -> None:
    """His addresses are proven like the vehicle's own, which stays in use while it is heard."""
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    for port in range(3):
        vehicle.now_ns += SECOND_NS
        vehicle.step += SECOND_NS // vehicle.dt_ns
        vehicle.prove(0, Place(("forwarder", port), 0))
        vehicle.observe(FIRST)
    session = routes(vehicle).of[1]
    paths = session.route
    assert isinstance(paths, ServerPaths)
    assert {*paths.places} == {FIRST, Place(("forwarder", 2), 0)}
    line = session.line
    sent = paths.sealed(b"\x93plan", line, vehicle.now_ns)
    assert {each.peer for each in sent} == {FIRST.peer, ("forwarder", 2)}
    later_ns = vehicle.now_ns + FORMER_NS + 1
    sent = paths.sealed(b"\x93plan", line, later_ns)
    assert [each.peer for each in sent] == [("forwarder", 2)], "the vehicle has another address"


def test_path_is_asked_for_a_proof_as_soon_as_it_is_heard_at_another_address() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.prove(1, SECOND)
    assert vehicle.observe(FIRST) == []
    ((question, peer),) = vehicle.observe(MOVED)
    assert peer == MOVED.peer
    assert isinstance(question, PathProof)
    assert vehicle.say(question._replace(path=0), MOVED) == []
    assert {*routes(vehicle).at} == {FIRST, MOVED, SECOND}


def test_copy_over_another_path_is_dropped_as_a_copy() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.prove(1, SECOND)
    sent, send = [], vehicle.send
    vehicle.send = lambda payload, place: sent.append(payload) or send(payload, place)  # type: ignore[method-assign,func-returns-value]
    vehicle.observe(FIRST)
    assert send(sent[-1], SECOND) == []
    assert vehicle.server.dropped == {Drop.COPY: 1}


def test_client_that_was_started_again_with_a_single_path_is_answered_there() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.prove(1, SECOND)
    vehicle.paths = None
    vehicle.open(MOVED)
    vehicle.observe(MOVED)
    vehicle.server.close(now_ns=vehicle.now_ns)
    assert {each.peer for each in vehicle.server.outbox()} == {MOVED.peer}


def test_client_that_was_started_again_with_more_paths_is_heard() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.paths = Paths((1000, 1000, 1000), SECOND_NS)
    vehicle.open()
    vehicle.observe(FIRST)
    session = vehicle.server.sessions.live(1)
    assert session
    assert isinstance(session.route, ServerPaths)
    assert len(session.route.prices) == 3
    assert not vehicle.server.dropped


def test_prices_are_those_that_the_vehicle_named_last() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.say(PathProof(1, vehicle.session, 1, 0, (1000, 7000)), SECOND)
    session = vehicle.server.sessions.live(1)
    assert session
    assert isinstance(session.route, ServerPaths)
    assert [path.price for path in session.route.paths.each] == [1.0, 7.0]


def test_client_that_was_started_again_in_its_session_is_acknowledged_at_once() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    vehicle.prove(1, SECOND)
    for _ in range(60):
        vehicle.observe(FIRST)
    vehicle.paths = Paths(PRICES, SECOND_NS)
    before = vehicle.session
    vehicle.open()
    assert vehicle.session == before
    vehicle.observe(FIRST)
    session = vehicle.server.sessions.live(1)
    assert session
    assert isinstance(session.route, ServerPaths)
    report, _ = split(session.route.paths.report())
    assert report
    assert (report.newest, report.arrived) == (1, (1, 0))


def test_a_path_message_that_was_overtaken_keeps_no_session_and_sets_no_price() -> None:
    vehicle = Vehicle()
    vehicle.observe(FIRST)
    vehicle.prove(0, FIRST)
    assert vehicle.paths
    late = vehicle.paths.report() + encode(PathProof(1, vehicle.session, 0, 0, (1000, 7000)))
    for _ in range(60):
        vehicle.observe(FIRST)
    session = vehicle.server.sessions.live(1)
    assert session
    assert isinstance(session.route, ServerPaths)
    heard_ns = session.heard_ns
    vehicle.now_ns += 1
    # Even where the vehicle may have begun its numbers anew.
    session.route.paths.peer_may_restart = True
    assert vehicle.send(late, FIRST) == []
    assert vehicle.server.dropped == {Drop.OVERTAKEN: 1}
    assert session.heard_ns == heard_ns
    assert session.route.prices == PRICES
    vehicle.observe(FIRST)
    assert vehicle.server.dropped == {Drop.OVERTAKEN: 1}
    assert session.route.paths.peer_may_restart
