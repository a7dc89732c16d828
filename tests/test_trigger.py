"""When a horizon is worth a packet: policies against numbers worked out by hand, and combined."""

import math
import re
from collections.abc import Iterator
from dataclasses import astuple, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.trigger import POLICIES, Combined, Situation, Trigger, Verdict, make_trigger
from shared import config
from shared.config import ControlConfig
from shared.model import Array, Flags, Indices
from shared.policy import SIGNATURES
from sim.flight import fly

quick = settings(max_examples=60, deadline=None)

CONTROL = ControlConfig(
    trigger="state_gap", dt=0.1, epsilon=3.0, decay_rate=2.0, terminal_weight=(50.0, 8.0)
)
ROW = np.array([0])
PLANNED = np.array([[[1.0, 0.5], [-1.0, 0.0]]])


def off_by(error: float) -> Array:
    """An estimate so far from PLANNED that V = error: on x alone, where P is 50."""
    estimate = PLANNED.copy()
    estimate[0, 0, 0] += math.sqrt(error / 50.0)
    return estimate


def ask(trigger: Trigger, step: int, estimate: Array, *, fresh: bool = False) -> Verdict:
    """The verdict on one vehicle."""
    return trigger.test(Situation(ROW, np.array([step]), np.array([fresh]), estimate, PLANNED))


def trigger_of(text: str, *, dt: float = 0.1, capacity: int = 1) -> Trigger:
    """What a scenario means by this text, with CONTROL's weights."""
    return make_trigger(msgspec.structs.replace(CONTROL, trigger=text, dt=dt), capacity)


def after_event(step: int, error: float, control: ControlConfig = CONTROL) -> Trigger:
    """Eq. (16), whose last event was at `step`, with V(k_i) = error."""
    trigger = make_trigger(control, 1)
    trigger.sent(ROW, np.array([step]), np.array([error]))
    return trigger


def test_error_weighs_position_and_velocity_with_p() -> None:
    """V = 50·0.2² + 8·0.5² + 50·0.1² + 8·1² = 2 + 2 + 0.5 + 8."""
    estimate = PLANNED + np.array([[[0.2, -0.5], [-0.1, 1.0]]])
    for text in ("state_gap", "always", "periodic", "silence(1)", "budget(1, 1)"):
        assert ask(trigger_of(text), 7, estimate).error == pytest.approx([12.5])


def test_threshold_decays_per_second() -> None:
    """E5: five steps of 0.1 s at λ = 2/s leave 10·exp(-1) + 3; per step it would be exp(-10)."""
    verdict = ask(after_event(20, 10.0), 25, off_by(0.0))
    assert verdict.threshold == pytest.approx([10.0 * math.exp(-1.0) + 3.0], rel=1e-12)


def test_threshold_depends_on_time_and_not_on_how_it_is_cut() -> None:
    """Ten steps of 0.05 s are five of 0.1 s."""
    fine = ControlConfig(
        trigger="state_gap", dt=0.05, epsilon=3.0, decay_rate=2.0, terminal_weight=(50.0, 8.0)
    )
    one = ask(after_event(20, 10.0), 25, off_by(0.0)).threshold
    other = ask(after_event(20, 10.0, fine), 30, off_by(0.0)).threshold
    assert one == pytest.approx(other, rel=1e-12)


def test_event_is_an_error_above_the_threshold() -> None:
    """S = 10·exp(-1) + 3 = 6.679: 6.6 is quiet, 6.7 is an event."""
    trigger = after_event(20, 10.0)
    assert ask(trigger, 25, off_by(6.6)).surely.tolist() == [False]
    assert ask(trigger, 25, off_by(6.7)).surely.tolist() == [True]


def test_threshold_is_the_tolerance_long_after() -> None:
    """Nothing of the last event is left."""
    verdict = ask(after_event(0, 1e6), 10_000, off_by(2.9))
    assert verdict.threshold.tolist() == [3.0]
    assert verdict.surely.tolist() == [False]
    assert ask(after_event(0, 1e6), 10_000, off_by(3.1)).surely.tolist() == [True]


