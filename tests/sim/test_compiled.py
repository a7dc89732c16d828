"""Flights with compiled code, as in virtual time, and in plain Python, as aboard: the same bits."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import interpreted, packaged
from skytether.shared.base.compilable import COMPILABLE
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason, Record
from skytether.sim.batch import fly_batch
from skytether.sim.flight import fly

SHORT = {"duration": 2.0, "settle": 0.0}


def assert_same(flown: Scenario, **keys: Any) -> Record:
    """Record of a flight, after checking that it is the same in plain Python."""
    compiled = fly(flown, **keys)
    with interpreted():
        plain = fly(flown, **keys)
    assert compiled.client.tobytes() == plain.client.tobytes()
    assert compiled.trace_hash() == plain.trace_hash()
    assert compiled.events == plain.events
    assert compiled.figures["client"] == plain.figures["client"]
    return compiled


def test_virtual_time_flies_by_machine_code_and_plain_python_does_not() -> None:
    """Otherwise the other tests here would compare a thing with itself."""
    assert all(hasattr(each.func, "dispatcher") for each in COMPILABLE)
    with interpreted():
        assert not any(hasattr(each.func, "dispatcher") for each in COMPILABLE)
    assert all(hasattr(each.func, "dispatcher") for each in COMPILABLE)


NOTHING = ""
NOISY = {"position_noise_m": 0.05, "velocity_noise_mps": 0.1}
scenarios = st.fixed_dictionaries(
    {
        "control": st.fixed_dictionaries(
            {
                "scheme": st.sampled_from(["predictive", "committed", "trajectory"]),
                "feedback": st.booleans(),
                "trigger": st.sampled_from(["always", "periodic", "heartbeat"]),
            }
        ).filter(lambda control: control["feedback"] or control["scheme"] != "trajectory"),
        "model": st.fixed_dictionaries(
            {"axes": st.sampled_from([2, 3]), "dead_time_s": st.sampled_from([[0.0], [0.08]])}
        ),
        "vehicle": st.fixed_dictionaries(
            {
                "wind": st.sampled_from([0.0, 0.3]),
                "gust_mps2": st.sampled_from([0.0, 0.5]),
                "exhausted": st.sampled_from(["hold", "brake"]),
                "report": st.sampled_from(
                    ["always", "deviation(0.05)", "silence(0.5)", "deviation(0.2) | silence(1)"]
                ),
                "tau_s": st.sampled_from([[], [0.7]]),
            }
        ),
        "sensor": st.sampled_from([{}, {}, NOISY, {"delay_s": 0.1}, {"filter": "none"}]),
        "network": st.fixed_dictionaries(
            {
                "uplink": st.sampled_from([NOTHING, "paper(0.4, 0.02, 2.0) & loss(0.5)"]),
                "downlink": st.sampled_from([NOTHING, "paper(0.4, 0.02, 2.0) & loss(0.1)"]),
            }
        ),
        "link": st.just({"heartbeat_s": 0.2, "timeout_s": 0.5}),
        "simulation": st.fixed_dictionaries(
            {"clock_drift_ppm": st.sampled_from([0.0, 40.0, -75.0])}
        ),
    }
)


@pytest.mark.long
@settings(max_examples=60)
@given(scenarios)
def test_flights_are_the_same(sections: dict[str, Any]) -> None:
    assert_same(packaged("paper", SHORT, **sections))


@pytest.mark.parametrize(
    "sections",
    [
        {},
        {"sensor": {"delay_s": 0.1}},
        {"sensor": {"velocity_every_s": 0.2}},
        {"model": {"dead_time_s": [0.12]}},
        {"fence": {"radius_m": 6.0}},
        {"sensor": NOISY},
        {"sensor": {"position_noise_m": 0.05}},
        {"sensor": {"velocity_noise_mps": 0.1, "filter": "none"}},
        {"sensor": {"position_bias_m": [0.2, -0.1], "velocity_bias_mps": [0.0, 0.05]}},
        {"vehicle": {"gust_every_s": 0.2, "gust_s": 0.1, "gust_mps2": 2.0}},
    ],
)
def test_flights_of_each_kind_of_vehicle_are_the_same(sections: dict[str, Any]) -> None:
    assert_same(packaged("demo", SHORT, **sections))


def test_a_flight_by_inputs_is_the_same() -> None:
    assert_same(packaged("paper", SHORT, sensor=NOISY))


@pytest.mark.long
def test_missions_are_the_same() -> None:
    lossy = {"uplink": {"loss": 0.3}, "downlink": {"loss": 0.3}}
    flown = packaged("corridor", {"duration": 12.0, "settle": 0.0}, network=lossy)
    assert_same(flown, vehicles=len(flown.make_reference().vehicles))


def test_vehicles_of_a_batch_and_of_a_fleet_keep_the_order_of_their_records() -> None:
    flown = packaged("target", {"duration": 4.0, "settle": 0.0})
    assert_same(flown, vehicles=3, secure=True)
    batch = fly_batch(flown, [3, 4, 5])
    for seed, record in zip([3, 4, 5], batch, strict=True):
        alone = fly(msgspec.structs.replace(flown, seed=seed))
        assert record.client.tobytes() == alone.client.tobytes()


def test_wind_and_gusts_of_a_noisy_vehicle_may_come_and_go() -> None:
    """Numbers drawn in advance are returned when gusts begin to draw theirs."""
    changes = [
        (1.0, {"vehicle.wind": 0.0}),
        (1.5, {"vehicle.wind": 0.3}),
        (2.0, {"vehicle.gust_mps2": 2.0}),
        (3.0, {"vehicle.gust_mps2": 0.0}),
    ]
    gusts = {"gust_every_s": 0.2, "gust_s": 0.1}
    flown = packaged("target", SHORT, duration=4.0, vehicle=gusts)
    assert_same(flown, changes=changes)


def test_a_state_that_leaps_brakes_the_vehicle() -> None:
    changes = [(5.0, {"vehicle.wind": 30.0})]
    record = assert_same(packaged("demo", SHORT, duration=8.0), changes=changes)
    assert Reason.LEAPT in record.client["reason"]
