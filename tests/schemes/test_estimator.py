"""Downlink delay compensator, eq. (12)-(13): x̂(k) predicted from an old state and inputs."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.server.controller import Controller
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.scheme import Foresight, empty_foresight
from skytether.server.schemes.feedback import feedback_gain
from skytether.server.schemes.predictive import Estimator
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Indices, discretise
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.protocol import NO_HORIZON, Mode, Observation
from skytether.sim.flight import fly

quick = settings(max_examples=20)

H, REACH = 3, 12
DT, TAU_S = 0.05, [0.81, 0.3]
MODEL = discretise(TAU_S, DT)
ROW = np.array([0])
SENT = np.array([True])
"""Mask of vehicles that are sent their horizon; (12) does not depend on it."""


def seen(step: int, state: Array) -> Observation:
    return Observation(1, 1, step, NO_HORIZON, 0, 0, 0, Mode.TRACK, 1, state, np.zeros(2))


def make(capacity: int = 1, *, compensate: bool = True) -> Estimator:
    flown = scenario("predictive" if compensate else "none")
    return Estimator(flown.terms(), flown.control, feedback_gain(flown), capacity)


def scenario(scheme: str, **control: Any) -> Scenario:
    """Network without delay; an observation may be twelve steps old."""
    direct = "loss(0.1)"
    raw = {
        "model": {"tau_s": TAU_S, "u_max": [1.6]},
        "control": {
            "dt": DT,
            "scheme": scheme,
            "feedback": False,
            "observer_s": 0.0,
            "trigger": "always",
            **control,
        },
        "network": {"uplink": direct, "downlink": direct},
        "link": {"age_max_s": REACH * DT},
    }
    return reading.check(raw, "test")


def computed(inputs: Array) -> Foresight:
    """Horizons that begin with these inputs [m/s; shape (n, axes)]."""
    found = empty_foresight(len(inputs), 2, H, 1)
    found.horizons[:] = inputs[:, :, None]
    return found


def remember(estimator: Estimator, inputs: Array, *, start: int = 0) -> None:
    """Remember û(start), û(start + 1), … of the only vehicle; inputs of shape (steps, axes)."""
    for step, u in enumerate(inputs, start):
        estimator.remember(ROW, np.array([step]), computed(u[None]), SENT)


def estimates(estimator: Estimator, rows: Indices, step: Indices) -> Array:
    """Estimates x̂(step), from which plans start, because d is 0."""
    found = empty_foresight(len(rows), 2, H, 1)
    estimator.foresee(rows, step, found)
    np.testing.assert_array_equal(found.start, found.estimate)
    assert not found.ahead.any()
    return found.estimate


def estimate(estimator: Estimator, step: int) -> Array:
    return estimates(estimator, ROW, np.array([step]))[0]


def flown(x: Array, inputs: Array) -> Array:
    for u in inputs:
        x = MODEL.step(x, u)
    return x


@pytest.mark.parametrize(
    ("age", "now"), [(0, 20), (1, 25), (5, 40), (REACH - 1, 25), (REACH, 24), (REACH, 40)]
)
def test_estimate_is_the_observation_flown_on(age: int, now: int) -> None:
    """(13) for τ = 0 … reach, at any position of the ring buffer."""
    rng = np.random.default_rng(age)
    inputs = rng.normal(size=(now, 2)).astype(np.float32).astype(np.float64)
    x = rng.normal(size=(2, 2))
    estimator = make()
    estimator.observe(0, seen(now - age, x))
    remember(estimator, inputs)
    assert now - estimator.observed_step.tolist()[0] == age
    expected = flown(x, inputs[now - age :])
    np.testing.assert_allclose(estimate(estimator, now), expected, rtol=0, atol=1e-13)


def test_input_of_the_present_step_does_not_count_yet() -> None:
    """Input û(k) acts from k on; x̂(k) is before it."""
    estimator = make()
    estimator.observe(0, seen(8, np.ones((2, 2))))
    remember(estimator, np.zeros((10, 2)))
    before = estimate(estimator, 10)
    remember(estimator, np.full((1, 2), 9.0), start=10)
    np.testing.assert_array_equal(estimate(estimator, 10), before)


def test_vehicle_hovers_before_anything_was_computed() -> None:
    estimator = make()
    x = np.array([[1.0, 2.0], [3.0, -4.0]])
    estimator.observe(0, seen(0, x))
    expected = flown(x, np.zeros((5, 2)))
    np.testing.assert_allclose(estimate(estimator, 5), expected, rtol=0, atol=1e-13)


def test_newest_observation_wins_after_reordering() -> None:
    estimator = make()
    states = {step: np.full((2, 2), float(step)) for step in (3, 5, 7)}
    kept = [estimator.observe(0, seen(step, states[step])) for step in (5, 3, 7, 7, 5)]
    assert kept == [True, False, True, False, False]
    assert estimator.observed_step.tolist() == [7]
    np.testing.assert_allclose(estimate(estimator, 7), states[7])


def test_estimate_keeps_its_own_copy_of_the_state() -> None:
    estimator, x = make(compensate=False), np.ones((2, 2))
    estimator.observe(0, seen(0, x))
    x[:] = 9.0
    estimate(estimator, 0)[:] = 9.0
    np.testing.assert_array_equal(estimate(estimator, 0), np.ones((2, 2)))


def test_missed_steps_are_remembered_too() -> None:
    """After steps 0, 1 and 5 the steps 2 … 4 were flown with û(1)."""
    u = np.array([[1.0, -1.0], [2.0, 0.5], [0.25, 0.75]])
    estimator = make()
    remember(estimator, u[:2])
    remember(estimator, u[2:], start=5)
    estimator.observe(0, seen(0, np.zeros((2, 2))))
    expected = flown(np.zeros((2, 2)), u[[0, 1, 1, 1, 1, 2]])
    np.testing.assert_allclose(estimate(estimator, 6), expected, rtol=0, atol=1e-13)


def test_gap_longer_than_the_ring_overwrites_all_of_it() -> None:
    """Û(19) along the gap, then û(k); filling is bounded by the ring's length."""
    estimator = make()
    remember(estimator, np.full((20, 2), 7.0))
    remember(estimator, np.array([[0.5, -0.5]]), start=10**12)
    estimator.observe(0, seen(10**12 + 1 - REACH, np.zeros((2, 2))))
    held = np.concatenate([np.full((REACH - 1, 2), 7.0), [[0.5, -0.5]]])
    expected = flown(np.zeros((2, 2)), held)
    np.testing.assert_allclose(estimate(estimator, 10**12 + 1), expected, rtol=0, atol=1e-13)


