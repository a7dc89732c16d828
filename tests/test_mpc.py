"""The optimal control problem as algebra: the QP is the printed cost, and its answer the optimum.

The printed cost (5), with the S-term of (9), is evaluated here stage by stage on the model; nothing
of the condensed form is used to check the condensed form.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from server.mpc import MPC, condense, shift, stationary_gain
from server.solver import OsqpSolver
from shared.config import ControlConfig
from shared.model import Array, discretise

quick = settings(max_examples=40, deadline=None)

TWO_TAUS = discretise(np.array([0.81, 0.3]), 0.05)
"""A vehicle that is not the same on both axes."""
U_MAX = np.array([1.8, 1.0])


CALM = np.zeros((1, 2))
WEIGHTS = {
    "state_weight": (7.1, 14.0),
    "terminal_weight": (73.0, 555.0),
    "input_weight": 1.8,
    "change_weight": 0.03,
}


def control(H: int, **keys: object) -> ControlConfig:
    """Weights of the paper's scenario over H steps, some of them changed."""
    return ControlConfig(horizon=H, **(WEIGHTS | keys))


def printed_cost(
    weights: ControlConfig,
    u: Array,
    *,
    change_weight: float,
    x: Array,
    target: Array,
    previous: Array,
) -> Array:
    """J of (9) of each axis, summed up along a flight of TWO_TAUS; with E6 and E7."""
    Q, P = np.array(weights.state_weight), np.array(weights.terminal_weight)
    H, cost = weights.horizon, np.zeros(len(x))
    for i in range(H):
        wanted = target[:, i, 1] if weights.input_reference else 0.0
        cost += (x - target[:, i]) ** 2 @ Q + weights.input_weight * (u[:, i] - wanted) ** 2
        if i <= H - 2:
            cost += change_weight * (u[:, i] - previous[:, i]) ** 2
        x = TWO_TAUS.step(x, u[:, i])
    return cost + (x - target[:, H]) ** 2 @ P


def predict(mpc: MPC, x: Array, u: Array) -> Array:
    """The states at the stages 0 … H, written into rows in another order; (n, axes, H + 1, 2)."""
    n, axes, H = u.shape
    states, rows = np.full((n + 2, axes, H + 1, 2), np.nan), np.arange(n, 0, -1)
    mpc.predict(x, u, np.zeros(x.shape[:2]), states, rows)
    assert np.isnan(states[[0, -1]]).all()
    return states[rows]


def optimum(mpc: MPC, gradient: Array, u_max: Array) -> Array:
    """The bounded QPs of one vehicle by dense least squares: ½ ‖Lᵀu + L⁻¹g‖², 𝓗 = L Lᵀ."""
    answers = []
    for hessian, g, bound in zip(mpc.hessian, gradient, u_max, strict=True):
        L = np.linalg.cholesky(hessian)
        b = -np.linalg.solve(L, g)
        answers.append(lsq_linear(L.T, b, (-bound, bound), method="bvls", tol=1e-14).x)
    return np.array(answers)


def situation(seed: int, H: int, axes: int = 2, size: float = 1.0) -> tuple[Array, Array, Array]:
    """Some state, target and horizon before, for one vehicle."""
    rng = np.random.default_rng(seed)
    x, target = rng.normal(size=(axes, 2)), rng.normal(size=(axes, H + 1, 2))
    return size * x, size * target, size * rng.normal(size=(axes, H))


