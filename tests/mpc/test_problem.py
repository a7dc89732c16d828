"""Optimal control problem: the QP equals the printed cost, and its solution is the optimum.

The printed cost (5), with the S-term of (9), is evaluated stage by stage on the model,
independently of the condensed form.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from bench.problems import from_python, gradients
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import (
    FIRST,
    LATER,
    Problem,
    add_cost,
    follow,
    lead,
    make_mpc,
    pose,
    set_inputs,
    set_previous,
    set_target,
    simd_batch,
    simd_memory,
)
from skytether.shared.law.model import Array, discretise
from skytether.shared.scenario.schema import ControlConfig, ModelConfig
from skytether.shared.scenario.whole import Scenario

quick = settings(max_examples=15)

TAU_S = (0.81, 0.3)
TWO_TAUS = discretise(TAU_S, 0.05)
U_MAX = np.array([1.8, 1.0])


CALM = np.zeros((1, 2))
WEIGHTS = {
    "state_weight": (7.1, 14.0),
    "terminal_weight": (73.0, 555.0),
    "input_weight": 1.8,
    "input_reference": False,
    "change_weight": 0.03,
}


def control(H: int, **keys: object) -> ControlConfig:
    return ControlConfig(horizon=H, **(WEIGHTS | keys))


def make(weights: ControlConfig, which: int = LATER, tau_s: tuple[float, ...] = TAU_S) -> Problem:
    u_max = tuple(np.resize(U_MAX, len(tau_s)).tolist())
    model = ModelConfig(axes=len(tau_s), tau_s=tau_s, u_max=u_max)
    terms = Scenario(model=model, control=weights).terms()
    return pose(terms.model, make_mpc(terms, weights), which)


def printed_cost(
    weights: ControlConfig, u: Array, *, x: Array, target: Array, previous: Array, wind: Array
) -> Array:
    """J of (9) of each axis, summed along a flight of TWO_TAUS; with E6 and E7."""
    Q, P = np.array(weights.state_weight), np.array(weights.terminal_weight)
    H, cost = weights.horizon, np.zeros(len(x))
    for i in range(H):
        wanted, driven = target[:, i, 1] if weights.input_reference else 0.0, u[:, i] + wind
        cost += (x - target[:, i]) ** 2 @ Q + weights.input_weight * (driven - wanted) ** 2
        if i <= H - 2:
            cost += weights.change_weight * (u[:, i] - previous[:, i]) ** 2
        x = TWO_TAUS.step(x, driven)
    return cost + (x - target[:, H]) ** 2 @ P


def optimum(problem: Problem, gradient: Array) -> Array:
    """Solution of one vehicle's bounded QPs by dense least squares: ½ ‖Lᵀu + L⁻¹g‖², 𝓗 = L Lᵀ."""
    answers = []
    for hessian, g, bound in zip(problem.hessian, gradient, U_MAX, strict=True):
        L = np.linalg.cholesky(hessian)
        b = -np.linalg.solve(L, g)
        answers.append(lsq_linear(L.T, b, (-bound, bound), method="bvls", tol=1e-14).x)
    return np.array(answers)


def situation(seed: int, H: int, axes: int = 2, size: float = 1.0) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    x, target = rng.normal(size=(axes, 2)), rng.normal(size=(axes, H + 1, 2))
    return size * x, size * target, size * rng.normal(size=(axes, H))


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 50), st.booleans())
def test_qp_ranks_any_two_plans_as_the_printed_cost(
    seed: int, H: int, input_reference: bool
) -> None:
    """Differences of ½ Uᵀ𝓗U + gᵀU are differences of ½ J, for any weights."""
    rng = np.random.default_rng(seed)
    weights = control(
        H,
        state_weight=tuple(rng.uniform(0, 20, 2)),
        terminal_weight=tuple(rng.uniform(0, 900, 2)),
        input_weight=rng.uniform(0.1, 5),
        change_weight=rng.uniform(0, 2),
        input_reference=input_reference,
    )
    problem = make(weights)
    x, target, previous = situation(seed, H)
    one, other = rng.normal(size=(2, 2, H))
    wind = rng.normal(size=2)
    g = gradients(problem, x[None], target[None], previous[None], wind[None])[0]
    values, costs = [], []
    for u in (one, other):
        values.append(0.5 * np.einsum("ak,akl,al->a", u, problem.hessian, u) + (g * u).sum(axis=1))
        cost = printed_cost(weights, u, x=x, target=target, previous=previous, wind=wind)
        costs.append(0.5 * cost)
    np.testing.assert_allclose(values[0] - values[1], costs[0] - costs[1], rtol=1e-8, atol=1e-7)


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 50))
def test_cost_of_a_change_is_that_of_the_hessian(seed: int, H: int) -> None:
    problem, change = make(control(H, change_weight=0.7)), situation(seed, H)[2]
    cost = 3.0
    for axis in range(2):
        cost = from_python(add_cost)(problem.mpc, axis, (0.0, 0.0), change[axis], cost)
    expected = np.einsum("ak,akl,al->", change, problem.hessian, change)
    np.testing.assert_allclose(cost - 3.0, expected, rtol=1e-9, atol=1e-9)


