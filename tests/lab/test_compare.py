"""Comparison: contenders, cases, weights, ratios, and the files of the report."""

import csv
import dataclasses
import json
import math
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import skytether
from bench.contenders import choice_table
from helpers import refused_before_writing
from skytether.__main__ import main
from skytether.figures.page import Picture
from skytether.lab.commands import pool
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.engine import budgets, contenders
from skytether.lab.engine.budgets import BUDGETS, REPORTS, SOUGHT, FlownContender, Plan
from skytether.lab.engine.calibration import Rmse, SearchLimits
from skytether.lab.engine.comparison import CLAIMS, Claim, ComparedCase, ContenderRuns, judge, ratio
from skytether.lab.engine.contenders import (
    ABOARD,
    BESIDE,
    CASES,
    CONTENDERS,
    REGULATED,
    Case,
    Contender,
    TunedWeights,
)
from skytether.lab.pages.comparison import FLIGHTS_MIN, UNDECIDED, budgets_table, leaders_table
from skytether.lab.pages.report import Drawn, html
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.arguments import argument
from skytether.shared.scenario.dotted import text_key
from skytether.shared.scenario.reading import COMPARED
from skytether.shared.scenario.registry import TRIGGERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import summarise
from skytether.sim import flight

pytestmark = pytest.mark.usefixtures("here")

PAPER = reading.load("paper")
BY_NAME = {contender.name: contender for contender in CONTENDERS}
BY_CASE = {case.name: case for case in CASES}
SCALE = contenders.ComparisonSize(100, 20)
TARGET = CASES[0]


# -- contenders and choice of thresholds ---------------------------------------------------------


def test_contenders_differ_in_scheme_and_trigger_alone_and_cases_in_what_is_met() -> None:
    """Plant, network and reference are the same for all contenders of a case."""
    for contender, case in SCALE.searched:
        start = contenders.search_start(contender, case, SCALE)
        own = {f"control.{key}" for key in contender.control}
        assert set(contenders.differences(start, case.plant)) <= own | set(case.keys)
        assert not own & set(case.keys)
        assert start.seed == 1001
        assert start.duration == SCALE.search_duration


def test_the_search_never_sees_the_seeds_that_are_compared() -> None:
    start = contenders.search_start(CONTENDERS[0], TARGET, SCALE)
    assert not set(range(start.seed, start.seed + SCALE.search_runs)) & set(range(1, 1001))


def test_every_case_has_weights_that_were_searched_for_or_those_of_one_that_has() -> None:
    for case in CASES:
        assert set(case.contenders) <= BY_NAME.keys()
        base = BY_CASE[case.weights or case.name]
        assert not base.weights
        assert {each.name for each in SCALE.who(case)} <= {each.name for each in SCALE.who(base)}
        assert base.plant == case.plant
        assert base.effort_mps < math.inf
        assert BESIDE in {each.name for each in SCALE.who(base)}


def test_a_case_may_be_named() -> None:
    assert contenders.cases([]) == CASES
    assert [case.name for case in contenders.cases(["gusts", "target"])] == ["gusts", "target"]
    with pytest.raises(ConfigError, match="--cases: got 'gust', expected a case; did you mean"):
        contenders.cases(["gust"])


def test_every_contender_in_every_case_comes_along() -> None:
    pairs = {contenders.entry(*pair): pair for pair in SCALE.searched}
    assert {name.removeprefix("compare/") for name in reading.names(COMPARED)} == set(pairs)
    for name, (contender, case) in pairs.items():
        start = contenders.search_start(contender, case, SCALE)
        scenario, free = reading.load(f"{COMPARED}/{name}"), Rmse(start, SearchLimits()).free()
        there = contenders.differences(start, case.plant)
        here = contenders.differences(scenario, case.plant)
        changed = {key for key, value in here.items() if value != there.get(key)}
        assert changed <= {
            text_key(key.key.removesuffix(".0").removesuffix(".1")) for key in free
        }, name
        assert scenario.control.state_weight[0] == PAPER.control.state_weight[0]
        assert scenario.title == f"{contender.title}, at its best: {case.title}"
    assert "compare" not in " ".join(reading.names())


def test_the_file_of_what_was_found_is_read_as_it(tmp_path: Path) -> None:
    contender, case = BY_NAME["committed-gap"], BY_CASE["gusts"]
    start = contenders.search_start(contender, case, SCALE)
    control = replace(start.control, state_weight=(7.1, 1e-4), trigger="cost_gap(12.5)")
    found = replace(start, control=control)
    file = tmp_path / "mine.toml"
    file.write_text(contenders.to_file([TunedWeights(contender, case, found, "A line.")], SCALE))
    read = reading.load(f"{file}/committed-gap-gusts")
    assert replace(read, title="") == replace(
        found, title="", duration=PAPER.duration, seed=PAPER.seed
    )
    said = file.read_text().replace("\n# ", " ")
    assert "in 20 generations of 8 points, each flown with 6 seeds from 1001 on for 30 s." in said
    assert f"- {case.effort_mps:g} m/s in the case gusts" in said
    assert '# A line.\n["committed-gap-gusts"]\n' in file.read_text()
    assert "radius" not in file.read_text()
    assert reading.names(str(file)) == [f"{file}/committed-gap-gusts"]


