"""Triggers, alone and combined, against numbers computed by hand."""

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether
from skytether.server.planning.scheme import FIGURES, Figures, empty_foresight
from skytether.server.triggers.guarded import column
from skytether.server.triggers.trigger import (
    Combined,
    Compared,
    Situation,
    SituationArrays,
    Trigger,
    Verdict,
    make_trigger,
)
from skytether.shared.law.model import Flags, Indices, discretise
from skytether.shared.scenario.registry import TRIGGERS
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.schemes import HELD

quick = settings(max_examples=25)

CONTROL = ControlConfig(
    scheme="committed",
    trigger="state_gap(3, 2)",
    dt=0.1,
    terminal_weight=(50.0, 8.0),
)
ROW = np.array([0])


def figures_of(
    n: int = 1,
    *,
    step: int = 50,
    error: float = 0.0,
    fresh: bool = False,
    cost_gap: float = 0.0,
    deviation_m: float = 0.0,
) -> Figures:
    """Given figures of n equal vehicles."""
    figures = np.zeros(n, dtype=FIGURES)
    figures["step"], figures["state_gap"], figures["fresh"] = step, error, fresh
    figures["cost_gap"], figures["deviation_m"] = cost_gap, deviation_m
    return figures


KNOWN = SituationArrays(
    model=discretise((0.84, 0.84), 0.1),
    dt_s=0.1,
    planned=3,
    foresight=empty_foresight(2, 2, 3, 2)._replace(
        ahead=np.array([2, 0]),
        horizons=np.arange(20, dtype=np.float32).reshape(2, 2, 5),
        held=np.arange(12.0).reshape(2, 2, 3),
    ),
    computes=(HELD,),
    sent_step=np.array([40, -1]),
    heartbeat_due=np.array([False, True]),
    desired=lambda rows, *_: np.zeros((len(rows), 2, 4, 2)),
)


def facing(rows: Indices, figures: Figures) -> Situation:
    states = np.zeros((len(rows), 2, 2))
    return Situation(rows, figures, states, states, KNOWN)


def ask(trigger: Trigger, step: int, error: float, *, fresh: bool = False) -> Verdict:
    return trigger.test(facing(ROW, figures_of(step=step, error=error, fresh=fresh)))


def tell(trigger: Trigger, step: int, error: float = 0.0) -> None:
    trigger.sent(ROW, figures_of(step=step, error=error))


def trigger_of(text: str, *, dt: float = 0.1, capacity: int = 1) -> Trigger:
    return make_trigger(msgspec.structs.replace(CONTROL, trigger=text, dt=dt), capacity)


def after_event(step: int, error: float, control: ControlConfig = CONTROL) -> Trigger:
    """Eq. (16), whose last event was at `step`, with V(k_i) = error."""
    trigger = make_trigger(control, 1)
    tell(trigger, step, error)
    return trigger


def test_threshold_decays_per_second() -> None:
    """E5: five steps of 0.1 s at λ = 2/s leave 10·exp(-1) + 3; per step it would be exp(-10)."""
    verdict = ask(after_event(20, 10.0), 25, 0.0)
    assert verdict.threshold == pytest.approx([10.0 * math.exp(-1.0) + 3.0], rel=1e-12)


def test_first_step_is_an_event_however_small_the_error() -> None:
    """E18: the vehicle has no plan yet."""
    verdict = ask(trigger_of("state_gap(3)"), 0, 0.0, fresh=True)
    assert (verdict.event.tolist(), verdict.figure.tolist()) == ([True], [0.0])
    assert verdict.threshold.tolist() == [3.0]


def test_nothing_happens_without_an_event() -> None:
    trigger = after_event(0, 10.0)
    for step in (1, 2, 3):
        ask(trigger, step, 100.0)
    assert ask(trigger, 5, 0.0).threshold == pytest.approx([10 * math.exp(-1.0) + 3.0])


def test_sending_anchors_the_threshold_anew() -> None:
    trigger = after_event(0, 10.0)
    tell(trigger, 40, 5.0)
    assert ask(trigger, 40, 0.0).threshold == pytest.approx([8.0])
    assert ask(trigger, 45, 0.0).threshold == pytest.approx([5 * math.exp(-1.0) + 3.0])


def test_new_life_forgets_the_events_of_the_old_one() -> None:
    trigger = after_event(5000, 1e6)
    assert ask(trigger, 0, 0.0, fresh=True).threshold.tolist() == [3.0]


