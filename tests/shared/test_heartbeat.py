"""Heartbeats: allowed silence of an end, and its cost."""

from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether
from idle_link import keep
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.events.flight import ModeChanged
from skytether.shared.law.heartbeat import (
    ASSUMED,
    FALSE_PER_H,
    NUMBERS,
    SESSION_NS,
    WEIGHT,
    WINDOW,
    Hearing,
    false_per_h,
    silences,
)
from skytether.shared.scenario.schema import LinkConfig
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Reason
from skytether.sim.flight import fly

DT_NS = 50 * MILLISECOND_NS
ear = partial(Hearing, 2 * SECOND_NS, DT_NS, None)


@pytest.mark.parametrize(
    ("link", "patience_s"),
    [
        (LinkConfig(timeout_s=1.5), 3.0),
        (LinkConfig(timeout_s=1.5, heartbeat_s=0.1), 1.5),
        (LinkConfig(timeout_s=20.0), SESSION_NS / SECOND_NS),
        (LinkConfig(timeout_s=40.0), 40.0),
    ],
    ids=["twice", "heartbeats are given", "as long as it remembers", "as the vehicle asks"],
)
def test_the_server_waits_longer_than_the_vehicle(link: LinkConfig, patience_s: float) -> None:
    """Twice as long with adaptive heartbeats, but no longer than it remembers a vehicle."""
    assert link.patience_ns == round(patience_s * SECOND_NS)


def hear(hearing: Hearing, number: int) -> None:
    hearing.hear(number % NUMBERS, number * MILLISECOND_NS)


@pytest.mark.parametrize(
    ("timeout_s", "period_s", "loss", "per_h"),
    [(1.0, 0.1, 0.1, 3.24e-5), (2.0, 0.2, 0.3, 0.248), (2.0, 0.5, 0.1, 6.48), (2.0, 0.3, 0.0, 0)],
)
def test_false_losses_are_runs_of_lost_heartbeats(
    timeout_s: float, period_s: float, loss: float, per_h: float
) -> None:
    """3600/T pⁿ (1 - p): n = 9, 9 and 3 fit into 0.95 of the timeout."""
    found = false_per_h(round(period_s * SECOND_NS), round(timeout_s * SECOND_NS), loss)
    assert found == pytest.approx(per_h, rel=2e-3)


