"""Contract of the solvers: answers in the box, failures of one vehicle only, no memory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether.server.mpc.osqp_solver
from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import LATER, make_mpc, pose
from skytether.server.mpc.solver import Solver, SolverFailed
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import ControlConfig, ModelConfig
from skytether.shared.scenario.whole import Scenario

quick = settings(max_examples=15)

H = 20
SCENARIO = Scenario(
    model=ModelConfig(tau_s=(0.81, 0.3), u_max=(1.8, 0.6)),
    control=ControlConfig(horizon=H, input_weight=0.01, input_reference=False, change_weight=0.033),
)
TERMS = SCENARIO.terms()
PROBLEM = pose(TERMS.model, make_mpc(TERMS, SCENARIO.control), LATER)
U_MAX = PROBLEM.mpc.bounds


@pytest.fixture(scope="module", params=[ExactSolver, OsqpSolver])
def make(request: pytest.FixtureRequest) -> type[Solver]:
    return request.param


def problems(seed: int, vehicles: int, size: float = 0.1) -> tuple[Array, Array]:
    """Gradients, and guesses within the box; some of their answers touch it."""
    rng = np.random.default_rng(seed)
    bound = U_MAX[:, None]
    guess = np.clip(rng.normal(size=(vehicles, 2, H)), -bound, bound)
    return size * rng.normal(size=(vehicles, 2, H)), guess


def residual(gradient: Array, u: Array) -> float:
    """Residual of optimality: the remaining projected-gradient step [m/s]."""
    slope = np.einsum("akl,nal->nak", PROBLEM.hessian, u) + gradient
    bound = U_MAX[:, None]
    return float(np.abs(np.clip(u - slope, -bound, bound) - u).max())


def test_problems_of_these_tests_touch_the_box_and_leave_it(make: type[Solver]) -> None:
    gradient, guess = problems(0, 4)
    u, solved = make(PROBLEM).solve(gradient, guess)
    assert solved.all()
    at_bound = np.isclose(np.abs(u), U_MAX[:, None], rtol=0, atol=1e-6)
    assert 0.1 < np.mean(at_bound) < 0.9
    assert residual(gradient, u) < 1e-6


@quick
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1e4))
def test_answers_never_leave_the_box(make: type[Solver], seed: int, size: float) -> None:
    u, solved = make(PROBLEM).solve(*problems(seed, 2, size))
    assert solved.all()
    assert (np.abs(u) <= U_MAX[:, None]).all()


@pytest.mark.parametrize(("axis", "bad"), [(0, np.nan), (1, np.inf)])
def test_bad_gradient_fails_its_own_vehicle_alone(
    make: type[Solver], axis: int, bad: float
) -> None:
    gradient, guess = problems(1, 3)
    healthy, _ = make(PROBLEM).solve(gradient, guess)
    gradient[1, axis, 7] = bad
    u, solved = make(PROBLEM).solve(gradient, guess)
    assert solved.tolist() == [True, False, True]
    np.testing.assert_array_equal(u[1], guess[1])
    np.testing.assert_array_equal(u[[0, 2]], healthy[[0, 2]])


def test_osqp_refuses_a_bad_guess() -> None:
    gradient, guess = problems(2, 2)
    guess[0, 0, 0] = np.nan
    _, solved = OsqpSolver(PROBLEM).solve(gradient, guess)
    assert solved.tolist() == [False, True]


def test_bad_problem_is_not_even_tried() -> None:
    """Thousands of iterations on NaN would delay every other vehicle."""
    _, guess = problems(2, 1)
    with pytest.raises(SolverFailed, match=r"^problem not finite after 0 iterations$"):
        OsqpSolver(PROBLEM)._solve_axis(0, np.full(H, np.nan), guess[0, 0])


def test_nothing_bad_sticks(make: type[Solver]) -> None:
    gradient, guess = problems(3, 3)
    used, fresh = make(PROBLEM), make(PROBLEM)
    used.solve(np.full_like(gradient, np.nan), guess)
    used.solve(gradient, np.full_like(guess, np.nan))
    u, solved = used.solve(gradient, guess)
    assert solved.all()
    np.testing.assert_array_equal(u, fresh.solve(gradient, guess)[0])


def test_iteration_limit_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skytether.server.mpc.osqp_solver, "ITERATIONS_MAX", 1)
    gradient, guess = problems(4, 2)
    u, solved = OsqpSolver(PROBLEM).solve(gradient, guess)
    assert solved.tolist() == [False, False]
    np.testing.assert_array_equal(u, guess)


def test_caller_keeps_its_arrays(make: type[Solver]) -> None:
    gradient, guess = problems(5, 2)
    before = gradient.copy(), guess.copy()
    u, _ = make(PROBLEM).solve(gradient, guess)
    u[:] = 0.0
    np.testing.assert_array_equal(gradient, before[0])
    np.testing.assert_array_equal(guess, before[1])


@quick
@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.floats(0.0, 1e4)), max_size=5))
def test_answer_depends_on_problem_and_guess_alone(
    make: type[Solver], history: list[tuple[int, float]]
) -> None:
    gradient, guess = problems(6, 1)
    used = make(PROBLEM)
    for seed, size in history:
        used.solve(*problems(seed, 1, size))
    fresh, _ = make(PROBLEM).solve(gradient, guess)
    np.testing.assert_array_equal(used.solve(gradient, guess)[0], fresh)


def test_answer_does_not_lean_on_its_guess(make: type[Solver]) -> None:
    """A good guess saves time and changes the answer by no more than the tolerance."""
    gradient, guess = problems(7, 1)
    solver = make(PROBLEM)
    one, _ = solver.solve(gradient, guess)
    other, _ = solver.solve(gradient, -guess)
    again, _ = solver.solve(gradient, one)
    assert np.abs(one - other).max() < 1e-6
    assert np.abs(one - again).max() < 1e-6


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_batch_is_solved_as_its_singles(make: type[Solver], seed: int, vehicles: int) -> None:
    gradient, guess = problems(seed, vehicles)
    solver = make(PROBLEM)
    u, _ = solver.solve(gradient, guess)
    singles = [solver.solve(gradient[[i]], guess[[i]])[0][0] for i in range(vehicles)]
    np.testing.assert_array_equal(u, singles)