def thresholds(contender: Contender, scenario: Scenario) -> dict[float | None, bool]:
    points = budgets.flying(contender, BY_CASE["gusts"], scenario)
    found = {point.threshold: point.tuned for point in points}
    assert [(point.threshold, point.report) for point in points] == [
        (threshold, report) for threshold in found for report in REPORTS
    ]
    return found


def test_a_curve_goes_through_what_was_found_and_rises() -> None:
    """Thresholds around the found one; whole steps without duplicates; one point of `always`."""
    gap = replace(PAPER, control=replace(PAPER.control, trigger="cost_gap(0.8)"))
    found = thresholds(BY_NAME["committed-gap"], gap)
    assert list(found) == pytest.approx([0.08, 0.24, 0.8, 2.4, 8.0, 24.0, 80.0])
    assert [value for value, tuned in found.items() if tuned] == [0.8]
    slow = replace(PAPER, control=replace(PAPER.control, trigger="periodic(10)"))
    assert list(thresholds(BY_NAME["paper-periodic"], slow)) == [1, 2, 5, 10, 20, 40, 80]
    often = replace(PAPER, control=replace(PAPER.control, trigger="periodic(2)"))
    assert list(thresholds(BY_NAME["paper-periodic"], often)) == [1, 2, 4, 8, 16]
    assert thresholds(BY_NAME["paper-every-step"], PAPER) == {None: True}


def test_where_nobody_has_searched_the_weights_of_another_case_meet_what_is_met_there() -> None:
    contender, case = BY_NAME["committed-gap"], BY_CASE["loss-0.5"]
    tuned = contenders.search_start(contender, TARGET, SCALE)
    lossy = "paper(0.4, 0.02, 2.0) & loss(0.2)"
    tuned = replace(tuned, network=replace(tuned.network, uplink=lossy))
    for flying in budgets.flying(contender, case, tuned):
        assert flying.keys.keys() & case.keys.keys() <= {
            key for changes in REPORTS.values() for key in changes
        }


SPENT = {"rmse_xy": 1.0, "packets_per_s": 50.0, "effort_mps": 0.1}


def planned(name: str, case: str = "gusts") -> Plan:
    """Plan of one contender in a case, one scouting flight a point."""
    scale = contenders.ComparisonSize(runs=4, generations=1, scouts=1, contenders=[BY_NAME[name]])
    return Plan(BY_CASE[case], COMPARED, scale)


def scout(
    plan: Plan,
    points: Sequence[FlownContender],
    flies: Callable[[FlownContender], dict[str, float | None]],
) -> None:
    runs = [(replace(SUMMARY, **{**SPENT, **flies(point)}),) for point in points]
    done = {(cell, 0): run for cell, run in enumerate(runs)}
    plan.scouted(points, plan.scouts(points), done)


def test_within_a_budget_the_nearest_is_chosen() -> None:
    def chosen(*flown: dict[str, float | None]) -> list[int | None]:
        """Number of the chosen point within each budget, if the first points have these results."""
        plan = planned("committed-gap")
        all_flown = [*flown, *[{}] * (len(plan.points) - len(flown))]
        scout(plan, plan.points, lambda point: all_flown[plan.points.index(point)])
        found = plan.chosen()
        points = (found.get(("committed-gap", budget)) for budget in BUDGETS)
        return [None if point is None else plan.points.index(point) for point in points]

    assert chosen() == [None] * 6
    cheap, near = {"packets_per_s": 1.5}, {"packets_per_s": 9.0, "rmse_xy": 0.5}
    wild = {"packets_per_s": 1.5, "rmse_xy": 0.1, "effort_mps": 0.106}
    assert chosen(cheap, near, wild, {"packets_per_s": 0.2, "rmse_xy": None}) == [
        *(None, 0, 0),
        *(1, 1, 1),
    ]


@pytest.mark.parametrize("name", ["committed-gap", "feedback-expected"])
def test_thresholds_are_tried_until_each_budget_is_almost_used_up(name: str) -> None:
    """More packets, less error: the chosen point could send hardly more within its budget.

    Without these rounds a threshold left up to two thirds of its budget unused.
    """
    plan = planned(name, case="target")
    points = list(plan.points)
    asked = len(points)
    middle = next(point.threshold for point in plan.points if point.tuned)
    assert middle

    def flies(point: FlownContender) -> dict[str, float | None]:
        """Packets in inverse proportion to the threshold; only one reporting policy sends few."""
        assert point.threshold
        share = point.threshold / middle
        extra = 0.0 if point.report == "every 4 s" else 60.0
        return {"packets_per_s": extra + 6.0 / share, "rmse_xy": share}

    for number in range(1 + contenders.ROUNDS):
        if number:
            points = plan.halfway()
            asked += len(points)
        scout(plan, points, flies)
    for (_, budget), point in plan.chosen().items():
        used = flies(point)["packets_per_s"]
        assert used is not None
        assert 0.9 * budget < used <= budget
        assert point.keys["control." + point.contender.threshold] == point.threshold
        assert not point.tuned
    assert len(plan.chosen()) == len(SOUGHT)
    assert asked <= len(plan.points) + contenders.ROUNDS * len(SOUGHT)


