"""Margins: flights agree with theory."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import demo_with
from skytether.__main__ import main
from skytether.lab.engine import margins
from skytether.lab.engine.margins import (
    AS_IT_IS,
    Differing,
    clocked_trigger,
    growth_of,
    limit,
    margin,
    uses_state,
)
from skytether.shared.law.model import Array, white_acceleration
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.whole import Scenario

BLIND = {
    "control__feedback": False,
    "control__horizon": 40,
    "control__input_weight": 0.1,
    "control__input_reference": False,
}
"""Committed inputs without feedback, at tight weights."""
NOISE = {"sensor__position_noise_m": 0.01, "sensor__velocity_noise_mps": 0.02}
TRAJECTORY = {
    "control__scheme": "trajectory",
    "control__trigger": "expected_gap(0.05) | silence(1)",
}


def regulated(scenario: Scenario, gain: float = 1.0) -> tuple[Array, Array]:
    """Closed loop F of p, v and u(k-1) along a trajectory, and its feedback K.

    `gain` is the vehicle's relative to the model's.
    """
    model, (gain_p, gain_v, lag) = scenario.terms().model, regulator(scenario)[0]
    K = np.array([(1.0 - lag) * gain_p, (1.0 - lag) * gain_v, -lag])
    F = np.pad(model.A[0], ((0, 1), (0, 1))) - np.outer([*(gain * model.B[0]), 1.0], K)
    return F, K


@pytest.fixture(autouse=True)
def _briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A response of 12 s: a growth per step is found in half of what the command follows."""
    monkeypatch.setattr(margins, "FOLLOWED_S", 12.0)


# -- pushes and wind -------------------------------------------------------------------------------


@pytest.mark.parametrize("change_weight", [pytest.param(0.0, marks=pytest.mark.long), 0.05])
def test_a_regulator_aboard_has_the_margin_of_its_lyapunov_equation(change_weight: float) -> None:
    """Along a trajectory x and u(k-1) are regulated aboard: P = F P Fᵀ + W; growth is ρ(F)²."""
    scenario = demo_with(
        **TRAJECTORY,
        control__dt=0.1,
        control__input_weight=0.01,
        control__change_weight=change_weight,
        sensor__filter="none",
    )
    F, K = regulated(scenario)
    L = np.zeros((3, 2))
    L[:2] = scenario.vehicle.wind * white_acceleration(scenario.tau_s, scenario.control.dt)[0]
    P: Array = np.zeros((3, 3))
    for _ in range(2000):
        P = F @ P @ F.T + L @ L.T
    found = margin(scenario, AS_IT_IS, clocked_trigger(scenario), 6)
    assert found.rms_m == pytest.approx([np.sqrt(P[0, 0])] * 2, rel=0.08)
    assert found.rms_input_mps == pytest.approx([np.sqrt(K @ P @ K)] * 2, rel=0.08)
    assert found.growth == pytest.approx(np.abs(np.linalg.eigvals(F)).max() ** 2, abs=0.01)
    assert found.stable


