"""Compiled steps of vehicles in virtual time: the same flights as by `Pilot`, to the last bit."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import packaged, uncompile
from skytether.client.endpoint import Client
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason, Record
from skytether.sim.aboard import fly_step
from skytether.sim.flight import fly, fly_batch
from skytether.sim.pilot import Ahead, _Flying

SHORT = {"duration": 4.0, "settle": 0.0}
"""A few seconds of a scenario."""


@contextmanager
def counted() -> Iterator[list[bool]]:
    """Whether each step that could be compiled was as usual, one after the other.

    Steps that were flown ahead always are.
    """
    usual: list[bool] = []
    go_on = _Flying.go_on

    def counts(*args: Any) -> bool:
        usual.append(fly_step(*args))
        return usual[-1]

    def goes_on(self: _Flying, ahead: Ahead, count: int) -> list[float]:
        usual.extend([True] * count)
        return go_on(self, ahead, count)

    with (
        mock.patch("skytether.sim.pilot.fly_step", counts),
        mock.patch("skytether.sim.pilot._Flying.go_on", goes_on),
    ):
        yield usual


def assert_as_by_pilot(flown: Scenario, **keys: Any) -> tuple[Record, list[bool]]:
    """The record of a flight that is the same by `Pilot`; and which steps were compiled."""
    with counted() as usual:
        compiled = fly(flown, **keys)
    with pytest.MonkeyPatch.context() as patch, counted() as none:
        uncompile(patch)
        plain = fly(flown, **keys)
    assert not none
    assert compiled.client.tobytes() == plain.client.tobytes()
    assert compiled.trace_hash() == plain.trace_hash()
    assert compiled.events == plain.events
    assert compiled.figures["client"] == plain.figures["client"]
    return compiled, usual


NOTHING = {"delay": "none", "loss": 0.0}
NOISY = {"position_noise_m": 0.05, "velocity_noise_mps": 0.1}
scenarios = st.fixed_dictionaries(
    {
        "control": st.fixed_dictionaries(
            {
                "scheme": st.sampled_from(["predictive", "committed", "trajectory"]),
                "feedback": st.booleans(),
                "epsilon": st.sampled_from([0.01, 0.5]),
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
                "uplink": st.sampled_from([NOTHING, {"delay": "poisson", "loss": 0.5}]),
                "downlink": st.sampled_from([NOTHING, {"delay": "poisson", "loss": 0.1}]),
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
def test_flights_are_the_same_as_by_the_pilot(sections: dict[str, Any]) -> None:
    """Flights of any scheme, sensor, wind, report and network equal those of `Pilot`."""
    assert_as_by_pilot(packaged("paper", SHORT, **sections))


@pytest.mark.parametrize("name", ["paper", "demo"])
def test_most_steps_of_a_flight_are_compiled(name: str) -> None:
    """Else the other tests here would prove nothing: all but those without a plan."""
    record, usual = assert_as_by_pilot(packaged(name, SHORT, duration=8.0))
    assert all(usual)
    assert len(usual) > 0.7 * len(record.client)


@pytest.mark.parametrize(
    "sections",
    [
        {"sensor": {"delay_s": 0.1}},
        {"sensor": {"velocity_every_s": 0.2}},
        {"model": {"dead_time_s": [0.12]}},
        {"fence": {"radius_m": 6.0}},
    ],
)
def test_what_is_not_simple_is_left_to_the_pilot(sections: dict[str, Any]) -> None:
    """A sensor that tells late or now and then, a dead time, a fence."""
    _, usual = assert_as_by_pilot(packaged("demo", SHORT, **sections))
    assert not usual


@pytest.mark.parametrize(
    "sensor",
    [
        NOISY,
        {"position_noise_m": 0.05},
        {"velocity_noise_mps": 0.1, "filter": "none"},
        {"position_bias_m": [0.2, -0.1], "velocity_bias_mps": [0.0, 0.05]},
        {"position_noise_m": 0.05, "position_bias_m": [0.2, 0.0], "velocity_noise_mps": 0.01},
    ],
)
@pytest.mark.parametrize("name", ["paper", "demo"])
def test_noisy_measurements_are_compiled(name: str, sensor: dict[str, Any]) -> None:
    """Noise and bias of positions, of velocities and of both, with the filter and without."""
    record, usual = assert_as_by_pilot(packaged(name, SHORT, duration=8.0, sensor=sensor))
    assert all(usual)
    assert len(usual) > 0.7 * len(record.client)


@pytest.mark.parametrize("name", ["swap", "sphere", "corridor"])
def test_missions_are_compiled(name: str) -> None:
    """Vehicles that hold their places, fly motions and come to rest, over a network that loses."""
    lossy = {"uplink": {"loss": 0.3}, "downlink": {"loss": 0.3}}
    flown = packaged(name, {"duration": 12.0, "settle": 0.0}, network=lossy)
    record, usual = assert_as_by_pilot(flown, vehicles=len(flown.make_reference().vehicles))
    assert all(usual)
    assert len(usual) > 0.9 * len(record.client)


def test_vehicles_are_woken_only_where_something_happens() -> None:
    """The rest of a flight is flown ahead, also where what comes changes it on the way."""
    changes = [
        (3.03, {"vehicle.wind": 0.0}),
        (5.01, {"vehicle.wind": 0.2}),
        (7.0, {"armed": False}),
        (8.0, {"armed": True}),
    ]
    flown = packaged("swap", {"duration": 16.0, "settle": 0.0}, simulation={"clock_drift_ppm": 50})
    flies = mock.Mock()
    fly_one = Client._fly

    def counts(self: Client, now_ns: int) -> None:
        flies()
        fly_one(self, now_ns)

    with mock.patch.object(Client, "_fly", counts):
        record = fly(flown, vehicles=16, changes=changes)
    assert flies.call_count < 0.3 * len(record.client)
    assert_as_by_pilot(flown, vehicles=16, changes=changes)


def test_vehicles_of_a_batch_and_of_a_fleet_keep_the_order_of_their_records() -> None:
    """The order is that of time: of several vehicles, of a batch, and on a sealed link."""
    flown = packaged("target", {"duration": 8.0, "settle": 0.0})
    assert_as_by_pilot(flown, vehicles=3, secure=True)
    batch = fly_batch(flown, [3, 4, 5])
    for seed, record in zip([3, 4, 5], batch, strict=True):
        alone = fly(msgspec.structs.replace(flown, seed=seed))
        assert record.client.tobytes() == alone.client.tobytes()


def test_wind_may_change_in_flight() -> None:
    """The arrays take on other air, and a step is flown in what was drawn for it."""
    changes = [(1.5, {"vehicle.wind": 0.3}), (2.5, {"vehicle.gust_mps2": 2.0})]
    _, usual = assert_as_by_pilot(packaged("paper", SHORT), changes=changes)
    assert all(usual)


def test_wind_and_gusts_of_a_noisy_vehicle_may_come_and_go() -> None:
    """Numbers that were drawn in advance are given back where gusts begin to draw theirs."""
    changes = [
        (1.0, {"vehicle.wind": 0.0}),
        (1.5, {"vehicle.wind": 0.3}),
        (2.0, {"vehicle.gust_mps2": 2.0}),
        (3.0, {"vehicle.gust_mps2": 0.0}),
    ]
    flown = packaged("target", SHORT, vehicle={"gust_every_s": 0.2, "gust_s": 0.1})
    _, usual = assert_as_by_pilot(flown, changes=changes)
    assert all(usual)


def test_a_step_that_is_not_as_usual_is_flown_by_the_pilot() -> None:
    """A state that leaps brakes the vehicle, in the wind that was drawn for the step."""
    changes = [(5.0, {"vehicle.wind": 30.0})]
    record, usual = assert_as_by_pilot(packaged("demo", SHORT, duration=8.0), changes=changes)
    assert not all(usual)
    assert Reason.LEAPT in record.client["reason"]