def test_nothing_is_tried_where_it_cannot_be_better() -> None:
    plan = planned("committed-gap")
    scout(plan, plan.points, lambda point: {"packets_per_s": 6.0 / (point.threshold or 1.0)})
    assert not plan.halfway()
    scout(plan, plan.points, lambda _: {"rmse_xy": None})
    assert not plan.halfway()


# -- tables and claims ---------------------------------------------------------------------------

SUMMARY = summarise(PAPER, "paper", flight.fly(replace(PAPER, duration=6.0)).client)


def flew(
    name: str,
    errors: Sequence[float | None],
    *,
    packets_per_s: float = 2.0,
    bytes_per_s: float = 1000.0,
) -> ContenderRuns:
    spent = {"packets_per_s": packets_per_s, "bytes_per_s": bytes_per_s}
    runs = [replace(SUMMARY, rmse_xy=error, **spent) for error in errors]
    return ContenderRuns(FlownContender(BY_NAME[name], packets_per_s, "every step", True, {}), runs)


def test_what_has_not_flown_counts_in_nothing() -> None:
    one = flew("paper-event", [0.1, None, 0.3])
    assert one.estimate("rmse_xy")[0] == pytest.approx(0.2)
    assert len(one.values("packets_per_s")) == 2
    assert math.isnan(flew("paper-event", [None]).mean("rmse_xy"))


ERRORS = st.lists(st.tuples(st.floats(0.01, 10.0), st.floats(0.01, 10.0)), min_size=2, max_size=30)


@given(ERRORS, st.floats(0.1, 10.0))
@settings(max_examples=30)
def test_a_ratio_lies_in_its_interval_and_goes_with_what_is_compared(
    errors: list[tuple[float, float]], factor: float
) -> None:
    ours, theirs = zip(*errors, strict=True)
    found = ratio(flew("paper-event", ours), flew("paper-periodic", theirs))
    more = ratio(flew("paper-event", np.multiply(ours, factor)), flew("paper-periodic", theirs))
    assert found is not None
    assert more is not None
    value, low, high = found
    assert value == pytest.approx(np.mean(ours) / np.mean(theirs))
    assert low <= value <= high
    np.testing.assert_allclose(more, np.multiply(found, factor), atol=1e-9)


def test_an_interval_is_of_pairs() -> None:
    """Variation between seeds that both share does not widen the interval; unpaired, it would."""
    rng = np.random.default_rng(3)
    seeds = rng.uniform(0.1, 1.0, 50)
    found = ratio(flew("paper-event", 0.5 * seeds), flew("paper-periodic", seeds))
    assert found == pytest.approx((0.5, 0.5, 0.5))
    mixed = ratio(flew("paper-event", 0.5 * rng.permutation(seeds)), flew("paper-periodic", seeds))
    assert mixed is not None
    assert mixed[2] - mixed[1] > 0.05


def test_a_jackknife_is_an_interval_of_students_where_both_apply() -> None:
    """Errors with a small spread, so that the ratio of means is nearly linear."""
    rng = np.random.default_rng(4)
    ours, theirs = 1.0 + 0.05 * rng.standard_normal((2, 100))
    found = ratio(flew("paper-event", ours), flew("paper-periodic", theirs))
    assert found is not None
    half = 1.984 * np.std(ours - theirs, ddof=1) / math.sqrt(100)
    assert found[1] == pytest.approx(found[0] - half, abs=0.05 * half)
    assert found[2] == pytest.approx(found[0] + half, abs=0.05 * half)


def test_seeds_that_did_not_fly_in_both_are_left_out() -> None:
    ours, theirs = flew("paper-event", [1.0, None, 3.0]), flew("paper-periodic", [2.0, 2.0, 2.0])
    found = ratio(ours, theirs)
    assert found is not None
    assert found[0] == pytest.approx(1.0)
    assert ratio(flew("paper-event", [1.0, None]), flew("paper-periodic", [2.0, 2.0])) is None


CLAIM = Claim("committed-gap", "paper-periodic", 0.25, {"target": 0.9})


def within(case: Case, *points: tuple[float, ContenderRuns]) -> ComparedCase:
    bought = {(runs.what.contender.name, budget): runs for budget, runs in points}
    return ComparedCase(case, bought)


