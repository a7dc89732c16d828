"""Trajectory generator (14) and tracker (15).

`OnPaper` is an independent version of section 4.1 for one vehicle, with a dense solver.
"""

from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

import skytether.server.mpc.hierarchical
from bench.problems import gradients, listening, solving
from skytether.server.controller import BLOCK
from skytether.server.mpc.appraisal import GENERATOR, TRACKER
from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.hierarchical import PlanBatch, Planner
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import FIRST, LATER, Problem, make_mpc, pose
from skytether.server.mpc.riccati import RiccatiWorkspace
from skytether.server.planning.desired import Desired
from skytether.server.planning.scheme import FIGURES, Figures, Foresight, empty_foresight
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario

H = 15
SCENARIO = check(
    {
        "model": {"tau_s": [0.81, 0.3], "u_max": [1.8, 1.0]},
        "control": {
            "horizon": H,
            "scheme": "committed",
            "trigger": "cost_gap | silence(1)",
            "state_weight": [7.1, 14.0],
            "terminal_weight": [73.0, 555.0],
            "input_weight": 1.8,
            "change_weight": 5.0,
        },
        "reference": {"shape": "circle", "radius_m": 1.5, "period_s": 7.0},
    },
    "test",
)
"""Two different axes, one of them too slow for its circle, and a noticeable S-term."""
TERMS = SCENARIO.terms()
MODEL = TERMS.model
START = np.array([[1.2, 0.3], [-0.4, 0.8]])
CALM = np.zeros((1, 2))


def problem(which: int) -> Problem:
    return pose(MODEL, make_mpc(TERMS, SCENARIO.control), which)


def make(capacity: int = 1, scenario: Scenario = SCENARIO) -> Planner:
    terms = scenario.terms()
    desired = Desired(scenario, terms, capacity, capacity)
    return Planner(scenario.control, terms, desired, capacity, capacity, Stopwatch())


class Plan(NamedTuple):
    """Copy of a planner's results for n vehicles, and of its memory of them."""

    inputs: Array
    """U(k) of generator and tracker [m/s]; shape (2, n, axes, H)."""
    states: Array
    """X(k) of the generator, from its initial state on [m, m/s]; shape (n, axes, H + 1, 2)."""
    step: Indices
    """First step of the plans, or -1; shape (n,)."""
    planned: Array
    """Planned state x_p(k|k-1) [m, m/s]; shape (n, axes, 2)."""
    figures: Figures
    horizons: Array
    """Horizons that may be sent [m/s]; shape (n, axes, 2 H)."""

    @property
    def tracked(self) -> Array:
        """U(k) of the tracker [m/s]; shape (n, axes, H)."""
        return self.inputs[TRACKER]

    @property
    def led(self) -> Array:
        """U(k) of the generator [m/s]; shape (n, axes, H)."""
        return self.inputs[GENERATOR]


def plan(planner: Planner, rows: Indices, step: Indices, found: Foresight) -> Plan:
    planner.plan(rows, step, found)
    memory, n = planner._memory, len(rows)
    inputs = memory.inputs[:, rows].astype(float)
    figures = planner.figures[:n].copy()
    figures["row"] = 0  # a plan must not depend on the vehicle's row
    figures["gap"][figures["fresh"]] = 0
    return Plan(
        inputs,
        np.stack([fly(*led) for led in zip(memory.start[rows], inputs[GENERATOR], strict=True)]),
        memory.step[rows].copy(),
        planner.planned[:n].copy(),
        figures,
        found.horizons[:n].copy(),
    )


def seen(estimates: Array) -> Foresight:
    found = empty_foresight(len(estimates), 2, H, H)
    found.start[:] = estimates
    return found


def run(planner: Planner, step: int, estimate: Array) -> Plan:
    return plan(planner, np.array([0]), np.array([step]), seen(estimate[None]))


def elsewhere(step: int) -> Array:
    return START + np.random.default_rng(step).normal(scale=0.2, size=(2, 2))


def same(one: Plan, other: Plan) -> None:
    for mine, yours in zip(one, other, strict=True):
        for name in FIGURES.names if mine.dtype == FIGURES else (...,):
            np.testing.assert_array_equal(mine[name], yours[name])


