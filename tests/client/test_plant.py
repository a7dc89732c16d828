"""Simulated vehicle: it follows the model exactly, and wind is noise of the stated strength."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm

from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.weather import Weather
from skytether.shared.law.model import Array, discretise, white_acceleration
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario

FLIGHT = {
    "model": {"tau_s": [0.81, 0.3]},
    "control": {"dt": 0.05},
    "reference": {"shape": "circle", "radius_m": 1.5, "period_s": 14.2},
}
COMMANDS = np.random.default_rng(0).uniform(-1.8, 1.8, size=(50, 2))


def scenario(**vehicle: object) -> Scenario:
    return check({**FLIGHT, "vehicle": vehicle}, "test")


def plant(seed: int = 0, **vehicle: object) -> FirstOrderPlant:
    flown = scenario(**vehicle)
    return FirstOrderPlant(flown, Weather(flown, np.random.default_rng(seed)))


def flight(flown: FirstOrderPlant, commands: Array = COMMANDS) -> Array:
    states = []
    for command in commands:
        flown.advance(command)
        states.append(flown.state())
    return np.array(states)


@pytest.mark.parametrize(
    ("vehicle", "tau_s", "gain", "wind"),
    [
        ({}, [0.81, 0.3], 1.0, 0.0),
        ({"tau_s": [1.0]}, [1.0, 1.0], 1.0, 0.0),
        ({"tau_s": [1.0, 0.2]}, [1.0, 0.2], 1.0, 0.0),
        ({"gain": 1.25}, [0.81, 0.3], 1.25, 0.0),
        ({"steady_wind_mps": [0.3, -0.2]}, [0.81, 0.3], 1.0, np.array([0.3, -0.2])),
    ],
    ids=["the model", "one time constant", "two", "gain", "steady wind"],
)
def test_the_plant_is_the_model_with_its_own_numbers(
    vehicle: dict[str, Any], tau_s: list[float], gain: float, wind: Array | float
) -> None:
    """The controller's own prediction, to the last bit: v̇ = (g u + w - v)/τ."""
    flown = plant(**vehicle)
    model, x = discretise(np.array(tau_s), 0.05), flown.state()
    for command, state in zip(COMMANDS, flight(flown), strict=True):
        x = model.step(x, gain * command + wind)
        np.testing.assert_array_equal(state, x)


def test_steady_wind_adds_its_velocity_in_the_long_run() -> None:
    u, w = np.array([0.5, -1.0]), [0.3, -0.2]
    last = flight(plant(steady_wind_mps=w), np.tile(u, (600, 1)))[-1]
    np.testing.assert_allclose(last[:, 1], u + w, atol=1e-12)


@pytest.mark.parametrize("steps", [1, 3, 200])
def test_dead_time_of_whole_steps_only_shifts(steps: int) -> None:
    """To the last bit; until then it hovers."""
    late = flight(plant(dead_time_s=steps * 0.05), np.concatenate([COMMANDS, np.zeros((200, 2))]))
    prompt = flight(plant())
    np.testing.assert_array_equal(late[:steps], np.tile(plant().state(), (steps, 1, 1)))
    np.testing.assert_array_equal(late[steps : steps + len(prompt)], prompt)


@settings(max_examples=20)
@given(st.integers(0, 500_000_000), st.floats(0.5, 2.0))
def test_dead_time_is_exact_within_a_step(dead_time_ns: int, gain: float) -> None:
    tau, w = np.array([0.81, 0.3]), np.array([0.1, 0.0])
    flown = plant(dead_time_s=dead_time_ns / 1e9, gain=gain, steady_wind_mps=w.tolist())
    x = flown.state()
    whole, rest_ns = divmod(dead_time_ns, 50_000_000)
    pieces = [discretise(tau, length_ns / 1e9) for length_ns in (rest_ns, 50_000_000 - rest_ns)]
    due = np.concatenate([np.zeros((whole + 1, 2)), COMMANDS])
    for k, state in enumerate(flight(flown)):
        for piece, command in zip(pieces, due[k : k + 2], strict=True):
            x = piece.step(x, gain * command + w)
        np.testing.assert_allclose(state, x, rtol=0, atol=1e-12)