THEIRS = (
    (10.0, flew("paper-periodic", [2.0, 2.1, 2.2], packets_per_s=9.0)),
    (40.0, flew("paper-periodic", [1.0, 1.1, 1.2], packets_per_s=20.0)),
)
OURS = (
    (2.0, flew("committed-gap", [0.8, 0.88, 0.96], packets_per_s=1.5)),
    (5.0, flew("committed-gap", [0.7, 0.77, 0.84], packets_per_s=4.9)),
    (10.0, flew("committed-gap", [0.5, 0.55, 0.6], packets_per_s=5.1)),
)


def test_ours_is_judged_with_the_most_that_it_may_spend() -> None:
    """The other contender flies within the largest budget; the share refers to its packets."""
    judged = judge(CLAIM, within(TARGET, *THEIRS, *OURS))
    assert judged is not None
    assert judged.theirs is THEIRS[1][1]
    assert judged.ours is OURS[1][1]
    assert judged.ratio is not None
    assert judged.ratio[0] == pytest.approx(0.7)
    assert judged.holds
    never = judge(CLAIM, within(TARGET, *THEIRS, OURS[2]))
    assert never is not None
    assert never.holds is False
    assert judge(CLAIM, within(TARGET, *OURS)) is None


def test_a_claim_holds_with_all_of_its_interval_or_not_at_all() -> None:
    wide = (2.0, flew("committed-gap", [0.1, 0.1, 1.9], packets_per_s=1.5))
    judged = judge(CLAIM, within(TARGET, *THEIRS, wide))
    assert judged is not None
    assert judged.ratio is not None
    assert judged.ratio[0] < 0.9 < judged.ratio[2]
    assert judged.holds is False
    unasked = judge(CLAIM, within(CASES[-1], *THEIRS, *OURS))
    assert unasked is not None
    assert unasked.holds is None


def test_a_run_that_went_astray_moves_the_mean_and_not_the_median() -> None:
    """The report has both, of a contender and of a ratio."""
    astray = (2.0, flew("committed-gap", [0.5, 0.6, 0.7, 50.0, 0.6], packets_per_s=1.5))
    steady = (40.0, flew("paper-periodic", [1.2, 1.2, 1.2, 1.2, 1.2], packets_per_s=20.0))
    assert astray[1].median() == pytest.approx(0.6)
    judged = judge(CLAIM, within(TARGET, astray, steady))
    assert judged is not None
    assert judged.medians == pytest.approx(0.5)
    assert judged.ratio is not None
    assert judged.ratio[0] > 8.0
    assert flew("committed-gap", [None]).median() is None


def test_the_best_within_a_budget_is_marked_and_ours_is_measured_against_it() -> None:
    """A contender over the budget has a dash in its column; one that failed comes last."""
    ours = flew("trajectory-expected", [0.3, 0.31], packets_per_s=3.0)
    best = flew("feedback-gap", [0.2, 0.21], packets_per_s=4.0)
    failed = flew("paper-event", [None, None], packets_per_s=1.0)
    compared = within(TARGET, (5.0, ours), (5.0, best), (10.0, best), (5.0, failed))
    lines = {row[1]: row[2:] for row in budgets_table([compared]).rows}
    dash = "–"
    assert lines["committed with feedback, cost gap"] == (
        *(dash, dash, "0.2050 ± 0.0635 (0.2050) @ 4.0 *", "0.2050 ± 0.0635 (0.2050) @ 4.0 *"),
        *(dash, dash),
    )
    assert lines["trajectory, expected gap"] == (
        *(dash, dash, "0.3050 ± 0.0635 (0.3050) @ 3.0"),
        *(dash, dash, dash),
    )
    ((_, budget, _, error, other, their_error, value, _),) = leaders_table([compared]).rows
    assert (budget, error, their_error) == ("≤ 5/s", "0.3050", "0.2050")
    assert other == "committed with feedback, cost gap"
    assert float(value) == pytest.approx(0.305 / 0.205, abs=1e-3)


def test_what_has_sent_more_than_its_budget_is_marked() -> None:
    """Its threshold was within the budget on other seeds."""
    runs = flew("paper-event", [0.3, 0.31], packets_per_s=2.3)
    (row,) = budgets_table([within(TARGET, (2.0, runs))]).rows
    assert "@ 2.3! *" in row[3]


def test_a_contender_of_ones_own_is_measured_against_the_best_as_well() -> None:
    own = Contender("mine", "mine", "", {}, keys={"control.horizon": 20})
    mine = ContenderRuns(
        FlownContender(own, 3.0, "", True, {}), flew("paper-event", [0.1, 0.1]).runs
    )
    best = flew("feedback-gap", [0.2, 0.2])
    table = leaders_table([within(TARGET, (5.0, mine), (5.0, best))])
    ((_, _, contender, error, _, their_error, value, _),) = table.rows
    assert (error, their_error, value) == ("0.1000", "0.2000", "0.500")
    assert contender == own.title


