"""Motions of a mission: nothing from link, server or clock takes a vehicle off its motion.

The other vehicles keep clear of the motion in force alone, so a vehicle that brakes somewhere else
may meet them. The test plays the server.
"""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from by_hand import ByHand
from helpers import packaged
from skytether.client import failsafe
from skytether.client.failsafe import AT_ONCE, FOLLOWING, TRANSITIONS, Failsafe
from skytether.client.link import PlainLink
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.events.flight import Leaving
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason, Rows
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.protocol import (
    Close,
    Heartbeat,
    Idle,
    Mode,
    Observation,
    Refusal,
    Trajectory,
    stamp_us,
)

SWAP = packaged("swap", duration=30.0)
SPACING, KNOTS = 10, 9
"""Steps between knots, and knots of the motion: 4 s."""
WAY_M = 2.0
"""Length of the motion, along the first axis [m]."""


class Sealed(PlainLink):
    """Link that counts as authenticated, so that malformed messages are the server's."""

    secure = True


class OnMission(ByHand):
    """Client that has just accepted a motion."""

    def __init__(self, flown: Scenario = SWAP, age: int = 1) -> None:
        super().__init__(flown, link=Sealed())
        self.wake()
        self.welcome()
        self.observed: Observation | None = None
        self.hears = True
        """Whether heartbeats arrive."""
        while self.mode is not Mode.READY or self.observed is None or not self.observed.takes:
            self.step()
        observed = self.observed
        for _ in range(age - 1):
            self.step()
        self.observed, self.made_for = observed, observed.step + age
        self.send_motion(self.made_for, self.observed.state[:, 0])

    @property
    def mode(self) -> Mode:
        return self.client._failsafe.mode

    def step(self) -> None:
        if self.hears:
            self.beat()
        for message in self.wake():
            if isinstance(message, Observation):
                self.observed = message

    def beat(self, idle: int = Idle.PLANS, later_ns: int = 0) -> None:
        server_us = stamp_us(1234 + self.now_ns - 5 * SECOND_NS + later_ns)
        self.say(Heartbeat(4, self.session, server_us, idle, 0, 0, 0))

    def send_motion(self, step: int, begin: np.ndarray) -> None:
        assert self.observed is not None
        share = np.linspace(0.0, 1.0, KNOTS)
        knots = np.zeros((self.terms.axes, KNOTS, 2), np.float32)
        knots[:, :, 0] = begin[:, None]
        knots[0, :, 0] += WAY_M * share**2 * (3 - 2 * share)
        knots[0, :, 1] = WAY_M * 6 * share * (1 - share) / (SPACING * (KNOTS - 1) * 0.05)
        server_us = stamp_us(1234 + self.now_ns - 5 * SECOND_NS)
        age = step - self.observed.step
        self.say(Trajectory(4, self.session, step, server_us, age, SPACING, knots))

    @property
    def last(self) -> int:
        """Step of the last knot."""
        return self.made_for + SPACING * (KNOTS - 1)

    def fly(self, happen: Iterable[tuple[int, Callable[["OnMission"], None]]] = ()) -> Rows:
        """Fly to the last knot while things happen, each at a stage; returns the steps flown."""
        waiting = sorted(happen, key=lambda each: each[0])
        while self.client._pilot.step <= self.last:
            while waiting and self.client._pilot.step >= self.made_for + waiting[0][0]:
                waiting.pop(0)[1](self)
            self.step()
        rows = self.rows()
        return rows[(rows["step"] > self.made_for) & (rows["step"] < self.last)]


def silence(flight: OnMission) -> None:
    flight.hears = False
    flight.client._failsafe._timeout_ns = SECOND_NS // 2  # the scenario's is longer than a motion


def closes(flight: OnMission) -> None:
    flight.say(Close(4, flight.session))


def restarts(flight: OnMission) -> None:
    flight.session += 1
    flight.welcome(server_boot_id=flight.session)


def refuses(flight: OnMission) -> None:
    flight.welcome(refusal=Refusal.TAKEN)


def speaks_nonsense(flight: OnMission) -> None:
    for _ in range(failsafe.MALFORMED_MAX + 1):
        flight.say(Heartbeat(4, flight.session, 0, 99, 7, 0, 0))


