"""The client as an endpoint: session, steps on its own grid, and flight without packets."""

from typing import Any, Literal

import numpy as np
import pytest

from by_hand import ByHand
from helpers import packaged
from skytether.client.endpoint import Client
from skytether.client.link import HELLO_NS
from skytether.client.several import PATH_SOCKETS, Several
from skytether.client.simulated.vehicle import SimulatedVehicle, simulated
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import Finished, Flying, ModeChanged, NoSession, SessionRefused
from skytether.shared.events.ground import NoAnswer, Unanswered
from skytether.shared.law.terms import Difference
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.paths import Paths
from skytether.shared.wire.protocol import (
    NO_HORIZON,
    Close,
    Heartbeat,
    Hello,
    Idle,
    Message,
    Observation,
    Refusal,
    Welcome,
    encode,
    stamp_us,
)

OPENED = ModeChanged(vehicle=4, before="init", after="ready", reason="its session is open")
"""Event of a vehicle that holds its last input for ever, and so accepts a horizon at once."""


def scenario(**changes: Any) -> Scenario:
    return packaged("paper-every-step", {"duration": 10.0}, changes)


def flying(**changes: Any) -> ByHand:
    """Client that has just received WELCOME."""
    server = ByHand(scenario(**changes))
    assert [type(message) for message in server.wake()] == [Hello]
    server.welcome()
    return server


def test_hello_is_repeated_until_somebody_answers() -> None:
    server = ByHand(scenario())
    said = []
    for second in range(4):
        assert server.client.next_wake_ns() == (0 if second == 0 else server.now_ns + HELLO_NS)
        said += server.wake()
    assert said == [Hello(4, 99, server.terms)] * 4


def test_an_unreachable_server_ends_the_client_with_a_reason() -> None:
    """After `link.connect_s`, before any flight; after 5 s it logs that it still tries."""
    server = ByHand(scenario(link={"connect_s": 15.0}))
    for _ in range(30):
        if server.client.finished:
            break
        server.wake()
    failure = NoAnswer(vehicle=4, host="server", port=0, waited_s=16.0)
    assert server.client.failure == failure
    waits = Unanswered(vehicle=4, host="server", port=0, left_s=10.0)
    assert server.client.events() == (waits, failure)
    assert server.client.next_wake_ns() is None


def test_a_server_that_is_not_heard_on_any_path_is_named_by_all_its_addresses() -> None:
    flown, places = scenario(link={"connect_s": 15.0}), (("wifi", 1), ("lte", 2))
    client = Client(flown, simulated(flown, 1), server=Several(places), vehicle=4, boot_id=99)
    while (now_ns := client.next_wake_ns()) is not None:
        client.wake(now_ns=now_ns)
    waits, failure = client.events()
    assert isinstance(waits, Unanswered)
    assert isinstance(failure, NoAnswer)
    assert waits.everywhere == failure.everywhere == "wifi:1, lte:2"


def test_another_scenario_at_the_server_ends_the_client_with_the_difference() -> None:
    server = ByHand(scenario())
    server.wake()
    server.welcome(terms=server.terms._replace(dt_ns=20_000_000))
    assert server.client.finished
    failure = SessionRefused(
        vehicle=4, differences=(Difference("control.dt", here="0.05", there="0.02"),)
    )
    assert server.client.failure == failure
    assert server.client.events() == (failure,)


@pytest.mark.parametrize(
    ("refusal", "reason"),
    [(Refusal.FULL, "full"), (Refusal.TAKEN, "taken")],
)
def test_a_vehicle_that_is_refused_says_why_asks_on_and_gives_up_with_the_reason(
    refusal: int, reason: Literal["full", "taken"]
) -> None:
    """Logged at the first refusal; gives up after `link.connect_s`, as without an answer."""
    server, hellos = ByHand(scenario(link={"connect_s": 15.0})), 0
    while not server.client.finished:
        hellos += len(server.wake())
        server.welcome(refusal=refusal)
    assert hellos == 37  # at 0, 1 s, 1.4 s, …
    failure = NoSession(vehicle=4, host="server", port=0, reason=reason)
    assert server.client.failure == failure
    assert server.client.events() == (failure,)
    assert server.client.next_wake_ns() is None
    assert server.client.dropped == {reason: 38}