def test_a_contender_that_cannot_be_told_from_the_best_is_marked_as_well() -> None:
    """Seed by seed the second is better or worse than the first; the third is always worse."""
    best = flew("feedback-gap", [0.2, 0.3, 0.2])
    equal = flew("trajectory-expected", [0.21, 0.29, 0.21])
    worse = flew("paper-event", [0.3, 0.4, 0.3])
    table = budgets_table([within(TARGET, (5.0, best), (5.0, equal), (5.0, worse))])
    marked = {row[1]: row[4].endswith("*") for row in table.rows}
    assert [*marked.values()] == [False, True, True]
    found = [row["best"] for row in csv.DictReader(table.csv.splitlines())]
    assert found == ["false", "true", "true"]


def test_the_page_names_the_best_within_each_budget_and_counts_those_alike() -> None:
    """The second is as good seed by seed; nothing flew within the other budgets."""
    best = flew("feedback-gap", [0.2, 0.3, 0.2])
    alike = flew("trajectory-expected", [0.21, 0.29, 0.21])
    every = flew("paper-every-step", [0.3, 0.4, 0.35])
    compared = within(TARGET, (5.0, best), (5.0, alike), (40.0, every))
    ((case, *cells),) = choice_table([compared]).rows
    assert case.startswith("`target`: ")
    assert cells == [
        "0.350 ± 0.124",
        "–",
        "**committed with feedback, cost gap** 0.233 ± 0.143; 1 alike",
        "**paper, every step** 0.350 ± 0.124",
    ]


def test_where_nearly_all_are_as_good_as_the_best_none_is_marked() -> None:
    """The figures stand before the tables, the case over its rows, and the best in bold type."""
    alike = [flew(each.name, [0.2, 0.3 + 0.01 * at, 0.2]) for at, each in enumerate(CONTENDERS[:4])]
    better = flew(CONTENDERS[4].name, [0.05, 0.06, 0.05])
    compared = within(TARGET, *((5.0, each) for each in alike), (10.0, better), (10.0, alike[0]))
    table = budgets_table([compared])
    assert not [row for row in table.rows if row[4].endswith("*")]
    assert [row[1:3] + row[4:6] for row in table.rows if UNDECIDED in row] == [
        ("which is best", "", UNDECIDED, "")
    ]
    ((line, column),) = table.bold
    assert table.rows[line][1] == CONTENDERS[4].title
    assert table.heading[column] == "≤ 10/s"
    picture: Any = Picture("trade", "trade", "", b"")
    drawn = Drawn("", "", [table], [picture], "", figures_first=True)
    page = html(drawn, reading.load("demo"), [CommandCall.now("compare", []).facts(0)])
    assert page.index('id="trade"') < page.index('id="budgets"')
    assert page.count(TARGET.title) == 1
    assert page.count('class="best"') == 1


def test_a_contender_of_ones_own_is_highlighted() -> None:
    own = Contender("mine", "mine", "", {}, keys={"control.horizon": 20})
    mine = ContenderRuns(
        FlownContender(own, 3.0, "", True, {}), flew("paper-event", [0.1, 0.1]).runs
    )
    compared = within(TARGET, (5.0, mine), (5.0, flew("feedback-gap", [0.2, 0.2])))
    for table in (budgets_table([compared]), leaders_table([compared])):
        assert ["mine" in table.rows[at] for at in table.own] == [True]


def test_what_is_claimed_is_what_was_asked_for() -> None:
    for claim in CLAIMS:
        assert {claim.ours, claim.theirs} <= BY_NAME.keys()
        assert set(claim.at_most) <= BY_CASE.keys()


# -- the command ---------------------------------------------------------------------------------

REAL = {name: getattr(contenders, name) for name in ("quick", "QUICK")}
QUICK = ("paper-every-step", BESIDE, "trajectory-expected")
"""Contenders of `--quick` here."""
TUNE = ["compare", "--quick", "--tune", "--generations", "1"]
FLOWN_S = 4.0


def test_a_first_look_is_enough_for_a_verdict() -> None:
    """As many flights as a verdict needs, each counted for as long as it settles, and longer."""
    look = REAL["quick"](contenders.ComparisonSize(runs=100, generations=16))
    assert look.runs >= FLIGHTS_MIN
    for case in look.cases:
        assert not case.weights, "with the weights of another case, half as many flights"
        scenario = look.scenario(case)
        assert scenario.duration > 2 * scenario.settled_s


@pytest.fixture(scope="module")
def fewer() -> Iterator[None]:
    """`--quick` with two thresholds, the found one first, few, short flights, and a case without
    weights of its own.
    """
    real = contenders.quick
    brief = {"runs": 3, "duration": FLOWN_S, "search_duration": FLOWN_S, "scouts": 1, "rounds": 1}

    def quick(scale: contenders.ComparisonSize) -> contenders.ComparisonSize:
        cases = [case for case in scale.cases if case.name in ("target", "loss-0.5")]
        size = dataclasses.replace(real(scale), **brief)
        return dataclasses.replace(size, cases=cases) if cases else size

    with pytest.MonkeyPatch.context() as patch:
        for name in ("NEAR", "PERIODS"):
            factors = getattr(contenders, name)
            first = factors.index(1)
            patch.setattr(contenders, name, factors[first : first + 2])
        patch.setattr(contenders, "quick", quick)
        patch.setattr(contenders, "QUICK", QUICK)
        yield


