"""Flights without a plan: never flown, ended in hover, or with a gap."""

from typing import Any

import numpy as np
import pytest

from bench.missions import fly_with_deaths
from helpers import packaged
from skytether.server.tick import Ticker
from skytether.shared.events.flight import Finished, ModeChanged, NotFlown
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason, Record
from skytether.sim.flight import fly


def scenario(**sections: Any) -> Scenario:
    """Twenty seconds of the demo over 0.2 s each way without loss, with sections changed."""
    quick = "constant(0.2)"
    preset = {
        "duration": 20.0,
        "network": {"uplink": quick, "downlink": quick},
        "link": {"heartbeat_s": 0.1, "timeout_s": 1.0},
    }
    return packaged("demo-committed", preset, sections)


def said(flight: Record, host: str = "client") -> list[Any]:
    return [event for _, name, event in flight.events if name.split()[0] == host]


def interrupted(flown: Scenario, begin_s: float, end_s: float = 1e6) -> Record:
    """Flight with a server that is down from one time to another, and returns as another life."""
    flight, _ = fly_with_deaths(flown, 1, [(begin_s, end_s)])
    return flight


def test_a_vehicle_that_never_had_a_horizon_was_never_flown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Ticker, "_send_plans", lambda *_: None)
    flight = fly(scenario())
    why = str(Reason.OLD)
    assert flight.failure == NotFlown(vehicle=1, covered=0, steps=400, why=why)
    assert said(flight)[-1] == flight.failure
    assert not flight.client["input"].any()


def test_a_vehicle_that_hovers_to_the_end_has_not_been_flown() -> None:
    flight = interrupted(scenario(), 10.6)
    why = str(Reason.LOST)
    assert isinstance(flight.failure, NotFlown)
    assert flight.failure.why == why
    assert flight.failure.covered == np.count_nonzero(flight.client["covered"])
    *_, brakes, hovers, _ = (event for event in said(flight) if not isinstance(event, Finished))
    changed = {"vehicle": 1, "reason": why}
    assert brakes == ModeChanged(before="coast", after="brake", **changed)
    assert hovers == ModeChanged(before="brake", after="hover", **changed)
    assert said(flight)[-1] == flight.failure
    assert np.abs(flight.client["state"][-1, :, 1]).max() < 0.1


def test_a_server_that_dies_within_the_last_horizon_leaves_a_flight() -> None:
    """Without a plan for less than `link.timeout_s`, so it was flown to the end."""
    flight = interrupted(scenario(), 18.5)
    assert not flight.client["covered"][-1]
    assert flight.failure is None
    assert said(flight)[-1] == Finished(vehicle=1, steps=400, missed=0)


def test_a_flight_with_a_gap_is_a_flight() -> None:
    flight = interrupted(scenario(), 6.0, 12.0)
    assert flight.failure is None
    *changes, finished = said(flight)[-6:]
    assert isinstance(finished, Finished)
    assert [(each.after, each.reason) for each in changes] == [
        ("brake", str(Reason.LOST)),
        ("hover", str(Reason.LOST)),
        ("hover", str(Reason.RESTARTED)),
        ("hover", str(Reason.GOOD)),
        ("track", str(Reason.HORIZON)),
    ]
    assert not flight.client["covered"].all()
    assert flight.client["covered"][-100:].all()


def test_after_a_restart_a_vehicle_is_flown_that_drifts_faster_than_any_input() -> None:
    """Wind of 4 m/s against inputs of up to 1.6 m/s: committed inputs are kept within the bound."""
    wind = {"steady_wind_mps": [4.0, 0.0], "start_m": [-10.0, 0.0]}
    flown = scenario(vehicle=wind, model={"u_max": [1.6]})
    flight = interrupted(flown, 3.0, 10.0)
    before, after = flight.client[199], flight.client[-1]
    assert before["state"][0, 1] > 3.9
    assert not before["covered"]
    assert flight.client["covered"][-100:].all()
    assert after["in_force"] > 200
    assert after["state"][0, 1] < 2.5  # the effect of 1.6 m/s