def test_a_vehicle_that_hears_its_server_says_no_hello_again() -> None:
    server = flying(link={"heartbeat_s": 0.1, "timeout_s": 1.0})
    said: list[Message] = []
    for step in range(100):
        said += server.wake()
        server.say(Heartbeat(4, server.session, 1234 + step, Idle.PLANS, 0))
    assert [type(message) for message in said] == [Observation] * 100


def test_a_vehicle_that_was_refused_flies_once_there_is_room() -> None:
    server = ByHand(scenario())
    for refusal in (Refusal.FULL, Refusal.TAKEN, Refusal.ACCEPTED):
        server.wake()
        server.welcome(refusal=refusal)
    (said,) = server.wake()
    assert isinstance(said, Observation)
    events = [type(event) for event in server.client.events()]
    assert events == [NoSession, NoSession, Flying, ModeChanged]


def test_a_refusal_in_flight_is_told_and_flown_through() -> None:
    """After its first session a vehicle never gives up, and a late refusal is not logged."""
    server = flying(link={"heartbeat_s": 0.1, "timeout_s": 1.0, "connect_s": 2.0})
    server.welcome(refusal=Refusal.TAKEN)
    assert server.client.events() == (Flying(vehicle=4), OPENED)
    for _ in range(100):
        server.wake()
        server.welcome(refusal=Refusal.TAKEN)
    taken = NoSession(vehicle=4, host="server", port=0, reason="taken")
    assert server.client.events() == (taken,)
    server.welcome()
    assert server.client.events() == ()
    assert server.client.failure is None
    assert server.rows()["step"].tolist() == list(range(100))


def test_another_scenario_in_flight_is_dropped() -> None:
    server = flying()
    server.welcome(terms=server.terms._replace(horizon=server.terms.horizon + 1))
    assert server.client.failure is None
    assert server.client.dropped == {Drop.OTHER_TERMS: 1}


def test_nothing_of_a_closed_session_is_heard() -> None:
    server, beat = flying(vehicle={"exhausted": "brake"}), Heartbeat(4, 7, 0, 0, 0, 1, 25)
    server.say(beat)
    server.say(Close(4, 7))
    server.say(beat)
    assert server.client.dropped == {Drop.UNKNOWN_SESSION: 1}
    server.welcome()
    server.say(beat)
    assert server.client.dropped == {Drop.UNKNOWN_SESSION: 1}


def test_a_restarted_server_whose_clock_is_ahead_is_no_sleep_of_the_vehicle() -> None:
    """Clocks of two runs of the server cannot be compared; only the restart causes braking."""
    server = flying(vehicle={"exhausted": "brake"})
    for step in range(45):
        server.wake()
        server.horizon(step, 0.5)
    server.client.events()
    ahead_ns = server.now_ns + 10_000 * SECOND_NS
    restarted = Welcome(4, 8, 99, 2, ahead_ns, Refusal.ACCEPTED, server.terms)
    server.say(restarted)
    assert server.client.dropped[Drop.UNASKED] == 1
    server.client._session._awaits_welcome = True
    server.say(restarted)
    reasons = [event.reason for event in server.client.events() if isinstance(event, ModeChanged)]
    assert reasons == [str(Reason.RESTARTED)]


def test_a_welcome_that_no_hello_asked_for_changes_nothing() -> None:
    """A late copy of an old WELCOME would lead the vehicle to a session that has ended."""
    server, beat = flying(vehicle={"exhausted": "brake"}), Heartbeat(4, 7, 0, 0, 0, 1, 25)
    server.say(beat)
    server.client.events()
    server.session = 8
    server.welcome(server_boot_id=2, asked=False)
    assert server.client.dropped == {Drop.UNASKED: 1}
    assert server.client._session.number == 7
    assert not server.client.events()


def test_packets_are_numbered_anew_in_each_session() -> None:
    server = flying()
    numbers = [said.number for _ in range(3) for said in server.wake()]  # type: ignore[union-attr]
    server.session = 8
    server.welcome()
    numbers += [said.number for _ in range(2) for said in server.wake()]  # type: ignore[union-attr]
    assert [number - numbers[0] for number in numbers] == [0, 1, 2, 0, 1]