def test_first_step_is_an_event_however_small_the_error() -> None:
    """E18: the vehicle has nothing to fly yet."""
    verdict = ask(trigger_of("state_gap"), 0, off_by(0.0), fresh=True)
    assert (verdict.surely.tolist(), verdict.error.tolist()) == ([True], [0.0])
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
    assert verdict.surely.tolist() == [True]


@quick
@given(st.floats(0.0, 1e4), st.integers(1, 200), st.floats(0.0, 5.0), st.floats(0.01, 5.0))
def test_faster_decay_means_a_lower_threshold(
    error: float, steps: int, rate: float, more: float
) -> None:
    """Fig. 5: more λ, more events."""
    slow, fast = (
        ControlConfig(trigger="state_gap", dt=0.1, epsilon=3.0, decay_rate=decay)
        for decay in (rate, rate + more)
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
        ask(
            after_event(0, error, ControlConfig(trigger="state_gap", epsilon=tolerance)),
            steps,
            PLANNED,
        ).threshold[0]
        for tolerance in (epsilon, epsilon + more)
    )
    assert high - low == pytest.approx(more, rel=1e-9)


def test_always_sends_even_without_an_error() -> None:
    """At every step, whatever was sent before."""
    trigger = trigger_of("always")
    for step in range(3):
        verdict = ask(trigger, step, PLANNED)
        assert (verdict.surely.tolist(), verdict.threshold.tolist()) == ([True], [0.0])
        trigger.sent(ROW, np.array([step]), verdict.error)


def events(trigger: Trigger, first: int, last: int, *, unsent: tuple[int, ...] = ()) -> list[int]:
    """The steps at which it wants to send; it does, but for those in `unsent`."""
    wanted = []
    for step in range(first, last + 1):
        verdict = ask(trigger, step, off_by(100.0), fresh=step == first)
        if verdict.surely[0]:
            wanted.append(step)
            if step not in unsent:
                trigger.sent(ROW, np.array([step]), verdict.error)
    return wanted


def test_periodic_sends_at_the_first_step_and_every_so_many_after() -> None:
    """Whatever the error; period 1 is every step."""
    assert events(trigger_of("periodic(4)"), 3, 16) == [3, 7, 11, 15]
    assert events(trigger_of("periodic(1)"), 0, 4) == [0, 1, 2, 3, 4]
    verdict = ask(trigger_of("periodic"), 0, off_by(2.0), fresh=True)
    assert (verdict.error, verdict.threshold) == (pytest.approx([2.0]), [0.0])


def test_periodic_counts_from_what_was_sent() -> None:
    """A horizon that was not solved for is due until one is; so is a first one."""
    assert events(trigger_of("periodic(4)"), 0, 13, unsent=(4, 5)) == [0, 4, 5, 6, 10]
    assert events(trigger_of("periodic(4)"), 0, 8, unsent=(0, 1)) == [0, 1, 2, 6]


def test_periodic_begins_anew_with_a_new_life() -> None:
    """Step 0 owes nothing to step 5000 of before."""
    trigger = trigger_of("periodic(4)")
    assert events(trigger, 5000, 5001) == [5000]
    assert events(trigger, 0, 5) == [0, 4]


def test_periodic_counts_for_each_vehicle_by_itself() -> None:
    """Two vehicles, last sent to at steps 3 and 5, both at step 7."""
    trigger = trigger_of("periodic(4)", capacity=6)
    rows, step = np.array([5, 2]), np.array([7, 7])
    trigger.sent(rows, np.array([3, 5]), np.zeros(2))
    both = np.repeat(PLANNED, 2, axis=0)
    verdict = trigger.test(Situation(rows, step, np.array([False, False]), both, both))
    assert verdict.surely.tolist() == [True, False]


def test_silence_ends_in_time() -> None:
    """0.35 s are seven steps of 0.05 s, in floating point too; 0.33 s are six, and 0.01 s one."""
    for seconds, steps in ((0.35, 7), (0.33, 6), (0.01, 1)):
        trigger = trigger_of(f"silence({seconds})", dt=0.05)
        assert events(trigger, 3, 40) == list(range(3, 41, steps))