def shift(inputs: Array, gap: int) -> Array:
    """Horizons shifted by some steps (11); shape (..., H)."""
    return inputs[..., np.minimum(np.arange(H) + gap, H - 1)]


def fly(x: Array, u: Array) -> Array:
    """State x, and the states that follow with H inputs; shape (axes, H + 1, 2)."""
    states = [x]
    for stage in range(H):
        states.append(MODEL.step(states[-1], u[:, stage]))
    return np.stack(states, axis=1)


class OnPaper:
    def __init__(self) -> None:
        self.step: int | None = None
        self.led, self.tracked = np.zeros((2, 2, H))
        self.trajectory = np.zeros((2, H + 1, 2))

    def plan(self, step: int, estimate: Array, wind: Array) -> Array:
        """U(k) of the tracker; sets `led` and `trajectory` of the generator."""
        gap = H + 1 if self.step is None else step - self.step
        which = FIRST if gap > H else LATER
        start = estimate if gap > H else self.trajectory[:, gap]
        times = SCENARIO.control.dt * (step + np.arange(H + 1))
        desired = SCENARIO.make_reference()(times).transpose(1, 0, 2)
        self.led = self._solve(which, start, desired, shift(self.led, gap), CALM)
        self.trajectory = fly(start, self.led)
        before = shift(self.tracked, gap)
        self.tracked = self._solve(which, estimate, self.trajectory, before, wind[None])
        self.step = step
        return self.tracked

    def _solve(self, which: int, x: Array, target: Array, previous: Array, wind: Array) -> Array:
        posed = problem(which)
        gradient = gradients(posed, x[None], target[None], previous[None], wind)[0]
        answers = []
        for hessian, g, bound in zip(posed.hessian, gradient, posed.mpc.bounds, strict=True):
            L = np.linalg.cholesky(hessian)
            box = (-bound, bound)
            answers.append(lsq_linear(L.T, -np.linalg.solve(L, g), box, "bvls", tol=1e-14).x)
        return np.array(answers)


def test_planner_solves_the_papers_two_problems() -> None:
    planner, paper, wind = make(), OnPaper(), np.array([0.1, -0.2])
    for step in (0, 1, 3, 3 + H, 4 + 2 * H):
        found = seen(elsewhere(step)[None])
        found.disturbance[:] = wind
        made = plan(planner, np.array([0]), np.array([step]), found)
        expected = paper.plan(step, elsewhere(step), wind)
        assert made.figures["solved"].tolist() == [True]
        np.testing.assert_allclose(made.tracked[0], expected, rtol=0, atol=2e-6)
        np.testing.assert_allclose(made.led[0], paper.led, rtol=0, atol=2e-6)
        np.testing.assert_allclose(made.states[0], paper.trajectory, atol=2e-6)


def test_first_plan_starts_from_the_estimate() -> None:
    made = run(make(), 7, START)
    assert made.figures["fresh"].tolist() == [True]
    np.testing.assert_array_equal(made.planned[0], START)


def test_first_plan_has_no_change_term() -> None:
    """E8: S = 0, which differs from S on a previous horizon of zeros."""
    desired = SCENARIO.make_reference()(SCENARIO.control.dt * np.arange(H + 1))
    target, still = desired.transpose(1, 0, 2)[None], np.zeros((1, 2, H))

    def best(which: int) -> Array:
        gradient = gradients(problem(which), START[None], target, still, CALM)
        return OsqpSolver(problem(which)).solve(gradient, still)[0]

    led = run(make(), 0, START).led
    np.testing.assert_allclose(led, best(FIRST), rtol=0, atol=1e-6)
    assert np.abs(led - best(LATER)).max() > 0.05