def test_a_part_of_a_step_is_not_rounded_away() -> None:
    """With the dead time rounded to whole steps the error exceeds 1 cm."""
    early, right = (flight(plant(dead_time_s=dead_time_s)) for dead_time_s in (0.2, 0.22))
    assert np.abs(early - right)[:, :, 0].max() > 0.01


def test_wind_is_never_late() -> None:
    late, prompt = (
        plant(1, dead_time_s=dead_time_s, steady_wind_mps=[0.3, 0.0], wind=0.2, gust_mps2=1.0)
        for dead_time_s in (5.0, 0.0)
    )
    calm = np.zeros((50, 2))
    np.testing.assert_array_equal(flight(late, calm), flight(prompt, calm))


@pytest.mark.parametrize(
    ("vehicle", "place"),
    [({}, (1.5, 0.0)), ({"start_m": [-3.0, 4.0]}, (-3.0, 4.0)), ({"start_m": [0.0, 0.0]}, (0, 0))],
)
def test_flight_starts_at_rest_where_the_scenario_or_the_reference_does(
    vehicle: dict[str, Any], place: tuple[float, float]
) -> None:
    assert plant(**vehicle).state().tolist() == [[place[0], 0.0], [place[1], 0.0]]


def test_plant_flies_in_space() -> None:
    raw = {
        "model": {"axes": 3, "tau_s": [0.81]},
        "control": {"dt": 0.05},
        "reference": {"shape": "circle", "radius_m": 1.5, "altitude_m": 2.0},
    }
    checked = check(raw, "test")
    flown = FirstOrderPlant(checked, Weather(checked, np.random.default_rng(0)))
    assert flown.state().tolist() == [[1.5, 0.0], [0.0, 0.0], [2.0, 0.0]]
    (state,) = flight(flown, np.array([[0.0, 0.0, 1.0]]))
    expected = discretise(np.array([0.81]), 0.05).step(np.array([[2.0, 0.0]]), np.array([1.0]))
    np.testing.assert_allclose(state, [[1.5, 0.0], [0.0, 0.0], expected[0]], atol=1e-15)


def test_state_is_the_caller_s_own() -> None:
    flown = plant()
    flown.state()[:] = 9.0
    assert flown.state().tolist() == [[1.5, 0.0], [0.0, 0.0]]


def test_steady_gust_settles_at_u_plus_tau_a() -> None:
    """An acceleration a acts like the input τ a; here one gust begins at once and never ends."""
    flown = plant(gust_mps2=2.0, gust_every_s=1e-9, gust_s=1e9)
    u, tau = np.array([0.5, -1.0]), np.array([0.81, 0.3])
    velocity = flight(flown, np.tile(u, (600, 1)))[-1, :, 1]
    acceleration = (velocity - u) / tau
    assert np.linalg.norm(acceleration) == pytest.approx(2.0, rel=1e-9)
    assert (np.abs(acceleration) > 0.01).all()


def test_steady_gust_is_integrated_exactly() -> None:
    """Model v̇ = (u - v)/τ + a, solved by quadrature over one step."""
    tau, dt = np.array([0.81, 0.3]), 0.05
    flown = plant(gust_mps2=2.0, gust_every_s=1e-9, gust_s=1e9)
    long = flight(flown, np.zeros((600, 2)))
    acceleration = long[-1, :, 1] / tau
    rate = [np.array([[0.0, 1.0], [0.0, -1.0 / t]]) for t in tau]
    before, after = long[0], long[1]
    for axis in range(2):
        pushed, _ = quad_vec(lambda s, A=rate[axis]: expm(A * s)[:, 1], 0.0, dt, epsrel=1e-12)
        expected = expm(rate[axis] * dt) @ before[axis] + pushed * acceleration[axis]
        np.testing.assert_allclose(after[axis], expected, rtol=0, atol=1e-10)