def test_budget_spends_its_burst_and_then_what_comes_in() -> None:
    """Two at once, then one every 0.2 s: four steps of 0.05 s."""
    trigger = trigger_of("budget(5, 2)", dt=0.05)
    assert events(trigger, 0, 16) == [0, 1, 4, 8, 12, 16]
    assert events(trigger, 17, 21, unsent=(20,)) == [20, 21]
    assert events(trigger, 1000, 1004) == [1000, 1001, 1004]  # no more than the burst is saved


def test_budget_binds_a_vehicle_at_its_first_step_too() -> None:
    """A hard cap is a hard cap: a new life has the tokens that the old one left, and gains more."""
    trigger = trigger_of("budget(5, 2)", dt=0.05)
    assert events(trigger, 5000, 5002) == [5000, 5001]
    assert events(trigger, 0, 12) == [3, 7, 11]
    for text in ("always", "periodic", "state_gap", "cost_gap", "deviation", "silence(1)"):
        situation = facing(1, step=3, fresh=True, cost_gap=0.0, deviation_m=0.0)
        assert trigger_of(text).test(situation).surely.tolist() == [True]


def test_packet_that_another_policy_asked_for_takes_what_tokens_there_are() -> None:
    """Such a packet leaves no debt: ten steps after the last token there is one again."""
    trigger = trigger_of("budget(0.1, 1)", dt=1.0)
    for step in range(26):
        trigger.sent(ROW, np.array([step]), np.zeros(1))
    assert events(trigger, 26, 40) == [35]


gaps = st.lists(st.tuples(st.integers(1, 200), st.booleans()), min_size=1, max_size=120)
"""Steps since the one before, and whether something else wants to send there."""


def packets(trigger: Trigger, walk: list[tuple[int, bool]]) -> list[int]:
    """The steps with a packet, where one goes out if both want it."""
    sent, step = [], 0
    for gap, wanted in walk:
        step += gap
        verdict = ask(trigger, step, PLANNED, fresh=gap > 40)
        if wanted and verdict.surely[0]:
            sent.append(step)
            trigger.sent(ROW, np.array([step]), verdict.error)
    return sent


@settings(max_examples=300, deadline=None)
@given(gaps, st.floats(0.01, 60.0), st.floats(1.0, 20.0), st.sampled_from([0.02, 0.05, 1.0]))
def test_budget_is_kept_in_every_window(
    walk: list[tuple[int, bool]], rate: float, burst: float, dt: float
) -> None:
    """From any packet to any other, T seconds later: at most burst + rate · T, both counted."""
    sent = packets(trigger_of(f"budget({rate!r}, {burst!r})", dt=dt), walk)
    for i, first in enumerate(sent):
        for count, last in enumerate(sent[i:], start=1):
            assert count <= burst + rate * dt * (last - first) + 1e-9


@quick
@given(gaps, st.floats(0.01, 60.0), st.floats(1.0, 20.0))
def test_budget_is_the_token_bucket_filled_step_by_step(
    walk: list[tuple[int, bool]], rate: float, burst: float
) -> None:
    """Token bucket b ← min(b + g, burst) at each step by itself, b ← b - 1 when sent."""
    tokens, step, sent = burst, 0, []
    for gap, wanted in walk:
        for _ in range(gap):
            tokens, step = min(tokens + rate * 0.05, burst), step + 1
        if abs(tokens - 1.0) < 1e-9:
            return  # a matter of rounding
        if wanted and tokens >= 1.0:
            tokens -= 1.0
            sent.append(step)
    assert packets(trigger_of(f"budget({rate!r}, {burst!r})", dt=0.05), walk) == sent


def test_without_the_budget_its_cap_is_broken() -> None:
    """Ablation: the same desires, with the bucket and without."""
    walk = [(1, True)] * 100
    assert len(packets(trigger_of("always & budget(5, 2)", dt=0.05), walk)) == 26
    assert len(packets(trigger_of("always"), walk)) == 100