def test_the_epoch_is_the_moment_the_session_opens() -> None:
    """Step k begins at epoch + k Δt exactly, however late the timer is."""
    server = flying()
    epoch_ns = server.now_ns
    (first,) = server.wake()
    server.now_ns += server.dt_ns + 3_000_000
    (second,) = server.wake()
    assert isinstance(first, Observation)
    assert isinstance(second, Observation)
    assert (first.step, first.in_force) == (0, NO_HORIZON)
    assert second.step == 1
    assert server.client.next_wake_ns() == epoch_ns + 2 * server.dt_ns


def test_every_observation_tells_when_the_newest_word_of_the_server_came() -> None:
    """Arrival time minus time stamp of the message, for the server's estimate of the clock
    offset.
    """
    server = flying()
    epoch_ns = server.now_ns
    (first,) = server.wake()
    server.now_ns += 7_000_000
    server.say(Heartbeat(4, 7, 4321, 0, 0))
    heard_ns = server.now_ns
    (second,) = server.wake()
    (third,) = server.wake()
    assert isinstance(first, Observation)
    assert isinstance(second, Observation)
    assert isinstance(third, Observation)
    assert first.backward_us == stamp_us(-1000)  # of 1234 ns, rounded up
    assert second.backward_us == stamp_us(heard_ns - epoch_ns - 4_321_000) == third.backward_us
    assert (first.heard, second.heard, third.heard) == (1, 2, 2)


def test_an_input_is_flown_from_the_step_after_it_came() -> None:
    """Applied at the next step, visible in the state one step later."""
    server = flying()
    server.wake()
    server.horizon(0, 1.0)
    for _ in range(3):
        server.wake()
    rows = server.rows()
    assert rows["input"][:, 0].tolist() == [0.0, 1.0, 1.0, 1.0]
    assert rows["in_force"].tolist() == [NO_HORIZON, 0, 0, 0]
    velocity = rows["state"][:, 0, 1]
    assert velocity[:2].tolist() == [0.0, 0.0]
    assert velocity[2] == pytest.approx(1 - np.exp(-0.05 / 0.84), abs=1e-12)
    assert rows["age_ns"].tolist() == [-1, *(n * server.dt_ns for n in (1, 2, 3))]


def test_ages_are_counted_from_a_clock_that_begins_with_the_flight_as_well() -> None:
    """The observation of step 0 is stamped 0; without a horizon the age is -1."""
    server = ByHand(scenario())
    server.now_ns = 0
    server.wake()
    server.welcome()
    server.wake()
    server.horizon(0, 1.0)
    for _ in range(3):
        server.wake()
    assert server.rows()["age_ns"].tolist() == [-1, *(n * server.dt_ns for n in (1, 2, 3))]
    assert server.client.vehicle_figures()["age_ms"] == 150.0


def test_a_vehicle_that_does_not_know_its_true_state_records_its_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SimulatedVehicle, "truth", lambda _: None)
    server = flying()
    said = [message for _ in range(3) for message in server.wake()]
    rows = server.rows()
    np.testing.assert_array_equal(rows["state"], rows["estimate"])
    assert rows["step"].tolist() == [0, 1, 2]
    for row, message in zip(rows, said, strict=True):
        assert isinstance(message, Observation)
        np.testing.assert_array_equal(row["estimate"].astype(np.float32), message.state)


def test_steps_slept_through_are_flown_with_the_old_input_and_counted() -> None:
    """The actuator holds the last input; only the present step is observed."""
    server = flying()
    server.wake()
    server.horizon(0, 1.0)
    server.wake()
    server.now_ns += 4 * server.dt_ns
    (late,) = server.wake()
    assert isinstance(late, Observation)
    assert late.step == 5
    assert server.client.missed == 3
    tau, held_s = 0.84, 4 * 0.05
    assert late.state[0, 1] == pytest.approx(1 - np.exp(-held_s / tau), rel=1e-7)


def test_a_silent_server_is_called_while_the_flight_goes_on() -> None:
    """HELLO accompanies the observations until a heartbeat arrives; the epoch stays."""
    server = flying(link={"heartbeat_s": 0.1, "timeout_s": 1.0})
    epoch_ns = server.now_ns
    said = [message for _ in range(65) for message in server.wake()]
    hellos = [message for message in said if isinstance(message, Hello)]
    assert len(said) - len(hellos) == 65
    assert len(hellos) == 6  # from 1.05 s on, every 0.4 s
    server.say(Heartbeat(4, 7, 1, 0, 0))
    (only,) = server.wake()
    assert isinstance(only, Observation)
    assert only.step == 65
    assert server.client.next_wake_ns() == epoch_ns + 66 * server.dt_ns