def test_estimate_right_after_a_gap_knows_no_input_of_a_ring_ago() -> None:
    """At step 23, with nothing computed since 20: û(21), û(22) are not the ring's old û(9), û(10).

    The vehicle held its input: û(20) is the best knowledge.
    """
    estimator = make()
    old, new = np.full((15, 2), 7.0), np.full((6, 2), 0.5)
    remember(estimator, np.concatenate([old, new]))
    estimator.observe(0, seen(20, np.zeros((2, 2))))
    expected = flown(np.zeros((2, 2)), np.tile([0.5, 0.5], (3, 1)))
    np.testing.assert_allclose(estimate(estimator, 23), expected, rtol=0, atol=1e-13)


def test_asking_for_estimates_changes_no_later_one() -> None:
    asked, silent = make(), make()
    for estimator in (asked, silent):
        remember(estimator, np.full((15, 2), 7.0))
        remember(estimator, np.array([[0.5, -0.5]]), start=15)
        estimator.observe(0, seen(14, np.ones((2, 2))))
    for step in (16, 17, 17, 19):
        estimate(asked, step)
    for estimator in (asked, silent):
        remember(estimator, np.array([[0.2, 0.9]]), start=20)
    np.testing.assert_array_equal(estimate(asked, 24), estimate(silent, 24))


def test_observation_from_ahead_is_taken_as_it_is() -> None:
    """If the clocks differ by a step there is nothing to predict."""
    estimator = make()
    remember(estimator, np.ones((10, 2)))
    x = np.array([[1.0, 2.0], [3.0, 4.0]])
    estimator.observe(0, seen(11, x))
    np.testing.assert_array_equal(estimate(estimator, 10), x)


def test_without_compensation_the_observation_is_the_estimate() -> None:
    estimator = make(compensate=False)
    x = np.array([[1.0, 2.0], [3.0, 4.0]])
    estimator.observe(0, seen(0, x))
    remember(estimator, np.ones((10, 2)))
    np.testing.assert_array_equal(estimate(estimator, 10), x)