def facing(
    n: int,
    *,
    step: int = 50,
    fresh: bool = False,
    cost_gap: float | None = None,
    deviation_m: float | None = None,
) -> Situation:
    """One situation for n vehicles; what is None is not to be asked for."""
    figures = [
        None if value is None else partial(np.full, n, value) for value in (deviation_m, cost_gap)
    ]
    at = np.repeat(PLANNED, n, axis=0)
    return Situation(np.arange(n), np.full(n, step), np.full(n, fresh), at, at, *figures)


def test_deviation_is_a_distance_above_the_threshold() -> None:
    """In metres; its own key stands in for the argument."""
    for text in ("deviation(0.05)", "deviation"):
        for metres, event in ((0.05, False), (0.051, True)):
            verdict = trigger_of(text).test(facing(2, deviation_m=metres))
            assert verdict.surely.tolist() == verdict.perhaps.tolist() == [event, event]
            assert (verdict.error.tolist(), verdict.threshold.tolist()) == (
                [metres] * 2,
                [0.05] * 2,
            )


def test_cost_gap_may_fire_until_it_is_known() -> None:
    """Once known, the gap fires where it is above the threshold."""
    for text in ("cost_gap(1)", "cost_gap"):
        trigger = trigger_of(text)
        assert trigger.test(facing(1, fresh=True)).surely.tolist() == [True]
        verdict = trigger.test(facing(1))
        assert (verdict.surely.tolist(), verdict.perhaps.tolist()) == ([False], [True])
        assert np.isnan(verdict.error).all()
        for gap, event in ((1.0, False), (1.1, True)):
            verdict = trigger.test(facing(1, cost_gap=gap))
            assert verdict.surely.tolist() == verdict.perhaps.tolist() == [event]
            assert (verdict.error.tolist(), verdict.threshold.tolist()) == ([gap], [1.0])


def test_no_solve_is_asked_for_where_it_could_change_nothing() -> None:
    """Without a token nothing is sent; after the longest silence something is, whatever it says."""
    trigger = trigger_of("cost_gap & budget(1, 1) | silence(2)", capacity=2)
    trigger.test(facing(2, step=0, fresh=True))
    trigger.sent(np.array([0, 1]), np.array([0, 0]), np.zeros(2))
    wanted = []
    for step in (5, 10, 20):
        verdict = trigger.test(facing(2, step=step))
        wanted.append((verdict.surely.tolist(), verdict.perhaps.tolist()))
    no, yes = [False, False], [True, True]
    assert wanted == [(no, no), (no, yes), (yes, yes)]


def test_figure_for_the_record_is_that_of_the_leftmost_policy_that_has_one() -> None:
    """The others have V and no threshold."""
    for text, error, threshold in (
        ("silence(1) | cost_gap(3) & state_gap(5, 1)", 0.25, 3.0),
        ("budget(1, 1) & (deviation(2) | cost_gap(3))", 0.5, 2.0),
        ("state_gap(5, 1) | deviation(2)", 0.0, 5.0),
        ("always & budget(1, 1)", 0.0, 0.0),
    ):
        verdict = trigger_of(text).test(facing(1, fresh=True, deviation_m=0.5, cost_gap=0.25))
        assert (verdict.error.tolist(), verdict.threshold.tolist()) == ([error], [threshold])


def test_each_policy_is_told_its_own_error_when_a_packet_goes_out() -> None:
    """V(k_i) of eq. (16) is V, also behind a policy whose cost gap is recorded in its stead."""
    trigger = trigger_of("cost_gap(3) | state_gap(3, 2)")
    situation = Situation(
        ROW,
        step=np.array([20]),
        fresh=np.array([False]),
        estimate=off_by(10.0),
        planned=PLANNED,
        cost_gap=lambda: np.array([7.0]),
    )
    verdict = trigger.test(situation)
    assert verdict.error.tolist() == [7.0]
    trigger.sent(ROW, situation.step, verdict.error)
    for error, event in ((6.6, False), (6.7, True)):  # S = 10·exp(-1) + 3 = 6.679
        later = Situation(
            ROW,
            step=np.array([25]),
            fresh=np.array([False]),
            estimate=off_by(error),
            planned=PLANNED,
            cost_gap=lambda: np.zeros(1),
        )
        assert trigger.test(later).surely.tolist() == [event]