@pytest.mark.parametrize("input_reference", [False, True])
@pytest.mark.parametrize("change_weight", [0.0, 0.7])
@pytest.mark.parametrize("H", [1, 2, 6])
def test_qp_is_the_printed_cost(H: int, change_weight: float, input_reference: bool) -> None:
    """𝓗 and g are the second and first differences of ½ J, which is quadratic: exact."""
    weights = control(H, input_reference=input_reference)
    mpc = condense(TWO_TAUS, weights, change_weight=change_weight)
    x, target, previous = situation(H, H)
    unit = np.eye(H)

    def half_cost(u: Array) -> Array:
        return 0.5 * printed_cost(
            weights,
            np.tile(u, (2, 1)),
            change_weight=change_weight,
            x=x,
            target=target,
            previous=previous,
        )

    still = half_cost(np.zeros(H))
    for i in range(H):
        slope = 0.5 * (half_cost(unit[i]) - half_cost(-unit[i]))
        gradient = mpc.gradient(x[None], target[None], previous[None], CALM)[0, :, i]
        np.testing.assert_allclose(gradient, slope, rtol=1e-9, atol=1e-9)
        for j in range(H):
            bend = half_cost(unit[i] + unit[j]) - half_cost(unit[i]) - half_cost(unit[j]) + still
            np.testing.assert_allclose(mpc.hessian[:, i, j], bend, rtol=1e-9, atol=1e-9)


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
        input_reference=input_reference,
    )
    S = rng.uniform(0, 2)
    mpc = condense(TWO_TAUS, weights, change_weight=S)
    x, target, previous = situation(seed, H)
    one, other = rng.normal(size=(2, 2, H))
    g = mpc.gradient(x[None], target[None], previous[None], CALM)[0]
    values, costs = [], []
    for u in (one, other):
        values.append(0.5 * np.einsum("ak,akl,al->a", u, mpc.hessian, u) + (g * u).sum(axis=1))
        cost = printed_cost(weights, u, change_weight=S, x=x, target=target, previous=previous)
        costs.append(0.5 * cost)
    np.testing.assert_allclose(values[0] - values[1], costs[0] - costs[1], rtol=1e-8, atol=1e-7)


def test_last_stage_has_no_change_weight() -> None:
    """(9) sums S up to H-2: the horizon before says nothing about stage H-1."""
    with_s = condense(TWO_TAUS, control(5), change_weight=3.0).hessian
    without = condense(TWO_TAUS, control(5), change_weight=0.0).hessian
    np.testing.assert_allclose(
        with_s - without, [np.diag([3.0, 3.0, 3.0, 3.0, 0.0])] * 2, atol=1e-12
    )


def test_last_input_of_the_horizon_before_changes_nothing() -> None:
    """For the same reason."""
    mpc = condense(TWO_TAUS, control(5), change_weight=3.0)
    x, target, previous = situation(1, 5)
    other = previous.copy()
    other[:, -1] = 99.0
    one, two = (mpc.gradient(x[None], target[None], u[None], CALM) for u in (previous, other))
    np.testing.assert_array_equal(one, two)


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([2, 3]))
def test_prediction_is_the_model_flown_step_by_step(seed: int, H: int, axes: int) -> None:
    """(7): Φx + ΓU is where H single steps lead, stage by stage."""
    rng = np.random.default_rng(seed)
    model = discretise(rng.uniform(0.1, 3.0, axes), 0.05)
    mpc = condense(model, control(H), change_weight=0.0)
    x, _, u = situation(seed, H, axes)
    predicted = predict(mpc, x[None], u[None])[0, :, 1:]
    for stage in range(H):
        x = model.step(x, u[:, stage])
        np.testing.assert_allclose(predicted[:, stage], x, rtol=0, atol=1e-11)


CASES = [
    pytest.param(H, size, S, reference, id=f"H={H}-{name}-S={S}-{'E7' if reference else 'literal'}")
    for H in (1, 40, 100)
    for name, size in (("free", 0.02), ("bound", 3.0))
    for S in (0.0, 0.5)
    for reference in (False, True)
]


@pytest.mark.parametrize(("H", "size", "change_weight", "input_reference"), CASES)
def test_solver_finds_the_optimum(
    H: int, size: float, change_weight: float, input_reference: bool
) -> None:
    """Within 1e-6 m/s of a dense active-set solver, inside the box and at its sides."""
    weights = control(H, input_reference=input_reference)
    mpc = condense(TWO_TAUS, weights, change_weight=change_weight)
    x, target, previous = situation(H, H, size=size)
    target = np.cumsum(target, axis=1) / np.sqrt(H)
    previous = np.clip(previous, -U_MAX[:, None], U_MAX[:, None])
    gradient = mpc.gradient(x[None], target[None], previous[None], CALM)
    u, solved = OsqpSolver(mpc.hessian, U_MAX).solve(gradient, previous[None])
    best = optimum(mpc, gradient[0], U_MAX)
    at_bound = np.abs(best) == U_MAX[:, None]
    assert solved.tolist() == [True]
    assert at_bound.any() == (size > 1)
    assert np.abs(u[0] - best).max() < 1e-6


