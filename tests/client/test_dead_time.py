"""Dead time and gain of the model: prediction of the state when the next input takes effect."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import packaged
from skytether.client.filter import Kalman
from skytether.client.navigation import Navigation
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.vehicle import simulated
from skytether.client.simulated.weather import Weather
from skytether.shared.base.chance import stream
from skytether.shared.law.dead_time import PendingInputs, dead_times
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.sim.flight import fly

AUTOPILOT = {
    "tau_s": [0.47, 0.21],
    "gain": [1.01, 0.9],
    "dead_time_s": [0.27, 0.24],
    "u_max": [3.0],
}
"""Model like an autopilot's horizontal and vertical axis, with dead times between steps."""
PERFECT = dict.fromkeys(("uplink", "downlink"), "")
BRISK = {"shape": "figure-eight", "radius_m": 3.0, "period_s": 15.0}


def scenario(**sections: Any) -> Scenario:
    """The demo in calm air for 15 s, with sections changed."""
    calm = {"duration": 15.0, "settle": 5.0, "vehicle": {"wind": 0.0}}
    return packaged("demo-committed", calm, sections)


def flown(**sections: Any) -> tuple[Summary, Record]:
    """Summary and record of a flight along a fast figure eight."""
    flight = scenario(**{"reference": BRISK} | sections)
    record = fly(flight)
    return summarise(flight, "test", record.client, record.server, record.netem), record


# -- predicted state -------------------------------------------------------------------------------


@pytest.mark.long
@given(
    tau_s=st.tuples(*[st.floats(0.05, 3.0)] * 2),
    gain=st.tuples(*[st.floats(0.3, 2.0)] * 2),
    dead_time_ns=st.tuples(*[st.integers(0, 1_200_000_000)] * 2),
    dt_s=st.sampled_from([0.02, 0.05, 0.1]),
    wind_mps=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
    seed=st.integers(0, 999),
)
def test_what_the_next_input_meets_obeys_eq_4_without_dead_time(
    tau_s: tuple[float, ...],
    gain: tuple[float, ...],
    dead_time_ns: tuple[int, ...],
    dt_s: float,
    wind_mps: tuple[float, ...],
    seed: int,
) -> None:
    """Predicted from the plant's true state, with dead times in whole and broken steps."""
    late_s = [ns / 1e9 for ns in dead_time_ns]
    model = {"tau_s": tau_s, "gain": gain, "dead_time_s": late_s}
    steady = [g * w for g, w in zip(gain, wind_mps, strict=True)]
    known = scenario(
        model=model, vehicle={"steady_wind_mps": steady}, control={"dt": dt_s, "horizon": 40}
    )
    terms = known.terms()
    plant = FirstOrderPlant(known, Weather(known, stream(0, "wind")))
    on_their_way = PendingInputs(terms.model.axes(), dead_times(terms))
    wind = np.array(wind_mps)
    met, states = on_their_way.predict(plant.state(), wind), []
    for u in np.random.default_rng(seed).uniform(-3.0, 3.0, (40, 2)):
        wanted = terms.model.step(met, u + wind)
        plant.advance(u)
        on_their_way.issue(u)
        met = on_their_way.predict(plant.state(), wind)
        states.append((plant.state(), met))
        np.testing.assert_allclose(met, wanted, rtol=0.0, atol=1e-12 * 40)
    for axis, ns in enumerate(dead_time_ns):
        whole, rest_ns = divmod(ns, known.dt_ns)
        if not rest_ns and whole < len(
            states
        ):  # the predicted state is the plant's own, some steps later
            later, _ = states[-1]
            _, before = states[-1 - whole]
            np.testing.assert_allclose(before[axis], later[axis], rtol=0.0, atol=1e-10)