@pytest.mark.parametrize("gap", [1, 3, H])
def test_generator_goes_on_from_its_own_prediction(gap: int) -> None:
    """Initial state x_p(k|k-1) ∈ X_p(k-1): the state after the inputs of the steps passed."""
    planner = make()
    before = run(planner, 10, START)
    made = run(planner, 10 + gap, elsewhere(gap))
    assert made.figures["fresh"].tolist() == [False]
    expected = fly(START, before.led[0])[:, gap]
    np.testing.assert_allclose(made.planned[0], expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(made.planned[0], before.states[0, :, gap])


def test_generator_never_looks_at_the_vehicle_again() -> None:
    """E17: two vehicles with one start have the same X_p for ever, whatever their states."""
    one, other = make(), make()
    run(one, 0, START)
    run(other, 0, START)
    for step in (1, 2, 4):
        mine, yours = run(one, step, elsewhere(step)), run(other, step, -elsewhere(step))
        np.testing.assert_array_equal(mine.states, yours.states)
        assert np.abs(mine.tracked - yours.tracked).max() > 0.5


def test_tracker_follows_all_of_the_trajectory() -> None:
    """E9: without a weight on inputs, a vehicle on X_p stays on X_p at every stage."""
    free = {
        "horizon": H,
        "change_weight": 0.0,
        "input_weight": 1e-6,
        "state_weight": [7.1, 14.0],
        "terminal_weight": [73.0, 555.0],
    }
    raw = {"model": {"tau_s": [0.81, 0.3], "u_max": [3.0]}, "control": free}
    made = run(make(scenario=check(raw, "test")), 0, START)
    trajectory = made.states[0]
    assert np.abs(trajectory[:, -1] - trajectory[:, 0]).max() > 0.3
    np.testing.assert_allclose(fly(START, made.tracked[0]), trajectory, rtol=0, atol=1e-5)


@pytest.mark.parametrize("anew", ["gap", "forget"])
def test_vehicle_starts_anew_after_a_long_gap_or_when_forgotten(anew: str) -> None:
    used, step = make(), 3 + H
    for past in (0, 1, 2):
        run(used, past, elsewhere(past))
    if anew == "forget":
        used.forget(0)
        step = 3
    made = run(used, step, START)
    assert made.figures["fresh"].tolist() == [True]
    same(made, run(make(), step, START))


def test_plan_is_exactly_what_can_be_sent() -> None:
    """Inputs are float32 numbers, and X_p is predicted with exactly these."""
    planner = make()
    made, then = run(planner, 0, START), run(planner, H, START)
    np.testing.assert_array_equal(made.horizons[:, :, :H], made.tracked)
    np.testing.assert_array_equal(then.planned[0], fly(START, made.led[0])[:, H])


@pytest.mark.parametrize("solver", ["exact", "osqp"])
def test_batch_is_planned_as_its_singles(solver: str) -> None:
    control = msgspec.structs.replace(SCENARIO.control, solver=solver)
    scenario = msgspec.structs.replace(SCENARIO, control=control)
    together, singles = make(5, scenario), [make(scenario=scenario) for _ in range(3)]
    rows = np.array([4, 0, 2])
    for steps in ([0, 100, 7], [1, 103, 7 + H], [2, 104, 9 + 3 * H]):
        estimates = np.stack([elsewhere(step) for step in steps])
        made = plan(together, rows, np.array(steps), seen(estimates))
        for i, single in enumerate(singles):
            alone, one = run(single, steps[i], estimates[i]), slice(i, i + 1)
            same(Plan(made.inputs[:, one], *(field[one] for field in made[1:])), alone)


def crowd(rng: np.random.Generator, ahead: Indices) -> Foresight:
    """Foresight of vehicles beside the circle, with random inputs and disturbances."""
    n = len(ahead)
    found = empty_foresight(n, 2, H, H)
    found.ahead[:] = ahead
    found.start[:] = START + rng.normal(scale=2.0, size=found.start.shape)
    for field in (found.committed, found.held):
        field[:] = rng.uniform(-1.0, 1.0, size=field.shape)
    found.disturbance[:] = rng.normal(scale=0.2, size=(n, 2))
    return found


def cost_of(found: Foresight, target: Array, told: Array, inputs: Array) -> float:
    """Twice the cost (9) of the tracker's inputs, over the states 1 … H and both axes."""
    weights, wind = make_mpc(TERMS, SCENARIO.control).weights, found.disturbance[0][:, None]
    off = fly(found.start[0], inputs + wind)[:, 1:] - target[:, 1:]
    fast = inputs + wind - target[:, :-1, 1]
    cost = (off**2 * weights.states).sum() + weights.input * (fast**2).sum()
    return float(cost + (weights.changes[LATER] * (inputs - told) ** 2).sum())


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, H), st.integers(0, H))
def test_figures_are_what_they_are_called(seed: int, gap: int, d: int) -> None:
    """V of (16), the additional cost of keeping the old plan, and its deviation."""
    rng, rows, planner = np.random.default_rng(seed), np.array([2]), make(3)
    before = plan(planner, rows, np.array([40 - d]), crowd(rng, np.array([d])))
    found = crowd(rng, np.array([d]))
    made = plan(planner, rows, np.array([40 - d + gap]), found)
    (figures,), off = made.figures, found.start[0] - before.states[0, :, gap]
    P = np.array(SCENARIO.control.terminal_weight)
    assert (figures["step"], figures["fresh"], figures["solved"]) == (40 - d + gap, False, True)
    assert figures["state_gap"] == pytest.approx((off**2 @ P).sum())
    target, told = made.states[0], shift(before.tracked[0], gap)
    cost = cost_of(found, target, told, found.held[0]) - cost_of(
        found, target, told, made.tracked[0]
    )
    assert figures["cost_gap"] == pytest.approx(cost, rel=1e-4)
    flown = fly(found.start[0], found.held[0] + found.disturbance[0][:, None])
    away = flown[:, : H + 1 - gap, 0] - before.states[0, :, gap:, 0]
    assert figures["deviation_m"] == pytest.approx(np.linalg.norm(away, axis=0).max())
    committed = found.committed[:, :, :d].astype(np.float32)
    np.testing.assert_array_equal(made.horizons[:, :, :d], committed)
    np.testing.assert_array_equal(made.horizons[:, :, d : d + H], made.tracked)


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.1, 0.05), (0.3, 0.7)])
def test_expected_gap_weighs_what_flying_on_costs_where_packets_are_lost(
    shares: tuple[float, float],
) -> None:
    """Each case weighted with its probability; with no loss, the plain gap."""
    rng, rows, planner = np.random.default_rng(7), np.array([0]), make()
    before = plan(planner, rows, np.array([40]), crowd(rng, np.array([0])))
    found = crowd(rng, np.array([0]))._replace(
        loss_probability=np.array([shares]),
        inputs_if_lost=rng.uniform(-1.0, 1.0, size=(1, 2, 2, H)),
        start_if_lost=np.zeros((1, 2, 2, 2)),
    )
    found.start_if_lost[:] = found.start[:, None]
    made = plan(planner, rows, np.array([41]), found)
    target, told = made.states[0], shift(before.tracked[0], 1)
    best = cost_of(found, target, told, made.tracked[0])
    gaps = [cost_of(found, target, told, inputs) - best for inputs in found.inputs_if_lost[0]]
    (figures,) = made.figures
    expected = (1.0 - sum(shares)) * figures["cost_gap"] + np.dot(shares, gaps)
    assert figures["expected_gap"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("flown", [0, H - 3, H])
def test_inputs_that_are_never_flown_are_not_compared(flown: int) -> None:
    rng, rows = np.random.default_rng(7), np.array([0])
    first, found = crowd(rng, np.array([0])), crowd(rng, np.array([0]))
    found = found._replace(
        loss_probability=np.array([[0.2]]),
        inputs_if_lost=rng.uniform(-1.0, 1.0, size=(1, 1, 2, H)),
        start_if_lost=np.zeros((1, 1, 2, 2)),
    )
    found.usable[:] = flown

    def figures() -> Any:
        planner = make()
        plan(planner, rows, np.array([40]), first)
        return plan(planner, rows, np.array([41]), found).figures[0]

    before = figures()
    for inputs in (found.held, found.inputs_if_lost):
        inputs[..., flown:] += 0.5
    assert figures() == before
    if flown:
        for inputs in (found.held, found.inputs_if_lost):
            inputs[..., 0] += 0.5
        assert figures()["cost_gap"] != before["cost_gap"]
        assert figures()["expected_gap"] != before["expected_gap"]


@pytest.mark.parametrize("first", [True, False])
def test_figures_that_compare_with_nothing_are_zero(first: bool) -> None:
    """V and deviation at a first step; with "predictive", those compared with the sent horizon."""
    control = msgspec.structs.replace(SCENARIO.control, scheme="predictive")
    scenario = SCENARIO if first else msgspec.structs.replace(SCENARIO, control=control)
    planner, rng, rows = make(scenario=scenario), np.random.default_rng(1), np.array([0])
    if not first:
        run(planner, 0, START)
    (figures,) = plan(planner, rows, np.array([1]), crowd(rng, np.array([0]))).figures
    assert (figures["state_gap"] == 0.0, figures["cost_gap"] == 0.0) == (first, not first)
    assert figures["deviation_m"] == 0.0


ROUGH = {
    "model": {"tau_s": [0.4, 0.6], "u_max": [1.8, 1.0]},
    "control": {"dt": 0.1, "horizon": H, "input_weight": 1e-3, "state_weight": [10.0, 1.0]},
    "reference": {"shape": "square", "radius_m": 1.5, "period_s": 4.0},
}
"""Long steps, hardly any weight of the input, and a path with corners."""


compiled_pass = skytether.server.mpc.hierarchical._plan


def leaving(batch: PlanBatch, rows: Indices, steps: Indices, work: RiccatiWorkspace) -> int:
    """Plan with the compiled pass, but leave every third vehicle unsolved, with its memory."""
    left, memory = rows[::3], batch.memory
    before = memory.inputs[:, left], memory.start[left], memory.step[left]
    compiled_pass(batch, rows, steps, work)
    memory.inputs[:, left], memory.start[left], memory.step[left] = before
    batch.figures["solved"][: len(rows) : 3] = False
    return len(left)


PREDICTIVE = {**ROUGH["control"], "scheme": "predictive", "trigger": "always"}


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(SCENARIO, id="smooth"),
        pytest.param(check(ROUGH, "test"), id="rough"),
        pytest.param(check({**ROUGH, "control": PREDICTIVE}, "test"), id="predictive"),
    ],
)
@pytest.mark.parametrize("leaves", [False, True])
def test_compiled_pass_has_the_bits_of_the_moves_around_a_solver(
    monkeypatch: pytest.MonkeyPatch, scenario: Scenario, leaves: bool
) -> None:
    """Over new vehicles, gaps of all lengths, disturbances, and NaN estimates.

    The vehicles that the pass leaves unsolved have the same result.
    """
    if leaves:
        monkeypatch.setattr(skytether.server.mpc.hierarchical, "_plan", leaving)
    rng, capacity = np.random.default_rng(0), 30
    compiled = make(capacity, scenario)
    with listening() as listeners:
        around = make(capacity, scenario)
    starts, unsolved, fresh = rng.integers(100, 2000, capacity), 0, 0
    for _ in range(12):
        rows = rng.permutation(capacity)[: rng.integers(1, capacity + 1)]
        starts[rows] += rng.choice([0, 1, 2, 7, H, H + 1, 40], len(rows))
        for row in rng.permutation(capacity)[:2]:
            compiled.forget(row)
            around.forget(row)
        ahead = rng.integers(0, H + 1, len(rows))
        found = crowd(rng, ahead)
        found.start[rng.random(len(rows)) < 0.05, rng.integers(2), 0] = np.nan
        other = Foresight(*(field.copy() for field in found[:-1]), found.splines)
        one = plan(compiled, rows, starts[rows] - ahead, found)
        same(one, plan(around, rows, starts[rows] - ahead, other))
        unsolved += np.count_nonzero(~one.figures["solved"])
        fresh += np.count_nonzero(one.figures["fresh"])
    for mine, yours in zip(compiled._memory[:3], around._memory[:3], strict=True):
        np.testing.assert_array_equal(mine, yours)
    assert min(unsolved, fresh) > 0
    assert all(len(listener.recorded()[0][0]) > 0 for listener in listeners)