def test_a_restarted_server_is_flown_with_in_its_new_session() -> None:
    server = flying()
    server.wake()
    server.session = 8
    server.welcome(server_boot_id=2)
    (said,) = server.wake()
    assert isinstance(said, Observation)
    assert (said.session, said.step) == (8, 1)
    server.session = 7
    server.horizon(1, 1.0)
    assert server.client.dropped == {Drop.UNKNOWN_SESSION: 1}


def test_an_answer_to_another_life_is_dropped() -> None:
    server = ByHand(scenario())
    server.wake()
    server.welcome(boot_id=98)
    assert server.client.dropped == {Drop.FOR_ANOTHER_LIFE: 1}
    assert [type(message) for message in server.wake()] == [Hello]


def test_the_flight_ends_after_its_duration() -> None:
    server = flying()
    for step in range(200):
        assert not server.client.finished
        server.wake()
        server.horizon(step, 0.0)
    assert server.client.finished
    assert server.client.events()[-1] == Finished(vehicle=4, steps=200, missed=0)
    assert server.client.next_wake_ns() is None
    assert server.rows()["step"].tolist() == list(range(200))


def test_a_client_that_wakes_after_the_end_flies_the_last_step() -> None:
    server = flying(duration=2.0)
    server.wake()
    server.now_ns += 60 * SECOND_NS
    server.wake()
    assert server.client.finished
    assert server.rows()["step"].tolist() == [0, 39]


def test_an_exhausted_horizon_brakes_or_holds() -> None:
    speeds = {}
    for exhausted in ("hold", "brake"):
        server = flying(vehicle={"exhausted": exhausted})
        for _ in range(22):  # after a second of good link
            server.wake()
        server.horizon(21, 1.0)
        for _ in range(100):
            server.wake()
        speeds[exhausted] = server.rows()["input"][22:, 0]
    assert speeds["hold"][-1] == 1.0
    # H = 40 inputs of 1 m/s on two axes, then 2 m/s² against a speed of √2 m/s.
    expected = np.maximum(0.0, 1.0 - np.arange(1, 62) * 2.0 * 0.05 / np.sqrt(2.0))
    np.testing.assert_allclose(speeds["brake"][39:], expected, atol=1e-9)
    assert speeds["brake"][-1] == 0.0


def test_only_the_servers_address_is_heard() -> None:
    server = ByHand(scenario())
    server.wake()
    welcome = Welcome(4, 7, 99, 1, 1234, Refusal.ACCEPTED, server.terms)
    server.client.receive(Datagram(encode(welcome), ("elsewhere", 1)), now_ns=0)
    assert server.client.dropped == {"not from the server's address": 1}
    assert not any(isinstance(event, Flying) for event in server.client.events())


def test_a_path_message_that_was_overtaken_is_no_sign_of_life() -> None:
    flown = packaged("demo-two-links")
    places: list[Address] = [("one", 1), ("two", 1)]
    client = Client(flown, simulated(flown, 1), server=Several(places), vehicle=4, boot_id=99)
    client.wake(now_ns=SECOND_NS)
    peer, session = Paths((1000, 1000), SECOND_NS), client._session

    def hear(message: Message, report: bytes, now_ns: int) -> None:
        datagram = Datagram(report + encode(message), places[0], PATH_SOCKETS[0])
        client.receive(datagram, now_ns=now_ns)

    hear(Welcome(4, 7, 99, 1, 1234, Refusal.ACCEPTED, flown.terms()), b"", SECOND_NS)
    late, tried = peer.report(), PathProof(4, 7, 0, 0, (1000, 1000))
    for i in range(1, 20):
        hear(tried, peer.report(), (i + 1) * SECOND_NS)
    assert session.heard_ns == 20 * SECOND_NS
    hear(tried, late, 21 * SECOND_NS)
    assert session.heard_ns == 20 * SECOND_NS
    assert client.dropped == {Drop.OVERTAKEN: 1}
