"""Failsafe aboard: behaviour when the link, the server or the vehicle fails.

The test plays the server at steps of 20 ms; the client is the real one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest

import skytether.client.endpoint
import skytether.client.pilot
import skytether.client.session
from by_hand import SERVER, ByHand
from helpers import packaged
from skytether.client import failsafe
from skytether.client.clamp import clamped
from skytether.client.compensator import Compensator
from skytether.client.failsafe import HOLD, TRANSITIONS, Failsafe
from skytether.client.link import AGAIN_NS, PlainLink
from skytether.client.server_clock import SLEPT_NS
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.flight import Event, ModeChanged
from skytether.shared.law import rule
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.protocol import (
    NO_FEEDBACK,
    NO_HORIZON,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    stamp_us,
)

STEPS_PER_S = 50
H = 100
D = 5
SPEED = 1.0
"""Input of all horizons, along x [m/s]."""


class Sealed(PlainLink):
    """Link that counts as authenticated."""

    secure = True


class Hand(ByHand):
    """Client, and its server played by the test: a heartbeat each 0.1 s, horizons on request."""

    def __init__(self, *, secure: bool = False, armed: bool = True, **sections: Any) -> None:
        flown = msgspec.structs.replace(scenario(**sections), armed=armed)
        super().__init__(flown, link=Sealed() if secure else None)
        self.events: list[Event] = []
        self.wake()
        self.welcome()

    def heartbeat(self) -> None:
        self.say(Heartbeat(4, self.session, 1, Idle.PLANS, 0))

    def plan(
        self,
        made_for: int | None = None,
        *,
        observed: int | None = None,
        gain: tuple[float, float] | None = None,
    ) -> None:
        """Send a horizon that starts at the vehicle's reported state, for the last step unless
        given.

        With `gain` the horizon has feedback.
        """
        step = self.step if made_for is None else made_for
        age = step - (self.step if observed is None else observed)
        inputs = np.zeros((self.terms.axes, D + self.terms.horizon), np.float32)
        inputs[0] = SPEED
        feedback = NO_FEEDBACK
        if gain is not None:
            aboard = [[p, v, 0.0, *gain] for p, v in self.said[-1].state.tolist()]
            feedback = np.array(aboard, np.float32)
        self.say(Horizon(4, self.session, step, 1, age, inputs, feedback))

    @property
    def step(self) -> int:
        return self.said[-1].step

    def fly(self, seconds: float, *, beats: bool = True, plans: bool = False) -> None:
        """Advance, with or without heartbeats, and with a horizon at each step or none."""
        for _ in range(round(seconds * STEPS_PER_S)):
            self.out = self.wake()
            self.said = [each for each in self.out if isinstance(each, Observation)] or self.said
            self.events += self.client.events()
            if beats and self.step % 5 == 0:
                self.heartbeat()
            if plans:
                self.plan()

    said: list[Observation]
    out: list[Message]

    @property
    def mode(self) -> Mode:
        return Mode(self.said[-1].mode)

    @property
    def takes(self) -> bool:
        """Whether the vehicle reports that it accepts horizons."""
        return bool(self.said[-1].takes)

    @property
    def speed(self) -> float:
        return float(np.linalg.norm(self.said[-1].input))

    @property
    def changes(self) -> list[tuple[str, str]]:
        self.events += self.client.events()
        events = [event for event in self.events if isinstance(event, ModeChanged)]
        return [(event.after, event.reason) for event in events]


def aboard(**times_s: float) -> Failsafe:
    """Failsafe without a client; times are a second each, unless given."""
    times = {"timeout": 1.0, "brake": 1.0, "land_after": 1.0} | times_s
    times_ns = {f"{name}_ns": round(s * SECOND_NS) for name, s in times.items()}
    return Failsafe(TRANSITIONS, armed=True, **times_ns)


def scenario(**sections: Any) -> Scenario:
    """Long flight of the demo at 50 Hz in calm air, with sections changed."""
    preset = {
        "duration": 100.0,
        "control": {"dt": 0.02, "horizon": H, "feedback": False},
        "vehicle": {"wind": 0.0, "land_after_s": 10.0, "report": "always"},
        "link": {"heartbeat_s": 0.1, "timeout_s": 1.0},
    }
    return packaged("demo-committed", preset, sections)


def tracking(**keys: Any) -> Hand:
    hand = Hand(**keys)
    hand.fly(1.2)
    assert hand.takes
    hand.fly(2.0, plans=True)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)
    return hand


def comes_to_hover_and_takes_no_horizon(hand: Hand, *, for_s: float = 0.8) -> None:
    """Braked at 2 m/s² from 1 m/s, although the link is good and horizons arrive."""
    hand.fly(0.02, plans=True)
    assert (hand.mode, hand.takes, hand.said[-1].in_force) == (Mode.BRAKE, False, NO_HORIZON)
    hand.fly(0.5, plans=True)
    assert (hand.mode, hand.speed) == (Mode.HOVER, 0.0)
    hand.fly(for_s - 0.52, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.HOVER, False, 0.0)
    hand.fly(1.0)
    assert (hand.mode, hand.takes) == (Mode.HOVER, True)
    hand.plan()
    hand.fly(0.02)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)


# -- before the first horizon ----------------------------------------------------------------------


def test_a_vehicle_takes_a_horizon_after_a_second_of_good_link() -> None:
    """An earlier horizon is dropped, and counted."""
    hand = Hand()
    hand.fly(0.98, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.SYNC, False, 0.0)
    assert hand.client.dropped[Drop.NOT_TAKEN] == 49
    hand.fly(0.04)
    assert (hand.mode, hand.takes) == (Mode.READY, True)
    hand.plan()
    hand.fly(0.02)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)
    modes = [(Mode(mode), Reason(reason)) for mode, reason in zip(*modes_of(hand), strict=True)]
    assert list(dict.fromkeys(modes)) == [
        (Mode.SYNC, Reason.OPENED),
        (Mode.READY, Reason.GOOD),
        (Mode.TRACK, Reason.HORIZON),
    ]


def modes_of(hand: Hand) -> tuple[list[int], list[int]]:
    rows = hand.rows()
    return rows["mode"].tolist(), rows["reason"].tolist()


def test_a_link_is_lost_after_more_than_its_time_out() -> None:
    guard = aboard(timeout=1.0)
    guard.heard(now_ns=SECOND_NS)
    assert not guard.is_lost(2 * SECOND_NS)
    assert guard.is_lost(2 * SECOND_NS + 1)


@pytest.mark.parametrize(
    ("gap_ns", "mode"),
    [(600 * MILLISECOND_NS, Mode.READY), (600 * MILLISECOND_NS + 1, Mode.SYNC)],
)
def test_a_link_is_good_with_gaps_up_to_two_thirds_of_the_time_out(gap_ns: int, mode: Mode) -> None:
    guard, now_ns = aboard(timeout=0.9), SECOND_NS
    guard.heard(now_ns=now_ns)
    guard.meet(Reason.OPENED, now_ns=now_ns)
    for _ in range(2):
        now_ns += gap_ns
        guard.heard(now_ns=now_ns)
    guard.step(late_ns=0, hindrance=None, now_ns=now_ns)
    assert guard.mode is mode


def tracking_alone(now_ns: int) -> Failsafe:
    """Failsafe without a client that has just received a packet and accepted a horizon."""
    guard = aboard(timeout=1.0, brake=0.5)
    guard.heard(now_ns=now_ns)
    for cause in (Reason.OPENED, Reason.GOOD):
        guard.meet(cause, now_ns=now_ns)
    guard.horizon_taken(now_ns=now_ns)
    return guard


@pytest.mark.parametrize(("over_ns", "mode"), [(0, Mode.TRACK), (1, Mode.BRAKE)])
def test_a_step_that_is_late_by_more_than_stall_ns_brakes(over_ns: int, mode: Mode) -> None:
    guard = tracking_alone(SECOND_NS)
    guard.step(late_ns=failsafe.STALL_NS + over_ns, hindrance=None, now_ns=SECOND_NS)
    assert guard.mode is mode


@pytest.mark.parametrize(("over_ns", "mode"), [(0, Mode.TRACK), (1, Mode.COAST)])
def test_a_horizon_is_old_after_more_than_the_time_out(over_ns: int, mode: Mode) -> None:
    guard, now_ns = tracking_alone(SECOND_NS), 2 * SECOND_NS + over_ns
    guard.heard(now_ns=now_ns)
    guard.step(late_ns=0, hindrance=None, now_ns=now_ns)
    assert guard.mode is mode


@pytest.mark.parametrize(("short_ns", "mode"), [(1, Mode.BRAKE), (0, Mode.HOVER)])
def test_braking_ends_after_its_longest_time(short_ns: int, mode: Mode) -> None:
    guard, now_ns = tracking_alone(SECOND_NS), SECOND_NS + 500 * MILLISECOND_NS - short_ns
    guard.meet(Reason.ENDED, now_ns=SECOND_NS)
    guard.step(late_ns=0, hindrance=None, now_ns=now_ns)
    assert guard.mode is mode


@pytest.mark.parametrize("cause", [Reason.LOST, Reason.CLOSED, Reason.RESTARTED])
def test_a_link_that_breaks_while_the_vehicle_brakes_has_to_be_good_again(cause: Reason) -> None:
    guard = tracking_alone(SECOND_NS)
    guard.meet(Reason.ENDED, now_ns=SECOND_NS)
    assert (guard.mode, guard.takes) == (Mode.BRAKE, True)
    guard.meet(cause, now_ns=SECOND_NS)
    assert (guard.mode, guard.takes) == (Mode.BRAKE, False)


@pytest.mark.parametrize("cause", failsafe.CLOSING)
def test_the_link_of_a_session_that_has_ended_is_lost_at_once(cause: Reason) -> None:
    guard = tracking_alone(SECOND_NS)
    assert not guard.is_lost(SECOND_NS)
    guard.meet(cause, now_ns=SECOND_NS)
    assert guard.is_lost(SECOND_NS)


def test_the_silence_of_the_server_goes_on_over_a_restart_of_the_client() -> None:
    guard = aboard(timeout=1.0)
    guard.resume(Reason.RESUMED, heard_ns=SECOND_NS, now_ns=3 * SECOND_NS)
    assert guard.mode is Mode.TRACK
    assert guard.is_lost(3 * SECOND_NS)


@pytest.mark.parametrize(("over_ns", "mode"), [(0, Mode.BRAKE), (1, Mode.TRACK)])
def test_malformed_messages_count_within_window_ns(over_ns: int, mode: Mode) -> None:
    guard = tracking_alone(SECOND_NS)
    for at_ns in (0, 1, 2, 3, failsafe.WINDOW_NS + over_ns):
        guard.malformed(now_ns=SECOND_NS + at_ns)
    assert guard.mode is mode


def test_a_vehicle_that_waits_in_another_mode_has_waited_since_the_first() -> None:
    guard = aboard(timeout=1.0, land_after=1.0)
    guard.heard(now_ns=SECOND_NS)
    for cause in (Reason.OPENED, Reason.GOOD):
        guard.meet(cause, now_ns=SECOND_NS)
    for now_ns in (SECOND_NS, 2 * SECOND_NS + 500 * MILLISECOND_NS):
        guard.step(late_ns=0, hindrance=None, now_ns=now_ns)
    assert guard.mode is Mode.LAND


def test_a_leap_stops_no_vehicle_that_holds() -> None:
    times_ns = {"timeout_ns": SECOND_NS, "brake_ns": SECOND_NS, "land_after_ns": SECOND_NS}
    guard = Failsafe(HOLD, armed=True, **times_ns)
    guard.meet(Reason.OPENED, now_ns=0)
    guard.leapt(now_ns=0)
    assert guard.takes


def test_rounding_of_a_speed_is_not_clamped() -> None:
    wanted = [1.0 + 5e-10]
    flown = clamped(wanted, [1.0], [2.0], np.inf, without_feedback=wanted, speed_max=1.0)
    assert flown == wanted


CHALLENGE = b"challenge"


class Challenged(PlainLink):
    """Link whose handshake answers a challenge."""

    def open(self, datagram: bytes, *, now_ns: int) -> bytes | None:  # type: ignore[override]  # noqa: ARG002
        return None if datagram == CHALLENGE else datagram

    def outbox(self) -> list[bytes]:
        return [b"answer"]


def test_no_hello_is_due_for_a_while_after_the_answer_to_a_challenge() -> None:
    hand = ByHand(scenario(), link=Challenged())
    hand.wake()
    hand.now_ns += 900 * MILLISECOND_NS
    hand.client.receive(Datagram(CHALLENGE, SERVER), now_ns=hand.now_ns)
    assert [each.payload for each in hand.client.outbox()] == [b"answer"]
    assert hand.client.next_wake_ns() == hand.now_ns + AGAIN_NS


def test_a_challenge_that_a_stranger_has_provoked_puts_off_no_hello() -> None:
    """He repeats an earlier HELLO of the vehicle, again and again, while the server is gone."""
    hand = ByHand(scenario(), link=Challenged())
    hand.wake()
    hand.welcome()
    hand.say(Heartbeat(4, hand.session, 1300, 0, 0, 1, 0))
    gone_ns = hand.now_ns + round(1.5 * hand.client._timeout_ns)
    asks = 0
    while hand.now_ns < gone_ns:
        hand.client.receive(Datagram(CHALLENGE, SERVER), now_ns=hand.now_ns)
        assert [each.payload for each in hand.client.outbox()] == [b"answer"]
        asks += sum(isinstance(each, Hello) for each in hand.wake())
    assert asks == 1


def test_a_link_that_stutters_is_not_good() -> None:
    """A heartbeat every 1.1 s for nine seconds; silence of 1 s is a loss."""
    hand = Hand()
    for _ in range(8):
        hand.fly(1.1, beats=False)
        hand.heartbeat()
        assert hand.mode is Mode.SYNC


def test_a_horizon_planned_before_the_vehicle_took_any_is_dropped() -> None:
    """The server assumed that the vehicle would stand still."""
    hand = Hand()
    hand.fly(1.2)
    hand.plan(observed=30)
    hand.fly(0.02)
    assert hand.mode is Mode.READY
    assert hand.client.dropped[Drop.NOT_TAKEN] == 1


def test_a_vehicle_that_is_not_armed_flies_nothing() -> None:
    hand = Hand(armed=False)
    hand.fly(3.0, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.READY, False, 0.0)
    assert hand.changes[-1] == ("ready", str(Reason.UNARMED))


# -- failures in flight ----------------------------------------------------------------------------


def test_without_a_newer_horizon_it_coasts_and_says_nothing() -> None:
    """Coasting begins after a second; the next horizon is flown at once."""
    hand = tracking()
    changes = hand.changes
    hand.fly(1.1)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.COAST, True, SPEED)
    hand.plan()
    hand.fly(0.02)
    assert hand.mode is Mode.TRACK
    assert hand.changes == changes


def test_an_exhausted_horizon_is_braked_along_and_the_next_is_taken_at_once() -> None:
    """The link is good, so the next horizon is accepted without a wait."""
    hand = tracking()
    hand.fly((D + H) / STEPS_PER_S + 0.1)
    assert (hand.mode, hand.takes) == (Mode.BRAKE, True)
    assert hand.speed == pytest.approx(SPEED - 0.2, abs=0.05)
    hand.fly(1.0)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.HOVER, True, 0.0)
    assert hand.changes[-2:] == [
        ("brake", str(Reason.OLD)),
        ("hover", str(Reason.OLD)),
    ]
    hand.plan()
    hand.fly(0.02)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)


def test_with_feedback_it_hovers_where_it_came_to_rest_in_whatever_wind() -> None:
    """The prescribed input is braked to zero, so the vehicle hovers; feedback compensates wind."""
    wind = [0.4, -0.3]
    hand = Hand(control={"feedback": True}, vehicle={"steady_wind_mps": wind})
    hand.fly(1.2)
    hand.plan(gain=(8.0, 2.0))
    hand.fly((D + H) / STEPS_PER_S + 0.1)
    assert hand.mode is Mode.BRAKE
    hand.fly(0.4)
    assert hand.mode is Mode.HOVER
    hand.fly(8.0)
    places = hand.rows()["state"][:, :, 0]
    assert np.abs(places[-1] - places[-100]).max() < 1e-3
    np.testing.assert_allclose(hand.said[-1].input, np.negative(wind), atol=1e-3)
    hand.fly(2.0, beats=False)  # the link is lost: no plan is flown any more
    assert (hand.mode, hand.speed, hand.said[-1].in_force) == (Mode.HOVER, 0.0, NO_HORIZON)


def test_what_is_told_while_braking_never_speeds_up_whatever_feedback_adds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Even with a faulty compensator that commands full speed after the last input."""
    hand = Hand(control={"feedback": True})
    hand.fly(1.2)
    hand.plan(gain=(0.0, 0.0))
    hand.fly((D + H) / STEPS_PER_S + 0.3)
    braked = hand.speed
    assert (hand.mode, 0.2 < braked < 0.8) == (Mode.BRAKE, True)
    monkeypatch.setattr(rule, "remaining", lambda *_: 1.0)
    for step in (1, 2):
        hand.fly(0.02)
        assert hand.speed == pytest.approx(braked - step * 2.0 * 0.02, abs=1e-6)


