"""Exact solver: accurate to rounding, independent of earlier problems, never a wrong answer."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from bench.problems import from_python, gradients
from skytether.server.mpc import exact
from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.hierarchical import make_solver
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import (
    LATER,
    Problem,
    make_mpc,
    pose,
    set_previous,
    simd_batch,
)
from skytether.server.mpc.riccati import active_sets, workspace
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading

PAPER = reading.load("paper")
U_MAX = np.array([1.8, 1.0])


def make(
    tau_s: tuple[float, ...] = (0.855, 0.3),
    u_max: tuple[float, ...] = (1.8, 1.0),
    **control: Any,
) -> Problem:
    replace = msgspec.structs.replace
    model = replace(PAPER.model, tau_s=tau_s, u_max=u_max)
    scenario = replace(PAPER, model=model, control=replace(PAPER.control, **control))
    terms = scenario.terms()
    return pose(terms.model, make_mpc(terms, scenario.control), LATER)


ROUGH = {"dt": 0.1, "horizon": 30, "input_weight": 1e-3, "state_weight": (10.0, 1.0)}
"""Long steps and hardly any weight of the input: active sets cycle."""


@pytest.fixture
def gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The active set of every third axis is given up, as if it had cycled to the end."""
    solve = exact._solve

    def impatient(*given: Any) -> None:
        *_, settled = given
        solve(*given)
        settled[::3] = False

    monkeypatch.setattr(exact, "_solve", impatient)


def problems(problem: Problem, count: int, scale: float, seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    axes, H = problem.hessian.shape[:2]
    x = rng.normal(0.0, scale, (count, axes, 2))
    target = np.cumsum(rng.normal(0.0, 0.2 * scale, (count, axes, H + 1, 2)), axis=2)
    guess = np.clip(rng.normal(0.0, 1.0, (count, axes, H)), -U_MAX[:, None], U_MAX[:, None])
    return gradients(problem, x, target, guess, np.zeros(x.shape[:2])), guess


def residual(problem: Problem, inputs: Array, gradient: Array) -> float:
    slope = np.einsum("akl,nal->nak", problem.hessian, inputs) + gradient
    at_bound = np.abs(inputs) >= U_MAX[:, None]
    wrong = np.where(at_bound, np.maximum(np.sign(inputs) * slope, 0.0), slope)
    return float((np.abs(wrong) / (1.0 + np.abs(gradient).max(axis=2, keepdims=True))).max())


@pytest.mark.parametrize(("horizon", "scale"), [(1, 10.0), (2, 1.0), (40, 1.0)])
def test_it_equals_an_independent_reference(horizon: int, scale: float) -> None:
    problem = make(horizon=horizon)
    gradient, guess = problems(problem, 4, scale, seed=horizon)
    inputs, solved = ExactSolver(problem).solve(gradient, guess)
    assert solved.all()
    for n in range(4):
        for axis, bound in enumerate(U_MAX):
            root = np.linalg.cholesky(problem.hessian[axis])
            aim = -np.linalg.solve(root, gradient[n, axis])
            reference = lsq_linear(root.T, aim, (-bound, bound), method="bvls", tol=1e-15).x
            np.testing.assert_allclose(inputs[n, axis], reference, rtol=0, atol=1e-9)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    scale=st.sampled_from([0.1, 1.0, 3.0, 30.0]),
    horizon=st.sampled_from([1, 7, 50]),
    input_reference=st.booleans(),
    change_weight=st.sampled_from([0.0, 0.033, 5.0]),
)
def test_every_answer_is_optimal_and_within_its_box(
    seed: int, scale: float, horizon: int, *, input_reference: bool, change_weight: float
) -> None:
    problem = make(horizon=horizon, input_reference=input_reference, change_weight=change_weight)
    gradient, guess = problems(problem, 10, scale, seed)
    inputs, solved = ExactSolver(problem).solve(gradient, guess)
    assert solved.all()
    assert (np.abs(inputs) <= U_MAX[:, None]).all()
    assert residual(problem, inputs, gradient) < 1e-10


