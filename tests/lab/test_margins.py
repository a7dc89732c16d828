"""Margins: what is computed of a loop is what it flies, and tells which vehicles swing for ever."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import demo_with
from skytether.__main__ import main
from skytether.lab import loops, maps, margins
from skytether.lab.loops import timing_of
from skytether.lab.maps import Box, resting
from skytether.lab.margins import (
    AS_IT_IS,
    Differing,
    equivalent_period,
    looks_at_state,
    margin,
    timings,
)
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Rows, client_columns
from skytether.sim.flight import fly_batch

HOVER = {"reference__shape": "hover", "reference__points_m": [[0.0, 0.0]], "vehicle__wind": 0.01}
BLIND = {
    "control__feedback": False,
    "control__horizon": 40,
    "control__input_weight": 0.1,
    "control__input_reference": False,
}
"""Committed inputs alone, at tight weights."""
NOISE = {"sensor__position_noise_m": 0.01, "sensor__velocity_noise_mps": 0.02}


# -- what is computed ------------------------------------------------------------------------------


@pytest.mark.parametrize("change_weight", [0.0, 0.05])
def test_a_regulator_aboard_has_the_variance_of_its_lyapunov_equation(change_weight: float) -> None:
    """Along a trajectory x and u(k-1) regulate themselves whatever arrives: P = F P Fᵀ + W, and
    ρ(F)² is the growth.
    """
    scenario = demo_with(
        control__scheme="trajectory",
        control__trigger="expected_gap(1)",
        control__input_weight=0.01,
        control__change_weight=change_weight,
        sensor__filter="none",
    )
    assert not looks_at_state(scenario)
    model, (gain_p, gain_v, lag) = scenario.terms().model, regulator(scenario)[0]
    K = np.array([(1.0 - lag) * gain_p, (1.0 - lag) * gain_v, -lag])
    F = np.pad(model.A[0], ((0, 1), (0, 1))) - np.outer([*model.B[0], 1.0], K)
    L = np.zeros((3, 2))
    L[:2] = scenario.vehicle.wind * white_acceleration(scenario.tau_s, scenario.control.dt)[0]
    P: Array = np.zeros((3, 3))
    for _ in range(2000):
        P = F @ P @ F.T + L @ L.T
    found = margin(scenario, AS_IT_IS, timings(scenario, 1))
    assert found.rms_m == pytest.approx([np.sqrt(P[0, 0])] * 2, rel=0.01)
    assert found.rms_input_mps == pytest.approx([np.sqrt(K @ P @ K)] * 2, rel=0.01)
    assert found.growth == pytest.approx(np.abs(np.linalg.eigvals(F)).max() ** 2, abs=0.01)
    assert found.stable


@pytest.mark.parametrize(
    ("keys", "runs", "rel"),
    [
        ({"control__trigger": "periodic(10)"}, 10, 0.1),
        pytest.param({"control__trigger": "always", **NOISE}, 6, 0.1, marks=pytest.mark.long),
        ({**BLIND, "control__trigger": "periodic(10)", "vehicle__dead_time_s": 0.08}, 32, 0.1),
        (
            {
                "control__trigger": "periodic(10)",
                "model__gain": 1.1,
                "model__dead_time_s": 0.13,
                "vehicle__gain": 0.9,
                "vehicle__dead_time_s": 0.22,
                **NOISE,
            },
            10,
            0.1,
        ),
    ],
    ids=["feedback", "noise and a filter", "committed, with dead time", "known dead time, wrong"],
)
def test_the_variance_that_is_computed_is_flown(
    keys: dict[str, Any], runs: int, rel: float
) -> None:
    """Along the same timings; the share is what so few flights can tell of a variance."""
    scenario = demo_with(**HOVER, **{"control__input_weight": 0.1, **keys}, duration=30.0)
    flights = fly_batch(scenario, range(1, 1 + runs))
    settled = flights[0].client["step"] * scenario.control.dt >= 8.0
    positions = np.array([flight.client["state"][settled][..., 0] for flight in flights])
    found = margin(scenario, AS_IT_IS, [timing_of(flight) for flight in flights])
    assert found.rms_m is not None
    assert np.square(positions).mean() == pytest.approx(found.rms_m[0] ** 2, rel=rel)


def test_only_what_looks_at_the_clock_is_linear() -> None:
    """For any other trigger the loop is computed at a period that sends as often."""
    for trigger in ("always", "periodic(7)", "periodic(7) | silence(1)", "always & budget(5, 2)"):
        assert not looks_at_state(demo_with(control__trigger=trigger))
    for trigger in ("cost_gap", "deviation(0.1) | silence(1)", "state_gap(3.6, 1.5)"):
        assert looks_at_state(demo_with(control__trigger=trigger))
    rare = equivalent_period(
        demo_with(control__trigger="cost_gap(1e9) | silence(1)", duration=20.0)
    )
    name, period = rare.control.trigger.rstrip(")").split("(")
    assert name == "periodic"
    assert 20 <= int(period) <= 23  # a second, but for what is lost


def test_a_slow_swing_does_not_change_the_growth() -> None:
    """Means over a quarter take it away; the logarithm by itself follows it."""
    n = np.arange(480)
    smoothed, plain = [], []
    for period in range(60, 180, 10):
        h = 0.98**n * (1.0 + 0.95 * np.sin(2.0 * np.pi * n / period))
        smoothed.append(margins._growth(h))
        plain.append(np.exp(np.polyfit(n[240:], np.log(h[240:]), 1)[0]))
    assert np.abs(np.array(smoothed) - 0.98).max() < 0.002
    assert np.abs(np.array(plain) - 0.98).max() > 0.005


def test_pushes_come_anywhere_between_two_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    """A position every fourth step: pushes that keep to its time would tell another variance."""
    monkeypatch.setattr(margins, "FLIGHT_S", 40.0)
    monkeypatch.setattr(margins, "FOLLOWED_S", 8.0)
    keys = {"control__trigger": "always", **HOVER, **NOISE}
    scenario = demo_with(**keys, sensor__position_every_s=0.2, sensor__velocity_every_s="never")
    given = timings(scenario, 1)

    def rms(pushes: int) -> float:
        monkeypatch.setattr(margins, "PUSHES", pushes)
        found = margin(scenario, AS_IT_IS, given).rms_m
        assert found is not None
        return found[0]

    every_step = rms(1000)
    assert rms(20) == pytest.approx(every_step, rel=0.05)
    monkeypatch.setattr(loops, "_periods", lambda _: [])
    assert rms(20) != pytest.approx(every_step, rel=0.05)


# -- what is flown ---------------------------------------------------------------------------------


def at(name: str, scenario: Scenario, **box: tuple[float, ...]) -> Box:
    """A box with one value each but for those given."""
    axes = {"tau": (1.0,), "gain": (1.0,), "dead_time_s": (0.0,), "burst_s": (0.0,)}
    return Box(name, scenario, "periodic(12)", **axes | box)


def test_a_loop_that_is_not_stable_ends_in_a_limit_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Committed inputs at tight weights, where the vehicle is twice as quick as the model."""
    monkeypatch.setattr(margins, "FLIGHT_S", 40.0)
    monkeypatch.setattr(maps, "REST_S", 40.0)
    monkeypatch.setattr(maps, "RUNS", 1)
    monkeypatch.setattr(maps, "TIMINGS", 1)
    tight = demo_with(**BLIND | {"control__input_weight": 0.01}, duration=10.0)
    swings, rests = (
        at("tight", each, tau=(0.5,)).fly(0) for each in (tight, demo_with(duration=10.0))
    )
    assert swings.cycles
    assert swings.growth > 1.0
    assert swings.rest_m > 0.2
    assert swings.saturated is not None
    assert swings.saturated > 0.5
    assert not rests.cycles
    assert rests.growth < 1.0
    assert rests.rest_m < 0.01