def test_forgotten_vehicle_begins_again_at_step_zero() -> None:
    estimator = make(2)
    both, x = np.array([0, 1]), np.array([[1.0, 2.0], [3.0, 4.0]])
    for row in both:
        estimator.observe(row, seen(500, x))
    for step in range(480, 501):
        estimator.remember(both, np.full(2, step), computed(np.ones((2, 2))), SENT.repeat(2))
    estimator.forget(0)
    assert estimator.observed_step.tolist() == [-1, 500]
    assert estimator.observe(0, seen(0, x))
    here, there = estimates(estimator, both, np.array([3, 501]))
    np.testing.assert_allclose(here, flown(x, np.zeros((3, 2))), rtol=0, atol=1e-13)
    np.testing.assert_allclose(there, flown(x, np.ones((1, 2))), rtol=0, atol=1e-13)
    remember(estimator, np.array([[0.5, 0.75]]))
    expected = flown(x, np.array([[0.5, 0.75]]))
    np.testing.assert_allclose(estimate(estimator, 1), expected, rtol=0, atol=1e-13)


@quick
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.booleans())
def test_batch_is_estimated_as_its_singles(seed: int, vehicles: int, compensate: bool) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.permutation(8)[:vehicles]
    together = make(8, compensate=compensate)
    singles = [make(compensate=compensate) for _ in rows]
    step = rng.integers(0, 50, vehicles)
    for _ in range(30):
        step += rng.integers(1, 4, vehicles)
        u = rng.normal(size=(vehicles, 2)).astype(np.float32)
        together.remember(rows, step, computed(u), rng.random(vehicles) < 0.5)
        for i, single in enumerate(singles):
            single.remember(ROW, step[[i]], computed(u[[i]]), SENT)
    for i, (row, single) in enumerate(zip(rows, singles, strict=True)):
        x, observed = rng.normal(size=(2, 2)), int(step[i] + 1 - rng.integers(0, REACH + 1))
        together.observe(int(row), seen(observed, x))
        single.observe(0, seen(observed, x))
    expected = [estimate(single, int(k) + 1) for single, k in zip(singles, step, strict=True)]
    np.testing.assert_array_equal(estimates(together, rows, step + 1), expected)


# -- observer and feedback -----------------------------------------------------------------------


def told(step: int, state: Array, u: Array) -> Observation:
    return seen(step, state)._replace(input=u)


def watch(
    estimator: Estimator, wind: Array, every: int = 1, *, steps: int = 200, row: int = 0
) -> Array:
    """Disturbance estimated in steady wind with changing inputs, observed at some steps."""
    x, found = np.zeros((2, 2)), empty_foresight(1, 2, H, 1)
    for step in range(steps):
        u = 0.2 * np.array([np.sin(0.1 * step), np.cos(0.1 * step)])
        if step % every == 0:
            estimator.observe(row, told(step, x, u))
            estimator.foresee(np.array([row]), np.array([step]), found)
        x = MODEL.step(x, u + wind)
    return found.disturbance[0]


def learning(scheme: str = "predictive", **control: Any) -> Estimator:
    """Estimator of two vehicles with an observer of half a second."""
    flown = scenario(scheme, observer_s=0.5, **control)
    return Estimator(flown.terms(), flown.control, feedback_gain(flown), 2)


WIND = np.array([0.3, -0.2])


@pytest.mark.parametrize("every", [1, 5])
def test_a_disturbance_is_learned_from_the_inputs_that_were_flown(every: int) -> None:
    """From the reported inputs, interpolated between two observations; û has no part in it."""
    estimator = learning()
    remember(estimator, np.full((200, 2), 9.0))
    np.testing.assert_allclose(watch(estimator, WIND, every), WIND, atol=5e-3)


def test_where_there_is_none_none_is_learned() -> None:
    """With changing inputs; exact to rounding, because every step is observed."""
    np.testing.assert_allclose(watch(learning(), 0.0 * WIND), 0.0, atol=1e-9)


def test_observations_far_apart_teach_nothing() -> None:
    assert not watch(learning(), WIND, 6).any()


def test_the_disturbance_is_flown_on_with_every_input() -> None:
    """Eq. (13) with u + w in place of u."""
    estimator = learning()
    w, x = watch(estimator, WIND), np.ones((2, 2))
    estimator.observe(0, told(300, x, np.zeros(2)))  # too late to learn from
    remember(estimator, np.full((5, 2), 0.5), start=300)
    expected = flown(x, np.full((5, 2), 0.5) + w)
    np.testing.assert_allclose(estimates(estimator, ROW, np.array([305]))[0], expected, atol=1e-12)