def test_a_horizon_whose_last_step_was_missed_is_braked_from_the_speed_flown() -> None:
    """Not from its last input, which is faster."""
    hand = Hand(control={"horizon": 20})
    hand.fly(1.2)
    inputs = np.zeros((hand.terms.axes, 20), np.float32)
    inputs[0] = [*[0.5] * 19, SPEED]
    made_for = hand.step
    hand.say(Horizon(4, hand.session, made_for, 1, 0, inputs))
    while hand.step < made_for + 18:
        hand.fly(0.02)
    hand.now_ns += 2 * hand.dt_ns
    for flown in (0.5, 0.5 - 2.0 * 0.02):
        hand.fly(0.02)
        assert hand.speed == pytest.approx(flown)


def test_a_silent_server_ends_in_brake_with_horizon_left() -> None:
    """After a second without a packet, although one more second of horizon is left."""
    hand = tracking()
    hand.fly(0.96, beats=False)
    assert hand.speed == SPEED
    hand.fly(0.1, beats=False)
    assert (hand.mode, hand.takes) == (Mode.BRAKE, False)
    hand.fly(0.6, beats=False)
    assert (hand.mode, hand.speed) == (Mode.HOVER, 0.0)
    assert hand.changes[-1] == ("hover", str(Reason.LOST))
    hand.fly(0.9, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.HOVER, False, 0.0)
    hand.fly(0.2)
    assert hand.takes


