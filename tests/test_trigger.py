"""When a horizon is worth a packet: eq. (16) against numbers worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.trigger import Always, Paper, Periodic, Trigger, Verdict, make_trigger
from shared.config import ControlConfig
from shared.model import Array

quick = settings(max_examples=60, deadline=None)

CONTROL = ControlConfig(dt=0.1, epsilon=3.0, decay_rate=2.0, terminal_weight=(50.0, 8.0))
ROW = np.array([0])
PLANNED = np.array([[[1.0, 0.5], [-1.0, 0.0]]])


def off_by(error: float) -> Array:
    """An estimate so far from PLANNED that V = error: on x alone, where P is 50."""
    estimate = PLANNED.copy()
    estimate[0, 0, 0] += math.sqrt(error / 50.0)
    return estimate


def ask(trigger: Trigger, step: int, estimate: Array, *, fresh: bool = False) -> Verdict:
    """The verdict on one vehicle."""
    return trigger.test(ROW, np.array([step]), estimate, PLANNED, np.array([fresh]))


def after_event(step: int, error: float, control: ControlConfig = CONTROL) -> Paper:
    """A trigger whose last event was at `step`, with V(k_i) = error."""
    trigger = Paper(control, 1)
    trigger.sent(ROW, np.array([step]), np.array([error]))
    return trigger


def test_error_weighs_position_and_velocity_with_p() -> None:
    """V = 50·0.2² + 8·0.5² + 50·0.1² + 8·1² = 2 + 2 + 0.5 + 8."""
    estimate = PLANNED + np.array([[[0.2, -0.5], [-0.1, 1.0]]])
    for trigger in (Paper(CONTROL, 1), Always(CONTROL)):
        verdict = trigger.test(ROW, np.array([7]), estimate, PLANNED, np.array([False]))
        assert verdict.error == pytest.approx([12.5])


def test_threshold_decays_per_second() -> None:
    """E5: five steps of 0.1 s at λ = 2/s leave 10·exp(-1) + 3; per step it would be exp(-10)."""
    verdict = ask(after_event(20, 10.0), 25, off_by(0.0))
    assert verdict.threshold == pytest.approx([10.0 * math.exp(-1.0) + 3.0], rel=1e-12)


def test_threshold_depends_on_time_and_not_on_how_it_is_cut() -> None:
    """Ten steps of 0.05 s are five of 0.1 s."""
    fine = ControlConfig(dt=0.05, epsilon=3.0, decay_rate=2.0, terminal_weight=(50.0, 8.0))
    one = ask(after_event(20, 10.0), 25, off_by(0.0)).threshold
    other = ask(after_event(20, 10.0, fine), 30, off_by(0.0)).threshold
    assert one == pytest.approx(other, rel=1e-12)


def test_event_is_an_error_above_the_threshold() -> None:
    """S = 10·exp(-1) + 3 = 6.679: 6.6 is quiet, 6.7 is an event."""
    trigger = after_event(20, 10.0)
    assert ask(trigger, 25, off_by(6.6)).event.tolist() == [False]
    assert ask(trigger, 25, off_by(6.7)).event.tolist() == [True]


def test_threshold_is_the_tolerance_long_after() -> None:
    """Nothing of the last event is left."""
    verdict = ask(after_event(0, 1e6), 10_000, off_by(2.9))
    assert verdict.threshold.tolist() == [3.0]
    assert verdict.event.tolist() == [False]
    assert ask(after_event(0, 1e6), 10_000, off_by(3.1)).event.tolist() == [True]


def test_first_step_is_an_event_however_small_the_error() -> None:
    """E18: the vehicle has nothing to fly yet."""
    verdict = ask(Paper(CONTROL, 1), 0, off_by(0.0), fresh=True)
    assert (verdict.event.tolist(), verdict.error.tolist()) == ([True], [0.0])
    assert verdict.threshold.tolist() == [3.0]


def test_nothing_happens_without_an_event() -> None:
    """Asking is not sending: the threshold goes on from the event before."""
    trigger = after_event(0, 10.0)
    for step in (1, 2, 3):
        ask(trigger, step, off_by(100.0))
    assert ask(trigger, 5, off_by(0.0)).threshold == pytest.approx([10 * math.exp(-1.0) + 3.0])


def test_sending_anchors_the_threshold_anew() -> None:
    """S starts at V(k_i) + ε and decays from there."""
    trigger = after_event(0, 10.0)
    trigger.sent(ROW, np.array([40]), np.array([5.0]))
    assert ask(trigger, 40, off_by(0.0)).threshold == pytest.approx([8.0])
    assert ask(trigger, 45, off_by(0.0)).threshold == pytest.approx([5 * math.exp(-1.0) + 3.0])


def test_new_life_forgets_the_events_of_the_old_one() -> None:
    """A vehicle that starts again at step 0 owes nothing to step 5000 of before."""
    trigger = after_event(5000, 1e6)
    assert ask(trigger, 0, off_by(0.0), fresh=True).threshold.tolist() == [3.0]


def test_new_life_forgets_them_also_if_its_first_horizon_was_not_sent() -> None:
    """The first plan may fail: the next step must not count from an event in the future."""
    trigger = after_event(50, 10.0)
    ask(trigger, 0, off_by(0.0), fresh=True)
    verdict = ask(trigger, 1, off_by(4.0))
    assert verdict.threshold.tolist() == [3.0]
    assert verdict.event.tolist() == [True]


@quick
@given(st.floats(0.0, 1e4), st.integers(1, 200), st.floats(0.0, 5.0), st.floats(0.01, 5.0))
def test_faster_decay_means_a_lower_threshold(
    error: float, steps: int, rate: float, more: float
) -> None:
    """Fig. 5: more λ, more events."""
    slow, fast = (
        ControlConfig(dt=0.1, epsilon=3.0, decay_rate=decay) for decay in (rate, rate + more)
    )
    low = ask(after_event(0, error, fast), steps, PLANNED).threshold[0]
    high = ask(after_event(0, error, slow), steps, PLANNED).threshold[0]
    assert 3.0 <= low <= high <= error + 3.0
    assert low < high or error * math.exp(-rate * 0.1 * steps) < 1e-9


@quick
@given(st.floats(0.0, 1e4), st.integers(0, 200), st.floats(0.0, 10.0), st.floats(0.01, 10.0))
def test_more_tolerance_means_a_higher_threshold(
    error: float, steps: int, epsilon: float, more: float
) -> None:
    """Fig. 5: more ε, fewer events; S rises by just as much."""
    low, high = (
        ask(after_event(0, error, ControlConfig(epsilon=tolerance)), steps, PLANNED).threshold[0]
        for tolerance in (epsilon, epsilon + more)
    )
    assert high - low == pytest.approx(more, rel=1e-9)


def test_always_sends_even_without_an_error() -> None:
    """At every step, whatever was sent before."""
    trigger = Always(CONTROL)
    for step in range(3):
        verdict = trigger.test(ROW, np.array([step]), PLANNED, PLANNED, np.array([False]))
        assert (verdict.event.tolist(), verdict.threshold.tolist()) == ([True], [0.0])
        trigger.sent(ROW, np.array([step]), verdict.error)


def events(trigger: Trigger, first: int, last: int, *, unsent: tuple[int, ...] = ()) -> list[int]:
    """The steps at which it wants to send; it does, but for those in `unsent`."""
    wanted = []
    for step in range(first, last + 1):
        verdict = ask(trigger, step, off_by(100.0), fresh=step == first)
        if verdict.event[0]:
            wanted.append(step)
            if step not in unsent:
                trigger.sent(ROW, np.array([step]), verdict.error)
    return wanted


def test_periodic_sends_at_the_first_step_and_every_so_many_after() -> None:
    """Whatever the error; period 1 is every step."""
    assert events(Periodic(ControlConfig(period=4), 1), 3, 16) == [3, 7, 11, 15]
    assert events(Periodic(ControlConfig(period=1), 1), 0, 4) == [0, 1, 2, 3, 4]
    verdict = ask(Periodic(CONTROL, 1), 0, off_by(2.0), fresh=True)
    assert (verdict.error, verdict.threshold) == (pytest.approx([2.0]), [0.0])


def test_periodic_counts_from_what_was_sent() -> None:
    """A horizon that was not solved for is due until one is; so is a first one."""
    assert events(Periodic(ControlConfig(period=4), 1), 0, 13, unsent=(4, 5)) == [0, 4, 5, 6, 10]
    assert events(Periodic(ControlConfig(period=4), 1), 0, 8, unsent=(0, 1)) == [0, 1, 2, 6]


def test_periodic_begins_anew_with_a_new_life() -> None:
    """Step 0 owes nothing to step 5000 of before."""
    trigger = Periodic(ControlConfig(period=4), 1)
    assert events(trigger, 5000, 5001) == [5000]
    assert events(trigger, 0, 5) == [0, 4]


def test_periodic_counts_for_each_vehicle_by_itself() -> None:
    """Two vehicles, last sent to at steps 3 and 5, both at step 7."""
    trigger = Periodic(ControlConfig(period=4), 6)
    rows, step = np.array([5, 2]), np.array([7, 7])
    trigger.sent(rows, np.array([3, 5]), np.zeros(2))
    both = np.repeat(PLANNED, 2, axis=0)
    verdict = trigger.test(rows, step, both, both, np.array([False, False]))
    assert verdict.event.tolist() == [True, False]


def test_scenario_names_its_trigger() -> None:
    """`paper` is eq. (16), `always` is always, `periodic` is now and then."""
    assert isinstance(make_trigger(ControlConfig(trigger="paper"), 1), Paper)
    assert isinstance(make_trigger(ControlConfig(trigger="always"), 1), Always)
    assert isinstance(make_trigger(ControlConfig(trigger="periodic"), 1), Periodic)


@quick
@given(st.integers(0, 2**32 - 1))
def test_batch_is_judged_as_its_singles(seed: int) -> None:
    """Vehicles of one batch have their own last events, steps and first steps."""
    rng = np.random.default_rng(seed)
    rows, sent_at = rng.permutation(6)[:4], rng.integers(0, 50, 4)
    step, errors = sent_at + rng.integers(0, 30, 4), rng.uniform(0.0, 50.0, 4)
    estimate, planned = rng.normal(size=(2, 4, 3, 2))
    fresh = rng.random(4) < 0.3
    together = Paper(CONTROL, 6)
    together.sent(rows, sent_at, errors)
    verdict = together.test(rows, step, estimate, planned, fresh)
    for i in range(4):
        one = slice(i, i + 1)
        single = after_event(sent_at[i], errors[i]).test(
            ROW, step[one], estimate[one], planned[one], fresh[one]
        )
        assert verdict.error[i] == single.error[0]
        assert verdict.threshold[i] == single.threshold[0]
        assert verdict.event[i] == single.event[0]