@pytest.fixture(scope="module")
def tuned(fewer: None, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: ARG001
    folder = tmp_path_factory.mktemp("tuned")
    assert main([*TUNE, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def out(tuned: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare")
    weights = str(tuned / "weights.toml")
    assert main(["compare", "--quick", "--weights", weights, "--out", str(folder)]) == 0
    return folder


def test_every_contender_gets_the_same_search(tuned: Path) -> None:
    weights, searches = tuned / "weights.toml", list((tuned / "searches").iterdir())
    assert len(searches) == len(reading.names(str(weights))) == len(QUICK)
    for folder in searches:
        head = tomllib.loads((folder / "settings.toml").read_text())
        lines = map(json.loads, (folder / "journal.jsonl").read_text().splitlines())
        points = {name: values for _, (name, values) in lines}
        effort = (head["runs"], head["population"], head["sigma"], len(points))
        assert effort == (2, 4, 0.1, 4)
        limits = (head["packets"], head["effort_mps"], head["saturated"])
        assert limits == (0.1, TARGET.effort_mps, 1.0)
        found = reading.load(f"{weights}/{folder.name}")
        score = Rmse(found, SearchLimits(0.1, TARGET.effort_mps)).score
        best = json.loads(min(points, key=lambda name: score(points[name])))
        place = [key.partition("=")[0] for key in head["free"]].index("control.input_weight")
        assert found.control.input_weight == best[place]
        assert found.duration == PAPER.duration


def test_searches_that_are_done_are_not_done_again(
    tuned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = {path: path.read_bytes() for path in tuned.rglob("*") if path.is_file()}
    monkeypatch.setattr(pool.Crew, "share", None)
    assert main([*TUNE, "--out", str(tuned)]) == 0
    assert {path: path.read_bytes() for path in tuned.rglob("*") if path.is_file()} == kept


def rows(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


def test_the_tables_are_what_each_contender_flew(out: Path, tuned: Path) -> None:
    table = rows(out / "budgets.csv")
    assert {row["case"] for row in table} == {"target", "loss-0.5"}
    row = next(
        row for row in table if (row["case"], row["contender"]) == ("target", "trajectory-expected")
    )
    found = reading.load(f"{tuned / 'weights.toml'}/trajectory-expected-target")
    keys = {**REPORTS[row["report"]], "control.trigger.expected_gap": float(row["threshold"])}
    runs = [
        each.summary for each in skytether.fly_batch(found, [1, 2, 3], duration=FLOWN_S, **keys)
    ]
    for figure in ("rmse_xy", "packets_per_s", "bytes_per_s", "effort_mps", "uplink_due"):
        assert float(row[figure]) == pytest.approx(np.mean([getattr(run, figure) for run in runs]))
    assert float(row["packets_per_s"]) <= 1.3 * float(row["budget"])
    assert float(row["rmse_xy_median"]) == pytest.approx(np.median([run.rmse_xy for run in runs]))
    weights = {row["contender"]: row for row in rows(out / "weights.csv")}
    assert list(weights) == [*QUICK]
    here = float(weights["trajectory-expected"]["control.trigger.expected_gap"])
    expected = argument(TRIGGERS, found.control.trigger, "expected_gap")
    assert here == pytest.approx(expected, rel=1e-3)


def test_the_curves_are_there_as_numbers_and_pictures(out: Path) -> None:
    assert (out / "trade-target.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "trade-target.pdf").read_bytes().startswith(b"%PDF")
    points = rows(out / "trade-target.csv")
    assert {row["contender"] for row in points} <= {*QUICK}
    assert all(row["flown"] == row["runs"] == "3" for row in points)
    page = (out / "report.html").read_text()
    for name in {row["contender"] for row in points}:
        assert BY_NAME[name].title in page
    assert "http" not in page
    assert "lower bound" in page


@pytest.mark.long
def test_where_the_reference_is_known_it_is_flown_without_packets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = [BY_NAME[name] for name in ("paper-every-step", BESIDE, REGULATED)]
    monkeypatch.setattr(contenders, "CONTENDERS", known)
    argv = ["compare", "--quick", "--cases", "wind-0.3", "--out", str(tmp_path)]
    assert main([*argv, "--tune", "--generations", "1"]) == 0
    assert main([*argv, "--weights", str(tmp_path / "weights.toml")]) == 0
    table = {row["contender"]: row for row in rows(tmp_path / "budgets.csv")}
    assert float(table[ABOARD.name]["packets_per_s"]) == 0.0
    errors = {name: float(row["rmse_xy"]) for name, row in table.items()}
    assert errors[ABOARD.name] < 1.1 * min(errors[BESIDE], errors[REGULATED])
    assert errors[ABOARD.name] < 0.5 * errors["paper-every-step"]


@pytest.mark.long
def test_the_second_time_it_only_draws(
    out: Path, tuned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    weights = str(tuned / "weights.toml")
    assert main(["compare", "--quick", "--weights", weights, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "2 figures; 0 runs flown" in said
    assert "A first look: 2 flights" in said
    changed = {path.name for path, content in kept.items() if path.read_bytes() != content}
    assert changed == {"report.html", "calls.jsonl"}
    calls = [json.loads(line)["runs"] for line in (out / "calls.jsonl").read_text().splitlines()]
    assert calls[0] > 0
    assert calls[1] == 0


def test_other_weights_are_another_comparison(
    out: Path, tuned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    weights = (tuned / "weights.toml").read_text()
    file.write_text(weights.replace("input_weight = ", "input_weight = 77", 1))
    assert main(["compare", "--quick", "--weights", str(file), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"compare: {out / 'scouts' / 'target' / 'round-0'}: grid: got [")
    assert said.endswith("] to continue there; or choose another --out\n")


@pytest.mark.usefixtures("fewer")
def test_weights_that_nobody_has_searched_for_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    argv = ["compare", "--quick", "--weights", str(file), "--out", str(tmp_path)]
    assert main(argv) == 2
    said = f"compare: {file}: cannot be read: No such file or directory"
    assert capsys.readouterr().err.strip() == said
    file.write_text('["paper-every-step-target"]\nextends = "target"\n')
    assert main(argv) == 2
    said = (
        f"compare: {file}: got no table 'feedback-gap-target', "
        "expected every contender in every case, as --tune writes them"
    )
    assert capsys.readouterr().err.strip() == said


def test_weights_of_an_unknown_contender_are_refused(
    tuned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    weights = (tuned / "weights.toml").read_text()
    file.write_text(f'{weights}\n["trajectory-expectd-target"]\nextends = "target"\n')
    assert main(["compare", "--quick", "--weights", str(file), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"compare: {file}: got the table 'trajectory-expectd-target', expected")
    assert said.endswith("did you mean trajectory-expected-target?\n")


# -- contenders of a user ------------------------------------------------------------------------

MINE = """
extends = "trajectory-expected"
threshold = "control.trigger.deviation"
[control]
trigger = "deviation(0.05) | heartbeat"
"""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files without a folder are written outside of the checkout."""
    monkeypatch.chdir(tmp_path)


def written(text: str, name: str = "mine") -> Path:
    file = Path(f"{name}.toml")
    file.write_text(text)
    return file


@pytest.mark.long
@pytest.mark.usefixtures("unpainted")
def test_a_contender_of_a_user_is_flown_within_the_same_budgets_and_reported(
    tuned: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the library; the command then finds every flight in the folder."""
    beside = (BESIDE, "trajectory-expected")
    monkeypatch.setattr(contenders, "QUICK", beside)
    mine = written(MINE)
    weights = tuned / "weights.toml"
    found = skytether.compare(mine, cases=["target"], quick=True, weights=weights, out="own")
    own = [each for each in found if each.keys["contender"] == "mine"]
    assert own
    assert {each.keys["contender"] for each in found} <= {*beside, "mine"}
    base = reading.load(f"{weights}/trajectory-expected-target")
    for each in own:
        keys = {
            **REPORTS[each.keys["report"]],
            "control.trigger": f"deviation({each.keys['threshold']}) | heartbeat",
        }
        flown = skytether.fly_batch(base, [1, 2, 3], duration=FLOWN_S, **keys)
        assert [run.rmse_xy for run in each.runs] == [one.summary.rmse_xy for one in flown]
        assert each.scenario.control.input_weight == base.control.input_weight
    table = {(row["contender"], row["budget"]): row for row in rows(Path("own/budgets.csv"))}
    for each in own:
        row = table["mine", str(each.keys["budget"])]
        assert float(row["rmse_xy"]) == pytest.approx(each.mean("rmse_xy")[0])
    assert "mine" in {row["contender"] for row in rows(Path("own/trade-target.csv"))}
    argv = ["--quick", "--cases", "target", "--weights", str(weights), "--contender", str(mine)]
    assert main(["compare", *argv, "--out", "own"]) == 0
    assert "1 figures; 0 runs flown" in capsys.readouterr().out


def test_a_contender_of_a_user_keeps_its_reports_and_has_a_point_for_each_threshold() -> None:
    def points(text: str) -> list[FlownContender]:
        (own,) = contenders.of_user([written(text)])
        scale = contenders.ComparisonSize(runs=1, generations=1, contenders=[own])
        return Plan(BY_CASE["gusts"], COMPARED, scale).points

    searched = points(MINE)
    assert {point.report for point in searched} == {*REPORTS}
    assert len(searched) == len(REPORTS) * len(contenders.NEAR)
    fixed = points('[control]\ntrigger = "periodic(9)"\n[vehicle]\nreport = "silence(3)"\n')
    assert [(point.threshold, point.report, point.tuned) for point in fixed] == [
        (None, budgets.ITS_OWN, True)
    ]
    assert fixed[0].keys == {"control.trigger": "periodic(9)", "vehicle.report": "silence(3)"}


def test_the_documented_contender_can_be_flown() -> None:
    page = (Path(__file__).parents[2] / "docs" / "compare.md").read_text()
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (own,) = contenders.of_user([written(text)])
    found = contenders.tuned(own, TARGET, COMPARED)
    weights = reading.load(f"{COMPARED}/{BY_NAME['trajectory-expected'].name}-target")
    assert found.control == replace(weights.control, trigger="send_on_delta(0.5) | heartbeat")


def test_a_contender_that_fits_no_budget_has_a_row_of_dashes() -> None:
    (own,) = contenders.of_user([written('title = "Loud"\ncontrol.trigger = "always"')])
    point = FlownContender(own, None, "every step", True, own.keys)
    row = budgets_table([ComparedCase(TARGET, {}, [point])]).rows[0]
    assert row == (TARGET.title, "Loud", *["–"] * len(BUDGETS))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reference.speed_mps = 2", "mine.toml: got reference.speed_mps, expected title,"),
        ("vehicle.wind = 0.0", "mine.toml: got vehicle.wind, expected title,"),
        ("control.dt = 0.1", "mine.toml: got control.dt, expected title,"),
        ('extends = "trajectory-expected"', "mine.toml: got no keys, expected some of control,"),
        ('extends = "paper"\ncontrol.horizon = 9', "mine.toml: extends: got 'paper', expected"),
        ("title = 3\ncontrol.horizon = 9", "mine.toml: title: got 3, expected a text"),
        ('control.trigger = "cots_gap"', "mine, target: control.trigger: got 'cots_gap'"),
        ("control.horizom = 9", "mine, target: control.horizom: no such key; did you mean"),
        (
            'threshold = "vehicle.report.silence"\ncontrol.horizon = 9',
            "mine, target: threshold: got vehicle.report.silence, expected the key of a number",
        ),
        (
            'threshold = "control.trigger.cost_gap"\ncontrol.trigger = "always"',
            "mine, target: threshold: got trigger.cost_gap, expected the key of a number",
        ),
    ],
)
def test_an_impossible_contender_is_refused(text: str, said: str) -> None:
    file = written(text)
    with pytest.raises(ConfigError) as refused:
        skytether.compare(file, cases=["target"], quick=True)
    assert str(refused.value).startswith(said)
    assert not Path("compare").exists()


def test_a_contender_cannot_have_weights_that_its_case_lacks() -> None:
    (own,) = contenders.of_user([written('extends = "trajectory-gap"\ncontrol.horizon = 60')])
    assert contenders.tuned(own, TARGET, COMPARED).control.horizon == 60
    with pytest.raises(ConfigError, match="mine, gusts: extends: got 'trajectory-gap', expected"):
        contenders.tuned(own, BY_CASE["gusts"], COMPARED)


def test_two_contenders_have_two_names(capsys: pytest.CaptureFixture[str]) -> None:
    mine, theirs = written(MINE), written(MINE, "paper-event")
    for files in ([mine, mine], [theirs]):
        flags = [word for file in files for word in ("--contender", str(file))]
        assert main(["compare", "--quick", *flags]) == 2
        assert f"got the name {files[0].stem!r}, expected another" in capsys.readouterr().err
    assert main(["compare", "--tune", "--contender", str(mine)]) == 2
    assert "got it with --tune" in capsys.readouterr().err


@pytest.mark.realtime
@pytest.mark.long
def test_ctrl_c_ends_a_search_in_order_and_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, real in REAL.items():  # as in the process
        monkeypatch.setattr(contenders, name, real)
    count = len(contenders.QUICK)
    argv = [*TUNE[:3], "--generations", "2", "--workers", "1", "--out", str(tmp_path)]
    journal = tmp_path / "searches" / "paper-every-step-target" / "journal.jsonl"
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "skytether", *argv], stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not (
            journal.exists() and journal.read_text().count("\n") > 0
        ):
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=180)
    assert process.returncode == 130, said
    assert f"of {count} generations done; the same command goes on" in said
    assert not (tmp_path / "weights.toml").exists()
    flown = journal.read_text()
    assert main([*TUNE, "--out", str(tmp_path)]) == 0
    assert journal.read_text().startswith(flown)
    assert len(reading.names(str(tmp_path / "weights.toml"))) == count


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--runs", "0"], "--runs: got 0, expected 1 to 100000"),
        (["--generations", "0"], "--generations: got 0, expected 1 to 1000000"),
        (["--workers", "0"], "--workers: got 0, expected 1 to 1024"),
    ],
)
def test_an_impossible_comparison_is_refused(
    argv: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused_before_writing(["compare", *argv], tmp_path, capsys)
    assert message == f"compare: {said}"