def test_ten_seconds_of_hovering_alone_end_in_landing_for_good() -> None:
    """In space it descends to the ground; later messages of the server change nothing."""
    space = {"model": {"axes": 3}, "reference": {"altitude_m": 2.0}}
    hand = tracking(control={"horizon": 60}, **space)
    hand.fly(0.5, plans=True)
    hand.fly(1.0 + 0.6 + 9.7, beats=False)
    assert hand.mode is Mode.HOVER
    hand.fly(0.5, beats=False)
    assert hand.mode is Mode.LAND
    assert hand.said[-1].input.tolist() == [0.0, 0.0, -0.5]
    hand.fly(5.0, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.LAND, False, 0.0)
    assert hand.rows()["state"][-1, 2, 0] == pytest.approx(0.0, abs=0.5)
    assert hand.changes[-1] == ("land", str(Reason.ALONE))


def test_a_vehicle_that_never_lands_hovers_on() -> None:
    hand = tracking(vehicle={"land_after_s": 0.0})
    hand.fly(40.0, beats=False)
    assert (hand.mode, hand.speed) == (Mode.HOVER, 0.0)
    hand.fly(1.2)
    hand.fly(0.2, plans=True)
    assert hand.mode is Mode.TRACK


def test_in_the_plane_landing_is_staying() -> None:
    hand = tracking()
    hand.fly(12.0, beats=False)
    assert (hand.mode, hand.speed) == (Mode.LAND, 0.0)