def plans_for_the_future(flight: OnMission) -> None:
    for _ in range(failsafe.FUTURE_MAX + 1):
        flight.send_motion(flight.client._pilot.step + 500, np.zeros(flight.terms.axes))


def is_late_by_half_a_minute(flight: OnMission) -> None:
    flight.beat(later_ns=40 * SECOND_NS)


def cannot_plan(flight: OnMission) -> None:
    flight.beat(Idle.OBSERVATION)


def names_a_leader(flight: OnMission) -> None:
    flight.say(Lead(4, flight.session, 1, 1, 3))


def asks_for_a_path(flight: OnMission) -> None:
    flight.say(PathProof(4, flight.session, 0, 5, (1000,)))


def stalls(flight: OnMission) -> None:
    flight.now_ns += 450 * MILLISECOND_NS


HAPPENINGS = (
    *(silence, closes, restarts, refuses, speaks_nonsense, plans_for_the_future),
    *(is_late_by_half_a_minute, cannot_plan, names_a_leader, asks_for_a_path, stalls),
)
"""What may come from link, server or clock."""


@pytest.fixture(scope="module")
def undisturbed() -> Rows:
    return OnMission().fly()


@given(st.lists(st.tuples(st.integers(1, 75), st.sampled_from(HAPPENINGS)), max_size=4))
def test_whatever_comes_from_link_server_or_clock_the_motion_is_flown(
    undisturbed: Rows, happen: list[tuple[int, Callable[[OnMission], None]]]
) -> None:
    """In mode at each step until the last knot; in place too, but for stalls one after another."""
    rows = OnMission().fly(happen)
    assert set(rows["mode"]) <= {int(each) for each in FOLLOWING}
    same = undisturbed[np.isin(undisturbed["step"], rows["step"])]
    assert len(rows) > SPACING
    off_m = np.abs(rows["state"][:, :, 0] - same["state"][:, :, 0]).max()
    # A stalled vehicle repeats its last input meanwhile.
    assert off_m < SWAP.mission.tube_m or sum(each is stalls for _, each in happen) > 1