def test_gust_comes_on_top_of_steady_wind_and_gain() -> None:
    """Velocity settles at g u + w + τ a, and back at g u + w."""
    u, w, tau = np.array([0.5, -1.0]), np.array([0.3, -0.2]), np.array([0.81, 0.3])
    flown = plant(
        gain=0.8, steady_wind_mps=[0.3, -0.2], gust_mps2=2.0, gust_every_s=500.0, gust_s=500.0
    )
    velocity = flight(flown, np.tile(u, (80_000, 1)))[:, :, 1]
    beyond = np.linalg.norm((velocity - 0.8 * u - w) / tau, axis=1)
    calm, blowing = (np.abs(beyond - strength) < 1e-9 for strength in (0.0, 2.0))
    assert calm.mean() + blowing.mean() > 0.95
    assert min(calm.mean(), blowing.mean()) > 0.1


def test_gusts_come_and_go_as_often_as_stated() -> None:
    """2 s of gust after 4 s of calm, on average: a third of the time, in one piece each."""
    flown = plant(gust_mps2=1.0, gust_every_s=4.0, gust_s=2.0)
    velocity = flight(flown, np.zeros((40_000, 2)))[:, :, 1]
    decay, settled = np.exp(-0.05 / np.array([0.81, 0.3])), np.array([0.81, 0.3])
    push = (velocity[1:] - decay * velocity[:-1]) / ((1.0 - decay) * settled)
    strength = np.linalg.norm(push, axis=1)
    blowing = strength > 0.5
    np.testing.assert_allclose(strength[blowing], 1.0, atol=1e-9)
    np.testing.assert_allclose(strength[~blowing], 0.0, atol=1e-9)
    assert blowing.mean() == pytest.approx(1 / 3, abs=0.05)
    begun = np.flatnonzero(blowing[1:] & ~blowing[:-1]).size
    assert blowing.sum() * 0.05 / begun == pytest.approx(2.0, rel=0.2)
    same = blowing[1:] & blowing[:-1]
    np.testing.assert_allclose(push[1:][same], push[:-1][same], atol=1e-9)


def test_wind_over_many_steps_varies_as_stated() -> None:
    """Wind adds noise of covariance wind² ∫ …, with zero mean and no correlation between steps."""
    flown = plant(wind=0.4)
    model = discretise(np.array([0.81, 0.3]), 0.05)
    states = np.concatenate([flown.state()[None], flight(flown, np.zeros((20_000, 2)))])
    added = states[1:] - model.step(states[:-1], np.zeros((20_000, 2)))
    for axis, root in enumerate(white_acceleration(np.array([0.81, 0.3]), 0.05)):
        expected = 0.4**2 * root @ root.T
        np.testing.assert_allclose(np.cov(added[:, axis].T), expected, rtol=0.05)
        assert (np.abs(added[:, axis].mean(axis=0)) < 4 * np.sqrt(np.diag(expected) / 2e4)).all()
    velocity = added[:, :, 1] / added[:, :, 1].std(axis=0)
    assert abs(np.mean(velocity[:, 0] * velocity[:, 1])) < 0.03
    assert (np.abs(np.mean(velocity[1:] * velocity[:-1], axis=0)) < 0.03).all()


def test_same_chance_is_the_same_flight() -> None:
    wild = {"wind": 0.3, "gust_mps2": 1.0, "gust_every_s": 0.5}
    first, again, other = (flight(plant(seed, **wild)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[-1] != other[-1]).all()


def test_calm_flight_needs_no_chance() -> None:
    rng = np.random.default_rng(3)
    flight(FirstOrderPlant(scenario(), Weather(scenario(), rng)))
    assert rng.random() == np.random.default_rng(3).random()