def test_horizons_that_come_late_for_half_a_second_end_in_brake() -> None:
    """Three quarters of a horizon after its committed steps, although each could be flown."""
    hand = tracking(control={"scheme": "predictive", "trigger": "always"})
    hand.fly((D + 0.75 * H) / STEPS_PER_S + 0.04)
    begun = hand.step
    while hand.mode is not Mode.BRAKE:
        hand.plan(hand.step - D - 76)
        hand.fly(0.02)
        assert hand.step <= begun + 30
    assert hand.step == begun + 26
    assert hand.changes[-1] == ("brake", str(Reason.LATE))
    comes_to_hover_and_takes_no_horizon(hand)


def test_one_horizon_in_time_among_late_ones_is_enough() -> None:
    guard = tracking_alone(SECOND_NS)
    for at_s, late in ((1.0, True), (1.2, False), (1.5, True), (1.9, True)):
        guard.horizon_arrived(late=late, now_ns=round(at_s * SECOND_NS))
        assert guard.mode is Mode.TRACK
    guard.horizon_arrived(late=True, now_ns=2 * SECOND_NS)
    assert (guard.mode, guard.reason) == (Mode.BRAKE, Reason.LATE)


def test_an_old_horizon_that_comes_again_and_again_is_no_late_one() -> None:
    """Half a second of overtaken copies says nothing about the newest."""
    hand = Hand(control={"horizon": 40})
    hand.fly(1.2)
    hand.plan()
    for _ in range(30):
        hand.fly(0.02)
        hand.plan(10, observed=10)
    assert hand.mode is Mode.TRACK


def test_a_restarted_server_s_horizons_wait_for_a_second_of_good_link() -> None:
    hand = tracking()
    hand.session = 8
    hand.welcome(server_boot_id=2)
    comes_to_hover_and_takes_no_horizon(hand)
    assert ("brake", str(Reason.RESTARTED)) in hand.changes


def test_malformed_messages_of_the_server_itself_end_in_brake() -> None:
    """Five within a second; a single one is tolerated."""
    hand = tracking(secure=True)
    for _ in range(4):
        hand.client.receive(Datagram(b"?", SERVER), now_ns=hand.now_ns)
    hand.fly(0.5, plans=True)
    assert hand.mode is Mode.TRACK
    hand.fly(0.6, plans=True)
    for _ in range(5):
        hand.say(with_input_out_of_range(hand))
    comes_to_hover_and_takes_no_horizon(hand)
    assert ("brake", str(Reason.MALFORMED)) in hand.changes


def test_what_has_been_counted_towards_a_new_session_counts_no_more() -> None:
    """Ten horizons for impossible times end a session; the next session counts from 0."""
    met: list[Reason] = []
    guard = aboard()

    def meet(cause: Reason, *, now_ns: int) -> None:
        met.append(cause)
        assert now_ns % (failsafe.FUTURE_MAX * MILLISECOND_NS) == 0

    guard.meet = meet  # type: ignore[method-assign]
    for count in range(1, 3 * failsafe.FUTURE_MAX):
        guard.future(now_ns=count * MILLISECOND_NS)
        assert len(met) == count // failsafe.FUTURE_MAX
    assert set(met) == {Reason.RESYNC}


def with_input_out_of_range(hand: Hand) -> Horizon:
    inputs = np.full((2, H), 1.01 * hand.terms.u_max[0], np.float32)
    return Horizon(4, hand.session, hand.step, 1, hand.step, inputs)


def test_in_plaintext_a_stranger_cannot_make_it_brake_by_malformed_messages() -> None:
    hand = tracking()
    for _ in range(100):
        hand.client.receive(Datagram(b"?", SERVER), now_ns=hand.now_ns)
    hand.fly(0.1, plans=True)
    assert hand.mode is Mode.TRACK


def test_horizons_for_impossible_times_end_in_a_new_session() -> None:
    """Ten within a second: the vehicle brakes and sends HELLO, and accepts only a WELCOME."""
    hand = tracking()
    for n in range(10):
        if n % 2:
            hand.plan(hand.step + H + 10 + n)
        else:
            hand.plan(hand.step + 1, observed=hand.step + 2)
    hand.fly(0.02, plans=True)
    assert (hand.mode, hand.takes) == (Mode.BRAKE, False)
    assert any(isinstance(each, Hello) for each in hand.out)
    assert hand.changes[-1] == ("brake", str(Reason.RESYNC))
    hand.welcome()
    comes_to_hover_and_takes_no_horizon(hand)


