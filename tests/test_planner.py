"""Trajectory generator (14) and tracker (15): who plans from what, along what, and after gaps.

`OnPaper` is section 4.1 once more, for one vehicle, with a dense solver and no batch.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from server.mpc import condense, shift
from server.planner import WINDOW, Desired, Plan, Planner, Successive
from server.solver import OsqpSolver
from shared.config import Scenario, check
from shared.model import Array, Flags, discretise
from shared.stopwatch import Stopwatch

H = 15
SCENARIO = check(
    {
        "model": {"tau_s": [0.81, 0.3], "u_max": [1.8, 1.0]},
        "control": {
            "horizon": H,
            "state_weight": [7.1, 14.0],
            "terminal_weight": [73.0, 555.0],
            "input_weight": 1.8,
            "change_weight": 5.0,
        },
        "reference": {"shape": "circle", "radius_m": 1.5, "period_s": 7.0},
    },
    "test",
)
"""Two unlike axes, one of them too slow for its circle, and an S-term that shows."""
MODEL = discretise(SCENARIO.tau_s, SCENARIO.control.dt)
START = np.array([[1.2, 0.3], [-0.4, 0.8]])
"""Beside the circle, and moving."""


CALM = np.zeros((1, 2))


def make(capacity: int = 1, scenario: Scenario = SCENARIO) -> Planner:
    """A planner that has not planned yet."""
    return Planner(scenario, MODEL, capacity, Stopwatch())


def run(planner: Planner, step: int, estimate: Array, *, row: int = 0) -> Plan:
    """The plan of one vehicle at one step."""
    rows, steps = np.array([row]), np.array([step])
    planned, fresh = planner.planned(rows, steps, estimate[None])
    return planner.plan(rows, steps, estimate[None], planned, fresh, CALM)


def start_of(planner: Planner, step: int, estimate: Array = START) -> tuple[Array, bool]:
    """Where the generator would plan from, x_p(k|k-1), and whether it would start anew."""
    planned, fresh = planner.planned(np.array([0]), np.array([step]), estimate[None])
    return planned[0], bool(fresh[0])


def elsewhere(step: int) -> Array:
    """Some estimate, another one at every step."""
    return START + np.random.default_rng(step).normal(scale=0.2, size=(2, 2))


class OnPaper:
    """{X_p(k), U_p(k)} ← (14), then {X(k), U(k)} ← (15)."""

    def __init__(self) -> None:
        self.step: int | None = None
        self.led, self.tracked = np.zeros((2, 2, H))
        self.trajectory = np.zeros((2, H, 2))

    def plan(self, step: int, estimate: Array) -> Array:
        """U(k) of the tracker; `led` and `trajectory` are the generator's."""
        gap = H + 1 if self.step is None else step - self.step
        change_weight = 0.0 if gap > H else SCENARIO.control.change_weight
        start = estimate if gap > H else self.trajectory[:, gap - 1]
        times = SCENARIO.control.dt * (step + np.arange(H + 1))
        desired = SCENARIO.make_reference()(times).transpose(1, 0, 2)
        self.led = self._solve(start, desired, self.led, gap, change_weight)
        self.trajectory = self._fly(start, self.led)
        lead = np.concatenate([start[:, None], self.trajectory], axis=1)
        self.tracked = self._solve(estimate, lead, self.tracked, gap, change_weight)
        self.step = step
        return self.tracked

    def _fly(self, x: Array, u: Array) -> Array:
        states = []
        for stage in range(H):
            x = MODEL.step(x, u[:, stage])
            states.append(x)
        return np.stack(states, axis=1)

    def _solve(
        self, x: Array, target: Array, before: Array, gap: int, change_weight: float
    ) -> Array:
        mpc = condense(MODEL, SCENARIO.control, change_weight=change_weight)
        previous = shift(before[None], np.array([gap]))
        gradient = mpc.gradient(x[None], target[None], previous, CALM)[0]
        answers = []
        for hessian, g, bound in zip(mpc.hessian, gradient, SCENARIO.u_max, strict=True):
            L = np.linalg.cholesky(hessian)
            box = (-bound, bound)
            answers.append(lsq_linear(L.T, -np.linalg.solve(L, g), box, "bvls", tol=1e-14).x)
        return np.array(answers)


def test_planner_solves_the_papers_two_problems() -> None:
    """Step after step, over gaps, and anew after a long one; inputs are float32."""
    planner, paper = make(), OnPaper()
    for step in (0, 1, 2, 5, 6, 6 + H, 7 + 2 * H, 8 + 2 * H):
        plan = run(planner, step, elsewhere(step))
        expected = paper.plan(step, elsewhere(step))
        assert plan.solved.tolist() == [True]
        np.testing.assert_allclose(plan.inputs[0], expected, rtol=0, atol=2e-6)
        np.testing.assert_allclose(planner._generator.inputs[0], paper.led, rtol=0, atol=2e-6)
        np.testing.assert_allclose(planner._generator.states[0, :, 1:], paper.trajectory, atol=2e-6)


