"""Which of its servers leads a vehicle: the number, and what a client does with it."""

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import packaged
from skytether.client.memory import SavedState, SavingClient, recall
from skytether.client.several import STANDBY_SOCKETS, Several
from skytether.client.simulated.vehicle import SimulatedVehicle, simulated
from skytether.client.standby.leadership import ASK_SHARE, NUMBER_MAX, Leadership
from skytether.client.standby.servers import NOT_THE_LEADER
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.standby import LeaderChanged
from skytether.shared.law.limits import Limits
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.lead import Lead, decode_led, with_leadership
from skytether.shared.wire.protocol import (
    Close,
    Heartbeat,
    Horizon,
    Message,
    Observation,
    Refusal,
    Welcome,
    decode,
    encode,
)

TIMEOUT_NS = SECOND_NS
SERVERS: tuple[Address, Address] = (("one", 0), ("other", 0))
SOCKETS = 0, STANDBY_SOCKETS[0]

numbers = st.integers(0, NUMBER_MAX)
times = st.integers(0, 10 * SECOND_NS)


@given(st.integers(1, 4), numbers, st.lists(st.tuples(st.booleans(), numbers, st.integers(0, 3))))
def test_the_number_only_rises(
    servers: int, number: int, acts: list[tuple[bool, int, int]]
) -> None:
    lead = Leadership(servers, number, TIMEOUT_NS)
    for learns, known, server in acts:
        before = lead.number
        if learns:
            assert lead.learn(known, server % servers) == (lead.number != before)
        else:
            lead.hand_over(server % servers)
        assert before <= lead.number <= NUMBER_MAX
        assert lead.number == before or lead.leader == server % servers


def test_no_number_follows_the_largest() -> None:
    """A larger one fits into no message."""
    lead = Leadership(2, NUMBER_MAX, TIMEOUT_NS)
    lead.hand_over(1 - lead.leader)
    assert lead.number == NUMBER_MAX
    lead = Leadership(2, 0, TIMEOUT_NS)
    lead.exceed(NUMBER_MAX, 1)
    assert lead.number == 0


@given(numbers, times, times, st.integers(0, 10 * SECOND_NS))
def test_another_leads_only_if_it_was_heard_since_the_leader_was_doubted(
    number: int, heard_ns: int, other_ns: int, now_ns: int
) -> None:
    lead = Leadership(2, number, TIMEOUT_NS)
    times_ns = [heard_ns, other_ns] if lead.leader == 0 else [other_ns, heard_ns]
    successor = lead.successor(times_ns, now_ns)
    if successor is not None:
        assert successor != lead.leader
        assert lead.doubts(times_ns, now_ns)
        assert other_ns - heard_ns >= ASK_SHARE * TIMEOUT_NS
        assert now_ns - heard_ns >= 3 * TIMEOUT_NS // 4