@pytest.mark.parametrize("happening", [closes, restarts, speaks_nonsense, plans_for_the_future])
def test_without_the_rule_the_vehicle_brakes_off_its_motion(
    happening: Callable[[OnMission], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(failsafe, "AT_ONCE", frozenset(Reason))
    flight = OnMission()
    rows = flight.fly([(20, happening)])
    assert Mode.BRAKE in set(rows["mode"])


def test_only_the_vehicle_itself_or_a_person_takes_it_off_its_motion_at_once() -> None:
    """Network, server and clock wait for the last knot, and so does a battery that runs low."""
    off = {
        cause
        for (mode, cause), after in TRANSITIONS.items()
        if mode in FOLLOWING and after not in FOLLOWING
    }
    assert off - AT_ONCE == {
        *(Reason.LOST, Reason.CLOSED, Reason.RESTARTED, Reason.MALFORMED, Reason.RESYNC),
        *(Reason.LATE, Reason.ENDED, Reason.STALLED, Reason.BATTERY, Reason.OVER),
    }


@pytest.mark.parametrize("cause", Reason)
def test_each_cause_takes_effect_at_once_or_at_the_last_knot(cause: Reason) -> None:
    def made(keeps: bool) -> Failsafe:
        made = Failsafe(
            TRANSITIONS,
            armed=True,
            timeout_ns=SECOND_NS,
            brake_ns=SECOND_NS,
            land_after_ns=0,
        )
        made.mode, made.keeps_motion = Mode.TRACK, keeps
        made.meet(cause, now_ns=SECOND_NS)
        return made

    free, held = made(False), made(True)
    if cause in AT_ONCE or free.mode in FOLLOWING:
        assert (held.mode, held.postponed) == (free.mode, None)
    else:
        assert (held.mode, held.postponed) == (Mode.TRACK, cause)
        assert held.takes == (cause is Reason.STALLED)
        held.motion_goes_on(False, now_ns=2 * SECOND_NS)
        assert (held.mode, held.reason, held.postponed) == (free.mode, free.reason, None)


def test_a_person_and_the_vehicle_itself_still_stop_it_at_once() -> None:
    def disarms(flight: OnMission) -> None:
        flight.client._failsafe.armed = False

    rows = OnMission().fly([(20, disarms)])
    assert Mode.BRAKE in set(rows["mode"][20:23])


def test_after_a_close_the_vehicle_rests_and_takes_no_motion_until_it_hovers() -> None:
    flight = OnMission()
    flight.fly([(20, closes)])
    assert not flight.client._failsafe.takes
    while flight.mode is not Mode.HOVER:
        flight.step()
    assert flight.client._failsafe.reason is Reason.CLOSED
    assert flight.client._pilot.step < flight.last + 10


def test_a_motion_is_flown_to_its_end_however_old_its_observation(undisturbed: Rows) -> None:
    """`link.age_max_s` bounds what is accepted, not what other vehicles keep clear of."""
    old = OnMission(packaged("swap", duration=30.0, link={"age_max_s": 7.5}), age=110)
    rows = old.fly()
    assert set(rows["mode"]) <= {int(each) for each in FOLLOWING}
    assert rows["covered"].all()
    way_m = np.ptp(rows["state"][:, 0, 0])
    assert way_m == pytest.approx(np.ptp(undisturbed["state"][:, 0, 0]), abs=0.1)


def finish(flight: OnMission) -> Rows:
    """Fly until the client has nothing left to do."""
    while not flight.client.finished:
        flight.step()
    return flight.rows()


@pytest.mark.parametrize("stage", [5, 40, 79])
def test_a_flight_whose_time_is_up_on_the_way_ends_at_the_last_knot(stage: int) -> None:
    """And accepts no motion meanwhile; without the rule it ends at once."""
    made_for = OnMission().made_for
    flight = OnMission(packaged("swap", duration=(made_for + stage) * 0.05))
    while flight.client._pilot.step < made_for + stage + 1:
        flight.step()
    flight.send_motion(flight.client._pilot.step, np.zeros(flight.terms.axes))
    rows = finish(flight)
    assert rows["step"][-1] == flight.last
    assert set(rows["in_force"][rows["step"] > made_for]) == {made_for}
    speeds = np.abs(rows["state"][:, :, 1]).max(axis=1)
    assert speeds[-1] < 0.1 < speeds.max()


def test_a_flight_whose_time_is_up_at_rest_ends_then() -> None:
    last = OnMission().last
    flight = OnMission(packaged("swap", duration=(last + 20) * 0.05))
    assert finish(flight)["step"][-1] == last + 19


def test_a_client_that_is_asked_to_end_flies_its_motion_first() -> None:
    """And accepts no other; at rest it ends at once."""
    flight = OnMission()
    for _ in range(20):
        flight.step()
    latest_ns = flight.client.leave(now_ns=flight.now_ns)
    (event,) = (each for each in flight.client.events() if isinstance(each, Leaving))
    assert event.vehicles == (4,)
    flight.send_motion(flight.client._pilot.step, np.zeros(flight.terms.axes))
    rows = finish(flight)
    assert flight.last - 1 <= rows["step"][-1] <= flight.last
    assert set(rows["in_force"][rows["step"] > flight.made_for]) == {flight.made_for}
    assert flight.now_ns < latest_ns < flight.now_ns + 2 * SECOND_NS

    rests = OnMission()
    rests.fly()
    rests.step()
    assert rests.client.leave(now_ns=rests.now_ns) == rests.now_ns
    assert rests.client.finished


def test_a_vehicle_that_rests_or_lands_on_a_mission_holds_its_place_in_wind() -> None:
    """Also after a gust that has pushed it away."""
    blown = packaged("swap", duration=30.0, vehicle={"steady_wind_mps": [0.3, 0.0], "wind": 0.0})
    server = ByHand(blown)
    server.wake()
    server.welcome()
    for mode in (Mode.SYNC, Mode.LAND):
        server.client._failsafe.mode = mode
        for _ in range(60):
            server.wake()
        server.flies.plant.x[0, 0] += 0.3
        for _ in range(60):
            server.wake()
        places = server.rows()["state"][:, :, 0]
        assert np.abs(places[-1] - places[0]).max() < 0.1