class Listener:
    """A trigger whose error is its own, and which keeps what it is told."""

    def __init__(self, error: float, *, compares: bool) -> None:
        self.compares = compares
        self.told: list[float] = []
        self._error = error

    def test(self, situation: Situation) -> Verdict:
        """Fire where the error is positive."""
        figure = np.full(len(situation.rows), self._error)
        return Verdict(figure > 0.0, figure > 0.0, figure, figure)

    def sent(self, rows: Indices, step: Indices, error: Array) -> None:  # noqa: ARG002
        """Keep the errors told."""
        self.told += error.tolist()


@pytest.mark.parametrize("compares", [(True, True), (False, True), (True, False), (False, False)])
def test_each_side_is_told_its_own_error_whichever_is_recorded(compares: tuple[bool, bool]) -> None:
    """A side is told only of the vehicles that were sent to."""
    left, right = (Listener(5.0 + i, compares=compares[i]) for i in range(2))
    both = Combined(np.logical_and, left, right, 3)
    verdict = both.test(facing(3))
    assert verdict.error.tolist() == [6.0 if compares == (False, True) else 5.0] * 3
    both.sent(np.array([2, 0]), np.array([50, 50]), verdict.error[:2])
    assert (left.told, right.told) == ([5.0, 5.0], [6.0, 6.0])


def test_scenario_names_its_trigger() -> None:
    """Every policy that a scenario may name is made, with the scenario's keys for its arguments."""
    assert POLICIES.keys() == SIGNATURES.keys()
    control = ControlConfig(period=4, epsilon=2.0, decay_rate=0.0, cost_gap=7.0, deviation_m=8.0)
    thresholds = {
        "state_gap": 2.0,
        "cost_gap": 7.0,
        "deviation": 8.0,
        "always": 0.0,
        "periodic": 0.0,
    }
    for name, threshold in thresholds.items():
        trigger = make_trigger(msgspec.structs.replace(control, trigger=name), 1)
        verdict = trigger.test(facing(1, cost_gap=0.0, deviation_m=0.0))
        assert verdict.threshold.tolist() == [threshold]
        if name == "periodic":
            assert events(trigger, 0, 9) == [0, 4, 8]


LEAVES = (
    *("always", "periodic(3)", "state_gap(1, 1)", "cost_gap(1)"),
    *("deviation(1)", "silence(0.5)", "budget(2, 2)"),
)
trees = st.recursive(
    st.sampled_from(LEAVES),
    lambda tree: st.tuples(tree, st.sampled_from("&|"), tree),
    max_leaves=6,
)
"""Expressions as nested triples."""


def written(tree: Any) -> str:
    """As a scenario has it."""
    return tree if isinstance(tree, str) else f"({written(tree[0])} {tree[1]} {written(tree[2])})"


def encounters(rng: np.random.Generator, rows: Indices, ticks: int) -> Iterator[Situation]:
    """What some vehicles meet at random, in steps of their own; some are new at times."""
    n, step = len(rows), rng.integers(0, 20, len(rows))
    for tick in range(ticks):
        fresh = (rng.random(n) < 0.1) | (tick == 0)
        step = np.where(rng.random(n) < 0.05, 0, step + rng.integers(1, 6, n))
        fresh |= step == 0
        estimate, planned = rng.normal(size=(2, n, 2, 2))
        gap, deviation_m = rng.uniform(0.0, 2.0, (2, n))
        yield Situation(
            rows,
            step,
            fresh,
            estimate * 0.1,
            planned * 0.1,
            deviation_m=partial(np.copy, deviation_m),
            cost_gap=partial(np.copy, gap),
        )