def test_problems_that_cycle_are_solved_all_the_same() -> None:
    """By changing one input per iteration: without that, more than 100 are left to DAQP."""
    problem = make((0.4, 0.6), **ROUGH)
    gradient, guess = problems(problem, 300, 3.0, seed=1)
    solver = ExactSolver(problem)
    inputs, solved = solver.solve(gradient, guess)
    assert solved.all()
    assert solver.fallbacks <= 5
    assert (np.abs(inputs) <= U_MAX[:, None]).all()
    assert residual(problem, inputs, gradient) < 1e-10


@pytest.mark.usefixtures("gives_up")
def test_an_input_that_daqp_leaves_just_inside_its_bound_is_at_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such an answer is accurate to rounding although it has a slope; it must not be refused."""
    dual = exact.daqp.solve

    def nearly(*args: object, **keys: object) -> object:
        answer, *rest = dual(*args, **keys)
        return answer * (1.0 - 4e-16), *rest

    monkeypatch.setattr(exact.daqp, "solve", nearly)
    problem = make((0.4, 0.6), **ROUGH)
    gradient, guess = problems(problem, 100, 3.0, seed=1)
    solver = ExactSolver(problem)
    inputs, solved = solver.solve(gradient, guess)
    assert solved.all()
    assert solver.fallbacks > 10
    assert residual(problem, inputs, gradient) < 1e-10


@pytest.mark.usefixtures("gives_up")
def test_without_the_fallback_such_problems_fail_and_are_not_guessed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wrong answer of DAQP is refused: these vehicles keep their guess."""
    problem = make((0.4, 0.6), **ROUGH)
    gradient, guess = problems(problem, 300, 3.0, seed=1)
    right, _ = ExactSolver(problem).solve(gradient, guess)

    def wrong(hessian: Array, *_: object, **__: object) -> tuple[Array, float, int, dict[str, int]]:
        return np.zeros(len(hessian)), 0.0, -4, {"iterations": 9}

    monkeypatch.setattr(exact.daqp, "solve", wrong)
    inputs, solved = ExactSolver(problem).solve(gradient, guess)
    assert 0 < (~solved).sum() < 300
    np.testing.assert_array_equal(inputs[~solved], guess[~solved])
    np.testing.assert_array_equal(inputs[solved], right[solved])


@pytest.mark.long
def test_a_horizon_rounded_to_float32_keeps_its_active_set() -> None:
    """Warm start of every saturated flight: one round, although 1.8 became 1.7999999.

    From a horizon further inside its bounds it takes more.
    """
    problem = make((0.855, 0.855), (1.8, 1.8))
    gradient, guess = problems(problem, 20, 10.0, seed=6)
    inputs, _ = ExactSolver(problem).solve(gradient, guess)
    assert (np.abs(inputs) == 1.8).mean() > 0.5
    rounded = inputs.astype(np.float32).astype(np.float64)
    assert np.abs(rounded).max() < 1.8
    work, settled = workspace(problem.mpc), np.ones(1, dtype=np.bool_)
    simd = simd_batch(work.memory)

    def rounds(previous: Array, at: tuple[int, ...]) -> int:
        from_python(set_previous)(previous, 0, False, simd, 0)
        simd.gradient[:, 0] = gradient[at]
        return int(from_python(active_sets)(problem.mpc, at[1], LATER, simd, work.free, settled))

    for at in np.ndindex(20, 2):
        assert rounds(rounded[at], at) == 1
        np.testing.assert_array_equal(simd.inputs[:, 0], inputs[at])
    assert max(rounds(0.9 * rounded[at], at) for at in np.ndindex(20, 2)) > 1


def test_osqp_agrees_to_its_tolerance() -> None:
    problem = make()
    gradient, guess = problems(problem, 50, 2.0, seed=5)
    exactly, _ = ExactSolver(problem).solve(gradient, guess)
    nearly, solved = OsqpSolver(problem).solve(gradient, guess)
    assert solved.all()
    np.testing.assert_allclose(nearly, exactly, rtol=0, atol=1e-6)


def test_a_scenario_names_its_solver() -> None:
    assert PAPER.control.solver == "exact"
    kinds = {"exact": ExactSolver, "osqp": OsqpSolver}
    for name, kind in kinds.items():
        control = msgspec.structs.replace(PAPER.control, solver=name)
        assert type(make_solver(control, make())) is kind