def test_first_plan_starts_from_the_estimate() -> None:
    """There is no plan before: x_p = x̂."""
    planned, fresh = start_of(make(), 7)
    assert fresh
    np.testing.assert_array_equal(planned, START)


def test_first_plan_has_no_change_term() -> None:
    """E8: S = 0, which is not the same as S on a horizon of zeros."""
    desired = SCENARIO.make_reference()(SCENARIO.control.dt * np.arange(H + 1))
    target, still = desired.transpose(1, 0, 2)[None], np.zeros((1, 2, H))

    def best(change_weight: float) -> Array:
        mpc = condense(MODEL, SCENARIO.control, change_weight=change_weight)
        gradient = mpc.gradient(START[None], target, still, CALM)
        return OsqpSolver(mpc.hessian, SCENARIO.u_max).solve(gradient, still)[0]

    planner = make()
    run(planner, 0, START)
    led = planner._generator.inputs
    np.testing.assert_allclose(led, best(0.0), rtol=0, atol=1e-6)
    assert np.abs(led - best(SCENARIO.control.change_weight)).max() > 0.05


@pytest.mark.parametrize("gap", [1, 3, H])
def test_generator_goes_on_from_its_own_prediction(gap: int) -> None:
    """Prediction x_p(k|k-1) ∈ X_p(k-1): where the last inputs lead in the steps passed."""
    planner = make()
    run(planner, 10, START)
    x = START
    for stage in range(gap):
        x = MODEL.step(x, planner._generator.inputs[0, :, stage])
    planned, fresh = start_of(planner, 10 + gap, elsewhere(gap))
    assert not fresh
    np.testing.assert_allclose(planned, x, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(planned, planner._generator.states[0, :, gap])


def test_generator_never_looks_at_the_vehicle_again() -> None:
    """E17: two vehicles with one start share X_p for ever, wherever they really fly."""
    one, other = make(), make()
    run(one, 0, START)
    run(other, 0, START)
    for step in (1, 2, 4):
        mine, yours = run(one, step, elsewhere(step)), run(other, step, -elsewhere(step))
        np.testing.assert_array_equal(one._generator.states, other._generator.states)
        assert np.abs(mine.inputs - yours.inputs).max() > 0.5


def test_tracker_follows_all_of_the_trajectory() -> None:
    """E9: where inputs cost nothing, the vehicle that is on X_p stays on it at every stage."""
    free = {
        "horizon": H,
        "change_weight": 0.0,
        "input_weight": 1e-6,
        "state_weight": [7.1, 14.0],
        "terminal_weight": [73.0, 555.0],
    }
    raw = {"model": {"tau_s": [0.81, 0.3], "u_max": [3.0]}, "control": free}
    planner = make(scenario=check(raw, "test"))
    run(planner, 0, START)
    trajectory = planner._generator.states[0]
    assert np.abs(trajectory[:, -1] - trajectory[:, 0]).max() > 0.3
    np.testing.assert_allclose(planner._tracker.states[0], trajectory, rtol=0, atol=1e-5)


def test_asking_where_the_plan_is_changes_nothing() -> None:
    """The trigger asks at every step, whether a plan follows or not."""
    asked, silent = make(), make()
    for planner in (asked, silent):
        run(planner, 0, START)
    for step in (1, 2, 3, 40):
        start_of(asked, step)
    one, other = run(asked, 2, elsewhere(2)), run(silent, 2, elsewhere(2))
    np.testing.assert_array_equal(one.inputs, other.inputs)


@pytest.mark.parametrize("anew", ["gap", "forget"])
def test_vehicle_starts_anew_after_a_long_gap_or_when_forgotten(anew: str) -> None:
    """As a vehicle never seen before does, to the last bit."""
    used, step = make(), 3 + H
    for past in (0, 1, 2):
        run(used, past, elsewhere(past))
    if anew == "forget":
        used.forget(0)
        step = 3
    assert start_of(used, step)[1]
    one, other = run(used, step, START), run(make(), step, START)
    np.testing.assert_array_equal(one.inputs, other.inputs)


def test_plan_is_exactly_what_can_be_sent() -> None:
    """Inputs are float32 numbers, and X_p is predicted with those and no others."""
    planner = make()
    plan = run(planner, 0, START)
    np.testing.assert_array_equal(plan.inputs, plan.inputs.astype(np.float32))
    mpc = condense(MODEL, SCENARIO.control, change_weight=0.0)
    expected = np.empty_like(planner._generator.states)
    mpc.predict(START[None], planner._generator.inputs, CALM, expected, np.array([0]))
    np.testing.assert_array_equal(planner._generator.states, expected)


def test_batch_is_planned_as_its_singles() -> None:
    """Three vehicles at steps of their own, with gaps of their own, one of them new each time."""
    together, singles = make(5), [make() for _ in range(3)]
    rows = np.array([4, 0, 2])
    for steps in ([0, 100, 7], [1, 103, 7 + H], [2, 104, 9 + 3 * H]):
        estimates = np.stack([elsewhere(step) for step in steps])
        planned, fresh = together.planned(rows, np.array(steps), estimates)
        plan = together.plan(
            rows, np.array(steps), estimates, planned, fresh, np.zeros((len(rows), 2))
        )
        for i, single in enumerate(singles):
            alone = run(single, steps[i], estimates[i])
            np.testing.assert_array_equal(plan.inputs[i], alone.inputs[0])
            assert plan.solved[i] == alone.solved[0]


class Unable:
    """A solver that never finds an answer."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """See `server.solver.Solver`."""
        return guess.copy(), np.zeros(len(gradient), dtype=np.bool_)


def disable(problem: Successive) -> None:
    """Let every solve of a problem fail from here on, first solves included."""
    problem._solver = problem._first_solver = Unable()


def test_unsolved_vehicle_goes_on_with_its_shifted_horizon() -> None:
    """Both problems: what was planned at step 4 is flown on at 6, and X_p along with it."""
    planner = make()
    run(planner, 4, START)
    led, tracked = planner._generator.inputs.copy(), planner._tracker.inputs.copy()
    trajectory = planner._generator.states[0].copy()
    disable(planner._generator)
    disable(planner._tracker)
    plan = run(planner, 6, elsewhere(6))
    assert plan.solved.tolist() == [False]
    np.testing.assert_array_equal(plan.inputs, shift(tracked, np.array([2])))
    np.testing.assert_array_equal(planner._generator.inputs, shift(led, np.array([2])))
    np.testing.assert_allclose(
        planner._generator.states[0, :, :-2], trajectory[:, 2:], rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("name", ["_generator", "_tracker"])
def test_plan_is_good_only_if_both_problems_were_solved(name: str) -> None:
    """A trajectory that is no optimum is not worth tracking."""
    planner = make()
    disable(getattr(planner, name))
    assert run(planner, 0, START).solved.tolist() == [False]


def test_vehicle_without_any_plan_hovers() -> None:
    """Where even the first problem has no answer."""
    planner = make()
    disable(planner._generator)
    disable(planner._tracker)
    assert not run(planner, 0, START).inputs.any()


def test_first_plan_is_tried_again_until_it_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing was sent, so the next step is the first: an event (E18), without an S-term (E8)."""
    planner = make()
    with monkeypatch.context() as patch:
        for name in ("_solver", "_first_solver"):
            patch.setattr(planner._generator, name, Unable())
        run(planner, 0, START)
    assert start_of(planner, 1)[1]
    one, other = run(planner, 1, START), run(make(), 1, START)
    np.testing.assert_array_equal(one.inputs, other.inputs)


def test_estimate_that_is_not_finite_spoils_its_own_vehicle_and_step_alone() -> None:
    """The neighbour is planned for as ever, and it itself goes on, and is solved a step later."""
    planner, neighbour, rows = make(2), make(), np.array([0, 1])
    plans = []
    for step in (0, 1, 2):
        estimates = np.stack([elsewhere(step), elsewhere(step + 10)])
        alone = run(neighbour, step, estimates[1])
        estimates[0, 0, 0] = np.nan if step == 1 else estimates[0, 0, 0]
        planned, fresh = planner.planned(rows, np.full(2, step), estimates)
        plans.append(
            planner.plan(rows, np.full(2, step), estimates, planned, fresh, np.zeros((2, 2)))
        )
        np.testing.assert_array_equal(plans[-1].inputs[1], alone.inputs[0])
    assert [plan.solved.tolist() for plan in plans] == [[True, True], [False, True], [True, True]]
    shifted = shift(plans[0].inputs, np.array([1, 1]))
    np.testing.assert_array_equal(plans[1].inputs[0], shifted[0])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.integers(0, 3 * WINDOW), min_size=1, max_size=4), min_size=1, max_size=5)
)
def test_the_reference_looked_up_is_the_reference(calls: list[list[int]]) -> None:
    """To the last bit: forwards and backwards, near each other and hours apart."""
    reference = SCENARIO.make_reference()
    desired = Desired(reference, SCENARIO.control.dt, H)
    for steps in calls:
        expected = [reference((step + np.arange(H + 1)) * SCENARIO.control.dt) for step in steps]
        found = desired(np.array(steps)).transpose(0, 2, 1, 3)
        np.testing.assert_array_equal(found, expected)


def test_the_reference_is_computed_once_for_a_window_of_steps() -> None:
    """Steps within the window take the reference that was computed before."""
    asked = []

    def reference(times: Array) -> Array:
        asked.append(times)
        return SCENARIO.make_reference()(times)

    desired = Desired(reference, SCENARIO.control.dt, H)
    for step in range(WINDOW):
        desired(np.array([step]))
    assert len(asked) == 1
    desired(np.array([WINDOW]))
    desired(np.array([0, WINDOW]))
    assert [times.shape for times in asked] == [(WINDOW + H,), (WINDOW + H,), (2, H + 1)]