def test_the_worst_corners_of_the_box_are_stable_at_weights_that_bear_them() -> None:
    """Quick, too strong and late; slow, too weak and late: those of the demo, not tighter ones."""
    corners = (Differing(0.5, 1.3, 0.3), Differing(2.0, 0.7, 0.3))
    scenario = demo_with(control__trigger="periodic(12)")
    given = timings(scenario, 1)
    for corner in corners:
        assert margin(corner.of(scenario), "corner", given).growth < 0.99
    tight = demo_with(control__input_weight=0.05, control__trigger="periodic(12)")
    assert margin(corners[0].of(tight), "corner", given).growth > 1.05


@pytest.mark.parametrize(("input_weight", "stable"), [(1.0, False), (1.2, True)])
def test_along_trajectories_the_worst_corner_asks_for_a_fifth_more(
    input_weight: float, stable: bool
) -> None:
    """The disturbance that the filter aboard has found is taken off at once, and so is firm."""
    scenario = demo_with(
        control__scheme="trajectory",
        control__trigger="expected_gap(0.05) | silence(1)",
        control__input_weight=input_weight,
    )
    corner = Differing(0.5, 1.3, 0.3).of(scenario)
    assert (margin(corner, "corner", timings(scenario, 1)).growth < 0.995) == stable