def test_new_life_forgets_them_also_if_its_first_horizon_was_not_sent() -> None:
    """The first plan may fail: the next step must not count from an event in the future."""
    trigger = after_event(50, 10.0)
    ask(trigger, 0, 0.0, fresh=True)
    verdict = ask(trigger, 1, 4.0)
    assert verdict.threshold.tolist() == [3.0]
    assert verdict.event.tolist() == [True]


@quick
@given(
    error=st.floats(0.0, 1e6),
    steps=st.integers(0, 10_000),
    rate=st.floats(0.0, 5.0),
    epsilon=st.floats(0.0, 10.0),
    dt=st.sampled_from([0.02, 0.05, 0.1]),
    off=st.floats(-1.0, 1.0),
)
def test_an_event_is_an_error_above_the_threshold_of_eq_16(
    error: float, steps: int, rate: float, epsilon: float, dt: float, off: float
) -> None:
    """S(k) = V(k_i) exp(-λ (k - k_i) Δt) + ε, for any length of the step."""
    control = ControlConfig(trigger=f"state_gap({epsilon!r}, {rate!r})", dt=dt)
    S = error * math.exp(-rate * steps * dt) + epsilon
    V = max(S + off, 0.0)
    verdict = ask(after_event(20, error, control), 20 + steps, V)
    assert verdict.threshold == pytest.approx([S], rel=1e-9)
    assert abs(V - S) < 1e-6 * (1.0 + S) or verdict.event.tolist() == [V > S]


def events(trigger: Trigger, first: int, last: int, *, unsent: tuple[int, ...] = ()) -> list[int]:
    wanted = []
    for step in range(first, last + 1):
        verdict = ask(trigger, step, 100.0, fresh=step == first)
        if verdict.event[0]:
            wanted.append(step)
            if step not in unsent:
                tell(trigger, step)
    return wanted


Life = tuple[int, int, tuple[int, ...], list[int]]
"""First and last step, steps at which nothing can be sent, and steps at which the trigger fires."""
WANTED: dict[str, tuple[str, list[Life]]] = {
    "each step": ("always", [(3, 9, (), [*range(3, 10)])]),
    "the first step, and every fourth after it": ("periodic(4)", [(3, 16, (), [3, 7, 11, 15])]),
    "due until it is sent": ("periodic(4)", [(0, 13, (4, 5), [0, 4, 5, 6, 10])]),
    "a first one, too": ("periodic(4)", [(0, 8, (0, 1), [0, 1, 2, 6])]),
    "a new life": ("periodic(4)", [(5000, 5001, (), [5000]), (0, 5, (), [0, 4])]),
    "seven steps, in floating point too": ("silence(0.35)", [(3, 40, (), [*range(3, 41, 7)])]),
    "six steps": ("silence(0.33)", [(3, 40, (), [*range(3, 41, 6)])]),
    "a step at least": ("silence(0.01)", [(3, 40, (), [*range(3, 41)])]),
    "two at once, then one every four steps, and no more is saved": (
        "budget(5, 2)",
        [
            (0, 16, (), [0, 1, 4, 8, 12, 16]),
            (17, 21, (20,), [20, 21]),
            (99, 103, (), [99, 100, 103]),
        ],
    ),
    "a hard cap, also of one that begins anew": (
        "budget(5, 2)",
        [(0, 1, (), [0, 1]), (2, 12, (), [4, 8, 12])],
    ),
}


@pytest.mark.parametrize(("text", "lives"), WANTED.values(), ids=WANTED)
def test_steps_at_which_a_policy_wants_to_send(text: str, lives: list[Life]) -> None:
    trigger = trigger_of(text, dt=0.05)
    for first, last, unsent, wanted in lives:
        assert events(trigger, first, last, unsent=unsent) == wanted


def test_periodic_counts_for_each_vehicle_by_itself() -> None:
    trigger = trigger_of("periodic(4)", capacity=6)
    rows = np.array([5, 2])
    figures = figures_of(2)
    figures["step"] = [3, 5]
    trigger.sent(rows, figures)
    verdict = trigger.test(facing(rows, figures_of(2, step=7)))
    assert verdict.event.tolist() == [True, False]


def test_heartbeat_sends_where_one_is_due() -> None:
    """To the second vehicle here, whose heartbeat is due; and to a vehicle without a plan."""
    sent = trigger_of("heartbeat")
    both = np.array([0, 1])
    known = KNOWN._replace(sent_step=np.array([40, 40]))
    for fresh, events in ((False, [False, True]), (True, [True, True])):
        asked = facing(both, figures_of(2, step=41, fresh=fresh))._replace(arrays=known)
        assert sent.test(asked).event.tolist() == events