def test_a_server_that_closes_the_session_ends_in_brake_at_once() -> None:
    """Other packets of the session are ignored; the vehicle asks for a new session."""
    hand = tracking()
    for _ in range(3):
        hand.say(Close(4, hand.session))
    hand.fly(0.02, plans=True)
    assert (hand.mode, hand.speed) == (Mode.BRAKE, pytest.approx(SPEED - 0.04))
    assert any(isinstance(each, Hello) for each in hand.out)
    hand.fly(3.0, plans=True)
    assert (hand.mode, hand.takes) == (Mode.HOVER, False)
    assert hand.changes[-1] == ("hover", str(Reason.CLOSED))
    hand.session = 8
    hand.welcome(server_boot_id=2)
    hand.fly(1.2)
    assert hand.takes


def test_a_close_of_another_session_is_dropped() -> None:
    hand = tracking()
    hand.say(Close(4, 6))
    hand.fly(0.02, plans=True)
    assert hand.mode is Mode.TRACK


def test_a_vehicle_that_was_asleep_brakes_on_waking_and_takes_the_next_horizon() -> None:
    """121 ms late: the plan in force was made for other places."""
    hand = tracking()
    hand.now_ns += 141_000_000
    hand.heartbeat()
    hand.fly(0.02)
    assert (hand.mode, hand.takes, hand.said[-1].in_force) == (Mode.BRAKE, True, NO_HORIZON)
    assert hand.changes[-1] == ("brake", str(Reason.STALLED))
    hand.plan()
    hand.fly(0.02)
    assert hand.mode is Mode.TRACK


@pytest.mark.parametrize(
    ("over_ns", "mode"), [(-MILLISECOND_NS, Mode.TRACK), (MILLISECOND_NS, Mode.BRAKE)]
)
def test_a_server_whose_clock_went_on_for_half_a_minute_shows_a_suspended_machine(
    over_ns: int, mode: Mode
) -> None:
    hand = tracking()
    hand.heartbeat()
    server_us = 1 + stamp_us(SLEPT_NS + over_ns)
    hand.say(Heartbeat(4, hand.session, server_us, Idle.PLANS, 0))
    hand.fly(0.02, beats=False)
    assert hand.mode is mode


def test_a_solver_that_fails_or_a_server_that_is_degraded_is_told() -> None:
    for idle, degraded, why in (
        (Idle.UNSOLVED, 0, str(Idle.UNSOLVED)),
        (Idle.PLANS, 1, "the server misses its deadlines"),
    ):
        hand = tracking()
        for _ in range(30):
            hand.say(Heartbeat(4, hand.session, 1, idle, degraded))
            hand.fly(0.1, beats=False)
        assert hand.changes[-2:] == [("brake", why), ("hover", why)]


def test_what_is_not_finite_ends_in_fault_for_good() -> None:
    for seen in (SimulatedVehicle, Compensator):
        hand = tracking()
        with pytest.MonkeyPatch.context() as mad, np.errstate(invalid="ignore"):
            if seen is Compensator:
                mad.setattr(Compensator, "choose", lambda *_: ([np.nan, 0.0], [0.0, 0.0]))
            else:
                mad.setattr(hand.flies.plant, "x", np.full((2, 2), np.inf))
            hand.fly(0.02, plans=True)
        hand.fly(3.0, plans=True)
        rows = hand.rows()[160:]
        assert (rows["mode"] == Mode.FAULT).all()
        assert not rows["input"].any()
        assert hand.changes[-1] == ("fault", str(Reason.NOT_FINITE))


def test_a_state_that_no_vehicle_can_have_ends_in_hover_until_somebody_has_chosen() -> None:
    """A position that changes by 300 m in a step, or a velocity by 20 m/s."""
    for p, v in ((300.0, 0.0), (0.0, 20.0)):
        hand = tracking()
        hand.flies.plant.x += [p, v]
        hand.fly(0.02, plans=True)
        assert (hand.mode, hand.speed) == (Mode.BRAKE, pytest.approx(SPEED - 0.04))
        assert hand.changes[-1] == ("brake", str(Reason.LEAPT))
        hand.fly(9.0, plans=True)
        assert (hand.mode, hand.takes) == (Mode.HOVER, False)
        assert hand.changes[-1] == ("hover", str(Reason.LEAPT))
        running = Running(hand.client, hand.scenario)
        with pytest.raises(ConfigError, match=r"^vehicle.after_leap: .*has not subtracted"):
            running.change({"vehicle.after_leap": "old"}, now_ns=hand.now_ns)
        with pytest.raises(ConfigError, match=r"^armed: got true after"):
            running.change({"armed": True}, now_ns=hand.now_ns)
        running.change({"vehicle.after_leap": "new"}, now_ns=hand.now_ns)
        hand.fly(0.1)
        assert hand.takes
        hand.fly(0.1, plans=True)
        assert hand.mode is Mode.TRACK


def test_in_a_new_frame_the_estimate_begins_anew() -> None:
    """With a filter, which would else go on from the place in the old frame."""
    server = ByHand(packaged("swap"))
    server.wake()
    server.welcome()
    server.wake()
    server.flies.plant.x[:, 0] += 300.0
    server.wake()
    running = Running(server.client, server.scenario)
    running.change({"vehicle.after_leap": "new"}, now_ns=server.now_ns)
    server.wake()
    row = server.rows()[-1]
    assert row["estimate"][:, 0] == pytest.approx(row["state"][:, 0], abs=1.0)


def test_one_that_is_to_stay_after_a_leap_hovers_on() -> None:
    hand = tracking()
    hand.flies.plant.x[:, 0] += 300.0
    hand.fly(1.0, plans=True)
    running = Running(hand.client, hand.scenario)
    running.change({"vehicle.after_leap": "stay"}, now_ns=hand.now_ns)
    hand.fly(15.0, plans=True)
    assert (hand.mode, hand.takes) == (Mode.HOVER, False)


