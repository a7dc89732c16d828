"""Model of the UAV, eq. (1)-(4): the discretisation is exact, for every axis and any Δt."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from bench.problems import from_python
from skytether.server.planning.compiled import advance as shared
from skytether.shared.base.kernel import part
from skytether.shared.law.model import advance, discretise, white_acceleration

quick = settings(max_examples=25)


def sampled(tau_s: float, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """A and B of one axis: the exponential of eq. (2)-(3), with constant input."""
    rate = np.array([[0.0, 1.0, 0.0], [0.0, -1.0 / tau_s, 1.0 / tau_s], [0.0, 0.0, 0.0]])
    exponential = expm(rate * dt_s)
    return exponential[:2, :2], exponential[:2, 2]


@pytest.mark.parametrize("dt_s", [0.001, 0.05, 1.0])
@pytest.mark.parametrize("tau_s", [(0.81, 0.81), (0.3, 2.0), (0.05, 0.81, 7.0), (1e-4, 50.0)])
def test_discretisation_is_the_matrix_exponential(tau_s: tuple[float, ...], dt_s: float) -> None:
    gains = [1.0, 0.8, 1.3][: len(tau_s)]
    model = discretise(np.array(tau_s), dt_s, gains)
    for axis, (tau, gain) in enumerate(zip(tau_s, gains, strict=True)):
        A, B = sampled(tau, dt_s)
        np.testing.assert_allclose(model.A[axis], A, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(model.B[axis], gain * B, rtol=1e-12, atol=1e-15)


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.sampled_from([2, 3]))
def test_batch_steps_as_its_singles(seed: int, vehicles: int, axes: int) -> None:
    rng = np.random.default_rng(seed)
    model = discretise(rng.uniform(0.1, 3.0, axes), 0.05)
    x, u = rng.normal(size=(vehicles, axes, 2)), rng.normal(size=(vehicles, axes))
    singles = [model.step(x[i], u[i]) for i in range(vehicles)]
    np.testing.assert_array_equal(model.step(x, u), singles)


@pytest.mark.parametrize("tau_s", [1e3, 1e6, 1e9])
def test_very_long_time_constant_stays_exact(tau_s: float) -> None:
    """A and B equal the matrix exponential's although 1 - exp(-Δt/τ) is nearly zero."""
    model = discretise(np.array([tau_s]), 0.05)
    A, B = sampled(tau_s, 0.05)
    np.testing.assert_allclose(model.A[0], A, rtol=1e-15, atol=1e-17)
    assert model.B[0, 1] == pytest.approx(B[1], rel=1e-14)
    assert model.B[0, 0] == pytest.approx(B[0], abs=2e-17)


def test_a_roll_is_its_steps() -> None:
    model, rng = discretise([0.8, 0.3, 1.1], 0.05), np.random.default_rng(2)
    x, inputs = rng.normal(size=(3, 2)), rng.normal(size=(3, 7))
    states = model.roll(x, inputs)
    assert states.shape == (8, 3, 2)
    for state, u in zip(states, inputs.T, strict=False):
        np.testing.assert_array_equal(state, x)
        x = model.step(x, u)
    np.testing.assert_array_equal(states[-1], x)


@pytest.mark.parametrize("step", [advance, from_python(part(shared))])
def test_one_axis_in_numbers_steps_as_all_in_arrays(step: Callable[..., Any]) -> None:
    """To the last bit, compiled or not, because client and server must agree."""
    model, rng = discretise([0.8, 0.3, 1.1], 0.05), np.random.default_rng(1)
    x, u = rng.normal(size=(3, 2)), rng.normal(size=3)
    for _ in range(100):
        singles = [
            step(axis, *state, float(u_axis))
            for axis, state, u_axis in zip(model.axes(), x.tolist(), u, strict=True)
        ]
        x = model.step(x, u)
        np.testing.assert_array_equal(singles, x)


@quick
@given(st.integers(0, 2**32 - 1))
def test_a_step_is_the_matrix_equation(seed: int) -> None:
    """Eq. (4), x(k+1) = A x(k) + B u(k), on each axis."""
    rng = np.random.default_rng(seed)
    model = discretise(rng.uniform(0.1, 3.0, 3), 0.05)
    x, u = rng.normal(size=(3, 2)), rng.normal(size=3)
    expected = (model.A @ x[..., None])[..., 0] + model.B * u[:, None]
    np.testing.assert_allclose(model.step(x, u), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("dt_s", [0.01, 0.05, 0.5])
def test_the_covariance_under_white_acceleration_is_that_of_the_integral(dt_s: float) -> None:
    """∫ e^{As} G Gᵀ e^{Aᵀs} over a step, by quadrature, on axes that differ."""
    tau_s = np.array([0.05, 0.3, 0.84, 5.0])
    roots = white_acceleration(tau_s, dt_s)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    s = 0.5 * dt_s * (nodes + 1.0)
    for root, tau in zip(roots, tau_s, strict=True):
        felt = np.array([tau * (1.0 - np.exp(-s / tau)), np.exp(-s / tau)])
        expected = 0.5 * dt_s * (weights * felt) @ felt.T
        assert root[0, 1] == 0.0
        np.testing.assert_allclose(root @ root.T, expected, rtol=1e-8)
