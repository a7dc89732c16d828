"""Whole flights in virtual time: reproducible, and with the documented errors."""

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import skytether.sim.flight
from helpers import packaged
from skytether.server import reception
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Finished, FlowOpened, Flying, ModeChanged, SessionOpened
from skytether.shared.events.ground import NoAnswer
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Reason, Record, client_columns
from skytether.shared.telemetry.summary import Summary, position_error, summarise
from skytether.shell.commandline.terminal import summary_rows
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly


def summary(flown: Scenario, flight: Record) -> Summary:
    return summarise(flown, "test", flight.client, flight.server, flight.netem)


def flew(name: str = "paper-every-step", **changes: Any) -> Summary:
    flown = packaged(name, **changes)
    return summary(flown, fly(flown))


QUIET = {"uplink": "", "downlink": ""}
"""Network without delay and loss."""

HASH = """
from skytether.shared.scenario import reading
from skytether.sim.flight import fly
import msgspec
flown = msgspec.structs.replace(reading.load("paper"), duration=2.0, settle=0.0, seed=5)
print(fly(flown).trace_hash())
"""


def test_the_same_seed_flies_the_same_in_another_process_and_hash_seed() -> None:
    environment = os.environ | {"PYTHONHASHSEED": "1"}
    run = subprocess.run(
        [sys.executable, "-c", HASH], env=environment, capture_output=True, check=True
    )
    hashes = {run.stdout.decode().strip()}
    hashes.add(fly(packaged("paper", duration=2.0, settle=0.0, seed=5)).trace_hash())
    assert len(hashes) == 1
    assert fly(packaged("paper", duration=2.0, settle=0.0, seed=6)).trace_hash() not in hashes


@pytest.mark.long
def test_compensation_is_worth_a_factor_of_two_and_a_half() -> None:
    error = {}
    for name in ("paper-no-compensation", "paper-every-step"):
        flown = packaged(name, duration=33.0)
        flights = fly_batch(flown, range(1, 6))
        error[name] = np.mean([summary(flown, flight).rmse_xy for flight in flights])
    assert error["paper-no-compensation"] >= 2.5 * error["paper-every-step"]


@pytest.mark.long
def test_the_event_trigger_saves_four_packets_in_five() -> None:
    every_step, triggered = flew(), flew("paper")
    assert every_step.event_ratio == 1.0
    assert triggered.event_ratio < 0.2
    assert triggered.uplink_packets < 0.25 * every_step.uplink_packets
    assert every_step.rmse_xy < triggered.rmse_xy < 2.5 * every_step.rmse_xy


def test_without_network_the_estimate_is_the_state() -> None:
    """Zero delay, no loss: x̂(k) = x(k) to the last bit of float32, at every step."""
    flown = packaged("paper-every-step", duration=10.0, network=QUIET)
    flight = fly(flown)
    # The flight ends with step 199, before the server has ticked for it.
    assert flight.server["step"].tolist() == list(range(199))
    state = flight.client["state"][:199].astype(np.float32)
    np.testing.assert_array_equal(flight.server["estimate"], state)


def test_a_flight_that_is_over_before_it_has_settled_has_an_error() -> None:
    flown = packaged("demo", duration=5.0)
    flight = fly(flown)
    error = position_error(flown, flight.client, flight.server)[50:]
    assert summary(flown, flight).rmse_x == pytest.approx(np.sqrt((error[:, 0] ** 2).mean()))
    assert packaged("demo", duration=9.0).settled_s == 8.0


HORIZONS = "uplink horizons, other packets"


@pytest.mark.parametrize(
    ("trigger", "least", "most"),
    [
        ("periodic(10)", 0.0, 0.0),
        ("heartbeat", 0.0, 0.0),
        ("state_gap(0, 100) | heartbeat", 0.95, 1.0),
        ("state_gap(3.6, 1.5)", 0.9, 1.0),
        ("state_gap(3.6, 1.5) | silence(0.2)", 0.1, 0.8),
    ],
)
def test_horizons_are_counted_by_what_sent_them(trigger: str, least: float, most: float) -> None:
    flown = packaged("paper", duration=20.0, control={"trigger": trigger})
    result = summary(flown, fly(flown))
    assert least <= result.uplink_above / result.uplink_horizons <= most
    assert result.uplink_above + result.uplink_due == result.uplink_horizons > 5