@quick
@given(trees, st.integers(0, 2**32 - 1))
def test_combination_fires_as_its_parts_say(tree: Any, seed: int) -> None:
    """At every step of a flight; and what is decided without the cost gap stays so with it."""
    rng, rows = np.random.default_rng(seed), np.array([2, 0, 3])
    whole = trigger_of(written(tree), capacity=4)
    parts = {leaf: trigger_of(leaf, capacity=4) for leaf in LEAVES}

    def expected(tree: Any, verdicts: dict[str, Verdict]) -> Flags:
        if isinstance(tree, str):
            return verdicts[tree].surely
        left, right = expected(tree[0], verdicts), expected(tree[2], verdicts)
        return left & right if tree[1] == "&" else left | right

    for situation in encounters(rng, rows, 25):
        before = whole.test(replace(situation, cost_gap=None))
        again = whole.test(replace(situation, cost_gap=None))
        for one, other in zip(astuple(before), astuple(again), strict=True):
            np.testing.assert_array_equal(one, other)
        verdict = whole.test(situation)
        verdicts = {leaf: part.test(situation) for leaf, part in parts.items()}
        assert verdict.surely.tolist() == verdict.perhaps.tolist()
        assert verdict.surely.tolist() == expected(tree, verdicts).tolist()
        assert (before.surely <= verdict.surely).all()
        assert (verdict.surely <= before.perhaps).all()
        if "cost_gap" not in written(tree):
            assert before.surely.tolist() == before.perhaps.tolist()
        sent = np.flatnonzero(verdict.surely & (rng.random(3) < 0.9))  # not all are solved
        step = situation.step[sent]
        whole.sent(rows[sent], step, verdict.error[sent])
        for leaf, part in parts.items():
            part.sent(rows[sent], step, verdicts[leaf].error[sent])


@quick
@given(trees, st.integers(0, 2**32 - 1))
def test_batch_is_judged_as_its_singles(tree: Any, seed: int) -> None:
    """Vehicles of one batch have their own last events, tokens, steps and first steps."""
    rng, rows = np.random.default_rng(seed), np.array([5, 1, 2])
    together = trigger_of(written(tree), capacity=6)
    singles = [trigger_of(written(tree)) for _ in rows]
    for situation in encounters(rng, rows, 15):
        verdict = together.test(situation)
        sent = np.flatnonzero(verdict.surely)
        together.sent(rows[sent], situation.step[sent], verdict.error[sent])
        for i, single in enumerate(singles):
            alone = single.test(only(situation, i))
            for one, all_ in zip(astuple(alone), astuple(verdict), strict=True):
                assert one[0] == all_[i]
            if alone.surely[0]:
                single.sent(ROW, situation.step[i : i + 1], alone.error)


def only(situation: Situation, i: int) -> Situation:
    """The i-th vehicle of it, in row 0."""
    one = slice(i, i + 1)
    deviation_m, cost_gap = situation.deviation_m, situation.cost_gap
    assert deviation_m is not None
    assert cost_gap is not None
    return Situation(
        ROW,
        situation.step[one],
        situation.fresh[one],
        situation.estimate[one],
        situation.planned[one],
        deviation_m=lambda: deviation_m()[one],
        cost_gap=lambda: cost_gap()[one],
    )


def test_documented_trigger_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/triggers.md, as it stands there, alone and combined."""
    for table in (POLICIES, SIGNATURES):
        monkeypatch.setitem(table, "slip", None)  # taken out again in the end
    text = (Path(__file__).parent.parent / "docs" / "triggers.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(example, {})
    slip = trigger_of("slip(0.5)")
    estimate = PLANNED + np.array([[[9.0, 0.3], [9.0, 0.5]]])
    verdict = ask(slip, 3, estimate)
    assert verdict.surely.tolist() == [True]
    assert verdict.error == pytest.approx([math.hypot(0.3, 0.5)])
    control = {"scheme": "predictive", "trigger": "slip(0.1) & budget(4, 1) | silence(1)"}
    flown = config.check({"duration": 10.0, "control": control}, "test")
    server = fly(flown).server
    sent_s = server["step"][server["event"]] * flown.control.dt
    assert len(sent_s) > 10
    assert np.diff(sent_s).max() <= 1.0 + 1e-9
    with pytest.raises(config.ConfigError, match=r"slip\(mps\) with 0 <= mps"):
        config.check({"control": {"trigger": "slip(-1)"}}, "test")