class Vehicle:
    """A client and what its two servers say to it."""

    def __init__(
        self,
        scenario: Scenario,
        before: SavedState | None = None,
        flies: SimulatedVehicle | None = None,
        *,
        has_standby: bool = True,
    ) -> None:
        self.scenario, self.now_ns = scenario, SECOND_NS
        self.saves, self.writes = True, False
        self.client = SavingClient(
            scenario,
            flies or simulated(scenario, 1),
            server=Several([SERVERS[0]], standby=[SERVERS[1]]) if has_standby else SERVERS[0],
            vehicle=4,
            boot_id=99,
            before=before,
        )
        self.sent: list[tuple[int, Message]] = []
        """Server, and message to it."""
        self.step()
        for server in range(1 + has_standby):
            welcome = Welcome(
                4, 7 + server, 99 ^ server, server, 1234, Refusal.ACCEPTED, scenario.terms()
            )
            self.hear(server, welcome)

    def hear(self, server: int, message: Message) -> None:
        datagram = Datagram(encode(message), SERVERS[server], SOCKETS[server])
        self.client.receive(datagram, now_ns=self.now_ns)
        self._take()

    def beat(self, server: int) -> None:
        self.hear(server, Heartbeat(4, 7 + server, self.now_ns // 1000 % 2**32, 0, 0))

    def step(self, seconds: float = 0.0) -> None:
        """Wake the client until a time has passed, at least once."""
        end_ns = self.now_ns + seconds_to_ns(seconds)
        while True:
            due_ns = self.client.next_wake_ns()
            assert due_ns is not None
            self.now_ns = max(self.now_ns, due_ns)
            self.client.wake(now_ns=self.now_ns)
            self._take()
            if self.now_ns >= end_ns:
                return

    def _take(self) -> None:
        # As the driver does: what is written meanwhile does not count for what is sent.
        self.writes |= self.client.keep(now_ns=self.now_ns) is not None
        for payload, _, socket in self.client.outbox():
            message = decode(payload, self.scenario.terms())
            self.sent.append((SOCKETS.index(socket), message))
        if self.writes and self.saves:
            self.writes = False
            self.client.kept()

    def told(self, server: int, kind: type[Message]) -> list[Message]:
        return [each for to, each in self.sent if to == server and isinstance(each, kind)]

    def answer(self, server: int, known: int = 0) -> None:
        """Acknowledge the newest LEAD to a server."""
        newest = self.told(server, Lead)[-1]
        assert isinstance(newest, Lead)
        self.hear(server, Lead(4, 7 + server, newest.number, newest.leads, known or newest.number))


@pytest.fixture
def vehicle() -> Vehicle:
    return Vehicle(packaged("demo"))


def test_nothing_is_reported_to_a_server_that_does_not_know_who_leads(vehicle: Vehicle) -> None:
    """It would take itself for the leader."""
    vehicle.step(1.0)
    for server in (0, 1):
        assert not vehicle.told(server, Observation)
        leads = vehicle.told(server, Lead)
        assert leads
        assert {(each.number, each.leads) for each in leads} == {(0, 1 - server)}  # type: ignore[union-attr]
        vehicle.answer(server)
    vehicle.step()  # at once: none was counted as sent before
    for server in (0, 1):
        assert len(vehicle.told(server, Observation)) == 1


def test_the_leader_falls_silent_and_the_other_is_asked_and_leads(vehicle: Vehicle) -> None:
    for server in (0, 1):
        vehicle.step(0.1)
        vehicle.answer(server)
    asked = len(vehicle.told(1, Lead))
    vehicle.step(0.8)
    assert len(vehicle.told(1, Lead)) > asked
    vehicle.answer(1)
    vehicle.step(0.6)
    newest = vehicle.told(1, Lead)[-1]
    assert isinstance(newest, Lead)
    assert (newest.number, newest.leads) == (1, 1)
    assert any(isinstance(each, LeaderChanged) for each in vehicle.client.events())


def test_nobody_leads_instead_if_nobody_is_heard(vehicle: Vehicle) -> None:
    for server in (0, 1):
        vehicle.step(0.1)
        vehicle.answer(server)
    vehicle.step(5.0)
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 0


@pytest.mark.parametrize("server", [0, 1])
def test_a_server_that_leaves_leads_no_more(server: int, vehicle: Vehicle) -> None:
    for each in (0, 1):
        vehicle.step(0.1)
        vehicle.answer(each)
    vehicle.hear(server, Close(4, 7 + server))
    vehicle.step()
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 1 - server
    assert vehicle.client.vehicle_figures()["mode"] == "sync"


def plan(scenario: Scenario, step: int, server: int, leadership: int) -> bytes:
    terms = scenario.terms()
    inputs = np.zeros((terms.axes, terms.horizon), np.float32)
    made = Horizon(4, 7 + server, step, 1_000_000, 1, inputs)
    return with_leadership(leadership, encode(made))


def test_a_plan_of_another_leadership_is_not_flown() -> None:
    """Whichever server sends it: of three, only that of the present leader is taken."""
    scenario = packaged("paper-every-step")
    vehicle = Vehicle(scenario, SavedState(leadership=2))
    vehicle.step(0.2)
    for server, leadership, dropped in ((0, 0, 1), (1, 1, 2), (1, 2, 3), (0, 2, 3)):
        payload = plan(scenario, 3, server, leadership)
        datagram = Datagram(payload, SERVERS[server], SOCKETS[server])
        vehicle.client.receive(datagram, now_ns=vehicle.now_ns)
        assert vehicle.client.dropped[NOT_THE_LEADER] == dropped


def test_the_leadership_of_a_plan_is_read_with_it() -> None:
    scenario = packaged("paper-every-step")
    terms, payload = scenario.terms(), plan(scenario, 3, 0, 0)
    for number in (0, 1, 127, 128, NUMBER_MAX):
        read, leadership = decode_led(with_leadership(number, payload), terms)
        assert (encode(read), leadership) == (payload, number)
    assert decode_led(encode(Close(4, 7)), terms) == (Close(4, 7), 0)
    fields = msgpack.unpackb(payload)
    for wrong in ([2**32], [-1], [True], [None], [b""]):
        with pytest.raises(ProtocolError, match=r"^field$"):
            decode_led(msgpack.packb([*fields, *wrong]), terms)
    for payload in (msgpack.packb([*fields, 1, 1]), msgpack.packb(fields[:-1])):
        with pytest.raises(ProtocolError, match=r"^not a message$"):
            decode_led(payload, terms)


def test_a_larger_number_is_followed_only_from_the_server_that_it_names(vehicle: Vehicle) -> None:
    for server, known, number in ((1, 2, 0), (0, 1, 0), (1, 3, 3), (0, 2, 3), (0, 4, 4)):
        vehicle.step(0.1)
        vehicle.answer(server, known)
        assert vehicle.client.vehicle_figures()["leadership"]["number"] == number


def test_the_number_survives_a_restart_of_the_client() -> None:
    scenario = packaged("demo")
    content = SavedState(boot_id=99, began_ns=1, leadership=5).encode(SECOND_NS)
    for written_ns, now_ns in ((SECOND_NS, SECOND_NS), (SECOND_NS, 900 * SECOND_NS), (None, 0)):
        assert recall(content, written_ns, now_ns, scenario.terms()).leadership == 5


def test_a_number_out_of_range_is_refused_by_the_codec() -> None:
    terms = packaged("demo").terms()
    fields = msgpack.unpackb(encode(Lead(4, 7, 1, 1)))
    assert isinstance(decode(msgpack.packb(fields), terms), Lead)
    for index, value in ((4, 2**32), (5, 2), (6, -1), (8, -2), (9, 2**16), (10, b"\0")):
        with pytest.raises(Exception, match=r"field|shape"):
            decode(msgpack.packb([*fields[:index], value, *fields[index + 1 :]]), terms)


def test_a_vehicle_that_waits_on_the_ground_keeps_its_leader() -> None:
    """Until it has flown the leader only answers HELLOs, less often than a time-out."""
    scenario = packaged("demo")
    ready = simulated(scenario, 1)
    ready.take_off = lambda *, now_ns: False  # type: ignore[method-assign] # noqa: ARG005
    vehicle = Vehicle(scenario, flies=ready)
    for _ in range(40):
        for server, after_s in ((0, 0.3), (1, 1.3)):
            vehicle.step(after_s)
            if vehicle.told(server, Lead):
                vehicle.answer(server)
            vehicle.beat(server)
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 0


def test_the_silence_of_the_ground_does_not_count_in_flight() -> None:
    """On the ground the leader speaks rarely: it has three quarters of a time-out from the first
    step, and after them another leads.
    """
    scenario = packaged("demo")
    flies, may_fly = simulated(scenario, 1), [False]
    flies.take_off = lambda *, now_ns: may_fly[0]  # type: ignore[method-assign] # noqa: ARG005
    vehicle = Vehicle(scenario, flies=flies)

    def number(seconds: float) -> int:
        end_ns = vehicle.now_ns + seconds_to_ns(seconds)
        while vehicle.now_ns < end_ns:
            vehicle.step()
            if vehicle.told(1, Lead):
                vehicle.answer(1)
            vehicle.beat(1)
        return int(vehicle.client.vehicle_figures()["leadership"]["number"])

    vehicle.step(0.3)
    for server in (0, 1):
        vehicle.answer(server)
        vehicle.beat(server)
    assert number(3.0) == 0
    may_fly[0] = True
    assert number(1.0) == 0
    assert vehicle.client._pilot.step
    assert number(1.0) == 1


def test_a_vehicle_that_has_no_standby_any_more_is_led_by_its_server() -> None:
    """The server may know that another led; it is told a larger number."""
    vehicle = Vehicle(packaged("paper-every-step"), SavedState(leadership=3), has_standby=False)
    vehicle.step(0.2)
    (told, *_) = vehicle.told(0, Lead)
    assert isinstance(told, Lead)
    assert (told.number, told.leads) == (4, 1)
    vehicle.answer(0)
    datagram = Datagram(plan(vehicle.scenario, 3, 0, 4), SERVERS[0], SOCKETS[0])
    vehicle.client.receive(datagram, now_ns=vehicle.now_ns)
    assert not vehicle.client.dropped[NOT_THE_LEADER]


def test_a_number_is_saved_before_it_is_told(vehicle: Vehicle) -> None:
    """Else the next run would take plans of a leadership that a server no longer reckons with."""
    for server in (0, 1):
        vehicle.step(0.1)
        vehicle.answer(server)
    vehicle.saves = False
    vehicle.step(0.8)
    vehicle.answer(1)
    vehicle.step(0.6)
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 1
    assert {each.number for each in vehicle.told(1, Lead)} == {0}  # type: ignore[union-attr]
    vehicle.saves = True
    vehicle.step(0.1)
    assert {each.number for each in vehicle.told(1, Lead)} == {0, 1}  # type: ignore[union-attr]


def test_on_a_failed_disk_the_standby_is_asked_and_both_are_told(vehicle: Vehicle) -> None:
    for server in (0, 1):
        vehicle.step(0.1)
        vehicle.answer(server)
    vehicle.saves = False
    for _ in range(40):
        vehicle.step(0.1)
        vehicle.answer(1)
        vehicle.beat(1)
    assert 1 in {each.number for each in vehicle.told(1, Lead)}  # type: ignore[union-attr]
    for server in (0, 1):
        observed = vehicle.told(server, Observation)
        assert [each.unsaved for each in observed[:1]] == [0]  # type: ignore[union-attr]
        assert [each.unsaved for each in observed[-1:]] == [1]  # type: ignore[union-attr]


def test_a_server_that_was_told_more_by_an_earlier_run_leads(vehicle: Vehicle) -> None:
    """The earlier run has not saved its number, and nobody would lead."""
    vehicle.step(0.1)
    vehicle.hear(1, Lead(4, 8, 5, 0, 5))
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 7
    vehicle.step(0.1)
    vehicle.hear(0, Lead(4, 7, 6, 0, 6))
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 7


def test_a_late_copy_of_limits_changes_nothing(vehicle: Vehicle) -> None:
    own, other = Limits(0.0, 0.6, 0.0, "a"), Limits(0.0, 0.6, 0.0, "b")
    vehicle.step(0.1)
    for server, limits, changes, may_lead in (
        *((0, own, 0, True), (1, own, 0, True), (0, other, 1, False), (1, other, 1, True)),
        *((1, own, 0, True), (0, own, 0, True), (1, own, 2, False)),
    ):
        vehicle.hear(server, Lead(4, 7 + server, 0, 1 - server, 0, limits=limits, changes=changes))
        assert vehicle.client._servers.leadership.may_lead(1) == may_lead


def test_a_number_far_above_the_own_is_not_believed(vehicle: Vehicle) -> None:
    vehicle.step(0.1)
    vehicle.answer(1, NUMBER_MAX)
    assert vehicle.client.vehicle_figures()["leadership"]["number"] == 0


def test_a_fixed_heartbeat_that_is_too_rare_for_a_standby_is_refused() -> None:
    rare = packaged("demo", link={"heartbeat_s": 0.6})
    with pytest.raises(ConfigError, match=r"link\.heartbeat_s: got 0\.6, expected at most a third"):
        Vehicle(rare)


@pytest.mark.parametrize("has_standby", [False, True])
def test_the_leader_is_chosen_in_flight_only(has_standby: bool) -> None:
    flown = packaged("demo", link={"leader": "standby"})
    with pytest.raises(
        ConfigError, match=r"^link\.leader: got 'standby', expected 'server': it is"
    ):
        Vehicle(flown, has_standby=has_standby)


def test_only_the_answer_to_a_recent_question_is_a_sign_of_life(vehicle: Vehicle) -> None:
    vehicle.step(0.1)
    for server in (0, 1):
        vehicle.answer(server)
    vehicle.step(3.0)
    session, asked = vehicle.client._sessions[1], vehicle.told(1, Lead)[-1]
    assert isinstance(asked, Lead)
    for step, is_heard in ((0, False), (asked.step, True)):
        before_ns = session.heard_ns
        vehicle.hear(1, Lead(4, 8, asked.number, asked.leads, asked.number, step))
        assert (session.heard_ns != before_ns) == is_heard
    vehicle.client._session.lead_ns = session.lead_ns = 2**62  # no further question
    vehicle.step(2.0)
    before_ns = session.heard_ns
    vehicle.hear(1, Lead(4, 8, asked.number, asked.leads, asked.number, asked.step))
    assert session.heard_ns == before_ns