def test_a_horizon_takes_the_place_of_a_heartbeat() -> None:
    """The number of packets stays the same, and the target is followed more closely."""
    few, owed = (
        [
            flight.summary
            for flight in skytether.fly_batch(
                "target",
                range(3, 5),
                duration=20.0,
                **{"control.scheme": "trajectory", "control.trigger": trigger},
            )
        ]
        for trigger in ("expected_gap(50)", "expected_gap(50) | heartbeat")
    )
    mean = {
        name: [np.mean([getattr(run, name) for run in runs]) for runs in (few, owed)]
        for name in ("event_ratio", "uplink_packets", "rmse_xy")
    }
    assert mean["event_ratio"][0] < 0.5 * mean["event_ratio"][1]
    assert mean["uplink_packets"][1] < 1.1 * mean["uplink_packets"][0]
    assert mean["rmse_xy"][1] < 0.9 * mean["rmse_xy"][0]


@pytest.mark.parametrize(("horizon", "steps"), [(40, 20), (41, 20), (3, 1), (2, 1), (1, 1)])
def test_silence_is_no_longer_than_half_a_horizon(horizon: int, steps: int) -> None:
    """For any allowed silence, so that a lost packet can be replaced; at least a step."""
    control = msgspec.structs.replace(CONTROL, trigger="silence(60)", horizon=horizon)
    assert events(make_trigger(control, 1), 0, 80) == list(range(0, 81, steps))


@pytest.mark.parametrize(
    "text", ["always", "periodic", "state_gap", "cost_gap", "deviation", "silence(1)"]
)
def test_a_vehicle_that_begins_anew_is_sent_to(text: str) -> None:
    verdict = trigger_of(text).test(facing(ROW, figures_of(step=3, fresh=True)))
    assert verdict.event.tolist() == [True]


@pytest.mark.parametrize("text", [name for name in TRIGGERS if name != "budget"] + ["budget(5, 2)"])
def test_a_forgotten_vehicle_is_as_one_that_was_never_there(text: str) -> None:
    text = {"silence": "silence(1)"}.get(text, text)
    new, old = trigger_of(text, capacity=2), trigger_of(text, capacity=2)
    rows = np.array([0, 1])
    for step in range(5000, 5004):
        old.sent(rows, figures_of(2, step=step, error=1e6))
    kept = old.test(facing(rows[1:], figures_of(step=5003)))
    old.forget(0)
    for one, other in zip(old.test(facing(rows[1:], figures_of(step=5003))), kept, strict=True):
        assert one == other
    assert events(old, 2, 30) == events(new, 2, 30)


def test_packet_that_another_policy_asked_for_takes_what_tokens_there_are() -> None:
    """Such a packet leaves no debt: ten steps after the last token there is one again."""
    trigger = trigger_of("budget(0.1, 1)", dt=1.0)
    for step in range(26):
        tell(trigger, step)
    assert events(trigger, 26, 40) == [35]


gaps = st.lists(st.tuples(st.integers(1, 200), st.booleans()), min_size=1, max_size=120)
"""Steps since the previous one, and whether another policy fires there."""


def packets(trigger: Trigger, walk: list[tuple[int, bool]]) -> list[int]:
    """Steps with a packet, which is sent if both fire."""
    sent, step = [], 0
    for gap, wanted in walk:
        step += gap
        verdict = ask(trigger, step, 0.0, fresh=gap > 40)
        if wanted and verdict.event[0]:
            sent.append(step)
            tell(trigger, step)
    return sent


@quick
@given(gaps, st.floats(0.01, 60.0), st.floats(1.0, 20.0))
def test_budget_is_the_token_bucket_filled_step_by_step(
    walk: list[tuple[int, bool]], rate: float, burst: float
) -> None:
    """So in every window there are at most `burst` packets and `rate` more a second."""
    tokens, step, sent = burst, 0, []
    for gap, wanted in walk:
        for _ in range(gap):
            tokens, step = min(tokens + rate * 0.05, burst), step + 1
        if abs(tokens - 1.0) < 1e-9:
            return  # depends on rounding
        if wanted and tokens >= 1.0:
            tokens -= 1.0
            sent.append(step)
    assert packets(trigger_of(f"budget({rate!r}, {burst!r})", dt=0.05), walk) == sent


def test_without_the_budget_its_cap_is_broken() -> None:
    walk = [(1, True)] * 100
    assert len(packets(trigger_of("always & budget(5, 2)", dt=0.05), walk)) == 26
    assert len(packets(trigger_of("always"), walk)) == 100