def test_first_step_has_no_change_weight() -> None:
    """E8: its QP equals that of a scenario without S, for any previous horizon."""
    first, without = make(control(5, change_weight=3.0), FIRST), make(control(5, change_weight=0.0))
    np.testing.assert_array_equal(first.hessian, without.hessian)
    x, target, previous = (each[None] for each in situation(1, 5))
    one, other = (gradients(each, x, target, previous, CALM) for each in (first, without))
    np.testing.assert_array_equal(one, other)


@pytest.mark.long
@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([2, 3]))
def test_prediction_is_the_model_flown_step_by_step(seed: int, H: int, axes: int) -> None:
    """(7): Φx + ΓU equals H single steps of the model, stage by stage."""
    rng = np.random.default_rng(seed)
    problem = make(control(H), tau_s=tuple(rng.uniform(0.1, 3.0, axes).tolist()))
    x, _, u = situation(seed, H, axes)
    states = [x]
    for stage in range(H):
        states.append(problem.model.step(states[-1], u[:, stage].astype(np.float32)))
    flown, follower = np.stack(states, axis=1), rng.normal(size=2)
    simd = simd_batch(simd_memory(H, 1))
    simd.w[0] = 0.3
    for axis in range(axes):
        (simd.p[0], simd.v[0]), (simd.leader_p[0], simd.leader_v[0]) = follower, x[axis]
        from_python(set_inputs)(u[axis], simd, 0)
        from_python(follow)(problem.mpc, axis, simd)
        speeds, drift = simd.leader_speed[:, 0].copy(), simd.drift_p[:, 0].copy()
        np.testing.assert_allclose(speeds, flown[axis, :, 1], rtol=0, atol=1e-11)
        simd.p[0], simd.v[0] = follower
        from_python(set_target)(flown[axis], simd, 0)
        from_python(lead)(problem.mpc, axis, simd)
        np.testing.assert_allclose(drift, simd.drift_p[:, 0], rtol=0, atol=1e-8)


CASES = [
    pytest.param(H, size, S, reference, id=f"H={H}-{name}-S={S}-{'E7' if reference else 'literal'}")
    for H, S, reference in ((1, 0.5, True), (40, 0.0, False), (40, 0.5, True))
    for name, size in (("free", 0.02), ("bound", 3.0))
]


@pytest.mark.parametrize(("H", "size", "change_weight", "input_reference"), CASES)
def test_solver_finds_the_optimum(
    H: int, size: float, change_weight: float, input_reference: bool
) -> None:
    """Within 1e-6 m/s of a dense active-set solver, inside the box and at its sides."""
    problem = make(control(H, input_reference=input_reference, change_weight=change_weight))
    x, target, previous = situation(H, H, size=size)
    target = np.cumsum(target, axis=1) / np.sqrt(H)
    previous = np.clip(previous, -U_MAX[:, None], U_MAX[:, None])
    gradient = gradients(problem, x[None], target[None], previous[None], CALM)
    u, solved = OsqpSolver(problem).solve(gradient, previous[None])
    best = optimum(problem, gradient[0])
    at_bound = np.abs(best) == U_MAX[:, None]
    assert solved.tolist() == [True]
    assert at_bound.any() == (size > 1)
    assert np.abs(u[0] - best).max() < 1e-6


def test_only_with_input_reference_a_steady_flight_is_optimal() -> None:
    """E7: with the literal R, a vehicle exactly on its reference is slowed down."""
    v = np.array([0.9, -0.5])
    t = 0.05 * np.arange(41)
    target = np.stack([v[:, None] * t, np.tile(v[:, None], 41)], axis=-1)[None]
    still = np.zeros((1, 2, 40))
    first = {}
    for reference in (False, True):
        problem = make(control(40, input_reference=reference, change_weight=0.0))
        gradient = gradients(problem, target[:, :, 0], target, still, CALM)
        u, _ = OsqpSolver(problem).solve(gradient, still)
        first[reference] = u[0]
    np.testing.assert_allclose(first[True], np.tile(v[:, None], 40), atol=1e-7)
    assert (np.abs(first[False][:, 0]) < np.abs(v) - 0.01).all()


def carried(inputs: Array, gap: int, *, fresh: bool = False) -> Array:
    simd = simd_batch(simd_memory(len(inputs), 1))
    from_python(set_previous)(inputs, gap, fresh, simd, 0)
    return simd.previous[:, 0]


def test_shifted_horizon_repeats_its_last_input() -> None:
    """(11): by any number of steps; a new vehicle has no previous horizon."""
    horizon = np.array([1.0, 2.0, 3.0, 4.0])
    later = [carried(horizon, gap).tolist() for gap in (0, 1, 3, 9)]
    assert later == [[1, 2, 3, 4], [2, 3, 4, 4], [4, 4, 4, 4], [4, 4, 4, 4]]
    assert carried(horizon, 1, fresh=True).tolist() == [0, 0, 0, 0]


@quick
@given(st.integers(0, 12), st.integers(0, 12))
def test_shifting_twice_is_shifting_once_by_the_sum(one: int, other: int) -> None:
    """A horizon may therefore be carried over any gaps."""
    inputs = np.random.default_rng(0).normal(size=7)
    twice = carried(carried(inputs, one), other)
    np.testing.assert_array_equal(twice, carried(inputs, one + other))