def test_vehicle_that_is_where_it_shall_be_stays() -> None:
    """At rest on a resting target the best input is none at all."""
    mpc = condense(TWO_TAUS, control(40), change_weight=0.033)
    x = np.array([[[1.5, 0.0], [-2.0, 0.0]]])
    gradient = mpc.gradient(x, np.repeat(x[:, :, None], 41, axis=2), np.zeros((1, 2, 40)), CALM)
    u, _ = OsqpSolver(mpc.hessian, U_MAX).solve(gradient, np.zeros((1, 2, 40)))
    np.testing.assert_allclose(u, 0.0, atol=1e-9)


def test_only_with_input_reference_a_steady_flight_is_optimal() -> None:
    """E7: the literal R asks a vehicle that flies just as desired to slow down."""
    v = np.array([0.9, -0.5])
    t = 0.05 * np.arange(41)
    target = np.stack([v[:, None] * t, np.tile(v[:, None], 41)], axis=-1)[None]
    still = np.zeros((1, 2, 40))
    first = {}
    for reference in (False, True):
        mpc = condense(TWO_TAUS, control(40, input_reference=reference), change_weight=0.0)
        gradient = mpc.gradient(target[:, :, 0], target, still, CALM)
        u, _ = OsqpSolver(mpc.hessian, U_MAX).solve(gradient, still)
        first[reference] = u[0]
    np.testing.assert_allclose(first[True], np.tile(v[:, None], 40), atol=1e-7)
    assert (np.abs(first[False][:, 0]) < np.abs(v) - 0.01).all()


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.booleans())
def test_batch_has_the_gradients_of_its_singles(
    seed: int, vehicles: int, input_reference: bool
) -> None:
    """Gradients and predictions of a batch are those of its singles."""
    mpc = condense(TWO_TAUS, control(20, input_reference=input_reference), change_weight=0.3)
    x, target, previous = (
        np.stack(some)
        for some in zip(*(situation(seed + i, 20) for i in range(vehicles)), strict=True)
    )
    wind = np.random.default_rng(seed).normal(size=(vehicles, 2))
    gradients = mpc.gradient(x, target, previous, wind)
    predictions = predict(mpc, x, previous)
    for i in range(vehicles):
        one = slice(i, i + 1)
        single = mpc.gradient(x[one], target[one], previous[one], wind[one])[0]
        np.testing.assert_allclose(gradients[i], single, rtol=0, atol=1e-10)
        single = predict(mpc, x[one], previous[one])[0]
        np.testing.assert_allclose(predictions[i], single, rtol=0, atol=1e-12)


def test_shifted_horizon_repeats_its_last_input() -> None:
    """(11): each vehicle's own number of steps later, however many."""
    horizon = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    shifted = shift(np.stack([horizon] * 4), np.array([0, 1, 3, 9]))
    assert shifted[:, 0].tolist() == [[1, 2, 3, 4], [2, 3, 4, 4], [4, 4, 4, 4], [4, 4, 4, 4]]
    assert shifted[:, 1].tolist() == [[5, 6, 7, 8], [6, 7, 8, 8], [8, 8, 8, 8], [8, 8, 8, 8]]


@quick
@given(st.integers(0, 12), st.integers(0, 12))
def test_shifting_twice_is_shifting_once_by_the_sum(one: int, other: int) -> None:
    """A horizon may therefore be carried over any gaps."""
    inputs = np.random.default_rng(0).normal(size=(1, 2, 7))
    twice = shift(shift(inputs, np.array([one])), np.array([other]))
    np.testing.assert_array_equal(twice, shift(inputs, np.array([one + other])))


@quick
@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0), st.floats(0.0, 10.0))
def test_stationary_gain_is_that_of_the_riccati_equation(q: float, r: float, s: float) -> None:
    """On either axis, with S beside R."""
    weights = control(20, state_weight=(7.1, q), input_weight=r, change_weight=s)
    gain = stationary_gain(TWO_TAUS, weights)
    for A, B, K in zip(TWO_TAUS.A, TWO_TAUS.B[:, :, None], gain, strict=True):
        X = solve_discrete_are(A, B, np.diag([7.1, q]), np.array([[r + s]]))
        expected = np.linalg.solve(r + s + B.T @ X @ B, B.T @ X @ A)[0]
        np.testing.assert_allclose(K, expected, rtol=1e-7)


def test_stationary_gain_where_nothing_weighs_the_position() -> None:
    """Nothing leads back to it then."""
    gain = stationary_gain(TWO_TAUS, control(20, state_weight=(0.0, 1.0)))
    np.testing.assert_allclose(gain[:, 0], 0.0, atol=1e-12)
    assert (gain[:, 1] > 0.0).all()