def test_deviation_is_a_distance_above_the_threshold() -> None:
    for text in ("deviation(0.05)", "deviation"):
        for metres, event in ((0.05, False), (0.051, True)):
            verdict = trigger_of(text).test(facing(ROW, figures_of(deviation_m=metres)))
            assert (verdict.event, verdict.figure, verdict.threshold) == ([event], [metres], [0.05])


def test_cost_gap_fires_above_the_threshold() -> None:
    trigger = trigger_of("cost_gap(1)")
    assert trigger.test(facing(ROW, figures_of(fresh=True))).event.tolist() == [True]
    for gap, event in ((1.0, False), (1.1, True)):
        verdict = trigger.test(facing(ROW, figures_of(cost_gap=gap)))
        assert (verdict.event, verdict.figure, verdict.threshold) == ([event], [gap], [1.0])


def test_figure_for_the_record_is_that_of_the_leftmost_policy_that_has_one() -> None:
    for text, error, threshold in (
        ("silence(1) | cost_gap(3) & state_gap(5, 1)", 0.25, 3.0),
        ("budget(1, 1) & (deviation(2) | cost_gap(3))", 0.5, 2.0),
        ("state_gap(5, 1) | deviation(2)", 0.0, 5.0),
        ("always & budget(1, 1)", 0.0, 0.0),
    ):
        figures = figures_of(fresh=True, deviation_m=0.5, cost_gap=0.25)
        verdict = trigger_of(text).test(facing(ROW, figures))
        assert (verdict.figure.tolist(), verdict.threshold.tolist()) == ([error], [threshold])


def test_eq_16_counts_from_v_whichever_figure_is_recorded() -> None:
    """V(k_i) of eq. (16) is V, also after a policy whose cost gap is recorded instead."""
    trigger = trigger_of("cost_gap(3) | state_gap(3, 2)")
    figures = figures_of(step=20, error=10.0, cost_gap=7.0)
    assert trigger.test(facing(ROW, figures)).figure.tolist() == [7.0]
    trigger.sent(ROW, figures)
    for error, event in ((6.6, False), (6.7, True)):  # S = 10·exp(-1) + 3 = 6.679
        assert ask(trigger, 25, error).event.tolist() == [event]


class Listener(Trigger):
    """Trigger with a figure of its own that records its calls."""

    def __init__(self, figure: float, *, compares: bool) -> None:
        self._compared = Compared.COST_GAP if compares else Compared.NOTHING
        self.told: list[int] = []
        self._figure = figure

    def forget(self, row: int) -> None:
        self.told.append(-row)

    def test(self, situation: Situation) -> Verdict:
        figure = np.full(len(situation.rows), self._figure)
        return Verdict(figure > 0.0, figure, figure, self._compared)

    def sent(self, rows: Indices, figures: Figures) -> None:  # noqa: ARG002
        self.told += rows.tolist()


@pytest.mark.parametrize("compares", [(True, True), (False, True), (True, False), (False, False)])
def test_both_sides_are_told_whichever_is_recorded(compares: tuple[bool, bool]) -> None:
    left, right = (Listener(5.0 + i, compares=compares[i]) for i in range(2))
    both = Combined(np.logical_and, left, right)
    verdict = both.test(facing(np.arange(3), figures_of(3)))
    assert verdict.figure.tolist() == [6.0 if compares == (False, True) else 5.0] * 3
    both.sent(np.array([2, 0]), figures_of(2))
    both.forget(1)
    assert left.told == right.told == [2, 0, -1]


def along(x_m: float, speed_mps: float = 0.0, sent_step: int = 50) -> SituationArrays:
    """Arrays of one vehicle whose reference is at x and flies along it."""
    desired = np.zeros((1, 2, 4, 2))
    desired[:, 0] = x_m, speed_mps
    return KNOWN._replace(desired=lambda *_: desired, sent_step=np.array([sent_step]))


def asked(trigger: Trigger, arrays: SituationArrays, *, step: int = 50) -> bool:
    states = np.zeros((1, 2, 2))
    verdict = trigger.test(Situation(ROW, figures_of(step=step), states, states, arrays))
    return bool(verdict.event[0])


def test_send_on_delta_sends_when_the_reference_has_left_its_place_at_the_last_packet() -> None:
    trigger = trigger_of("send_on_delta(0.5)")
    assert asked(trigger, along(3.0))
    tell(trigger, 50)
    assert [asked(trigger, along(x_m)) for x_m in (3.4, 2.6, 3.6)] == [False, False, True]
    assert asked(trigger, along(3.6))  # not sent at the step before
    tell(trigger, 52)
    assert not asked(trigger, along(3.2))
    trigger.forget(0)
    assert not asked(trigger, along(0.4))


