"""Gain of feedback aboard: that of the Riccati equation, and the best there is with a dead time."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from client.plant import FirstOrderPlant, white_acceleration
from server.gain import ON_THEIR_WAY_MAX, DeadTime, _best, _summed, feedback_gain, regulator
from server.gain import stationary_gain as gain_for
from shared import config
from shared.chance import stream
from shared.config import ControlConfig, Scenario
from shared.model import Array, discretise
from sim.flight import fly

quick = settings(max_examples=40, deadline=None)

TAU_S, DT = 0.84, 0.05
MODEL = discretise([TAU_S], DT)
TWO_TAUS = discretise([0.81, 0.3], DT)
FIRM = ControlConfig(state_weight=(7.0, 1.0), input_weight=0.01)
"""The weights that a scenario has unless it says otherwise."""
TIGHT = ControlConfig(state_weight=(7.1, 0.001), input_weight=1e-4)
"""As tight as a search for the smallest error makes them."""


@quick
@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0), st.floats(0.0, 10.0))
def test_without_dead_time_it_is_that_of_the_riccati_equation(q: float, r: float, s: float) -> None:
    """On either axis, with S beside R."""
    weights = ControlConfig(state_weight=(7.1, q), input_weight=r, change_weight=s)
    for A, B, K in zip(
        TWO_TAUS.A, TWO_TAUS.B[:, :, None], gain_for(TWO_TAUS, weights), strict=True
    ):
        X = solve_discrete_are(A, B, np.diag([7.1, q]), np.array([[r + s]]))
        expected = np.linalg.solve(r + s + B.T @ X @ B, B.T @ X @ A)[0]
        np.testing.assert_allclose(K, expected, rtol=1e-7)


def test_where_nothing_weighs_the_position_nothing_leads_back_to_it() -> None:
    """With dead time as little as is stable, and no weights at all ask for nothing."""
    weights = ControlConfig(state_weight=(0.0, 1.0))
    plain, slow = gain_for(TWO_TAUS, weights), gain_for(TWO_TAUS, weights, 0.2)
    np.testing.assert_allclose(plain[:, 0], 0.0, atol=1e-12)
    assert (plain[:, 1] > 0.0).all()
    assert ((slow[:, 0] > 0.0) & (slow[:, 0] < 0.01)).all()
    assert not gain_for(TWO_TAUS, ControlConfig(state_weight=(0.0, 0.0)), 0.2).any()


@pytest.mark.parametrize("weights", [FIRM, TIGHT])
def test_the_search_finds_the_riccati_equation_s_where_there_is_no_dead_time(
    weights: ControlConfig,
) -> None:
    """From half of it as well."""
    Q, R = np.diag(weights.state_weight), weights.input_weight
    plain = regulator(MODEL, Q, R)[0]
    for begin in (plain, 0.5 * plain):
        found = _best(DeadTime(TAU_S, DT, 0.0), Q, R, begin)
        np.testing.assert_allclose(found, plain, rtol=1e-6)


# -- with dead time ------------------------------------------------------------------------------


def late(dead_time_s: float) -> FirstOrderPlant:
    """A vehicle whose inputs act so late."""
    table = config.to_table(Scenario())
    table["model"]["tau_s"], table["control"]["dt"] = [TAU_S], DT
    table["vehicle"]["dead_time_s"] = dead_time_s
    table["vehicle"]["start_m"] = [0.0, 0.0]
    return FirstOrderPlant(config.check(table, "test"), stream(1, "test"))


def response(gain: Array, dead_time_s: float, steps: int) -> tuple[Array, Array]:
    """States (steps, 2) and inputs of a vehicle with feedback after a jolt of 1 m/s."""
    plant, states, inputs = late(dead_time_s), [], []
    plant._x[0] = (0.0, 1.0)
    for _ in range(steps):
        x = plant.state()[0]
        states.append(x)
        inputs.append(-float(gain @ x))
        plant.advance(np.array([inputs[-1], 0.0]))
    return np.array(states), np.array(inputs)


@pytest.mark.parametrize("dead_time_s", [0.03, 0.1, 0.13, 0.3])
def test_it_reckons_with_the_inputs_on_their_way_as_the_vehicle_flies_them(
    dead_time_s: float,
) -> None:
    """Also where the dead time is no whole number of steps."""
    gain, axis = np.array([1.0, 0.5]), DeadTime(TAU_S, DT, dead_time_s)
    states, _ = response(gain, dead_time_s, 40)
    F, z = axis.closed(gain), np.zeros(len(axis.B))
    z[1] = 1.0
    for x in states:
        np.testing.assert_allclose(z[:2], x, atol=1e-12)
        z = F @ z


@pytest.mark.parametrize("weights", [FIRM, TIGHT])
@pytest.mark.parametrize("dead_time_s", [0.03, 0.1, 0.2, 0.3])
def test_no_gain_nearby_answers_a_jolt_at_a_smaller_cost(
    dead_time_s: float, weights: ControlConfig
) -> None:
    """Summed over all that follows; of jolts white acceleration is made."""
    gain = gain_for(MODEL, weights, dead_time_s)[0]

    def cost(gain: Array) -> float:
        """What all of the answer costs."""
        x, u = response(gain, dead_time_s, 800)
        return float((x**2 @ weights.state_weight).sum() + weights.input_weight * (u**2).sum())

    least = cost(gain)
    for change in ([1.02, 1.0], [0.98, 1.0], [1.0, 1.02], [1.0, 0.98], [1.01, 0.99]):
        assert cost(gain * change) > least


@pytest.mark.parametrize(
    ("weights", "dead_time_s"), [(TIGHT, 0.1), (FIRM, 0.2), (TIGHT, 0.2), (FIRM, 0.3), (TIGHT, 0.3)]
)
def test_it_is_stable_where_that_for_no_dead_time_is_not(
    weights: ControlConfig, dead_time_s: float
) -> None:
    """Ten seconds after a jolt one has come to rest, the other swings wider and wider."""
    calm, _ = response(gain_for(MODEL, weights, dead_time_s)[0], dead_time_s, 200)
    wild, _ = response(gain_for(MODEL, weights)[0], dead_time_s, 200)
    assert np.abs(calm[-20:]).max() < 0.02
    assert np.abs(wild[-20:]).max() > 10.0


def test_many_inputs_on_their_way_are_reckoned_with_in_longer_steps() -> None:
    """A gain for steps of 1 ms and a dead time of 2 s is that for steps of 50 ms, nearly."""
    short, axis = discretise([TAU_S], 0.001), DeadTime(TAU_S, 0.001, 2.0)
    assert len(axis.B) <= ON_THEIR_WAY_MAX + 3
    fine, coarse = gain_for(short, FIRM, 2.0), gain_for(MODEL, FIRM, 2.0)
    np.testing.assert_allclose(fine, coarse, rtol=0.01)


@pytest.mark.parametrize("dead_time_s", [0.0, 0.2])
def test_noise_of_the_measurements_is_not_worth_another_gain(dead_time_s: float) -> None:
    """The best gain behind a Kalman filter (2 cm, 5 cm/s; wind 0.1) is worth a hundredth."""
    root = 0.1 * white_acceleration(np.array([TAU_S]), DT)[0]
    noise = np.diag([0.02**2, 0.05**2])
    before = solve_discrete_are(MODEL.A[0].T, np.eye(2), root @ root.T, noise)
    jolts = before @ np.linalg.solve(before + noise, before)  # of the filter's estimate
    axis, Q, R = DeadTime(TAU_S, DT, dead_time_s), np.diag(FIRM.state_weight), FIRM.input_weight
    driven = np.zeros_like(axis.A)
    driven[:2, :2] = jolts

    def cost(gain: Array) -> float:
        """Mean cost of a step in which the estimate is what is fed back."""
        if not axis.holds(gain):
            return np.inf
        X = _summed(axis.closed(gain), driven)[:2, :2]
        return float((Q * X).sum() + R * (gain @ X @ gain))

    gain = gain_for(MODEL, FIRM, dead_time_s)[0]
    best = minimize(cost, gain, method="Nelder-Mead", options={"fatol": 0.0, "xatol": 1e-6})
    worth = cost(gain) / best.fun - 1.0
    if dead_time_s == 0.0:
        assert worth < 1e-9
        np.testing.assert_allclose(best.x, gain, rtol=1e-4)
    else:
        assert 0.005 < worth < 0.02


# -- in a scenario -------------------------------------------------------------------------------


def scenario(**sections: Any) -> Scenario:
    """The demo at firm weights in calm air, its inputs 0.3 s late; sections are laid over."""
    table = config.to_table(config.load("demo")) | {"duration": 20.0, "settle": 5.0}
    table["control"] |= {"input_weight": 0.01, "input_reference": False}
    table["vehicle"] |= {"wind": 0.0, "dead_time_s": 0.3}
    for section, values in sections.items():
        table[section] |= values
    return config.check(table, "test")


def test_a_scenario_s_gain_is_for_the_dead_time_of_its_model() -> None:
    """Whatever that of the vehicle truly is; and there is none without feedback."""
    known = scenario(model={"dead_time_s": 0.3})
    model = known.terms().model
    np.testing.assert_array_equal(feedback_gain(known), gain_for(model, known.control, 0.3))
    np.testing.assert_array_equal(feedback_gain(scenario()), gain_for(model, known.control))
    assert not feedback_gain(scenario(control={"feedback": False})).any()


def test_a_vehicle_with_dead_time_flies_calmly_by_a_gain_for_it() -> None:
    """By that for none it swings without end, at its bounds."""
    commands = {}
    for dead_time_s in (0.0, 0.3):
        flown = scenario(model={"dead_time_s": dead_time_s})
        commands[dead_time_s] = fly(flown).client["input"][-200:]
    effort = {key: np.diff(u, axis=0).std() for key, u in commands.items()}
    assert effort[0.3] < 0.5 * effort[0.0]
    bound = 1.6 - 1e-6
    assert np.abs(commands[0.3]).max() < bound
    assert (np.abs(commands[0.0]) > bound).mean() > 0.5