def test_what_was_learned_is_forgotten_with_the_vehicle() -> None:
    estimator, found = learning(), empty_foresight(2, 2, H, 1)
    for row in (0, 1):
        watch(estimator, WIND, row=row)
    estimator.forget(0)
    for row, step in ((0, 5), (1, 300)):
        estimator.observe(row, told(step, np.ones((2, 2)), np.zeros(2)))
    estimator.foresee(np.array([0, 1]), np.array([5, 300]), found)
    np.testing.assert_allclose(found.disturbance, [0.0 * WIND, WIND], atol=2e-3)


def test_without_compensation_nothing_is_learned() -> None:
    assert not watch(learning("none"), WIND).any()


def test_feedback_leads_on_from_where_the_vehicle_is_now() -> None:
    """From x̂(k), with the disturbance and the gain."""
    firm: dict[str, Any] = {"feedback": True, "input_weight": 0.01}
    estimator, found = learning(**firm), empty_foresight(1, 2, H, 1)
    w = watch(estimator, WIND)
    estimator.observe(0, told(199, np.ones((2, 2)), np.zeros(2)))
    estimator.foresee(ROW, np.array([203]), found)
    gain = feedback_gain(scenario("predictive", **firm))
    expected = np.column_stack([found.estimate[0], w, gain])
    np.testing.assert_array_equal(found.feedback[0], expected.astype(np.float32))
    assert (gain > 1.0).all()


@pytest.mark.long
def test_the_paper_s_scheme_flies_better_with_observer_and_with_feedback() -> None:
    """The observer compensates steady wind, feedback compensates noise."""

    def rmse(wind: dict[str, Any], **control: Any) -> float:
        """RMSE of 25 s with a packet at every step [m]."""
        table = reading.to_table(reading.load("paper-every-step")) | {"duration": 25.0}
        table["control"] |= control
        table["vehicle"] |= wind
        windy = reading.check(table, "test")
        error = summarise(windy, "test", fly(windy).client).rmse_xy
        assert error is not None
        return error

    steady, white = {"steady_wind_mps": WIND.tolist()}, {"wind": 0.1}
    assert rmse(steady) > 1.0
    assert rmse(steady, observer_s=2.0) < 0.4
    assert rmse(steady, observer_s=2.0, feedback=True) < 0.15
    assert rmse(white) > 0.18
    assert rmse(white, feedback=True) < 0.12


# -- age of observations -------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["none", "predictive", "committed"])
def controller(request: pytest.FixtureRequest) -> Controller:
    table = reading.to_table(reading.load("paper"))
    table["control"] = {**table["control"], "scheme": request.param, "dt": 0.05}
    flown = reading.check(table, "test")
    return Controller(flown, flown.terms(), 1, ClockMap(1, flown.dt_ns), Stopwatch())


def is_able(controller: Controller, step: int) -> bool:
    rows, steps = controller.able(ROW, np.array([step]))
    assert rows.tolist() in ([], ROW.tolist())
    assert steps.tolist() == [step] * len(rows)
    return len(rows) > 0


@pytest.mark.parametrize(
    ("observed", "now", "able"), [(5, 5, True), (5, 105, True), (5, 106, False), (120, 106, True)]
)
def test_old_observations_are_out_of_reach(
    controller: Controller, observed: int, now: int, *, able: bool
) -> None:
    """Five seconds are allowed, a step more is not; an observation from the future is new."""
    controller.forget(0)
    controller.observe(0, seen(observed, np.zeros((2, 2))))
    assert is_able(controller, now) == able


def test_vehicle_that_was_never_observed_is_out_of_reach(controller: Controller) -> None:
    controller.observe(0, seen(7, np.zeros((2, 2))))
    controller.forget(0)
    assert [is_able(controller, step) for step in (0, 7)] == [False, False]


def test_every_step_is_decided_once(controller: Controller) -> None:
    controller.forget(0)
    controller.observe(0, seen(5, np.zeros((2, 2))))
    controller.decide(ROW, np.array([7]))
    assert [is_able(controller, step) for step in (6, 7, 8)] == [False, False, True]
