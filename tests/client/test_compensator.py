"""Uplink delay compensator, eq. (11): the horizon in force, and the input computed aboard."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import interpreted
from skytether.client.compensator import Compensator
from skytether.shared.law import rule
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reading import check
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import FEEDBACK, NO_HORIZON, Horizon, Trajectory

quick = settings(max_examples=20)

H = 10
INPUTS = np.array([np.linspace(0.1, 1.0, H), np.linspace(-0.5, 0.5, H)])
HERE = np.zeros((2, 2))
"""State for tests without feedback, where it has no effect."""


def terms(*, scheme: str = "predictive", exhausted: str = "hold", feedback: bool = False) -> Terms:
    """Ten stages of 0.1 s, a network without delay, an age bound of 50 steps."""
    direction = "loss(0.1)"
    return check(
        {
            "model": {"u_max": [1.8, 0.9]},
            "control": {
                "dt": 0.1,
                "horizon": H,
                "scheme": scheme,
                "feedback": feedback,
                "trigger": "always",
            },
            "vehicle": {"exhausted": exhausted, "brake_mps2": 2.0},
            "network": {"uplink": direction, "downlink": direction},
        },
        "test",
    ).terms()


def horizon(step: int, inputs: Array = INPUTS) -> Horizon:
    return Horizon(1, 1, step, 0, 0, inputs.astype(np.float32))


def holding(step: int, inputs: Array = INPUTS, **keys: str) -> Compensator:
    compensator = Compensator(terms(**keys))
    compensator.offer(horizon(step, inputs), step + 1, step)
    return compensator


def chosen(compensator: Compensator, step: int, state: Array) -> Array:
    return np.array(compensator.choose(step, state, np.zeros(2), np.zeros(2))[0])


def told(compensator: Compensator, step: int, state: Array) -> Array:
    """Part of the input that is not feedback."""
    return np.array(compensator.choose(step, state, np.zeros(2), np.zeros(2))[1])


def test_vehicle_hovers_before_its_first_horizon() -> None:
    compensator = Compensator(terms())
    assert compensator.in_force == NO_HORIZON
    assert chosen(compensator, 0, HERE).tolist() == [0.0, 0.0]
    assert chosen(compensator, 1000, HERE).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("exhausted", ["hold", "brake"])
@pytest.mark.parametrize("stage", [-4, 0, 1, H - 1])
def test_stage_is_the_step_since_the_horizon_was_made(stage: int, exhausted: str) -> None:
    """Input u(k|k_h); if the server's step is ahead, the first input."""
    compensator = Compensator(terms(exhausted=exhausted))
    compensator.offer(horizon(100), 95, 94)
    flown = chosen(compensator, 100 + stage, HERE)
    np.testing.assert_allclose(flown, INPUTS[:, max(stage, 0)], rtol=1e-7)


@pytest.mark.parametrize("step", [100 + H, 101 + H, 100_000])
def test_held_horizon_flies_its_last_input_for_ever(step: int) -> None:
    """E10: the paper's min(k, k_h + H - 1)."""
    np.testing.assert_allclose(chosen(holding(100), step, HERE), INPUTS[:, -1], rtol=1e-7)


def test_brake_takes_the_speed_away_at_its_rate() -> None:
    """1.0 m/s at 2 m/s² in steps of 0.1 s: 0.8, 0.6 … 0, then hovering."""
    compensator = holding(0, np.tile([[0.6], [0.8]], H), exhausted="brake")
    speeds = [float(np.linalg.norm(chosen(compensator, H + i, HERE))) for i in range(8)]
    assert speeds == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.0, 0.0, 0.0, 0.0], abs=1e-7)


@quick
@given(st.floats(-1.8, 1.8), st.floats(-0.9, 0.9), st.integers(0, 40))
def test_brake_goes_straight_and_never_back(x: float, y: float, later: int) -> None:
    compensator = holding(0, np.tile([[x], [y]], H), exhausted="brake")
    last, now, then = (chosen(compensator, H - 1 + i, HERE) for i in (0, later, later + 1))
    assert last[0] * now[1] == pytest.approx(last[1] * now[0], abs=1e-12)
    assert float(last @ now) >= 0.0
    lost = np.linalg.norm(now) - np.linalg.norm(then)
    assert -1e-12 <= lost <= 0.2 + 1e-12
    assert chosen(compensator, H + 10, HERE).tolist() == [0.0, 0.0]