def test_the_summary_counts_what_the_network_saw() -> None:
    flown = packaged("paper", duration=20.0)
    flight = fly(flown)
    result = summary(flown, flight)
    up = flight.netem[flight.netem["direction"] == UPLINK]
    down = flight.netem[flight.netem["direction"] == DOWNLINK]
    assert result.steps == 400
    assert result.duration_s == 20.0
    # HELLO and an observation per step; the last half second is still under way at the end.
    assert result.downlink_packets == len(down) >= 390
    assert result.downlink_bytes == down["bytes"].sum()
    assert result.uplink_packets == len(up)
    assert result.event_ratio * len(flight.server) == pytest.approx(flight.server["event"].sum())
    assert result.uplink_horizons == flight.server["event"].sum()
    horizons = summary_rows(result)[[name for name, _ in summary_rows(result)].index(HORIZONS)][1]
    assert horizons == f"{result.uplink_horizons}, {len(up) - result.uplink_horizons}"
    assert result.lost == flight.netem["lost"].sum() > 0
    assert result.reordered == flight.netem["overtaken"].sum() > 0
    assert result.solve_ms_p50 is None
    assert result.secure is False
    assert result.rmse_xy == pytest.approx(np.hypot(result.rmse_x or 0, result.rmse_y or 0))


def test_two_contenders_of_a_seed_meet_the_same_network() -> None:
    met: list[dict[tuple[int, int], tuple[int, bool]]] = []
    bursts = {
        "uplink": "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 0.5)",
        "downlink": "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 0.5)",
    }
    for trigger, scheme in (("always", "predictive"), ("periodic(7)", "committed")):
        control = {"trigger": trigger, "scheme": scheme}
        rows = fly(packaged("paper", duration=20.0, control=control, network=bursts)).netem
        fates = zip(rows["delay_ns"].tolist(), rows["lost"].tolist(), strict=True)
        entries = zip(rows["direction"].tolist(), rows["arrived_ns"].tolist(), strict=True)
        met.append(dict(zip(entries, fates, strict=True)))
    every, seldom = met
    for direction, least in ((UPLINK, 50), (DOWNLINK, 350)):
        both = [entry for entry in every if entry in seldom and entry[0] == direction]
        assert len(both) >= least
        assert any(every[entry][1] for entry in both)
        assert [every[entry] for entry in both] == [seldom[entry] for entry in both]


def test_age_is_a_round_trip_and_the_wait_for_the_next_step() -> None:
    """At least 0.8 s of delay, at most 0.25 s of waiting and jitter at the median."""
    assert 850 <= flew(duration=20.0).age_ms_p50 <= 1050


def test_the_summary_tells_ages_effort_and_bounds_of_what_was_flown() -> None:
    flown = packaged("paper", duration=1.0, settle=0.05)
    rows = np.zeros(6, client_columns(2))
    rows["step"] = range(6)
    rows["input"][:, 0] = [0.0, 0.3, 0.3, flown.u_max[0], flown.u_max[0], 0.0]
    rows["input"][:, 1] = [0.0, 0.4, 0.4, 0.0, 0.0, -np.float32(flown.u_max[1])]
    rows["in_force"] = [-1, -1, 0, 0, 3, 4]
    rows["age_ns"] = np.array([-1, -1, 500, 550, 450, 400]) * 1_000_000
    result = summarise(flown, "test", rows)
    assert (result.aoi_s_mean, result.aoi_s_peak) == (pytest.approx(0.475), pytest.approx(0.5))
    assert result.plan_age_s_mean == pytest.approx(0.05 * (2 + 3 + 1 + 1) / 4)
    u = float(flown.u_max[0])
    changes = [0.25, 0.0, (u - 0.3) ** 2 + 0.16, 0.0, 2 * u**2]
    assert result.effort_mps == pytest.approx(np.sqrt(np.mean(changes)))
    assert result.saturated == pytest.approx(3 / 5)


def test_unsynchronised_clocks_change_nothing() -> None:
    plain = fly(packaged("paper-every-step", duration=8.0))
    for offset_s in (-3600.0, 86000.0):
        clocks = {"clock_offset_s": offset_s}
        offset = fly(packaged("paper-every-step", duration=8.0, simulation=clocks))
        np.testing.assert_array_equal(plain.client["state"], offset.client["state"])


def test_a_server_too_slow_for_its_steps_misses_deadlines_and_says_so() -> None:
    """80 ms of computing in steps of 50 ms: three ticks in eight are skipped."""
    assert 65 <= flew(duration=10.0, simulation={"compute_s": 0.08}).deadline_misses <= 75


def test_it_flies_in_space_with_a_time_constant_for_each_axis() -> None:
    flown = packaged(
        "paper-every-step",
        duration=20.0,
        model={"axes": 3, "tau_s": [0.81, 0.6, 1.0]},
        reference={"altitude_m": 5.0},
        vehicle={"start_m": [1.5, 0.0, 4.0]},
    )
    flight = fly(flown)
    result = summary(flown, flight)
    assert flight.client["state"].shape == (400, 3, 2)
    assert result.rmse_z < 0.2
    assert flight.client["state"][-1, 2, 0] == pytest.approx(5.0, abs=0.05)