def test_a_swing_that_dies_away_is_no_limit_cycle() -> None:
    """The last quarter of a flight is compared with the one before."""
    scenario = maps.at_rest(demo_with())
    rows: Rows = np.zeros(400, client_columns(2))
    rows["step"] = np.arange(400)
    rows["state"][:, 0, 0] = 0.5 * np.sin(0.1 * rows["step"])
    before, last = resting(scenario, rows)
    assert before == pytest.approx(0.354, abs=0.05)
    assert last > maps.REST_M
    assert last > maps.SUSTAINED * before
    rows["state"][:, 0, 0] *= np.exp(-0.01 * rows["step"])
    before, last = resting(scenario, rows)
    assert last < maps.SUSTAINED * before


def test_a_place_of_the_box_differs_as_it_says() -> None:
    """Without wind, with bursts both ways; numbers count the time constants first."""
    box = at("demo", demo_with(), tau=(0.5, 2.0), gain=(0.7,), dead_time_s=(0.1,), burst_s=(2.0,))
    assert [place.tau for place in box.places] == [0.5, 2.0]
    scenario = box.scenario_of(1)
    assert scenario.true_tau_s.tolist() == [1.68, 1.68]
    assert scenario.true_gain.tolist() == [0.7, 0.7]
    assert scenario.true_dead_time_s.tolist() == [0.1, 0.1]
    assert (scenario.vehicle.wind, scenario.tau_s.tolist()) == (0.0, [0.84, 0.84])
    assert scenario.network.uplink.burst_s == scenario.network.downlink.burst_s == 2.0


# -- the command -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("here")
def test_the_command_says_which_vehicles_are_stable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(margins, "FLIGHT_S", 20.0)
    monkeypatch.setattr(maps, "REST_S", 20.0)
    monkeypatch.setattr(maps, "RUNS", 1)
    monkeypatch.setattr(maps, "TIMINGS", 1)
    file, folder = tmp_path / "margins.json", tmp_path / "maps"
    flags = "--runs 2 --control.trigger always --tau 1 --gain 1 --dead-time 0 --burst 0"
    flags += " --control.input-weight 0.01 --control.horizon 40"
    argv = ["margins", "demo", *flags.split(), "--duration", "5", "--settle", "1"]
    assert main([*argv, "--json", str(file), "--maps", str(folder), "--workers", "1"]) == 0
    shown = capsys.readouterr().out
    assert "half as quick" in shown
    found = {each["vehicle"]: each for each in json.loads(file.read_bytes())["margins"]}
    assert found[AS_IT_IS]["stable"]
    assert not found["dead time 0.3 s more"]["stable"]
    assert found["dead time 0.3 s more"]["rms_m"] is None
    (point,) = csv.DictReader((folder / "points.csv").read_text().splitlines())
    assert (point["cycles"], point["tau"]) == ("false", "1.0")
    assert (folder / "maps.png").stat().st_size > 10_000


def test_an_empty_box_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["margins", "demo", "--maps", str(tmp_path / "maps"), "--gain", "0", "1"]
    assert main(argv) == 2
    assert "vehicle.gain[0]: got 0.0" in capsys.readouterr().err
