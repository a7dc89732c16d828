"""Hostile packets are dropped and counted, and change nothing."""

import random
from collections.abc import Iterator

import numpy as np
import pytest

from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.server.endpoint import VEHICLES_MAX, Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Address, Datagram, Endpoint
from skytether.shared.events.flight import Omitted
from skytether.shared.scenario import reading
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.protocol import (
    FEEDBACK,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Mode,
    Observation,
    Welcome,
    decode,
    encode,
)

SCENARIO = reading.load("paper")
TERMS = SCENARIO.terms()
SERVER: Address = ("server", 0)
STRANGER = ("stranger", 6)
DATAGRAMS = 10_000


def hostile(rng: random.Random) -> Iterator[bytes]:
    """Random bytes, and real messages with bytes changed, cut off, inserted or duplicated."""
    inputs = np.zeros((2, 40), np.float32)
    real = [
        encode(message)
        for message in (
            Welcome(1, 7, 5, 3, 10, 0, TERMS),
            Observation(1, 7, 5, 4, 4, 8, 9, 3, 1, np.zeros((2, 2)), np.zeros(2)),
            Horizon(1, 7, 5, 10, 1, inputs),
            Horizon(1, 7, 5, 10, 1, inputs, np.ones((2, FEEDBACK), np.float32)),
            Heartbeat(1, 7, 10, 0, 0),
            Close(1, 7),
        )
    ]
    while True:
        if rng.random() < 0.3:
            yield rng.randbytes(rng.randrange(1500))
            continue
        payload = bytearray(rng.choice(real))
        for _ in range(rng.randrange(1, 4)):
            at = rng.randrange(len(payload) + 1)
            match rng.randrange(4):
                case 0 if at < len(payload):
                    payload[at] = rng.randrange(256)
                case 1:
                    payload = payload[:at]
                case 2:
                    payload[at:at] = rng.randbytes(rng.randrange(1, 9))
                case _:
                    payload += payload[at:]
        yield bytes(payload)


def endpoints() -> list[Endpoint]:
    flies = simulated(SCENARIO, 1)
    return [
        Server(SCENARIO, boot_id=2**40, entropy=stream(1, "entropy").bytes),
        Client(SCENARIO, flies, server=SERVER, vehicle=1, boot_id=2**50),
    ]


@pytest.mark.parametrize("endpoint", endpoints(), ids=["server", "client"])
def test_ten_thousand_hostile_datagrams_are_counted_and_change_nothing(
    endpoint: Server | Client,
) -> None:
    asleep_until = endpoint.next_wake_ns()
    datagrams = hostile(random.Random(1))
    sender = SERVER if isinstance(endpoint, Client) else STRANGER  # others are ignored
    for _ in range(DATAGRAMS):
        endpoint.receive(Datagram(next(datagrams), sender), now_ns=SECOND_NS)
    assert endpoint.outbox() == []
    assert endpoint.next_wake_ns() == asleep_until
    assert not endpoint.finished
    assert sum(endpoint.dropped.values()) == DATAGRAMS
    assert set(endpoint.dropped) <= {
        *(Drop.TOO_LONG, Drop.NOT_MSGPACK, Drop.NOT_A_MESSAGE, Drop.VERSION, Drop.TYPE, Drop.FIELD),
        *(Drop.SHAPE, Drop.NOT_FINITE, Drop.INPUT_OUT_OF_RANGE, Drop.UNKNOWN_SESSION),
        *(Drop.FOR_ANOTHER_LIFE, Drop.NOT_FOR_A_SERVER, Drop.NOT_FOR_A_CLIENT),
    }


def test_a_flood_of_hellos_stays_within_the_servers_bounds() -> None:
    """Many vehicles with many lives: one answer each, bounded memory, each refusal logged."""
    server = Server(SCENARIO, boot_id=1, entropy=stream(1, "entropy").bytes)
    answers = 0
    for boot_id in range(3):
        for vehicle in range(2000):
            hello = encode(Hello(vehicle, boot_id, TERMS))
            server.receive(Datagram(hello, STRANGER), now_ns=SECOND_NS)
            answers += len(server.outbox())
    assert answers == 6000
    assert len(server.sessions.welcomed_vehicles) == VEHICLES_MAX
    assert sum(not isinstance(event, Omitted) for event in server.events()) <= EVENTS_MAX


def test_an_answer_is_no_longer_than_its_question() -> None:
    """HELLO and WELCOME: the server cannot be used to amplify a flood."""
    hello = encode(Hello(1, 2**63, TERMS))
    server = Server(SCENARIO, boot_id=2**63, entropy=stream(1, "entropy").bytes)
    server.receive(Datagram(hello, STRANGER), now_ns=3 * 10**14)
    ((answer, _, _),) = server.outbox()
    assert len(answer) < 1.5 * len(hello)


@pytest.mark.parametrize("step", [0, 5, 2**31, 2**32 - 1])
@pytest.mark.parametrize("backward_us", [0, 2**31, 2**32 - 1])
@pytest.mark.parametrize("began_ns", [0, 2**60])
def test_no_observation_in_a_session_stops_the_server(
    step: int, backward_us: int, began_ns: int
) -> None:
    """The largest and the smallest of all numbers, as a first message and repeated."""
    server = Server(SCENARIO, boot_id=1, entropy=stream(1, "entropy").bytes)
    server.receive(Datagram(encode(Hello(1, 2, TERMS)), STRANGER), now_ns=began_ns)
    ((payload, _, _),) = server.outbox()
    welcome = decode(payload, TERMS)
    assert isinstance(welcome, Welcome)
    state = np.full((2, 2), 3e38)
    observation = Observation(
        vehicle=1,
        session=welcome.session,
        step=step,
        in_force=0,
        since=step,
        backward_us=backward_us,
        heard=1,
        mode=Mode.TRACK,
        takes=1,
        state=state,
        input=np.array(TERMS.u_max),
    )
    for number in range(10):
        now_ns = began_ns + number * TERMS.dt_ns
        with np.errstate(all="ignore"):
            server.receive(Datagram(encode(observation), STRANGER), now_ns=now_ns)
            server.receive(
                Datagram(encode(observation._replace(in_force=-1)), STRANGER), now_ns=now_ns
            )
            server.receive(Datagram(encode(observation._replace(since=0)), STRANGER), now_ns=now_ns)
            server.receive(
                Datagram(encode(observation._replace(in_force=-1, since=0)), STRANGER),
                now_ns=now_ns,
            )
            server.wake(now_ns=now_ns)
