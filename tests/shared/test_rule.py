"""Rule of flight: in plain numbers, and equal for the vehicle and the server's replay."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.problems import from_python
from skytether.client.compensator import Compensator
from skytether.client.horizons import late_max
from skytether.server.planning import compiled as law
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.scheme import Foresight, empty_foresight
from skytether.server.schemes.committed import Replay
from skytether.server.schemes.feedback import feedback_gain
from skytether.shared.base.kernel import part
from skytether.shared.law import rule
from skytether.shared.law.model import Array, Axis, advance
from skytether.shared.law.rule import (
    AxisHorizon,
    bounded,
    entry,
    feedback,
    flown,
    lasting,
    reference_input,
    remaining,
)
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import NO_HORIZON, Horizon, Mode, Observation

quick = settings(max_examples=200)

# -- scalar functions ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observed", "count"),
    [(99, 10), (60, 10), (59, 10), (58, 9), (51, 2), (50, 1), (49, 0), (0, -49)],
)
def test_no_input_is_flown_for_longer_than_the_age_bound_allows(observed: int, count: int) -> None:
    assert lasting(10, 100, observed, 50) == count


@pytest.mark.parametrize(("horizon", "steps"), [(1, 2), (11, 2), (12, 3), (40, 10), (120, 30)])
def test_a_horizon_may_be_late_by_a_quarter_of_itself(horizon: int, steps: int) -> None:
    assert late_max(horizon) == steps


@pytest.mark.parametrize(("stage", "index"), [(-3, 0), (0, 0), (4, 4), (9, 9), (10, 9), (999, 9)])
def test_the_nearest_input_counts_where_a_horizon_has_none(stage: int, index: int) -> None:
    assert entry(stage, 10) == index


def test_an_input_is_kept_within_the_bound() -> None:
    assert [bounded(u, 1.8) for u in (-5.0, -1.8, 0.1, 1.8, 1.8015)] == [-1.8, -1.8, 0.1, 1.8, 1.8]


def test_feedback_leads_back_in_position_and_velocity() -> None:
    assert feedback(3.0, 1.5, 0.25, 0.0) == 0.75
    assert feedback(3.0, 1.5, 0.0, -0.5) == -0.75
    assert feedback(3.0, 1.5, 0.25, -0.5) == 0.0


@pytest.mark.parametrize(
    ("told", "back", "u"), [(0.5, 0.0, 0.5), (0.5, 0.25, 0.75), (1.5, 9.0, 1.8), (0.5, -9.0, -1.8)]
)
def test_feedback_is_added_within_the_bound_from_the_first_stage_on(
    told: float, back: float, u: float
) -> None:
    """Also after the last stage; before the first there is no reference for feedback."""
    assert [flown(stage, told, back, 1.8) for stage in (0, 9, 10, 10**12)] == [u] * 4
    assert flown(-1, told, back, 1.8) == told


@pytest.mark.parametrize(
    ("stage", "brake"), [(-1, 0.0), (-1, 0.2), (9, 0.2), (10, 0.0), (10**12, 0.0)]
)
def test_an_input_is_told_in_full_until_it_is_braked(stage: int, brake: float) -> None:
    assert remaining(stage, 10, 1.0, brake) == 1.0


def test_braking_takes_away_its_part_of_the_speed_at_every_step_until_rest() -> None:
    left = [remaining(stage, 10, 0.5, 0.125) for stage in range(10, 16)]
    assert left == [0.75, 0.5, 0.25, 0.0, 0.0, 0.0]
    assert remaining(10**12, 10, 0.5, 0.125) == 0.0
    assert remaining(10, 10, 0.0, 0.125) == 0.0  # already at rest


def test_where_it_leads_is_blown_along_only_until_it_stands() -> None:
    assert reference_input(0.5, -0.25, 1.0) == 0.25
    assert reference_input(0.0, -0.25, 0.01) == -0.25
    assert reference_input(0.0, -0.25, 0.0) == 0.0


def held(inputs: Sequence[float], *, feeds_back: bool = True, **changed: Any) -> AxisHorizon:
    """Horizon of some usable inputs, followed by the braking curve."""
    axis = Axis(a01=0.09, a11=0.88, b0=0.01, b1=0.12)
    numbers = {"speed": abs(inputs[-1]), "brake": 0.125, "bound": 1.8, "disturbance": 0.25}
    gain = {"gain_p": 3.0, "gain_v": 1.5}
    given = {"length": len(inputs), **numbers, **gain, **changed}
    return AxisHorizon(model=axis, inputs=inputs, feeds_back=feeds_back, **given)


@pytest.mark.parametrize(
    ("stage", "told", "along"),
    [(0, 0.25, 0.5), (1, 0.5, 0.75), (2, 0.375, 0.625), (5, 0.0, 0.0)],
)
def test_a_step_flies_what_is_told_and_leads_on_along_it(
    stage: int, told: float, along: float
) -> None:
    """Two inputs, then the braking curve; x̄ continues with the disturbance until it rests."""
    u, without, *after = rule.step(held([0.25, 0.5]), stage, 1.0, 0.5, 0.75, 0.0)
    assert (u, without) == (min(told + 3.0 * 0.25 + 1.5 * 0.5, 1.8), told)
    assert tuple(after) == advance(held([0.0]).model, 1.0, 0.5, along)


def test_a_step_without_feedback_or_before_the_first_stage_leads_nowhere() -> None:
    state = (1.0, 0.5, 0.0, 0.0)
    assert rule.step(held([0.25, 0.5], feeds_back=False), 1, *state) == (0.5, 0.5, 1.0, 0.5)
    assert rule.step(held([0.25, 0.5]), -1, *state) == (0.25, 0.25, 1.0, 0.5)


def test_where_a_horizon_leads_is_that_step_by_step() -> None:
    horizon, lead = held([0.25, 0.5]), (1.0, 0.5)
    for stage in range(6):
        assert rule.reference_at(horizon, 0, stage, 1.0, 0.5) == lead
        assert rule.reference_at(horizon, stage, stage, *lead) == lead
        *_, lead_p, lead_v = rule.step(horizon, stage, *lead, 0.0, 0.0)
        lead = lead_p, lead_v


speeds = st.floats(-3.0, 3.0)
COMPILED = {
    each.__name__: from_python(part(each))
    for each in (lasting, entry, bounded, remaining, reference_input, feedback, flown, rule.step)
}


@pytest.mark.long
@quick
@given(
    st.integers(-5, 25),
    st.integers(1, 12),
    st.tuples(speeds, speeds, st.floats(0.0, 3.0), st.sampled_from([0.0, 0.1]), st.floats(0.1, 3)),
)
def test_compiled_it_says_the_same(
    stage: int, length: int, numbers: tuple[float, float, float, float, float]
) -> None:
    told, back, speed, brake, bound = numbers
    share = remaining(stage, length, speed, brake)
    for function, *given_ in (
        (remaining, stage, length, speed, brake),
        (reference_input, told, back, share),
        (flown, stage, told, back, bound),
        (feedback, *numbers[:4]),
        (bounded, told, bound),
        (entry, stage, length),
        (lasting, length, 100, 100 - stage, 20),
    ):
        assert COMPILED[function.__name__](*given_) == function(*given_)
    inputs, states = np.linspace(told, back, length), (told, back, back, speed)
    for feeds_back in (False, True):
        horizon = held(inputs, feeds_back=feeds_back, speed=speed, brake=brake, bound=bound)
        assert COMPILED["step"](horizon, stage, *states) == rule.step(horizon, stage, *states)


# -- client and server ---------------------------------------------------------------------------

H, BOUND, MOST = 6, 4, 70
ROW = np.array([0])
FIRST = 100


def scenario(exhausted: str, age_max: int, *, feedback: bool) -> Scenario:
    """Six stages of 0.1 s, and a delay of up to four; the age bound is in steps."""
    raw = {
        "model": {"tau_s": [0.81, 0.3], "u_max": [1.8, 0.9]},
        "control": {
            "dt": 0.1,
            "horizon": H,
            "scheme": "committed",
            "delay_bound": 0.1 * BOUND,
            "feedback": feedback,
            "trigger": "always",
            "observer_s": 2.0,
        },
        "vehicle": {"exhausted": exhausted, "brake_mps2": 2.0},
        "network": {"uplink": "loss(0.1)", "downlink": "loss(0.1)"},
        "link": {"age_max_s": 0.1 * age_max},
    }
    return check(raw, "test")


def make_horizon(rng: np.random.Generator, step: int, d: int, near: Array, gain: Array) -> Horizon:
    """Horizon of random inputs, some beyond the bound, d committed, with a reference near a state.

    With feedback if there is a gain.
    """
    bound = np.array([[1.8], [0.9]])
    inputs = rng.uniform(-1.2, 1.2, (2, d + H)) * bound
    origin = near + 0.1 * rng.normal(size=(2, 2))
    feedback = np.column_stack([origin, 0.1 * rng.normal(size=2), gain]) if gain.size else gain
    return Horizon(
        1, 1, step, 0, 0, inputs.astype(np.float32), feedback=feedback.astype(np.float32)
    )


def send(replay: Replay, horizon: Horizon) -> None:
    found, length = empty_foresight(1, 2, H, MOST), horizon.inputs.shape[1]
    found.ahead[:], found.horizons[0, :, :length] = length - H, horizon.inputs
    if horizon.feedback.size:
        found.feedback[0] = horizon.feedback
    replay.remember(ROW, np.array([horizon.step]), found, np.array([True]))


def foresee(replay: Replay, step: int) -> Foresight:
    found = empty_foresight(1, 2, H, MOST)
    replay.foresee(ROW, np.array([step]), found)
    return found


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    feedback=st.booleans(),
    exhausted=st.sampled_from(["hold", "brake"]),
    age=st.integers(-H, 30),
    in_flight=st.sets(st.integers(1 - BOUND, 4), max_size=3),
    later=st.integers(0, 5),
    observed=st.integers(1, 20),
    spare=st.integers(0, 30),
)
def test_the_vehicle_and_the_replay_fly_by_the_same_rule(
    *,
    seed: int,
    feedback: bool,
    exhausted: str,
    age: int,
    in_flight: set[int],
    later: int,
    observed: int,
    spare: int,
) -> None:
    """To the last bit, before the first stage of a horizon, within, and after the last.

    The newest observation is `age` stages into the vehicle's horizon, which was planned from an
    observation `observed` steps before its arrival. Horizons in flight were made so many steps
    later, and come into force after their delay. The age bound is `spare` steps above the necessary
    one, and shortens horizons. The observer finds no disturbance.
    """
    rng, seen = np.random.default_rng(seed), FIRST + age
    begin = min(FIRST, seen)
    first, made, due = int(rng.integers(H + 1)), dict[int, int](), 0
    for step in sorted(seen + after for after in in_flight if seen + after > FIRST):
        # The delay bound falls by no more than a step at a time.
        due = max(due, seen + 1, step + int(rng.integers(1, 2 * H)))
        made[step] = due - step
    now = max([seen, *made]) + later
    age_max = max(BOUND + 2, now - seen, FIRST + first - begin + observed) + spare
    setting = scenario(exhausted, age_max, feedback=feedback)
    terms = setting.terms()
    assert terms.age_max == age_max
    K = feedback_gain(setting)
    gain = K if feedback else np.zeros((2, 0))
    vehicle = Compensator(terms)
    replay = Replay(terms, setting.control, K, 1, ClockMap(1, terms.dt_ns))

    x, states, inputs = rng.normal(size=(2, 2)), [], []
    arriving = {begin: (make_horizon(rng, FIRST, first, x, gain), begin - observed)}
    replay.observe(
        0,
        Observation(1, 1, begin - observed, NO_HORIZON, 0, 0, 0, Mode.READY, 1, x, np.zeros(2)),
    )
    send(replay, arriving[begin][0])
    for step in range(begin, now + BOUND + H):
        last_seen = int(replay.observed_step[0])
        if step in made and step + made[step] - last_seen <= age_max:  # others are not sent
            due = step + made[step]
            arriving[due] = make_horizon(rng, step, made[step], x, gain), last_seen
            send(replay, arriving[due][0])
        if step in arriving:
            horizon, last_seen = arriving[step]
            vehicle.offer(horizon, step, last_seen)
        states.append(x)
        inputs.append(np.array(vehicle.choose(step, x, np.zeros(2), np.zeros(2))[0]))
        if step in {begin, seen}:
            told = Mode.TRACK, 1, x, inputs[-1]
            replay.observe(0, Observation(1, 1, step, FIRST, begin, 0, 0, *told))
            foresee(replay, step)
        x = terms.model.step(x, inputs[-1])

    found = foresee(replay, now)
    assert found.ahead.tolist() == [BOUND]
    assert not found.disturbance.any()
    np.testing.assert_array_equal(found.estimate[0], states[now - begin])
    np.testing.assert_array_equal(found.start[0], states[now + BOUND - begin])
    reckoned = np.concatenate([found.committed[0, :, :BOUND], found.held[0]], axis=1)
    np.testing.assert_array_equal(reckoned.T, inputs[now - begin :])


def test_the_server_compiles_the_very_functions_that_the_vehicle_calls() -> None:
    for name in ("lasting", "bounded", "reference_at", "step", "advance"):
        assert getattr(law, name) is getattr(rule, name)