def test_a_link_that_is_lost_meanwhile_changes_nothing_in_that() -> None:
    hand = tracking()
    hand.flies.plant.x[:, 0] += 300.0
    hand.fly(3.0, plans=True)
    hand.fly(2.0, beats=False)
    assert hand.changes[-1] == ("hover", str(Reason.LOST))
    hand.fly(3.0, plans=True)
    assert (hand.mode, hand.takes) == (Mode.HOVER, False)
    assert hand.changes[-1] == ("hover", str(Reason.LEAPT))


# -- the paper's rule ------------------------------------------------------------------------------


def test_a_vehicle_that_holds_has_no_failsafe() -> None:
    hand = Hand(vehicle={"exhausted": "hold"})
    hand.fly(0.02)
    hand.plan()
    hand.fly(0.02)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)
    hand.fly((D + H) / STEPS_PER_S + 0.1)
    assert hand.changes[-1] == ("coast", str(Reason.OLD))
    hand.session = 8
    hand.welcome(server_boot_id=2)
    hand.say(Close(4, hand.session))
    hand.fly(20.0, beats=False)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.COAST, True, SPEED)
    assert not {Mode.SYNC, Mode.BRAKE, Mode.HOVER, Mode.LAND} & {*HOLD.values()}


# -- the last clamp --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "flown"),
    [
        ([0.5, -0.5], [0.5, -0.5]),
        ([9.0, -9.0], [1.6, -0.8]),
        ([1.6, -9.0], [1.6, -0.8]),
        ([np.nan, 0.0], None),
        ([0.0, np.inf], None),
    ],
)
def test_the_last_clamp_bounds_value_and_change(
    wanted: list[float], flown: list[float] | None
) -> None:
    """From 0.8 and 0.2 m/s; bounds are 1.6 m/s and 1 m/s per step; NaN is refused."""
    assert clamped(wanted, [0.8, 0.2], [1.6, 1.6], 1.0, without_feedback=wanted) == flown


@pytest.mark.parametrize(
    ("wanted", "told", "speed_max", "flown"),
    [
        ([3.0, 4.0], [3.0, 4.0], 2.5, [1.5, 2.0]),
        ([3.0, 4.0], [3.0, 4.0], 5.0 - 1e-12, [3.0, 4.0]),
        ([3.0, 4.0], [3.0, 4.0], 0.0, [0.0, 0.0]),
        ([2.0, 4.0], [3.0, 4.0], 2.5, [0.5, 2.0]),
        ([2.0, 4.0], [0.0, 0.0], 0.0, [2.0, 4.0]),
        ([2.0, 4.0], [np.nan, 0.0], 0.0, None),
    ],
    ids=["along its way", "over by rounding", "to rest", "with feedback", "feedback alone", "nan"],
)
def test_the_last_clamp_keeps_braking_from_speeding_up_but_for_feedback(
    wanted: list[float], told: list[float], speed_max: float, flown: list[float] | None
) -> None:
    loose = [0.0, 0.0], [9.0, 9.0], 9.0
    found = clamped(wanted, *loose, without_feedback=told, speed_max=speed_max)
    assert found == (flown and pytest.approx(flown))


@pytest.mark.parametrize("clamps", [True, False])
def test_no_mistake_of_the_compensator_reaches_the_plant(
    monkeypatch: pytest.MonkeyPatch, *, clamps: bool
) -> None:
    hand = tracking(vehicle={"slew_mps2": 5.0})
    if not clamps:
        monkeypatch.setattr(skytether.client.pilot, "clamped", lambda wanted, *_, **__: wanted)
    monkeypatch.setattr(Compensator, "choose", lambda *_: ([100.0, -100.0],) * 2)
    # An observation above u_max cannot be encoded, so the record is checked instead.
    monkeypatch.setattr(skytether.client.session.ServerSession, "send", lambda *_, **__: None)
    hand.fly(0.4, plans=True)
    flown = hand.rows()["input"]
    bounded = np.abs(flown).max() <= hand.terms.u_max[0]
    slow = np.abs(np.diff(flown[70:], axis=0)).max() <= 5.0 * 0.02 + 1e-12
    assert (bounded, slow) == (clamps, clamps)


def test_a_slew_that_would_not_let_it_brake_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^test: vehicle.slew_mps2: got 1.5, expected at least"):
        scenario(vehicle={"slew_mps2": 1.5})


# -- the table -------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [TRANSITIONS, HOLD])
def test_nothing_leads_out_of_fault_and_only_fault_out_of_land(table: failsafe.Table) -> None:
    out = [(before, after) for (before, _), after in table.items()]
    assert {after for before, after in out if before is Mode.LAND} <= {Mode.FAULT}
    assert not [before for before, _ in out if before is Mode.FAULT]
    assert all((mode, Reason.NOT_FINITE) in table for mode in Mode if mode is not Mode.FAULT)


def test_whatever_happens_a_locked_vehicle_takes_no_horizon() -> None:
    """Ten thousand random causes: after a forced brake only a good link allows a horizon."""
    rng = stream(1, "causes")
    failing = aboard()
    final = (Reason.ALONE, Reason.NOT_FINITE, Reason.LEAPT)
    calm = [each for each in Reason if each not in final]
    locked = False
    for now_ns in range(10_000):
        cause = calm[int(rng.integers(len(calm)))]
        before = failing.mode, failing.takes
        if cause is not Reason.HORIZON or failing.takes:
            failing.meet(cause, now_ns=now_ns)
        locked &= not (cause is Reason.GOOD and before[0] in (Mode.SYNC, Mode.HOVER))
        newest = [each.cause for each in failing.transitions[-1:]]
        locked |= newest == [cause] and cause in failsafe.LOCKING
        assert not (locked and failing.takes)


# -- ablations of guards ---------------------------------------------------------------------------

# -- hindrances of the vehicle ----------------------------------------------------------------


def hindered(hand: Hand, cause: Reason | None) -> None:
    hand.flies.hindrance = lambda *, now_ns: cause  # noqa: ARG005


PILOTS = (Reason.TAKEN, Reason.DISARMED)
GROUNDING = (Reason.BATTERY, Reason.ASTRAY, Reason.RIVAL, Reason.STRAYED)
DEAF = (Reason.MUTE, Reason.UNUSABLE)
"""Causes while which the vehicle receives no commands."""