@settings(max_examples=25)
@given(st.integers(200, 10_000), st.integers(5, 200), st.floats(0.0, 1.0))
def test_what_is_asked_for_meets_the_goal_or_is_the_shortest(
    timeout_ms: int, step_ms: int, loss: float
) -> None:
    """A whole number of steps, from a fifteenth to a third of the timeout if steps allow."""
    timeout_ns, step_ns = timeout_ms * MILLISECOND_NS, step_ms * MILLISECOND_NS
    table = silences(timeout_ns, step_ns)
    times_ns = [ns for _, ns in table]
    assert times_ns == sorted(set(times_ns), reverse=True)
    assert all(ns % step_ns == 0 for ns in times_ns)
    assert times_ns[0] <= max(step_ns, timeout_ns // 3)
    assert times_ns[-1] >= min(step_ns, timeout_ns // 15)
    for up_to, silence_ns in table:
        if loss <= up_to:
            assert false_per_h(silence_ns, timeout_ns, loss) <= FALSE_PER_H * 1.01
            break


@pytest.mark.parametrize(
    ("loss", "period_s"), [(0.0, 0.6), (0.05, 0.45), (0.1, 0.35), (0.2, 0.2), (0.3, 0.15)]
)
def test_a_lossier_link_is_asked_for_more(loss: float, period_s: float) -> None:
    table = silences(2 * SECOND_NS, DT_NS)
    found = next(ns for up_to, ns in table if loss + 0.005 * (loss == 0.0) <= up_to)
    assert found == round(period_s * SECOND_NS)


def test_a_new_session_assumes_a_loss_of_three_in_ten() -> None:
    """The estimate follows the packets; late, duplicate and missing ones count correctly."""
    hearing = ear()
    assert hearing.loss == ASSUMED
    assert hearing.silence_ns == 150 * MILLISECOND_NS - DT_NS // 2
    for number in (0, 2, 1, 1, 4):
        hear(hearing, number)
    assert hearing.loss == pytest.approx((1 + WEIGHT * ASSUMED) / (5 + WEIGHT))
    for number in range(5, 3 * WINDOW):
        hear(hearing, number)
    assert hearing.loss == pytest.approx(WEIGHT * ASSUMED / (WINDOW + WEIGHT))
    hear(hearing, 4 * WINDOW - 2)
    assert hearing.loss > 0.9
    hear(hearing, 0)
    assert hearing.loss > 0.9
    hearing.begin()
    assert hearing.loss == ASSUMED


@given(st.lists(st.integers(0, NUMBERS - 2), max_size=60), st.sampled_from([0, 2 * WINDOW]))
def test_the_share_lost_does_not_depend_on_the_order(numbers: list[int], before: int) -> None:
    heard, sorted_ = ear(), ear()
    for number in range(before):
        hear(heard, number)
        hear(sorted_, number)
    for number in numbers:
        hear(heard, before + number)
    for number in sorted(set(numbers)):
        hear(sorted_, before + number)
    assert heard.loss == sorted_.loss


@settings(max_examples=30)
@given(st.integers(0, 4 * NUMBERS))
def test_of_a_burst_no_more_than_its_rest_by_the_modulus_is_seen(burst: int) -> None:
    hearing = ear()
    for number in range(2 * WINDOW):
        hear(hearing, number)
    hear(hearing, 2 * WINDOW + burst)
    assert hearing.loss == pytest.approx((burst % NUMBERS + WEIGHT * ASSUMED) / (WINDOW + WEIGHT))


def test_a_number_that_is_asked_for_is_asked_for_whatever_the_loss() -> None:
    hearing = Hearing(2 * SECOND_NS, DT_NS, SECOND_NS // 4)
    assert hearing.silence == 10  # half steps of 50 ms
    hear(hearing, 100)
    assert hearing.silence == 10


def test_a_link_at_rest_is_rarely_taken_for_lost() -> None:
    """Over three hours; with fixed heartbeats, far more often."""
    network = "paper(0.4, 0.02, 2.0) & loss(0.3)"
    kept = keep(network, 18, LinkConfig(timeout_s=2.0))
    assert kept.false_per_h <= 0.34
    assert max(kept.noticed_s) < 2.0 + 0.6
    assert kept.packets_per_s == pytest.approx(2.7, rel=0.1)
    assert keep(network, 3, LinkConfig(timeout_s=2.0, heartbeat_s=0.5)).false_per_h > 30.0


def test_a_hover_in_still_air_costs_the_heartbeats_and_no_more() -> None:
    """Both ends settle at the rate that the loss requires."""
    calm = {"vehicle.wind": 0.0, "reference.shape": "hover", "reference.points_m": [[0.0, 0.0]]}
    way = {"network.uplink.loss": 0.1, "network.downlink.loss": 0.1}
    scenario = skytether.load("demo", duration=60, settle=5, **calm, **way)
    flown = fly(scenario)
    late = flown.netem[flown.netem["arrived_ns"] > flown.netem["arrived_ns"].max() - 25 * SECOND_NS]
    for direction, packets_per_s in ((UPLINK, 4.7), (DOWNLINK, 1.8)):
        rate = (late["direction"] == direction).sum() / 25.0
        assert rate == pytest.approx(packets_per_s, rel=0.15)
    assert flown.client["covered"][200:].all()


def test_both_ends_keep_a_link_alive_and_notice_its_end() -> None:
    kept = keep("paper(0.4, 0.02, 2.0) & loss(0.1)", 6)
    assert kept.false_per_h <= 1.0
    assert len(kept.noticed_s) == 6
    assert 1.2 < min(kept.noticed_s) <= max(kept.noticed_s) < 2.1
    assert keep("paper(0.4, 0.02, 2.0) & loss(0.6)", 2).false_per_h > 0
    calm = keep("paper(0.4, 0.02, 2.0)", 1)
    assert (calm.false_per_h, calm.noticed_s) == (0, pytest.approx([1.75], abs=0.35))


def test_bursts_are_longer_than_any_heartbeat_helps_against() -> None:
    assert keep("paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 2.0)", 3).false_per_h > 20


def test_a_flight_notices_that_it_is_cut() -> None:
    cut_s = 40.0
    keys = {
        "control.scheme": "trajectory",
        "control.trigger": "expected_gap(0.05) | silence(1)",
        "vehicle.report": "deviation(0.05) | silence(1)",
        "link.timeout_s": 1.5,
        "network.uplink.loss": 0.1,
        "network.downlink.loss": 0.1,
    }
    cut = {f"network.{direction}.loss": 1.0 for direction in ("uplink", "downlink")}
    flown = fly(skytether.load("demo", duration=50.0, **keys), changes=[(cut_s, cut)])
    noticed_s = [
        time_ns / SECOND_NS - cut_s
        for time_ns, _, event in flown.events
        if isinstance(event, ModeChanged) and event.reason == str(Reason.LOST)
    ]
    assert 1.4 < noticed_s[-1] < 2.1
