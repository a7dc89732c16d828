"""The server as an endpoint: sessions, ticks, and messages."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import packaged
from skytether.server.endpoint import VEHICLES_MAX, Server
from skytether.server.gate import GateCall, PlainGate
from skytether.server.secure import SecureGate
from skytether.server.sessions import WELCOME_NS, Session, Sessions
from skytether.server.tick import Grid
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.events.flight import (
    BegunAnew,
    Degraded,
    NumberTaken,
    PlanningResumed,
    PlanningStopped,
    ServerFull,
    SessionEnded,
    SessionOpened,
    SessionRefused,
    StateDoubted,
    Unauthenticated,
)
from skytether.shared.law.heartbeat import NUMBERS, SESSION_NS, Hearing
from skytether.shared.law.terms import Difference
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, Rows, server_columns
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.keys import Keyring
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.protocol import (
    NO_HORIZON,
    NO_INPUT,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    Refusal,
    Time,
    Welcome,
    decode,
    encode,
    stamp_us,
)

HERE: Address = ("vehicle", 1)
LINE = PlainGate().open(Datagram(b"", ("", 0)), now_ns=0).line
NO_ASSIGNMENT: Any = None
"""Of sessions without a standby server, which never ask."""
SILENCE_NS = 1500 * MILLISECOND_NS
"""Time after which another life of a vehicle may take its number, in all of these tests."""
DAY_NS = 86_400 * SECOND_NS


def scenario(**control: Any) -> Scenario:
    soon = {"timeout_s": SILENCE_NS / SECOND_NS}
    return packaged("paper-every-step", control=control, link=soon)


class Vehicles:
    def __init__(self, flown: Scenario, boot_id: int = 77, capacity: int = VEHICLES_MAX) -> None:
        self.terms = flown.terms()
        self.dt_ns = flown.dt_ns
        self._steps = MemoryRecorder(server_columns(flown.model.axes, flown.control.scheme))
        self.server = Server(
            flown,
            boot_id=boot_id,
            entropy=stream(1, "entropy").bytes,
            capacity=capacity,
            recorder=self._steps,
        )
        # Ticks lie on multiples of 50 ms: the first is 30 ms after the first message.
        self.now_ns = 10 * SECOND_NS + 20 * MILLISECOND_NS
        self.epochs_ns: dict[int, int] = {}

    def say(self, message: Message, sender: Address = HERE) -> list[tuple[Message, Address]]:
        self.server.receive(Datagram(encode(message), sender), now_ns=self.now_ns)
        return self.answers()

    def answers(self) -> list[tuple[Message, Address]]:
        return [(decode(out.payload, self.terms), out.peer) for out in self.server.outbox()]

    def ask(self, vehicle: int = 1, boot_id: int = 5, sender: Address = HERE) -> Welcome:
        ((welcome, peer),) = self.say(Hello(vehicle, boot_id, self.terms), sender)
        assert isinstance(welcome, Welcome)
        assert peer == sender
        return welcome

    def open(self, vehicle: int = 1, boot_id: int = 5, sender: Address = HERE) -> Welcome:
        """Session, welcomed but not yet live."""
        welcome = self.ask(vehicle, boot_id, sender)
        assert welcome.refusal == Refusal.ACCEPTED
        return welcome

    def observe(
        self,
        welcome: Welcome,
        step: int,
        state: object = ((1.0, 0.0), (0.0, 0.0)),
        sender: Address = HERE,
    ) -> None:
        epoch_ns = self.epochs_ns.setdefault(welcome.session, self.now_ns - step * self.dt_ns)
        self.now_ns = max(self.now_ns, epoch_ns + step * self.dt_ns)
        assert self.say(self.told(welcome, step, state), sender) == []

    def told(
        self, welcome: Welcome, step: int, state: object = ((1.0, 0.0), (0.0, 0.0))
    ) -> Observation:
        epoch_ns = self.epochs_ns[welcome.session]
        return Observation(
            welcome.vehicle,
            welcome.session,
            step,
            in_force=NO_HORIZON,
            since=0,
            backward_us=stamp_us(-epoch_ns),
            heard=step % NUMBERS,
            mode=Mode.TRACK,
            takes=1,
            state=np.array(state),
            input=np.zeros(2),
            number=step % NUMBERS,
            silence=40,
        )

    @property
    def due_ns(self) -> int:
        due_ns = self.server.next_wake_ns()
        assert due_ns is not None
        return due_ns

    def tick(self) -> list[tuple[Message, Address]]:
        self.now_ns = max(self.now_ns, self.due_ns)
        self.server.wake(now_ns=self.now_ns)
        return self.answers()

    def planned(self) -> tuple[Horizon, Address]:
        ((horizon, peer),) = self.tick()
        assert isinstance(horizon, Horizon)
        return horizon, peer

    def rows(self) -> Rows:
        return self._steps.rows()


def live(step: int = 0, **more: Any) -> tuple[Vehicles, Welcome]:
    """Server with one vehicle, which has been observed once, and its WELCOME."""
    vehicles = Vehicles(scenario(), **more)
    welcome = vehicles.open()
    vehicles.observe(welcome, step)
    return vehicles, welcome


def test_hello_is_welcomed_with_the_servers_terms() -> None:
    vehicles = Vehicles(scenario())
    welcome = vehicles.open(vehicle=3, boot_id=42)
    assert (welcome.vehicle, welcome.boot_id, welcome.server_boot_id) == (3, 42, 77)
    assert welcome.terms == vehicles.terms
    assert welcome.server_ns == vehicles.now_ns


def test_a_repeated_hello_gets_the_same_session() -> None:
    """A lost WELCOME costs only time, before and after the first observation."""
    vehicles = Vehicles(scenario())
    first = vehicles.open()
    assert vehicles.open().session == first.session
    vehicles.observe(first, 0)
    assert vehicles.open().session == first.session


def test_other_terms_open_no_session() -> None:
    vehicles = Vehicles(scenario())
    other = vehicles.terms._replace(horizon=20)
    ((welcome, _),) = vehicles.say(Hello(1, 5, other))
    assert isinstance(welcome, Welcome)
    assert welcome.terms == vehicles.terms
    assert (welcome.refusal, welcome.session) == (Refusal.OTHER_TERMS, 0)
    differences = (Difference("control.horizon", here="40", there="20"),)
    assert vehicles.server.events() == (SessionRefused(vehicle=1, differences=differences),)
    vehicles.observe(welcome, 0)
    assert vehicles.server.dropped[Drop.UNKNOWN_SESSION] == 1


def test_who_is_refused_gets_no_channel() -> None:
    admitted = []

    class Listing(PlainGate):
        def admit(self, call: GateCall, *, now_ns: int) -> None:  # noqa: ARG002
            admitted.append(call)

    vehicles = Vehicles(scenario())
    vehicles.server._reception._gate = Listing()
    other = vehicles.terms._replace(dt_ns=vehicles.dt_ns + 1)
    vehicles.say(Hello(1, 5, other))
    assert not admitted
    vehicles.open()
    assert len(admitted) == 1


def test_of_the_refusals_that_were_told_the_newest_64_are_remembered() -> None:
    vehicles = Vehicles(scenario())
    other = vehicles.terms._replace(horizon=20)

    def told(*boot_ids: int) -> int:
        """Number of logged refusals of these lives of vehicle 1."""
        for boot_id in boot_ids:
            vehicles.say(Hello(1, boot_id, other))
        return len(vehicles.server.events())

    assert told(*range(64)) == 64
    assert told(0, 63) == 0
    assert told(64) == 1
    assert told(1, 64) == 0
    assert told(0) == 1


def test_strangers_are_told_of_every_ten_seconds_with_their_number() -> None:
    gate = SecureGate(Keyring("keys", {}), entropy=stream(2, "gate").bytes)
    server = Server(scenario(), boot_id=1, entropy=stream(1, "entropy").bytes, gate=gate)
    events = []
    for second in range(25):
        peer = (f"stranger {second}", second)
        server.receive(Datagram(b"?", peer), now_ns=(100 + second) * SECOND_NS)
        events += [(second, event) for event in server.events()]
    assert server.dropped == {Drop.NOT_SEALED: 25}
    assert events == [
        (
            second,
            Unauthenticated(
                count=second + 1, host=f"stranger {second}", port=second, reason=Drop.NOT_SEALED
            ),
        )
        for second in (0, 10, 20)
    ]


def test_an_idle_server_asks_for_no_wake() -> None:
    vehicles = Vehicles(scenario())
    assert vehicles.server.next_wake_ns() is None
    welcome = vehicles.open()
    assert vehicles.server.next_wake_ns() is None
    vehicles.observe(welcome, 0)
    assert vehicles.due_ns % vehicles.dt_ns == 0
    assert 0 < vehicles.due_ns - vehicles.now_ns <= vehicles.dt_ns


def test_the_first_tick_sends_a_horizon_for_the_step_it_is_aboard() -> None:
    vehicles, welcome = live(100)
    horizon, peer = vehicles.planned()
    assert peer == HERE
    assert (horizon.vehicle, horizon.session) == (1, welcome.session)
    # 30 ms have passed since the start of step 100, a step is 50 ms.
    assert horizon.step == 100
    assert horizon.age == 0
    later, _ = vehicles.planned()
    assert (later.step, later.age) == (101, 1)


@pytest.mark.parametrize("minutes", [36, 71.6, 1000])
def test_an_observation_that_was_held_back_is_no_new_one(minutes: float) -> None:
    """However often stamps have wrapped since: its round trip would be negative."""
    vehicles, welcome = live()
    vehicles.observe(welcome, 1)
    later = round(minutes * 60 * SECOND_NS) // vehicles.dt_ns
    vehicles.observe(welcome, later)
    assert vehicles.server.dropped == {}
    vehicles.say(vehicles.told(welcome, 1))
    assert vehicles.server.dropped == {Drop.IMPLAUSIBLE_CLOCK: 1}
    vehicles.observe(welcome, later + 1)
    assert vehicles.server.dropped == {Drop.IMPLAUSIBLE_CLOCK: 1}


def test_a_vehicle_that_is_begun_anew_has_its_packets_counted_anew() -> None:
    """Otherwise all would be late after an observation of a step 71 minutes ahead."""
    vehicles = Vehicles(scenario())
    welcome = vehicles.open()
    vehicles.epochs_ns[welcome.session] = vehicles.now_ns
    vehicles.say(vehicles.told(welcome, 71 * 60 * 20))
    for step in range(4):
        vehicles.say(vehicles.told(welcome, step))
        vehicles.now_ns += vehicles.dt_ns
    (session,) = vehicles.server.sessions
    assert vehicles.server.dropped == {Drop.IMPLAUSIBLE_CLOCK: 2}
    assert session.hearing.newest == 3


def test_the_newest_observation_wins_after_reordering() -> None:
    vehicles, welcome = live(5)
    vehicles.observe(welcome, 4, state=((9.0, 0.0), (9.0, 0.0)), sender=("old", 2))
    ((_, peer),) = vehicles.tick()
    assert peer == HERE
    row = vehicles.rows()[-1]
    assert (row["observed_step"], row["stale"]) == (5, 1)
    assert row["estimate"][:, 0].tolist() == [1.0, 0.0]


def test_answers_follow_the_vehicle_to_its_new_address() -> None:
    """A restarted netem has other ports: the newest observation shows the present address.

    Until a HELLO arrives from there, the old address is answered as well, because the packets may
    be forwarded copies.
    """
    vehicles, welcome = live()
    assert [peer for _, peer in vehicles.tick()] == [HERE]
    vehicles.observe(welcome, 1, sender=("elsewhere", 9))
    (there, at), (here, home) = vehicles.tick()
    assert (at, home) == (("elsewhere", 9), HERE)
    assert isinstance(there, Horizon)
    assert isinstance(here, Horizon)
    np.testing.assert_array_equal(there.inputs, here.inputs)
    vehicles.ask(sender=("elsewhere", 9))
    vehicles.observe(welcome, 2, sender=("elsewhere", 9))
    assert [peer for _, peer in vehicles.tick()] == [("elsewhere", 9)]


def test_a_newer_observation_in_an_older_packet_does_not_move_the_address() -> None:
    class Overtaken(PlainGate):
        def open(self, datagram: Datagram, *, now_ns: int) -> GateCall:
            return super().open(datagram, now_ns=now_ns)._replace(moves=False)

    vehicles, welcome = live()
    vehicles.server._reception._gate = Overtaken()
    vehicles.observe(welcome, 1, sender=("elsewhere", 9))
    assert [peer for _, peer in vehicles.tick()] == [HERE]


def test_where_repeats_of_a_packet_come_from_is_answered_too() -> None:
    """Whoever forwards copies that arrive first must not keep the answers from the vehicle."""

    class Repeating(PlainGate):
        def open(self, datagram: Datagram, *, now_ns: int) -> GateCall:  # noqa: ARG002
            raise ProtocolError(Drop.REPLAYED)

        def repeated(self, _: Datagram) -> int:
            return 1

    vehicles, _ = live()
    vehicles.server._reception._gate = Repeating()
    vehicles.server.receive(Datagram(b"?", ("elsewhere", 9)), now_ns=vehicles.now_ns)
    assert [peer for _, peer in vehicles.tick()] == [HERE, ("elsewhere", 9)]


def test_a_new_life_of_a_vehicle_takes_over_with_its_first_observation() -> None:
    vehicles, old = live(50)
    vehicles.now_ns += SILENCE_NS + 1
    new = vehicles.open(boot_id=6)
    assert new.session != old.session
    horizon, _ = vehicles.planned()
    assert horizon.session == old.session
    vehicles.observe(new, 0)
    horizon, _ = vehicles.planned()
    assert (horizon.session, horizon.step) == (new.session, 0)
    vehicles.observe(old, 51)
    assert vehicles.server.dropped[Drop.UNKNOWN_SESSION] == 1


def test_a_second_client_under_a_number_in_flight_is_told_so_and_changes_nothing() -> None:
    vehicles = Vehicles(scenario())
    first = vehicles.open(vehicle=3, boot_id=5)
    for step in range(100):
        vehicles.observe(first, step)
        if step % 20 == 0:
            refused = vehicles.ask(vehicle=3, boot_id=6, sender=("other", 2))
            assert (refused.refusal, refused.session, refused.boot_id) == (Refusal.TAKEN, 0, 6)
        horizon, peer = vehicles.planned()
        assert (horizon.session, peer) == (first.session, HERE)
    taken = NumberTaken(vehicle=3, host="other", port=2, holder="vehicle:1")
    opened = SessionOpened(vehicle=3, host="vehicle", port=1)
    assert vehicles.server.events() == (opened, taken)
    assert vehicles.server.refused[Refusal.TAKEN] == 5


def test_of_two_new_clients_under_one_number_the_first_flies() -> None:
    vehicles = Vehicles(scenario())
    first = vehicles.open(boot_id=5)
    assert vehicles.ask(boot_id=6, sender=("other", 2)).refusal == Refusal.TAKEN
    vehicles.observe(first, 0)
    horizon, _ = vehicles.planned()
    assert horizon.session == first.session
    vehicles = Vehicles(scenario())
    vehicles.open(boot_id=5)
    vehicles.now_ns += WELCOME_NS + 1
    vehicles.observe(vehicles.open(boot_id=6), 0)
    assert len(vehicles.server.sessions) == 1


def test_a_vehicle_that_was_silent_for_a_while_is_not_taken_over_once_it_is_heard_again() -> None:
    """The network was interrupted, not the vehicle; a life welcomed meanwhile is refused."""
    vehicles, first = live()
    vehicles.now_ns += SILENCE_NS + 1
    second = vehicles.open(boot_id=6, sender=("other", 2))
    vehicles.observe(first, 61)
    vehicles.observe(second, 0, sender=("other", 2))
    assert vehicles.server.dropped[Drop.TAKEN] == 1
    assert vehicles.ask(boot_id=6, sender=("other", 2)).refusal == Refusal.TAKEN
    horizon, peer = vehicles.planned()
    assert (horizon.session, peer) == (first.session, HERE)


def test_a_new_life_that_comes_when_the_old_one_was_just_forgotten_flies() -> None:
    vehicles, _ = live(capacity=1)
    vehicles.now_ns += SESSION_NS - SECOND_NS
    new = vehicles.open(boot_id=6)
    vehicles.now_ns += 2 * SECOND_NS
    vehicles.tick()
    assert len(vehicles.server.sessions) == 0
    assert vehicles.ask(vehicle=2).refusal == Refusal.FULL
    vehicles.observe(new, 0)
    assert [session.boot_id for session in vehicles.server.sessions] == [6]


def test_an_overtaken_message_gives_the_leadership_to_no_earlier_server() -> None:
    vehicles, welcome = live()
    for number, leads in ((3, 0), (2, 1)):
        ((answer, _),) = vehicles.say(Lead(1, welcome.session, number, leads))
        assert isinstance(answer, Lead)
        assert (answer.number, answer.leads) == (3, 0)


def test_an_observation_from_before_a_restart_of_the_server_is_dropped() -> None:
    welcome = Vehicles(scenario(), boot_id=1).open()
    vehicles = Vehicles(scenario(), boot_id=2**63)
    vehicles.observe(welcome, 3)
    assert vehicles.server.dropped == {Drop.UNKNOWN_SESSION: 1}


def test_a_close_ends_the_session_that_it_names_and_no_other() -> None:
    vehicles, welcome = live()
    vehicles.server.events()
    assert vehicles.say(Close(1, welcome.session + 1)) == []
    assert vehicles.say(Close(2, welcome.session)) == []
    assert vehicles.server.dropped == {Drop.UNKNOWN_SESSION: 2}
    assert len(vehicles.tick()) == 1
    assert vehicles.say(Close(1, welcome.session)) == []
    assert vehicles.server.events() == (SessionEnded(vehicle=1),)
    assert vehicles.tick() == []
    vehicles.observe(welcome, 2)
    assert vehicles.server.dropped == {Drop.UNKNOWN_SESSION: 3}


def test_ticks_slept_through_are_counted_and_skipped() -> None:
    vehicles, _ = live()
    vehicles.tick()
    due_ns = vehicles.due_ns
    vehicles.now_ns = due_ns + 3 * vehicles.dt_ns + 1
    vehicles.server.wake(now_ns=vehicles.now_ns)
    ((horizon, _),) = vehicles.answers()
    assert isinstance(horizon, Horizon)
    assert horizon.step == 4
    assert vehicles.server.missed == 3
    assert vehicles.server.next_wake_ns() == due_ns + 4 * vehicles.dt_ns


@pytest.mark.parametrize(
    ("late", "degraded"),
    [({5: 5}, []), ({1: 1, 7: 5}, [*range(7, 22)]), ({1: 1, 29: 6}, [*range(29, 50)])],
    ids=["five", "six, a second from the first on", "six, and one of before"],
)
def test_more_than_five_ticks_missed_within_a_second_make_a_degraded_server(
    late: dict[int, int], degraded: list[int]
) -> None:
    """To the tick; older missed ticks do not count.

    Args:
        late: ticks of 50 ms that were missed just before each of these.
        degraded: ticks at which the server is degraded.
    """
    events, dt_ns = Events(), 50 * MILLISECOND_NS
    grid = Grid(dt_ns, events)
    grid.arm(0)
    slept = {tick - back for tick, count in late.items() for back in range(1, count + 1)}
    awake = [tick for tick in range(60) if tick not in slept]
    found = []
    for tick in awake:
        assert grid.next_tick(tick * dt_ns) == tick * dt_ns
        found += [tick] * grid.degraded
    assert found == degraded
    assert grid.missed == sum(late.values())
    expected = [Degraded(degraded=True), Degraded(degraded=False)] if degraded else []
    assert list(events) == expected


def test_a_wake_before_its_time_does_nothing() -> None:
    vehicles, _ = live()
    due_ns = vehicles.due_ns
    vehicles.server.wake(now_ns=due_ns - 1)
    assert vehicles.answers() == []
    assert vehicles.server.next_wake_ns() == due_ns


def test_a_silent_server_sends_heartbeats() -> None:
    vehicles = Vehicles(scenario(trigger="state_gap(1e9)"))
    welcome = vehicles.open()
    sent = []
    for step in range(61):
        vehicles.observe(welcome, step)
        sent += [message for message, _ in vehicles.tick()]
    assert isinstance(sent[0], Horizon)
    heartbeats = sent[1:]
    # The vehicle asks for one a second, and a step is 50 ms.
    assert [type(message) for message in heartbeats] == [Heartbeat] * 3
    assert {message.session for message in heartbeats} == {welcome.session}


def test_no_estimate_without_a_recent_observation() -> None:
    vehicles, welcome = live()
    said = [[message for message, _ in vehicles.tick()] for _ in range(122)]
    assert [[type(message) for message in each] for each in said[:101]] == [[Horizon]] * 101
    ((heartbeat,),) = (each for each in said[101:] if each)
    assert isinstance(heartbeat, Heartbeat)
    assert heartbeat.idle == Idle.OBSERVATION
    stopped = PlanningStopped(vehicle=1, why=str(Idle.OBSERVATION))
    assert vehicles.server.events()[-1] == stopped
    vehicles.observe(welcome, 123)
    assert [type(message) for message, _ in vehicles.tick()] == [Horizon]
    assert vehicles.server.events() == (PlanningResumed(vehicle=1),)


def test_a_vehicle_unheard_for_long_is_forgotten() -> None:
    vehicles, _ = live()
    vehicles.now_ns += SESSION_NS + vehicles.dt_ns
    vehicles.server.wake(now_ns=vehicles.now_ns)
    assert vehicles.server.next_wake_ns() is None
    assert vehicles.server.events()[-1] == SessionEnded(vehicle=1)


def test_a_vehicle_too_many_is_told_that_the_server_is_full() -> None:
    vehicles = Vehicles(scenario())
    for number in range(VEHICLES_MAX):
        vehicles.observe(vehicles.open(vehicle=number), 0)
    vehicles.server.events()
    for _ in range(3):
        refused = vehicles.ask(vehicle=1000)
        assert (refused.refusal, refused.session) == (Refusal.FULL, 0)
    full = ServerFull(vehicle=1000, host="vehicle", port=1, capacity=VEHICLES_MAX)
    assert vehicles.server.events() == (full,)
    assert vehicles.server.refused[Refusal.FULL] == 3
    assert vehicles.open(vehicle=7).vehicle == 7


def test_a_full_server_keeps_the_second_life_of_a_vehicle_from_a_stranger() -> None:
    """The restarted vehicle has its row already, which no stranger can take."""
    vehicles = Vehicles(scenario(), capacity=2)
    for number in (1, 2):
        vehicles.observe(vehicles.open(vehicle=number), 0)
    vehicles.now_ns += SILENCE_NS + 1
    second_life = vehicles.open(vehicle=1, boot_id=6)
    for _ in range(2):
        assert vehicles.ask(vehicle=1000).refusal == Refusal.FULL
        vehicles.now_ns += WELCOME_NS + 1
    vehicles.observe(second_life, 0)
    assert [session.boot_id for session in vehicles.server.sessions] == [6, 5]


def test_welcomed_vehicles_count_as_present_until_they_are_overdue() -> None:
    vehicles = Vehicles(scenario(), capacity=3)
    welcomes = [vehicles.open(vehicle=number) for number in range(3)]
    assert vehicles.ask(vehicle=1000).refusal == Refusal.FULL
    vehicles.now_ns += WELCOME_NS
    vehicles.open(vehicle=0)  # says HELLO again: of the others, 1 has waited longest
    assert vehicles.ask(vehicle=1000).refusal == Refusal.FULL
    vehicles.now_ns += 1
    late = vehicles.open(vehicle=1000)
    for welcome in (welcomes[0], welcomes[2], late):
        vehicles.observe(welcome, 0)
    assert len(vehicles.server.sessions) == 3
    vehicles.observe(welcomes[1], 0)
    assert vehicles.server.dropped[Drop.UNKNOWN_SESSION] == 1


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["hello", "observe", "wait", "close"]),
            st.integers(0, 5),
            st.integers(0, 2),
        ),
        max_size=60,
    ),
    st.booleans(),
)
def test_whoever_was_welcomed_last_and_comes_in_time_gets_a_row(
    moves: list[tuple[str, int, int]], keeps: bool
) -> None:
    """For any vehicles, lives and waits: never more than the capacity, and never a crash.

    If rows are kept, a row never passes to another vehicle.
    """
    ear = partial(Hearing, SILENCE_NS, 50 * MILLISECOND_NS, None)
    entropy, now_ns = stream(1, "entropy").bytes, DAY_NS
    sessions = Sessions(3, entropy, SILENCE_NS, ear, NO_ASSIGNMENT, keeps_rows=keeps)
    kept: dict[int, int] = {}
    terms = scenario().terms()
    numbers: dict[tuple[int, int], int] = {}
    due: dict[int, tuple[int, int]] = {}
    """Life that each vehicle must be granted, and until when."""
    for move, vehicle, boot_id in moves:
        match move:
            case "hello":
                hello = Hello(vehicle, boot_id, terms)
                if sessions.holder(hello, now_ns) is None and not sessions.is_full(hello, now_ns):
                    session = sessions.welcome(hello, HERE, LINE, now_ns)
                    numbers[vehicle, boot_id] = session.number
                    due[vehicle] = (boot_id, now_ns + WELCOME_NS)
            case "observe" if (vehicle, boot_id) in numbers:
                rest = 0, -1, 0, 0, 0, Mode.READY, 1, np.zeros((2, 2)), np.zeros(2)
                said = Observation(vehicle, numbers[vehicle, boot_id], *rest)
                granted, refused = due.get(vehicle, (-1, 0)), ""
                try:
                    (sessions.find(said) or sessions.begin(said, now_ns)).heard_ns = now_ns
                except ProtocolError as error:
                    refused = error.reason
                in_time = granted[0] == boot_id and now_ns <= granted[1]
                assert refused in ("", "taken") or not in_time
            case "close" if (vehicle, boot_id) in numbers:
                if session := sessions.find(Close(vehicle, numbers[vehicle, boot_id])):
                    sessions.end(session)
            case "wait":
                now_ns += boot_id * (SILENCE_NS // 2 + 1) + vehicle * SECOND_NS
                if vehicle == 5:
                    now_ns += SESSION_NS
                sessions.expire(now_ns)
        for session in sessions:
            assert not keeps or kept.setdefault(session.row, session.vehicle) == session.vehicle
        assert len(sessions) + len(sessions.welcomed_vehicles) <= 3
        assert len(sessions.rows) == len(sessions)


def told_time_ms(*, late_ns: int = 0, error_us: int = 1000) -> float:
    """Bound of a clock whose vehicle has told its time of day, after a round trip of 200 ms."""
    vehicles = Vehicles(scenario())
    welcome, epoch_ns = vehicles.open(), vehicles.now_ns
    vehicles.epochs_ns[welcome.session] = epoch_ns
    slow_us = stamp_us(200 * MILLISECOND_NS - epoch_ns)
    vehicles.say(vehicles.told(welcome, 0)._replace(backward_us=slow_us))
    vehicles.now_ns += late_ns
    vehicles.server.learn_time(vehicles.now_ns, 0, now_ns=vehicles.now_ns)
    vehicles.say(Time(1, welcome.session, 0, stamp_us(epoch_ns), error_us=error_us))
    return bound_ms(vehicles)


def bound_ms(vehicles: Vehicles) -> float:
    vehicles.tick()
    bound: float = vehicles.server.figures()["by_vehicle"]["1"]["clock_bound_ms"]
    return bound


def test_a_time_of_day_narrows_a_clock_to_its_error_and_1_ms_for_each_second_under_way() -> None:
    prompt_ms = told_time_ms()
    assert prompt_ms < 2.0
    assert told_time_ms(late_ns=2 * SECOND_NS) - prompt_ms == pytest.approx(2.0, abs=0.1)
    # 5 ms on one side: the other is known from delays.
    assert told_time_ms(error_us=6000) - prompt_ms == pytest.approx(2.5, abs=0.1)


def test_an_echo_in_an_overtaken_observation_does_not_narrow_a_clock() -> None:
    """Since when the vehicle has known it is unknown."""
    bounds_ms = []
    for overtaken in (False, True):
        vehicles = Vehicles(scenario())
        welcome, epoch_ns = vehicles.open(), vehicles.now_ns
        vehicles.epochs_ns[welcome.session] = epoch_ns
        vehicles.now_ns += 5 * vehicles.dt_ns
        for step, trip_ms in ((5, 200), (4, 20))[: 1 + overtaken]:
            backward_us = stamp_us(trip_ms * MILLISECOND_NS - epoch_ns)
            vehicles.say(vehicles.told(welcome, step)._replace(backward_us=backward_us))
        bounds_ms.append(bound_ms(vehicles))
    assert bounds_ms[1] == pytest.approx(bounds_ms[0])


def test_each_series_of_impossible_states_is_reported_once() -> None:
    vehicles, welcome = live()
    for step, x in enumerate((1.0, 90.0, 90.0, 1.0, 90.0), start=1):
        vehicles.observe(welcome, step, ((x, 0.0), (0.0, 0.0)))
    events = vehicles.server.events()
    assert sum(isinstance(event, StateDoubted) for event in events) == 2


def with_session(capacity: int = 1) -> tuple[Sessions, Session]:
    """Sessions, of which that of vehicle 1 was opened by life 5 of its client at DAY_NS."""
    ear = partial(Hearing, SILENCE_NS, 50 * MILLISECOND_NS, None)
    sessions = Sessions(capacity, stream(1, "entropy").bytes, SILENCE_NS, ear, NO_ASSIGNMENT)
    welcomed = sessions.welcome(hello(1, 5), HERE, LINE, DAY_NS)
    rest = 0, -1, 0, 0, 0, Mode.READY, 1, np.zeros((2, 2)), np.zeros(2)
    session = sessions.begin(Observation(1, welcomed.number, *rest), DAY_NS)
    session.heard_ns = DAY_NS
    return sessions, session


def hello(vehicle: int, boot_id: int) -> Hello:
    return Hello(vehicle, boot_id, scenario().terms())


def test_numbers_of_sessions_take_as_many_bytes_whatever_the_entropy() -> None:
    ear = partial(Hearing, SILENCE_NS, 50 * MILLISECOND_NS, None)
    sessions = Sessions(1, bytes, SILENCE_NS, ear, NO_ASSIGNMENT)
    assert sessions.welcome(hello(1, 5), HERE, LINE, DAY_NS).number == 2**31


def test_a_session_ends_once_its_vehicle_has_been_silent_for_longer_than_session_ns() -> None:
    sessions, session = with_session()
    assert sessions.expire(DAY_NS + SESSION_NS) == []
    assert sessions.expire(DAY_NS + SESSION_NS + 1) == [session]


def test_a_number_is_held_until_its_vehicle_has_been_silent_for_longer_than_the_time_out() -> None:
    sessions, session = with_session()
    assert sessions.holder(hello(1, 6), DAY_NS + SILENCE_NS) is session
    assert sessions.holder(hello(1, 6), DAY_NS + SILENCE_NS + 1) is None


def test_a_place_is_kept_for_welcome_ns_after_the_newest_hello() -> None:
    sessions, _ = with_session(capacity=2)
    for again_ns in (0, SECOND_NS):
        sessions.welcome(hello(2, 5), HERE, LINE, DAY_NS + again_ns)
    last_ns = DAY_NS + SECOND_NS + WELCOME_NS
    assert sessions.is_full(hello(3, 5), last_ns)
    assert not sessions.is_full(hello(3, 5), last_ns + 1)


def test_a_heartbeat_is_due_as_soon_as_the_vehicle_has_asked_for_it() -> None:
    sessions, session = with_session()
    assert sessions.heartbeats_due(DAY_NS + SECOND_NS) == []  # it has asked for no bound
    session.asked_ns = SECOND_NS
    assert sessions.heartbeats_due(DAY_NS + SECOND_NS - 1) == []
    assert sessions.heartbeats_due(DAY_NS + SECOND_NS) == [session]
    session.number_next(DAY_NS + SECOND_NS)
    assert sessions.heartbeats_due(DAY_NS + SECOND_NS) == []


def test_a_row_that_was_left_is_used_again_as_if_it_were_new() -> None:
    def fourth(others: tuple[int, ...]) -> list[bytes]:
        vehicles = Vehicles(scenario())
        welcomes = {number: vehicles.open(vehicle=number) for number in others}
        for number, welcome in welcomes.items():
            vehicles.observe(welcome, 100, ((number, 1.0), (2.0, 3.0)))
        for step in range(101, 901):
            for number, welcome in welcomes.items():
                if number != 1:
                    vehicles.observe(welcome, step)
            if welcomes:
                vehicles.tick()
        vehicles.now_ns = 50 * SECOND_NS + 20 * MILLISECOND_NS
        assert {each.vehicle for each in vehicles.server.sessions} == set(others) - {1}
        welcome, sent = vehicles.open(vehicle=4, sender=("v", 4)), []
        for step in range(10):
            vehicles.observe(welcome, step, ((1.0, 0.1), (0.1 * step, 0.2)), ("v", 4))
            sent += [message for message, peer in vehicles.tick() if peer == ("v", 4)]
        if others:
            assert vehicles.server.sessions.at(0).vehicle == 4
        return [message.inputs.tobytes() for message in sent if isinstance(message, Horizon)]

    alone = fourth(())
    assert len(alone) == 10
    assert fourth((1, 2, 3)) == alone


def test_an_unsolved_problem_sends_nothing_and_is_counted() -> None:
    """One vehicle is at a position at which its QP overflows; the other flies on."""
    vehicles = Vehicles(scenario())
    good = vehicles.open(vehicle=1, sender=("v", 1))
    bad = vehicles.open(vehicle=2, sender=("v", 2))
    vehicles.observe(good, 0, sender=("v", 1))
    vehicles.observe(bad, 0, sender=("v", 2))
    known = vehicles.server.controller.scheme.predictor._memory
    known.state[1, 0] = 1e308  # beyond float32
    with np.errstate(all="ignore"):
        sent = vehicles.tick()
    assert [peer for _, peer in sent] == [("v", 1)]
    assert vehicles.server.controller.counts["unsolved"] == 1


def test_a_message_that_names_another_vehicle_than_its_key_is_dropped() -> None:
    class OfVehicle2(PlainGate):
        def open(self, datagram: Datagram, *, now_ns: int) -> GateCall:
            return super().open(datagram, now_ns=now_ns)._replace(vehicle=2)

    entropy, terms = stream(1, "entropy").bytes, scenario().terms()
    server = Server(scenario(), boot_id=1, entropy=entropy, gate=OfVehicle2())
    for vehicle, answers in ((1, 0), (2, 1)):
        server.receive(Datagram(encode(Hello(vehicle, 5, terms)), HERE), now_ns=DAY_NS)
        assert len(server.outbox()) == answers
    assert server.dropped == {Drop.OF_ANOTHER_VEHICLE: 1}


def test_an_observation_that_is_dropped_keeps_no_session_alive() -> None:
    vehicles, welcome = live()
    for step in range(20, 20 * 31, 20):  # once a second
        vehicles.observe(welcome, step, ((1e3 * step, 0.0), (0.0, 0.0)))
    assert vehicles.server.dropped == {Drop.IMPLAUSIBLE_JUMP: 30}
    vehicles.now_ns += vehicles.dt_ns
    vehicles.tick()
    assert len(vehicles.server.sessions) == 0


def test_a_client_that_begins_anew_on_a_mission_is_known_by_its_hello() -> None:
    """Although it is refused as long as its earlier run may be flying: others keep away."""
    vehicles = Vehicles(packaged("swap"))
    welcome = vehicles.open()
    vehicles.epochs_ns[welcome.session] = vehicles.now_ns
    vehicles.say(vehicles.told(welcome, 0)._replace(input=NO_INPUT))
    vehicles.server.events()
    assert vehicles.ask().refusal == Refusal.ACCEPTED
    assert vehicles.server.events() == ()
    assert vehicles.ask(boot_id=6).refusal == Refusal.TAKEN
    assert vehicles.server.events()[0] == BegunAnew(vehicle=1)


def test_figures_of_many_vehicles_stay_readable() -> None:
    vehicles = Vehicles(scenario())
    for number in range(20):
        vehicles.observe(vehicles.open(vehicle=number), 0)
    figures = vehicles.server.figures()
    assert (len(figures["by_vehicle"]), figures["vehicles"]) == (16, 20)


def test_figures_tell_what_was_counted() -> None:
    vehicles, _ = live()
    vehicles.tick()
    figures = vehicles.server.figures()
    assert (figures["vehicles"], figures["missed"]) == (1, 0)
    assert figures["counts"] == {"events": 1, "steps": 1, "unsolved": 0}
    assert figures["by_vehicle"] == {"1": {"step": 0, "clock_bound_ms": 15.045}}  # age of the echo


def test_nothing_that_was_overtaken_by_the_time_out_keeps_a_session() -> None:
    vehicles = Vehicles(scenario())
    welcome = vehicles.open()
    late = int(SILENCE_NS / vehicles.dt_ns) + 1
    for step in range(1, late + 2):
        vehicles.observe(welcome, step)
    session = vehicles.server.sessions.live(1)
    assert session
    heard_ns, vehicles.now_ns = session.heard_ns, vehicles.now_ns + SECOND_NS
    overtaken = (
        vehicles.told(welcome, 1)._replace(silence=1),
        Lead(1, welcome.session, 3, 0, step=1),
        Time(1, welcome.session, 1, 0, 1000),
    )
    for message in overtaken:
        assert vehicles.say(message) == []
    assert vehicles.server.dropped == {Drop.OVERTAKEN: len(overtaken)}
    assert session.heard_ns == heard_ns
    assert session.lead is None
    for message in overtaken:
        vehicles.say(message._replace(step=late))
    assert vehicles.server.dropped == {Drop.OVERTAKEN: len(overtaken)}