class Faulty:
    """Exact solver that fails for generator or tracker, which call it alternately."""

    def __init__(self, posed: Problem, fails: set[int]) -> None:
        self._exact = ExactSolver(posed)
        self._fails = fails
        self._asks = TRACKER

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        self._asks = TRACKER if self._asks == GENERATOR else GENERATOR
        if self._asks in self._fails:
            return guess.copy(), np.zeros(len(gradient), dtype=np.bool_)
        return self._exact.solve(gradient, guess)


def make_faulty(fails: set[int]) -> Planner:
    """Planner whose solver fails for the problems that `fails` contains at the time."""
    with solving(lambda posed: Faulty(posed, fails)):
        return make()


def test_unsolved_vehicle_goes_on_with_its_shifted_horizon() -> None:
    """Both problems: the plan of step 4 is continued at step 6, and X_p too."""
    fails: set[int] = set()
    planner = make_faulty(fails)
    before = run(planner, 4, START)
    fails |= {GENERATOR, TRACKER}
    made = run(planner, 6, elsewhere(6))
    assert made.figures["solved"].tolist() == [False]
    np.testing.assert_array_equal(made.inputs, shift(before.inputs, 2))
    np.testing.assert_allclose(made.states[0, :, :-2], before.states[0, :, 2:], rtol=0, atol=1e-13)