def test_two_vehicles_share_one_server() -> None:
    flown = packaged("paper-every-step", duration=20.0)
    flight = fly(flown, vehicles=2)
    for vehicle in (1, 2):
        rows = flight.client[flight.client["vehicle"] == vehicle]
        result = summarise(flown, "test", rows, flight.server, flight.netem)
        assert result.steps == 400
        assert result.rmse_xy < 0.4
    assert set(flight.netem["flow"]) == {0, 1}


def test_a_network_that_loses_everything_is_no_flight() -> None:
    lost = QUIET | {"uplink": "loss(1)"}
    flight = fly(packaged("paper", settle=0.0, network=lost))
    assert flight.failure == NoAnswer(vehicle=1, host="netem 1", port=0, waited_s=121.0)
    assert len(flight.client) == 0


def test_a_flight_keeps_what_everybody_said() -> None:
    flown = packaged("paper", duration=2.0, settle=0.0, seed=7, network=QUIET)
    events = fly(flown, vehicles=2).events
    assert [event.time_ns for event in events] == sorted(event.time_ns for event in events)
    said = {host: [event for _, name, event in events if name == host] for _, host, _ in events}
    assert said == {
        "netem 7": [FlowOpened(flow=n, host=f"client 7.{n + 1}", port=0) for n in (0, 1)],
        **{
            f"client 7.{n}": [
                Flying(vehicle=n),
                ModeChanged(vehicle=n, before="init", after="ready", reason=str(Reason.OPENED)),
                ModeChanged(vehicle=n, before="ready", after="track", reason=str(Reason.HORIZON)),
                Finished(vehicle=n, steps=40, missed=0),
            ]
            for n in (1, 2)
        },
        "server": [SessionOpened(vehicle=n, host="netem 7", port=n) for n in (1, 2)],
    }


def test_wind_and_gusts_push_but_do_not_break() -> None:
    gusts = {"wind": 0.3, "gust_mps2": 0.5, "gust_every_s": 5.0}
    calm, windy = flew(duration=15.0), flew(duration=15.0, vehicle=gusts)
    assert calm.rmse_xy < windy.rmse_xy < 2.0


def test_budget_caps_a_flight_and_a_heartbeat_ends_its_silences() -> None:
    """5 packets/s and a burst of 2; at most 1 s without one. Eq. (16) alone keeps neither."""

    def sent_s(trigger: str) -> Array:
        flown = packaged("paper", duration=20.0, control={"trigger": trigger})
        server = fly(flown).server
        return server["step"][server["event"]] * flown.control.dt

    def most(sent_s: Array) -> float:
        """Packets in any window, minus 5/s times its length."""
        n, i = np.arange(len(sent_s)), np.tril_indices(len(sent_s))
        return ((n[:, None] - n + 1) - 5.0 * (sent_s[:, None] - sent_s))[i].max()

    alone = sent_s("state_gap")
    assert most(sent_s("state_gap & budget(5, 2)")) <= 2.0 + 1e-9 < 4.0 < most(alone)
    assert np.diff(sent_s("state_gap | silence(1)")).max() <= 1.0 + 1e-9 < np.diff(alone).max()


@pytest.mark.long
def test_what_is_never_flown_costs_no_packets() -> None:
    """Over a round trip of 1.6 s, the last 1.3 s of a plan are too old to be flown."""
    slow = "paper(0.76, 0.02, 2.0) & loss(0.1)"
    long = packaged("demo-committed", duration=30.0, network={"uplink": slow, "downlink": slow})
    assert long.link.age_max_s == 5.0
    found = [summary(long, flight) for flight in fly_batch(long, range(1, 7))]
    assert max(each.event_ratio or 1.0 for each in found) < 0.08  # 0.6 if all of it is compared
    assert np.median([each.rmse_xy or 1.0 for each in found]) < 0.035


@pytest.mark.parametrize("name", ["demo", "paper"])
def test_a_flight_is_the_same_whenever_stamps_begin_anew(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every 71 minutes of the server's clock: 5 s after its start, and where the clocks differ."""
    flown = packaged(name, duration=8.0)
    usual = fly(flown)
    for midnight_s in (4290, 2 * 10**9):
        monkeypatch.setattr(skytether.sim.flight, "MIDNIGHT_NS", midnight_s * SECOND_NS)
        other = fly(flown)
        assert other.client.tobytes() == usual.client.tobytes()
        assert other.server.tobytes() == usual.server.tobytes()


def test_a_server_that_takes_stamps_as_they_are_plans_for_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reception, "stamped_ns", lambda stamp, near_ns: stamp * 1000)  # noqa: ARG005
    flight = fly(packaged("demo", duration=10.0))
    assert not flight.client["covered"].any()
