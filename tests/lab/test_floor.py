"""`lab.engine.floor`: lower bounds of the error, and flights without a network."""

import math

import numpy as np
import pytest

from helpers import packaged
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.weather import Weather
from skytether.lab.engine.floor import fly_aboard, summarise_aboard, target_floor_m, wind_floor_m
from skytether.shared.base.chance import stream
from skytether.shared.scenario import targets
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows, client_columns
from skytether.shared.telemetry.summary import summarise
from skytether.sim.flight import fly


def aged(flown: Scenario, age_steps: int, plan_steps: int) -> Rows:
    rows = np.zeros(flown.steps, client_columns(flown.model.axes))
    rows["step"] = np.arange(flown.steps)
    rows["age_ns"] = age_steps * flown.dt_ns
    rows["in_force"] = rows["step"] - plan_steps
    return rows


def test_the_winds_floor_is_what_it_does_until_an_input_has_done_its_work() -> None:
    """The floor equals the drift of 400 hovering vehicles over age and one step, to 4 σ."""
    flown = packaged("paper", duration=10.0, vehicle={"wind": 0.1})
    blown = []
    for seed in range(400):
        plant = FirstOrderPlant(flown, Weather(flown, stream(seed, "test")))
        start = plant.state()
        for _ in range(20):
            plant.advance(np.zeros(2))
        blown.append(plant.state()[:, 0] - start[:, 0])
    rms = math.sqrt((np.array(blown) ** 2).sum(axis=1).mean())
    floor = wind_floor_m(flown, aged(flown, 19, 10))
    assert floor == pytest.approx(rms, rel=4 / math.sqrt(2 * 800))
    assert floor == pytest.approx(0.055, abs=0.002)
    assert wind_floor_m(packaged("paper"), aged(flown, 19, 10)) == 0.0


def test_the_targets_floor_is_how_it_leaves_its_own_velocity() -> None:
    """Over the age of the plan and one step; the preview does not count."""
    free = {"shape": "target", "preview": "none", "agility": 0.3}
    flown = packaged("target", duration=10.0, settle=5.0, reference=free)
    walk = targets.target(stream(1, "test"), 2, agility=0.3, speed_mps=1e3, radius_m=1e6)
    starts_s = np.arange(0.0, 4000.0, 1.0)
    before, after = walk(starts_s), walk(starts_s + 1.0)
    left = after[..., 0] - before[..., 0] - before[..., 1]
    rms = math.sqrt((left**2).sum(axis=1).mean())
    floor = target_floor_m(flown, aged(flown, 30, 19))
    assert floor == pytest.approx(rms, rel=4 / math.sqrt(2 * 8000) + 0.02)
    assert floor == pytest.approx(0.3 * math.sqrt(2 / 3))
    seen = packaged("target", duration=10.0, settle=5.0, reference=free | {"preview": 0.5})
    assert target_floor_m(seen, aged(seen, 30, 19)) == pytest.approx(floor * 0.5**1.5)
    known = packaged("target", duration=10.0, settle=5.0, reference=free | {"preview": "all"})
    assert target_floor_m(known, aged(known, 30, 19)) == 0.0


def test_steps_without_a_plan_lower_a_floor() -> None:
    """Such steps count as undisturbed; only steps from `settle` on count."""
    flown = packaged("target", duration=10.0, settle=5.0, vehicle={"wind": 0.1})
    rows = aged(flown, 19, 10)
    floors = np.array([floor(flown, rows) for floor in (wind_floor_m, target_floor_m)])
    without = rows.copy()
    without["age_ns"][:150] = without["in_force"][:150] = -1
    lower = [floor(flown, without) for floor in (wind_floor_m, target_floor_m)]
    np.testing.assert_allclose(lower, floors * math.sqrt(0.495), rtol=1e-2)


def test_a_reference_aboard_needs_no_packets() -> None:
    """In calm air it flies the circle within 0.1 mm."""
    summary = summarise_aboard(packaged("paper", duration=30.0, settle=20.0))
    assert summary.rmse_xy is not None
    assert summary.rmse_xy < 1e-4
    assert (summary.uplink_packets, summary.downlink_bytes, summary.event_ratio) == (0, 0, 0.0)
    assert (summary.steps, summary.covered, summary.aoi_s_mean) == (600, 1.0, None)


def test_feedback_aboard_comes_as_near_as_no_packets_at_all() -> None:
    """In wind, with the same gain: a known trajectory needs no information from the network."""
    tight = {"state_weight": [7.1, 0.001], "terminal_weight": [15.0, 1.5]}
    tight |= {"input_weight": 0.0301, "change_weight": 0.0}
    sent = {"scheme": "committed", "feedback": True, "trigger": "cost_gap(6e-4)"}
    flown = packaged("paper", duration=30.0, control=tight | sent, vehicle={"wind": 0.1})
    planned = summarise(flown, "planned", fly(flown).client)
    aboard = summarise_aboard(flown)
    assert aboard.rmse_xy == pytest.approx(planned.rmse_xy, rel=0.05)
    assert aboard.effort_mps == pytest.approx(planned.effort_mps, rel=0.05)


def test_a_vehicle_with_its_reference_aboard_measures_itself_with_noise() -> None:
    """The vehicle flies by its filter; the error is of the true position."""
    noisy = packaged(
        "paper", duration=20.0, sensor={"position_noise_m": 0.05, "velocity_noise_mps": 0.1}
    )
    rows = fly_aboard(noisy)
    assert np.abs(rows["measured"] - rows["state"]).max() > 0.1
    error = (rows["estimate"] - rows["state"])[200:, :, 0]
    assert 0.005 < error.std() < 0.05
    assert summarise_aboard(noisy).rmse_xy == pytest.approx(0.03, abs=0.025)


def test_what_only_the_server_knows_is_not_aboard() -> None:
    with pytest.raises(ValueError, match="'target'"):
        fly_aboard(packaged("target"))