def test_a_filter_that_knows_of_the_dead_time_is_right_with_noise_and_late_measurements() -> None:
    """Without the dead time, the filter is decimetres off while inputs change."""
    sensor = {"position_noise_m": 0.01, "velocity_noise_mps": 0.02, "delay_s": 0.12}
    off = {}
    truth = {"dead_time_s": 0.27, "gain": 0.8}
    for model in (truth, {}):
        known = scenario(model=model, vehicle=truth, sensor=sensor)
        flies, aboard = simulated(known, 1), Navigation(known)
        errors, u = [], np.zeros(2)
        for k in range(400):
            now_ns = k * known.dt_ns
            aboard.advance(flies.measurements(now_ns=now_ns), u, now_ns=now_ns)
            errors.append(aboard.estimate - flies.truth())
            u = np.where(k // 15 % 2, 1.5, -1.5) * np.ones(2)
            flies.fly(u)
        off[bool(model)] = np.sqrt((np.array(errors)[100:] ** 2).mean(axis=(0, 1)))
    assert (off[True] < [0.01, 0.03]).all()
    assert (off[False] > 3.0 * off[True]).all()


def test_the_error_of_an_estimate_is_taken_when_the_next_input_meets_the_vehicle() -> None:
    """It is hardly larger with a dead time, because it is evaluated when the input takes effect."""
    noise = {"position_noise_m": 0.02, "velocity_noise_mps": 0.05}
    late = {"dead_time_s": 0.27}
    with_it, _ = flown(model=late, vehicle=late, sensor=noise)
    without, _ = flown(sensor=noise)
    assert with_it.estimate_error_m < 2.0 * without.estimate_error_m


def test_constant_wind_is_reckoned_with_while_inputs_are_on_their_way() -> None:
    """Estimated aboard even with exact measurements, because nothing else reveals wind."""
    known = scenario(model={"dead_time_s": 0.4}, vehicle={"steady_wind_mps": [1.0, -0.5]})
    flies, aboard, states, met = simulated(known, 1), Navigation(known), [], []
    for k in range(400):
        now_ns = k * known.dt_ns
        aboard.advance(flies.measurements(now_ns=now_ns), np.full(2, 0.3), now_ns=now_ns)
        states.append(flies.truth())
        met.append(aboard.predicted)
        flies.fly(np.full(2, 0.3))
    np.testing.assert_allclose(met[-9], states[-1], rtol=0.0, atol=2e-3)


# -- flights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["committed", "predictive", "trajectory"])
def test_a_known_dead_time_costs_hardly_anything(scheme: str) -> None:
    """Without the dead time in the model, the same vehicle has a large error."""
    splines = scheme == "trajectory"
    control = {"scheme": scheme, "trigger": "cost_gap(0.01) | silence(1)" if splines else "always"}
    control |= {"input_weight": 0.05}
    model = {"tau_s": [0.47], "gain": 1.0, "dead_time_s": [0.27, 0.24], "u_max": [3.0]}
    without = model | {"dead_time_s": 0.0}
    late = {"dead_time_s": model["dead_time_s"]}
    keys = {"control": control, "network": PERFECT, "duration": 9.0}
    errors = [
        flown(model=each, vehicle=vehicle, **keys)[0].rmse_xy
        for each, vehicle in ((model, {}), (without, {}), (without, late))
    ]
    known_m, none_m, unknown_m = (each or np.nan for each in errors)
    assert known_m < 1.1 * none_m + 0.002
    assert unknown_m > 2.0 * known_m


@pytest.mark.parametrize("feedback", [True, False])
def test_the_server_foresees_what_is_reported(feedback: bool) -> None:
    network = dict.fromkeys(("uplink", "downlink"), "constant(0.4)")
    control = {"feedback": feedback, "trigger": "always", "observer_s": 0.0}
    _, record = flown(model=AUTOPILOT, control=control, network=network)
    client = record.client
    reported = dict(zip(client["step"].tolist(), client["estimate"], strict=True))
    rows = record.server[(record.server["step"] > 100) & (record.server["step"] < 299)]
    off = [np.abs(row["estimate"] - reported[int(row["step"])]).max() for row in rows]
    assert max(off) < 1e-6


def test_the_reported_state_is_the_true_one_a_dead_time_later() -> None:
    summary, record = flown(model=AUTOPILOT | {"dead_time_s": [0.25, 0.1]})
    state, met = record.client["state"], record.client["estimate"]
    for axis, steps in enumerate((5, 2)):
        np.testing.assert_allclose(met[:-steps, axis], state[steps:, axis], rtol=0.0, atol=1e-4)
    assert summary.estimate_error_m < 1e-4


def test_a_gain_that_is_known_leaves_no_error() -> None:
    """Without the observer, a vehicle with a wrong gain in its model lags or leads."""
    control, network = {"observer_s": 0.0, "feedback": False, "trigger": "always"}, PERFECT
    right, wrong = (
        flown(model=model, vehicle={"gain": 0.8}, control=control, network=network, reference={})[0]
        for model in ({"gain": 0.8, "u_max": [3.0]}, {"u_max": [3.0]})
    )
    assert (right.rmse_xy or 1.0) < 0.5 * (wrong.rmse_xy or 0.0)


def test_without_a_dead_time_nothing_is_predicted() -> None:
    """The report equals the estimate, and exact measurements pass unfiltered."""
    known = Navigation(scenario())
    known.advance(simulated(scenario(), 1).measurements(now_ns=0), np.zeros(2), now_ns=0)
    assert known.predicted is known.estimate
    late = scenario(model={"dead_time_s": 0.1})
    assert isinstance(Navigation(late).filter, Kalman)
    assert not isinstance(Navigation(scenario()).filter, Kalman)