def test_stale_horizon_is_ignored_after_reordering() -> None:
    """E11: the newest horizon stays in force; older ones are counted and dropped."""
    compensator = Compensator(terms())
    for made in (10, 12, 11, 12, 10):
        new = horizon(made, INPUTS + 0.01 * (made - 10))
        compensator.offer(new, 14, made - 1)
    assert (compensator.in_force, compensator.observed, compensator.stale) == (12, 11, 3)
    np.testing.assert_allclose(chosen(compensator, 14, HERE), INPUTS[:, 2] + 0.02, rtol=1e-6)


@quick
@given(st.permutations(range(5)), st.integers(4, 12))
def test_order_of_arrival_does_not_matter(order: list[int], step: int) -> None:
    compensator = Compensator(terms())
    for made in order:
        compensator.offer(horizon(made, INPUTS * 0.1 * (made + 1)), 4, 0)
    expected = INPUTS[:, min(step - 4, H - 1)] * 0.5
    np.testing.assert_allclose(chosen(compensator, step, HERE), expected, rtol=1e-6)


@pytest.mark.parametrize("exhausted", ["hold", "brake"])
@pytest.mark.parametrize("step", [7, 12, 58])
def test_without_compensation_the_newest_first_input_is_flown(step: int, exhausted: str) -> None:
    """Until the age bound, 5 s after step 8; the rest of the horizon is ignored."""
    compensator = holding(5, scheme="none", exhausted=exhausted)
    compensator.offer(horizon(7, INPUTS + 0.2), 9, 8)
    compensator.offer(horizon(6, INPUTS + 0.3), 9, 8)
    np.testing.assert_allclose(chosen(compensator, step, HERE), INPUTS[:, 0] + 0.2, rtol=1e-6)


def on_spline(regulator: Array | None = None) -> Compensator:
    """Compensator with a trajectory from step 100 on: two intervals at constant velocity."""
    knots = np.array([[[1.0, 0.4], [1.2, 0.4]], [[2.0, -0.2], [1.9, -0.2]]], np.float32)
    compensator = Compensator(
        terms(scheme="trajectory", feedback=True, exhausted="brake"), regulator
    )
    assert compensator.offer(Trajectory(1, 1, 100, 0, 10, 5, knots), 100, 90)
    return compensator


def test_the_first_knot_of_a_spline_is_where_the_vehicle_is_to_be() -> None:
    """On the trajectory the regulator adds nothing to the desired velocity."""
    regulator = np.array([[2.0, 0.5, 0.0]] * 2)
    there = np.array([[1.0, 0.4], [2.0, -0.2]], np.float32).astype(float)
    compensator = on_spline(regulator)
    np.testing.assert_array_equal(told(compensator, 100, there), chosen(compensator, 100, there))
    assert chosen(compensator, 100, there).tolist() == pytest.approx([0.4, -0.2], abs=1e-5)
    faster = there + np.array([[0.0, 0.1], [0.0, 0.0]])
    (x, y) = chosen(on_spline(regulator), 100, faster)
    assert (x, y) == (pytest.approx(0.4 - 0.5 * 0.1, abs=1e-5), pytest.approx(-0.2, abs=1e-5))


def test_a_place_is_held_at_rest() -> None:
    """At its present position, whatever its velocity; no plan is in force."""
    compensator = Compensator(
        terms(scheme="trajectory", feedback=True, exhausted="brake"),
        np.array([[1.0, 0.0, 0.0]] * 2),
    )
    compensator.rest(7, np.array([[1.0, 0.3], [2.0, 0.0]]))
    assert compensator.rests
    for step in (7, 8, 100_000):
        assert chosen(compensator, step, np.array([[1.0, 0.0], [2.0, 0.0]])).tolist() == [0.0, 0.0]
    assert chosen(compensator, 100_001, np.array([[0.9, 0.0], [2.0, 0.0]]))[0] > 0.0
    assert compensator.in_force == NO_HORIZON
    assert not compensator.covered


def test_a_horizon_is_in_force_since_the_first_step_chosen_for() -> None:
    """Not since its arrival, nor since the newest step; another horizon restarts the count."""
    compensator = holding(100)
    for step in (103, 104, 107):
        chosen(compensator, step, HERE)
        assert compensator.since == 103
    compensator.offer(horizon(106), 108, 106)
    compensator.drop(108, np.zeros(2))
    chosen(compensator, 109, HERE)
    assert compensator.since == 103  # dropped before any input was flown
    compensator.offer(horizon(108), 110, 108)
    chosen(compensator, 110, HERE)
    chosen(compensator, 111, HERE)
    assert compensator.since == 110