@pytest.mark.parametrize("cause", PILOTS)
def test_what_a_pilot_has_taken_is_his_at_once_and_until_he_gives_it_back(cause: Reason) -> None:
    hand = tracking()
    hindered(hand, cause)
    hand.fly(0.02)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.MANUAL, False, 0.0)
    hand.fly(5.0, plans=True)
    assert (hand.mode, hand.speed) == (Mode.MANUAL, 0.0)
    hindered(hand, None)
    hand.fly(0.9, plans=True)
    assert (hand.mode, hand.takes) == (Mode.HOVER, False)
    hand.fly(0.2, plans=True)
    hand.plan()
    hand.fly(0.02)
    assert (hand.mode, hand.speed) == (Mode.TRACK, SPEED)


@pytest.mark.parametrize("cause", GROUNDING)
def test_a_vehicle_that_can_fly_no_further_brakes_and_lands(cause: Reason) -> None:
    landed: list[Mode] = []
    hand = tracking()
    hand.flies.land = lambda: landed.append(hand.client._failsafe.mode)
    hindered(hand, cause)
    hand.fly(0.02)
    assert (hand.mode, hand.takes) == (Mode.BRAKE, False)
    hand.fly(2.0, plans=True)
    assert hand.mode is Mode.LAND
    assert landed == [Mode.LAND]
    hindered(hand, None)
    hand.fly(2.0, plans=True)
    assert hand.mode is Mode.LAND


@pytest.mark.parametrize("cause", DEAF)
def test_a_vehicle_whose_autopilot_is_silent_brakes_and_waits_for_it(cause: Reason) -> None:
    hand = tracking()
    hindered(hand, cause)
    hand.fly(0.02)
    assert (hand.mode, hand.takes) == (Mode.BRAKE, False)
    hand.fly(9.0, plans=True)
    assert (hand.mode, hand.takes, hand.speed) == (Mode.HOVER, False, 0.0)
    hindered(hand, None)
    hand.fly(1.1)
    assert (hand.mode, hand.takes) == (Mode.HOVER, True)


def test_a_vehicle_whose_autopilot_stays_silent_lands() -> None:
    """`vehicle.land_after_s` of hovering, and the second for which a link must be good."""
    hand = tracking()
    hindered(hand, Reason.MUTE)
    hand.fly(0.6 + 10.0, plans=True)
    assert hand.mode is Mode.HOVER
    hand.fly(1.2, plans=True)
    assert hand.mode is Mode.LAND
    assert hand.changes[-1] == ("land", str(Reason.MUTE))


def test_a_link_that_comes_back_just_before_the_landing_has_its_second() -> None:
    hand = tracking()
    hand.fly(1.0 + 0.52 + 9.8, beats=False)
    assert hand.mode is Mode.HOVER
    hand.fly(1.3)
    assert (hand.mode, hand.takes) == (Mode.HOVER, True)


@pytest.mark.parametrize("cause", [None, *PILOTS])
def test_a_fence_does_not_steer_a_vehicle_that_a_pilot_flies(cause: Reason | None) -> None:
    """It stands beyond the fence."""
    fence = {"low_m": [-9.0, -9.0], "high_m": [9.0, 9.0], "wind_mps": 0.2}
    server = ByHand(scenario(fence=fence))
    server.flies.plant.x[:, 0] = 20.0
    server.flies.hindrance = lambda *, now_ns: cause  # noqa: ARG005
    server.wake()
    server.welcome()
    server.wake()
    assert server.rows()["input"].any() == (cause is None)


def test_a_fence_keeps_no_vehicle_from_landing() -> None:
    """Its lowest altitude lies above the vehicle."""
    fence = {"low_m": [-9.0, -9.0, 0.5], "high_m": [9.0, 9.0, 9.0], "wind_mps": 0.2}
    space = {"model": {"axes": 3}, "reference": {"altitude_m": 2.0}}
    server = ByHand(scenario(fence=fence, control={"horizon": 60}, **space))
    server.flies.plant.x[2, 0] = 0.4
    server.wake()
    server.welcome()
    server.wake()
    server.client._failsafe.mode = Mode.LAND
    server.wake()
    climbs, descends = server.rows()["input"][:, 2]
    assert climbs > 0.0
    assert descends < 0.0


# -- time limits of modes ----------------------------------------------------------------------


def beyond_its_fence() -> Hand:
    """Vehicle that wind of 1.5 m/s holds beyond its fence, whose bound is 4.5 m."""
    fence = {"low_m": [-9.0, -9.0], "high_m": [4.5, 9.0], "wind_mps": 0.2}
    hand = Hand(vehicle={"steady_wind_mps": [1.5, 0.0]}, fence=fence)
    hand.fly(1.2)
    hand.fly(5.0, plans=True)
    assert hand.rows()["state"][-1, 0, 0] > 4.6
    assert hand.speed > 1.0
    return hand


def test_a_fence_that_pushes_for_ever_keeps_no_vehicle_from_landing() -> None:
    """After loss of the link it brakes, hovers and lands in the usual time."""
    hand = beyond_its_fence()
    began_s = hand.now_ns / SECOND_NS
    while hand.mode is not Mode.LAND and hand.now_ns / SECOND_NS < began_s + 20.0:
        hand.fly(0.02, beats=False)
        assert hand.speed > 1.0
    modes = [after for after, _ in hand.changes]
    assert modes[-3:] == ["brake", "hover", "land"]
    timeout_s, braking_s, land_after_s = 1.0, failsafe.brake_ns(hand.terms) / SECOND_NS, 10.0
    assert hand.now_ns / SECOND_NS - began_s < timeout_s + braking_s + land_after_s + 0.1


def test_the_longest_braking_is_that_from_the_fastest_input() -> None:
    """From u_max on both axes at 2 m/s², in whole steps, and half a second more."""
    terms = scenario().terms()
    assert failsafe.brake_ns(terms) / SECOND_NS == pytest.approx(
        np.hypot(*terms.u_max) / 2.0 + 0.5, abs=terms.dt_s
    )