@pytest.mark.parametrize("who", [GENERATOR, TRACKER])
def test_plan_is_good_only_if_both_problems_were_solved(who: int) -> None:
    assert run(make_faulty({who}), 0, START).figures["solved"].tolist() == [False]


def test_vehicle_without_any_plan_hovers() -> None:
    assert not run(make_faulty({GENERATOR, TRACKER}), 0, START).tracked.any()


def test_first_plan_is_tried_again_until_it_is_solved() -> None:
    """Nothing was sent, so the next step is the first: an event (E18), no S-term (E8)."""
    fails = {GENERATOR}
    planner = make_faulty(fails)
    run(planner, 0, START)
    fails.clear()
    made = run(planner, 1, START)
    assert made.figures["fresh"].tolist() == [True]
    same(made, run(make(), 1, START))


def test_estimate_that_is_not_finite_spoils_its_own_vehicle_and_step_alone() -> None:
    planner, neighbour, rows = make(2), make(), np.array([0, 1])
    plans = []
    for step in (0, 1, 2):
        estimates = np.stack([elsewhere(step), elsewhere(step + 10)])
        alone = run(neighbour, step, estimates[1])
        estimates[0, 0, 0] = np.nan if step == 1 else estimates[0, 0, 0]
        plans.append(plan(planner, rows, np.full(2, step), seen(estimates)))
        np.testing.assert_array_equal(plans[-1].tracked[1], alone.tracked[0])
    solved = [made.figures["solved"].tolist() for made in plans]
    assert solved == [[True, True], [False, True], [True, True]]
    np.testing.assert_array_equal(plans[1].tracked[0], shift(plans[0].tracked[0], 1))


def hours_apart(rng: np.random.Generator) -> Indices:
    """Steps of a full block of vehicles, spread over a day: more pages than places."""
    return rng.integers(0, 86_400 / SCENARIO.control.dt, BLOCK)


def test_vehicles_hours_apart_are_planned_for_as_if_alone() -> None:
    """To the last bit, over steps in which pages come and go."""
    together, singles = make(BLOCK), {row: make() for row in (0, 50, BLOCK - 1)}
    rng, rows = np.random.default_rng(2), np.arange(BLOCK)
    steps = hours_apart(rng)
    for _ in range(4):
        steps += hours_apart(rng) + 2
        for step in (steps, steps + 1):
            found = crowd(rng, np.zeros(BLOCK, dtype=np.int64))
            made = plan(together, rows, step, found)
            for row, single in singles.items():
                one = Foresight(
                    *(field[row : row + 1].copy() for field in found[:-1]), found.splines
                )
                alone = plan(single, np.array([0]), step[row : row + 1], one)
                np.testing.assert_array_equal(made.inputs[:, row], alone.inputs[:, 0])
                np.testing.assert_array_equal(made.states[row], alone.states[0])