def test_a_horizon_is_from_the_future_where_it_is_more_than_h_steps_ahead() -> None:
    compensator = holding(100)
    with pytest.raises(ProtocolError, match=r"^from the future$"):
        compensator.offer(horizon(111 + H, INPUTS + 0.2), 110, 109)
    assert (compensator.in_force, compensator.stale) == (100, 0)
    np.testing.assert_allclose(chosen(compensator, 103, HERE), INPUTS[:, 3], rtol=1e-7)
    compensator.offer(horizon(110 + H), 110, 109)
    assert compensator.in_force == 110 + H


def test_inputs_are_held_within_the_bounds() -> None:
    """Last clamp, independent of the parser's: both bounds of each axis."""
    compensator = holding(0, np.tile([[1.8015, -5.0], [-0.9005, 3.0]], H // 2))
    assert chosen(compensator, 0, HERE).tolist() == [1.8, -0.9]
    assert chosen(compensator, 1, HERE).tolist() == [-1.8, 0.9]


def test_chosen_input_is_the_caller_s_own() -> None:
    for compensator in (holding(0), holding(0, scheme="none"), holding(0, exhausted="brake")):
        compensator.choose(0, HERE, np.zeros(2), np.zeros(2))[0][:] = [9.0, 9.0]
        np.testing.assert_allclose(chosen(compensator, 0, HERE), INPUTS[:, 0], rtol=1e-7)


# -- age bound and late horizons -----------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["none", "predictive", "committed"])
@pytest.mark.parametrize(
    ("step", "observed", "reason"),
    [
        (100, 99, None),
        (100, 50, None),  # its first input is 50 steps younger
        (100, 49, "too old"),
        (100, 101, "observation"),
        (100, -1, "observation"),  # observation before step 0
    ],
)
def test_a_horizon_from_an_old_or_impossible_observation_is_refused(
    scheme: str, step: int, observed: int, reason: str | None
) -> None:
    compensator = Compensator(terms(scheme=scheme))
    compensator.offer(horizon(95), 96, 95)
    if reason is None:
        compensator.offer(horizon(step), 101, observed)
        assert compensator.in_force == step
        return
    with pytest.raises(ProtocolError, match=f"^{reason}$"):
        compensator.offer(horizon(step), 101, observed)
    assert (compensator.in_force, compensator.stale) == (95, 0)
    np.testing.assert_allclose(
        chosen(compensator, 96, HERE), INPUTS[:, int(scheme != "none")], rtol=1e-6
    )


@pytest.mark.parametrize(("exhausted", "after"), [("hold", 1.0), ("brake", 0.8)])
def test_a_horizon_is_flown_no_longer_than_the_age_bound(exhausted: str, after: float) -> None:
    """Observed at step 54, so no input is flown after step 104; then held or braked."""
    compensator = Compensator(terms(exhausted=exhausted))
    compensator.offer(horizon(100, np.tile([[0.6], [0.8]], H)), 101, 54)
    flown = []
    for step in (103, 104, 105):
        flown.append(float(np.linalg.norm(chosen(compensator, step, HERE))))
        assert compensator.covered == (step <= 104)
    assert flown == pytest.approx([1.0, 1.0, after], abs=1e-6)


def test_a_horizon_that_is_over_when_it_comes_is_not_braked_along() -> None:
    """Its last input is flown for one step; a step later the braking curve has already ended."""
    for late, is_held in ((H - 1, True), (H, False)):
        compensator = Compensator(terms(exhausted="brake"))
        if is_held:
            assert compensator.offer(horizon(100), 100 + late, 99)
        else:
            with pytest.raises(ProtocolError) as refused:
                compensator.offer(horizon(100), 100 + late, 99)
            assert refused.value.reason is Drop.TOO_LATE


def test_a_horizon_that_is_cut_by_its_age_is_braked_along_its_last_flown_input() -> None:
    """Inputs beyond the age bound of 50 steps were never flown."""
    rising = np.array([np.linspace(0.1, 1.0, H), np.zeros(H)])
    compensator = Compensator(terms(exhausted="brake"))
    compensator.offer(horizon(45, rising), 46, 0)  # five stages are within the age bound
    flown, covered = [], []
    for step in range(46, 54):
        flown.append(chosen(compensator, step, HERE)[0])
        covered.append(compensator.covered)
    last = 45 + sum(covered)
    speeds = flown[last - 46 :]
    assert speeds[0] == pytest.approx(rising[0][last - 45])
    assert speeds[1] == pytest.approx(max(0.0, speeds[0] - 0.2), abs=1e-7)


@pytest.mark.parametrize("after", ["dropped", "replaced"])
def test_a_copy_is_counted_only_while_its_horizon_is_in_force(after: str) -> None:
    """The server repeats a horizon until it is acknowledged; copies of older ones count as late."""
    compensator = holding(100)
    assert not compensator.offer(horizon(100), 103, 100)
    assert (compensator.stale, compensator.repeated) == (1, 1)
    if after == "dropped":
        compensator.drop(103, np.zeros(2))
        assert compensator.observed == -1
    else:
        compensator.offer(horizon(102), 103, 102)
    assert not compensator.offer(horizon(100), 104, 100)
    assert (compensator.stale, compensator.repeated) == (2, 1)


@pytest.mark.parametrize("exhausted", ["hold", "brake"])
@pytest.mark.parametrize("after", [1.0, 0.5])
def test_without_compensation_the_age_bound_ends_the_first_input(
    exhausted: str, after: float
) -> None:
    """The first input is held, or braked at 2 m/s² from 1 m/s, whatever inputs follow."""
    inputs = np.tile([[0.6], [0.8]], H) * np.append(1.0, np.full(H - 1, after))
    compensator = holding(5, inputs, scheme="none", exhausted=exhausted)
    speeds = [float(np.linalg.norm(chosen(compensator, step, HERE))) for step in (55, 56, 57)]
    assert speeds == pytest.approx([1.0, 0.8, 0.6] if exhausted == "brake" else [1.0] * 3, abs=1e-6)


@pytest.mark.parametrize("scheme", ["predictive", "committed"])
@pytest.mark.parametrize("d", [0, 20])
def test_a_horizon_that_comes_long_after_its_committed_steps_is_refused(
    scheme: str, d: int
) -> None:
    """After a quarter of the horizon, two steps here; the paper's scheme has no committed steps."""
    inputs = np.concatenate([np.zeros((2, d)), INPUTS], axis=1)
    in_time, late = Compensator(terms(scheme=scheme)), Compensator(terms(scheme=scheme))
    in_time.offer(horizon(100, inputs), 102 + d, 99)
    assert in_time.in_force == 100
    if scheme == "predictive":
        late.offer(horizon(100, inputs), 103 + d, 99)
        assert late.in_force == 100
        return
    with pytest.raises(ProtocolError, match=r"^too late$"):
        late.offer(horizon(100, inputs), 103 + d, 99)
    assert late.in_force == NO_HORIZON


# -- feedback aboard -----------------------------------------------------------------------------

GAIN = np.array([[3.0, 1.5], [2.0, 0.5]])


def with_feedback(x: Array, disturbance: Array, gain: Array = GAIN) -> Horizon:
    """Horizon for step 100 whose reference starts at a state."""
    feedback = np.concatenate([x, disturbance[:, None], gain], axis=1).astype(np.float32)
    assert feedback.shape == (2, FEEDBACK)
    return horizon(100)._replace(feedback=feedback)


@pytest.mark.parametrize("stage", [0, 1, 5, H - 1])
def test_feedback_leads_back_to_where_the_inputs_lead(stage: int) -> None:
    flown = terms(scheme="committed", feedback=True)
    x, disturbance = np.array([[0.5, 0.25], [-1.0, 0.125]]), np.array([0.25, -0.5])
    compensator = Compensator(flown)
    compensator.offer(with_feedback(x, disturbance), 100, 99)
    for u in INPUTS[:, :stage].T:
        x = flown.model.step(x, u + disturbance)
    on_course = chosen(compensator, 100 + stage, x)
    np.testing.assert_allclose(on_course, INPUTS[:, stage], atol=1e-6)
    away = np.array([[0.02, -0.01], [0.03, 0.04]])
    back = chosen(compensator, 100 + stage, x + away) - on_course
    np.testing.assert_allclose(back, [-0.045, -0.08], atol=1e-6)


def test_feedback_stays_within_the_bounds() -> None:
    compensator = Compensator(terms(scheme="committed", feedback=True))
    compensator.offer(with_feedback(HERE, np.zeros(2)), 100, 99)
    far = np.array([[1e6, 0.0], [-1e6, 0.0]])
    assert chosen(compensator, 105, far).tolist() == [-1.8, 0.9]


def test_there_is_no_feedback_before_the_first_stage() -> None:
    compensator, plain = Compensator(terms(exhausted="brake")), holding(100, exhausted="brake")
    compensator.offer(with_feedback(HERE, np.zeros(2)), 99, 98)
    near, far = (chosen(compensator, 99, HERE + away) for away in (0.0, 3.0))
    np.testing.assert_array_equal(near, far)
    np.testing.assert_array_equal(near, chosen(plain, 99, HERE))


@pytest.mark.parametrize("exhausted", ["hold", "brake"])
@pytest.mark.parametrize("step", [100 + H, 120 + H])
def test_feedback_goes_on_after_the_last_stage(step: int, exhausted: str) -> None:
    """Added to the prescribed input: the last input, or the braking curve."""
    flown = terms(exhausted=exhausted, feedback=True)
    compensator, plain = Compensator(flown), holding(100, exhausted=exhausted)
    disturbance, x = np.array([0.25, -0.5]), HERE
    compensator.offer(with_feedback(HERE, disturbance), 100, 99)
    for u in (chosen(plain, k, HERE) for k in range(100, step)):
        x = flown.model.step(x, u + disturbance if u.any() else u)
    on_course = chosen(compensator, step, x)
    np.testing.assert_allclose(on_course, chosen(plain, step, HERE), atol=1e-6)
    np.testing.assert_array_equal(told(compensator, step, x), chosen(plain, step, HERE))
    away = np.array([[0.02, -0.01], [0.03, 0.04]])
    back = chosen(compensator, step, x + away) - on_course
    np.testing.assert_allclose(back, [-0.045, -0.08], atol=1e-6)


@pytest.mark.parametrize("goes_on", [True, False])
def test_with_feedback_it_brakes_and_stays_where_it_is_in_wind(
    monkeypatch: pytest.MonkeyPatch, *, goes_on: bool
) -> None:
    """For half a minute after the last input; without feedback there, the vehicle would drift."""
    flown, wind = terms(exhausted="brake", feedback=True), np.array([0.3, -0.2])
    compensator, x, places = Compensator(flown), HERE, []
    compensator.offer(with_feedback(HERE, np.zeros(2)), 100, 99)
    if not goes_on:
        whole = rule.flown

        def end(stage: int, told: float, back: float, bound: float) -> float:
            """Rule without feedback after the last input."""
            return whole(stage, told, back if stage < H else 0.0, bound)

        monkeypatch.setattr(rule, "flown", end)
    with interpreted():
        for step in range(100, 400 + H):
            x = flown.model.step(x, chosen(compensator, step, x) + wind)
            places.append(x[:, 0])
    drift = np.abs(places[-1] - places[-100])
    if goes_on:
        assert not told(compensator, 400 + H, x).any()
        assert drift.max() < 1e-6
        assert np.abs(x[:, 1]).max() < 1e-6
        np.testing.assert_allclose(chosen(compensator, 400 + H, x), -wind, atol=1e-6)
    else:
        np.testing.assert_allclose(drift, [2.97, 1.98], atol=0.01)


def test_a_horizon_that_is_dropped_leaves_no_feedback() -> None:
    compensator = Compensator(terms(exhausted="brake", feedback=True))
    compensator.offer(with_feedback(HERE, np.zeros(2)), 100, 99)
    compensator.drop(104, np.array([0.6, 0.8]))
    for away in (0.0, 3.0):
        flown = chosen(compensator, 105, HERE + away)
        np.testing.assert_allclose(flown, [0.48, 0.64])
        np.testing.assert_array_equal(told(compensator, 105, HERE + away), flown)
    assert not compensator.follower.feeds_back


def test_a_horizon_that_is_dropped_covers_nothing_from_then_on() -> None:
    compensator = holding(100, exhausted="brake")
    chosen(compensator, 101, HERE)
    assert (compensator.covered, compensator.since) == (True, 101)
    compensator.drop(101, np.array([0.6, 0.8]))
    assert (compensator.covered, compensator.in_force) == (False, NO_HORIZON)
    chosen(compensator, 102, HERE)
    assert (compensator.covered, compensator.since) == (False, 101)


def test_feedback_ends_with_its_horizon() -> None:
    compensator = Compensator(terms(scheme="committed", feedback=True))
    compensator.offer(with_feedback(HERE, np.zeros(2)), 100, 99)
    compensator.offer(horizon(101), 101, 100)
    near, far = (chosen(compensator, 103, HERE + away) for away in (0.0, 3.0))
    np.testing.assert_array_equal(near, far)