def test_the_limit_of_a_regulators_gain_is_where_its_eigenvalue_leaves_the_circle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bisection by flights: just below the limit a push decays, just above it grows."""
    scenario = demo_with(
        **TRAJECTORY, control__dt=0.1, control__input_weight=0.01, sensor__filter="none"
    )

    def radius(gain: float) -> float:
        return float(np.abs(np.linalg.eigvals(regulated(scenario, gain)[0])).max())

    expected = next(gain for gain in np.arange(1.0, 20.0, 0.01).tolist() if radius(gain) > 1.0)
    trigger = clocked_trigger(scenario)
    between = {"gain, most": ("gain", 0.9 * expected, 1.12 * expected)}
    monkeypatch.setattr(margins, "LIMITS", margins.LIMITS | between)
    monkeypatch.setattr(margins, "HALVINGS", 3)
    found = limit(scenario, "gain, most", trigger, 1)
    assert found.value == pytest.approx(expected, rel=0.03)
    decays, grows = (
        growth_of(Differing(gain=share * expected).of(scenario), trigger, 1)[0]
        for share in (0.95, 1.05)
    )
    assert grows == pytest.approx(radius(1.05 * expected) ** 2, abs=0.02)
    assert decays < 0.9
    assert limit(scenario, "gain, least", trigger, 1).value is None


def test_noise_does_not_hide_how_a_push_decays() -> None:
    """A flight without the push, with the same noise, is subtracted."""
    scenario = demo_with(control__trigger="always", **NOISE, sensor__filter="none")
    exact = demo_with(control__trigger="always", sensor__filter="none")
    noisy, alone = (growth_of(each, "always", 1)[0] for each in (scenario, exact))
    assert noisy == pytest.approx(alone, abs=0.001)


def test_a_vehicle_that_is_not_reached_is_not_stable() -> None:
    silent = demo_with(network__uplink="loss(1)", link__connect_s=5.0)
    assert growth_of(silent, "always", 1) == (np.inf, None)


def test_only_what_looks_at_the_clock_sends_after_a_weak_push() -> None:
    """Any other trigger is replaced by a period with the same rate."""
    for trigger in ("always", "periodic(7)", "periodic(7) | silence(1)", "always & budget(5, 2)"):
        assert not uses_state(demo_with(control__trigger=trigger))
    for trigger in ("cost_gap", "deviation(0.1) | silence(1)", "state_gap(3.6, 1.5)"):
        assert uses_state(demo_with(control__trigger=trigger))
    rare = clocked_trigger(demo_with(control__trigger="cost_gap(1e9) | silence(1)", duration=20.0))
    name, period = rare.rstrip(")").split("(")
    assert name == "periodic"
    assert 20 <= int(period) <= 23  # about a second, minus losses


def test_a_slow_swing_does_not_change_the_growth() -> None:
    """Means over a quarter remove the oscillation; the plain logarithm follows it."""
    n = np.arange(480)
    smoothed, plain = [], []
    for period in range(60, 180, 10):
        h = 0.98**n * (1.0 + 0.95 * np.sin(2.0 * np.pi * n / period))
        smoothed.append(margins._growth(h))
        plain.append(np.exp(np.polyfit(n[240:], np.log(h[240:]), 1)[0]))
    assert np.abs(np.array(smoothed) - 0.98).max() < 0.002
    assert np.abs(np.array(plain) - 0.98).max() > 0.005


def test_a_later_network_is_the_scenarios_with_a_delay_more() -> None:
    """The delay is added each way, also to a direction without any impairment."""
    nothing = ""
    scenario = demo_with(network__uplink="constant(0.1)", network__downlink=nothing)
    later = Differing(delay_s=0.25).of(scenario)
    assert (later.uplink.mean_s, later.downlink.mean_s) == pytest.approx((0.35, 0.25))


def test_the_worst_corners_of_the_box_are_stable_at_weights_that_bear_them() -> None:
    """Fast, strong and late; slow, weak and late: stable at the demo's weights, not at tighter."""
    corners = (Differing(0.5, 1.3, 0.3), Differing(2.0, 0.7, 0.3))
    for corner in corners:
        assert growth_of(corner.of(demo_with()), "periodic(12)", 2)[0] < 0.995
    tight = demo_with(control__input_weight=0.05)
    assert growth_of(corners[0].of(tight), "periodic(12)", 2)[0] > 1.05


@pytest.mark.parametrize(("input_weight", "stable"), [(1.0, False), (1.2, True)])
def test_along_trajectories_the_worst_corner_asks_for_a_fifth_more(
    input_weight: float, stable: bool
) -> None:
    """Compensation of the estimated disturbance tightens the loop, so it needs larger weights."""
    scenario = demo_with(**TRAJECTORY, control__input_weight=input_weight)
    corner = Differing(0.5, 1.3, 0.3).of(scenario)
    assert (growth_of(corner, clocked_trigger(scenario), 2)[0] < 0.995) == stable


# -- the command -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("here")
def test_the_command_says_which_vehicles_are_stable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(margins, "FOLLOWED_S", 24.0)  # with delays of 2 s each way
    late = "dead time 0.3 s more"
    monkeypatch.setattr(margins, "VEHICLES", {late: margins.VEHICLES[late]})
    limits = {
        "dead time, more [s]": ("dead_time_s", 0.0, 0.3),
        "delay each way, more [s]": ("delay_s", 1.2, 2.0),
    }
    monkeypatch.setattr(margins, "LIMITS", limits)
    monkeypatch.setattr(margins, "HALVINGS", 2)
    monkeypatch.setattr(margins, "WIND_S", 10.0)
    file = tmp_path / "margins.json"
    flags = "--runs 1 --control.trigger always"
    flags += " --control.dt 0.1 --control.input-weight 0.01 --control.horizon 20"
    argv = ["margins", "demo", *flags.split(), "--duration", "5", "--settle", "1"]
    assert main([*argv, "--json", str(file), "--workers", "1"]) == 0
    shown = capsys.readouterr().out
    assert late in shown
    content: dict[str, Any] = json.loads(file.read_bytes())
    found = {each["vehicle"]: each for each in content["margins"]}
    assert found[AS_IT_IS]["stable"]
    assert not found[late]["stable"]
    assert found[late]["rms_m"] is None
    told = {each["quantity"]: each["value"] for each in content["limits"]}
    assert 0.0 < told["dead time, more [s]"] < 0.3
    assert told["delay each way, more [s]"] > 1.5  # until observations are older than age_max_s
