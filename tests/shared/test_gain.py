"""Gain of feedback aboard: that of the Riccati equation, for any dead time."""

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from helpers import packaged
from skytether.server.schemes.feedback import feedback_gain
from skytether.server.schemes.feedback import stationary_gain as gain_for
from skytether.shared.law.model import Array, discretise, white_acceleration
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.whole import Scenario
from skytether.sim.flight import fly

TAU_S, DT = 0.84, 0.05
MODEL = discretise([TAU_S], DT)
TWO_AXES = discretise([0.81, 0.3], DT, [1.0, 0.8])
FIRM = ControlConfig(state_weight=(7.0, 1.0), input_weight=0.01)


@settings(max_examples=15)
@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0), st.floats(0.0, 10.0))
def test_it_is_that_of_the_riccati_equation(q: float, r: float, s: float) -> None:
    weights = ControlConfig(state_weight=(7.1, q), input_weight=r, change_weight=s)
    for A, B, K in zip(
        TWO_AXES.A, TWO_AXES.B[:, :, None], gain_for(TWO_AXES, weights), strict=True
    ):
        X = solve_discrete_are(A, B, np.diag([7.1, q]), np.array([[r + s]]))
        expected = np.linalg.solve(r + s + B.T @ X @ B, B.T @ X @ A)[0]
        np.testing.assert_allclose(K, expected, rtol=1e-7)


@settings(max_examples=10)
@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0), st.floats(1e-4, 10.0))
def test_a_trajectory_s_regulator_is_that_of_the_riccati_equation_with_changes(
    q: float, r: float, s: float
) -> None:
    """The previous input is a state: u = λ u(k-1) - (1 - λ) K x."""
    weights = {"state_weight": [7.1, q], "input_weight": r, "change_weight": s}
    flown = scenario(model={"tau_s": [0.81, 0.3], "gain": 0.8}, control=weights)
    model = flown.terms().model
    for A, B, (gain_p, gain_v, lag) in zip(model.A, model.B, regulator(flown), strict=True):
        F, G = np.pad(A, ((0, 1), (0, 1))), np.append(B, 1.0)[:, None]
        N = np.array([[0.0], [0.0], [-s]])
        X = solve_discrete_are(F, G, np.diag([7.1, q, s]), np.array([[r + s]]), s=N)
        K = np.linalg.solve(r + s + G.T @ X @ G, G.T @ X @ F + N.T)[0]
        found = [(1.0 - lag) * gain_p, (1.0 - lag) * gain_v, -lag]
        np.testing.assert_allclose(found, K, rtol=1e-6, atol=1e-9)
        assert 0.0 <= lag < 1.0


def test_without_a_weight_of_changes_it_is_the_feedback_gain() -> None:
    flown = scenario(control={"change_weight": 0.0, "feedback": True})
    along = regulator(flown)
    np.testing.assert_array_equal(along[:, :2], feedback_gain(flown))
    assert not along[:, 2].any()


def test_where_nothing_weighs_the_position_nothing_leads_back_to_it() -> None:
    gain = gain_for(TWO_AXES, ControlConfig(state_weight=(0.0, 1.0)))
    np.testing.assert_allclose(gain[:, 0], 0.0, atol=1e-12)
    assert (gain[:, 1] > 0.0).all()
    assert not gain_for(TWO_AXES, ControlConfig(state_weight=(0.0, 0.0))).any()


def test_noise_of_the_measurements_asks_for_no_other_gain() -> None:
    """The best gain behind a Kalman filter (2 cm, 5 cm/s; wind 0.1) is the same."""
    root = 0.1 * white_acceleration(np.array([TAU_S]), DT)[0]
    noise = np.diag([0.02**2, 0.05**2])
    before = solve_discrete_are(MODEL.A[0].T, np.eye(2), root @ root.T, noise)
    jolts = before @ np.linalg.solve(before + noise, before)  # of the filter's estimate
    Q, R = np.diag(FIRM.state_weight), FIRM.input_weight

    def cost(gain: Array) -> float:
        """Mean cost of a step with feedback of the estimate."""
        left = MODEL.A[0] - np.outer(MODEL.B[0], gain)
        if np.abs(np.linalg.eigvals(left)).max() >= 1.0:
            return np.inf
        X = np.linalg.solve(np.eye(4) - np.kron(left, left), jolts.ravel()).reshape(2, 2)
        return float((Q * X).sum() + R * (gain @ X @ gain))

    gain = gain_for(MODEL, FIRM)[0]
    best = minimize(cost, gain, method="Nelder-Mead", options={"fatol": 0.0, "xatol": 1e-6})
    assert cost(gain) / best.fun - 1.0 < 1e-9
    np.testing.assert_allclose(best.x, gain, rtol=1e-4)


# -- in a scenario -------------------------------------------------------------------------------


def scenario(**sections: Any) -> Scenario:
    """The demo at tight weights in calm air, with 0.3 s of dead time and sections changed."""
    late = {
        "duration": 20.0,
        "settle": 5.0,
        "control": {"input_weight": 0.01, "input_reference": False},
        "vehicle": {"wind": 0.0, "dead_time_s": 0.3},
    }
    return packaged("demo-committed", late, sections)


def test_a_scenario_s_gain_is_for_its_model_but_for_the_dead_time() -> None:
    known = scenario(model={"gain": 0.8, "dead_time_s": 0.3})
    expected = gain_for(discretise([0.84, 0.84], 0.05, 0.8), known.control)
    np.testing.assert_array_equal(feedback_gain(known), expected)
    assert not feedback_gain(scenario(control={"feedback": False})).any()


def test_a_vehicle_with_dead_time_flies_calmly_where_that_is_known() -> None:
    commands = {}
    for dead_time_s in (0.0, 0.3):
        flown = scenario(model={"dead_time_s": dead_time_s})
        commands[dead_time_s] = fly(flown).client["input"][-200:]
    effort = {key: np.diff(u, axis=0).std() for key, u in commands.items()}
    assert effort[0.3] < 0.1 * effort[0.0]
    bound = 1.6 - 1e-6
    assert np.abs(commands[0.3]).max() < bound
    assert (np.abs(commands[0.0]) > bound).mean() > 0.5