def test_the_next_packet_of_a_self_triggered_vehicle_is_due_at_a_time_fixed_at_the_last() -> None:
    """0.5 m at 1 m/s take five steps; at rest the longest wait counts."""
    trigger = trigger_of("self_triggered(0.5, 2)")
    for speed_mps, steps in ((1.0, 5), (0.0, 20)):
        asked(trigger, along(0.0, speed_mps))
        tell(trigger, 50)
        due = [asked(trigger, along(0.0, 9.0), step=50 + k) for k in (1, steps - 1, steps)]
        assert due == [False, False, True]
    assert asked(trigger, along(0.0, sent_step=-1), step=51)


LEAVES = (
    *("always", "periodic(3)", "state_gap(1, 1)", "cost_gap(1)"),
    *("deviation(1)", "silence(0.5)", "budget(2, 2)"),
)
trees = st.recursive(
    st.sampled_from(LEAVES),
    lambda tree: st.tuples(tree, st.sampled_from("&|"), tree),
    max_leaves=6,
)


def written(tree: Any) -> str:
    return tree if isinstance(tree, str) else f"({written(tree[0])} {tree[1]} {written(tree[2])})"


def encounters(rng: np.random.Generator, n: int, ticks: int) -> Iterator[Figures]:
    """Random situations of n vehicles, each with its own steps; some are new at times."""
    step = rng.integers(0, 20, n)
    for tick in range(ticks):
        figures = np.zeros(n, dtype=FIGURES)
        step = np.where(rng.random(n) < 0.05, 0, step + rng.integers(1, 6, n))
        figures["step"] = step
        figures["fresh"] = (rng.random(n) < 0.1) | (tick == 0) | (step == 0)
        for name in ("state_gap", "cost_gap", "deviation_m"):
            figures[name] = rng.uniform(0.0, 2.0, n)
        yield figures


@quick
@given(trees, st.integers(0, 2**32 - 1))
def test_combination_fires_as_its_parts_say(tree: Any, seed: int) -> None:
    rng, rows = np.random.default_rng(seed), np.array([2, 0, 3])
    whole = trigger_of(written(tree), capacity=4)
    parts = {leaf: trigger_of(leaf, capacity=4) for leaf in LEAVES}

    def expected(tree: Any, verdicts: dict[str, Verdict]) -> Flags:
        if isinstance(tree, str):
            return verdicts[tree].event
        left, right = expected(tree[0], verdicts), expected(tree[2], verdicts)
        return left & right if tree[1] == "&" else left | right

    for figures in encounters(rng, 3, 25):
        verdict, again = whole.test(facing(rows, figures)), whole.test(facing(rows, figures))
        for one, other in zip(verdict, again, strict=True):
            np.testing.assert_array_equal(one, other)
        verdicts = {leaf: part.test(facing(rows, figures)) for leaf, part in parts.items()}
        assert verdict.event.tolist() == expected(tree, verdicts).tolist()
        sent = np.flatnonzero(verdict.event & (rng.random(3) < 0.9))  # not all are solved
        for trigger in (whole, *parts.values()):
            trigger.sent(rows[sent], figures[sent])


@quick
@given(trees, st.integers(0, 2**32 - 1))
def test_batch_is_judged_as_its_singles(tree: Any, seed: int) -> None:
    rng, rows = np.random.default_rng(seed), np.array([5, 1, 2])
    together = trigger_of(written(tree), capacity=6)
    singles = [trigger_of(written(tree)) for _ in rows]
    for figures in encounters(rng, 3, 15):
        verdict = together.test(facing(rows, figures))
        sent = np.flatnonzero(verdict.event)
        together.sent(rows[sent], figures[sent])
        for i, single in enumerate(singles):
            alone = single.test(facing(ROW, figures[i : i + 1]))
            for one, all_ in zip(alone[:3], verdict[:3], strict=True):
                assert one[0] == all_[i]
            if alone.event[0]:
                single.sent(ROW, figures[i : i + 1])


def test_columns_of_a_plugin_reach_kernels_as_kernels_read_them() -> None:
    for values in (np.arange(3), np.arange(6.0)[::2], np.ones(3, dtype=np.float32), [1, 2, 3]):
        made = column(values, np.float64, 3)
        assert (made.dtype, made.flags.c_contiguous) == (np.dtype(np.float64), True)
        np.testing.assert_array_equal(made, values)
    assert column(np.ones(6, dtype=np.bool_)[::2], np.bool_, 3).flags.c_contiguous