ADVERSITIES: dict[str, tuple[float, Reason | None]] = {
    "silence": (float("inf"), None),
    "a link that stutters": (1.1, None),
    "a silent autopilot": (0.1, Reason.MUTE),
    "a low battery": (0.1, Reason.BATTERY),
    "no estimate": (0.1, Reason.ASTRAY),
    "a leap": (0.1, Reason.LEAPT),
}
"""Time between packets [s], and hindrance at every step."""


@pytest.mark.parametrize("adversity", ADVERSITIES)
@pytest.mark.parametrize(
    "mode", [Mode.SYNC, Mode.READY, Mode.TRACK, Mode.COAST, Mode.BRAKE, Mode.HOVER]
)
def test_no_mode_in_the_air_lasts_for_ever(mode: Mode, adversity: str) -> None:
    """The vehicle is never seen at rest, because something pushes it; only time passes."""
    every_s, hindrance = ADVERSITIES[adversity]
    failing = aboard(brake=2.0, land_after=10.0)
    failing.meet(Reason.OPENED, now_ns=0)
    failing.heard(now_ns=0)
    failing.mode, heard_ns = mode, 0
    if hindrance is Reason.LEAPT:
        failing.leapt(now_ns=0)
        hindrance = None
    now_ns, dt_ns = 0, 20 * MILLISECOND_NS
    while failing.mode is not Mode.LAND and now_ns < 60 * SECOND_NS:
        now_ns += dt_ns
        if now_ns - heard_ns >= every_s * SECOND_NS:
            heard_ns = now_ns
            failing.heard(now_ns=now_ns)
        failing.step(late_ns=0, hindrance=hindrance, now_ns=now_ns)
        if failing.mode in (Mode.TRACK, Mode.COAST) and now_ns > 5 * SECOND_NS:
            failing.meet(Reason.ENDED, now_ns=now_ns)
    # The longest plan, detection, braking, hovering, and a second for a link to be good.
    assert now_ns <= (5 + 1 + 2 + 10 + 1.1) * SECOND_NS


ROWS: dict[Reason, Callable[[], None]] = {
    Reason.GOOD: test_a_vehicle_takes_a_horizon_after_a_second_of_good_link,
    Reason.UNARMED: test_a_vehicle_that_is_not_armed_flies_nothing,
    Reason.OLD: test_without_a_newer_horizon_it_coasts_and_says_nothing,
    Reason.ENDED: test_an_exhausted_horizon_is_braked_along_and_the_next_is_taken_at_once,
    Reason.BRAKED: test_a_silent_server_ends_in_brake_with_horizon_left,
    Reason.WAITED: test_a_vehicle_whose_autopilot_stays_silent_lands,
    Reason.LOST: test_a_silent_server_ends_in_brake_with_horizon_left,
    Reason.ALONE: test_ten_seconds_of_hovering_alone_end_in_landing_for_good,
    Reason.LATE: test_horizons_that_come_late_for_half_a_second_end_in_brake,
    Reason.RESTARTED: test_a_restarted_server_s_horizons_wait_for_a_second_of_good_link,
    Reason.MALFORMED: test_malformed_messages_of_the_server_itself_end_in_brake,
    Reason.RESYNC: test_horizons_for_impossible_times_end_in_a_new_session,
    Reason.CLOSED: test_a_server_that_closes_the_session_ends_in_brake_at_once,
    Reason.STALLED: test_a_vehicle_that_was_asleep_brakes_on_waking_and_takes_the_next_horizon,
    Reason.NOT_FINITE: test_what_is_not_finite_ends_in_fault_for_good,
    Reason.LEAPT: test_a_state_that_no_vehicle_can_have_ends_in_hover_until_somebody_has_chosen,
}
"""Test that needs the table's rows of a cause."""
for _causes, _test in (
    (PILOTS, test_what_a_pilot_has_taken_is_his_at_once_and_until_he_gives_it_back),
    (GROUNDING, test_a_vehicle_that_can_fly_no_further_brakes_and_lands),
    (DEAF, test_a_vehicle_whose_autopilot_is_silent_brakes_and_waits_for_it),
):
    ROWS |= {cause: partial(_test, cause) for cause in _causes}
ROWS[Reason.RETURNED] = ROWS[Reason.TAKEN]


@pytest.mark.parametrize("cause", ROWS)
def test_without_the_rows_of_a_cause_its_scenario_goes_wrong(
    cause: Reason, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = {key: after for key, after in TRANSITIONS.items() if key[1] is not cause}
    monkeypatch.setattr(skytether.client.endpoint, "TRANSITIONS", rows)
    with pytest.raises(AssertionError):
        ROWS[cause]()


GUARDS: dict[str, tuple[object, str, object, Callable[[], None]]] = {
    "a second of good link": (
        *(failsafe, "GOOD_NS", 0),
        test_a_vehicle_takes_a_horizon_after_a_second_of_good_link,
    ),
    "locking": (
        *(failsafe, "LOCKING", frozenset()),
        test_a_silent_server_ends_in_brake_with_horizon_left,
    ),
    "dropping": (
        *(skytether.client.pilot, "DROPPING", frozenset()),
        test_a_restarted_server_s_horizons_wait_for_a_second_of_good_link,
    ),
    "closing": (
        *(skytether.client.endpoint, "CLOSING", frozenset()),
        test_a_server_that_closes_the_session_ends_in_brake_at_once,
    ),
    "who is malformed": (
        *(PlainLink, "secure", True),
        test_in_plaintext_a_stranger_cannot_make_it_brake_by_malformed_messages,
    ),
    "late in a row": (
        *(failsafe, "LATE_NS", 0),
        test_one_horizon_in_time_among_late_ones_is_enough,
    ),
    "malformed in a row": (
        *(failsafe, "MALFORMED_MAX", 1),
        test_malformed_messages_of_the_server_itself_end_in_brake,
    ),
}
"""Guard to switch off, how, and the test that needs it."""


@pytest.mark.parametrize("guard", GUARDS)
def test_without_a_guard_its_scenario_goes_wrong(
    guard: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, name, off, goes_wrong = GUARDS[guard]
    monkeypatch.setattr(where, name, off)
    with pytest.raises(AssertionError):
        goes_wrong()
