"""The comparison: who flies in what, at which weights, what is said of it, and its files."""

import csv
import json
import math
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skytether.__main__ import main
from skytether.lab import contenders
from skytether.lab.calibration import Rmse, SearchLimits
from skytether.lab.commands import pool
from skytether.lab.comparison import (
    BYTES_UP,
    CLAIMS,
    SHARE,
    Claim,
    ComparedCase,
    ContenderRuns,
    judge,
    measure,
    ranks_table,
    ratio,
)
from skytether.lab.contenders import (
    ABOARD,
    BESIDE,
    CASES,
    CONTENDERS,
    LOOKED_AT,
    Contender,
    FlownContender,
    Found,
)
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import reading
from skytether.shared.scenario.reading import COMPARED
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.summary import summarise
from skytether.sim import flight

pytestmark = pytest.mark.usefixtures("here")

PAPER = reading.load("paper")
BY_NAME = {contender.name: contender for contender in CONTENDERS}
BY_CASE = {case.name: case for case in CASES}
SCALE = contenders.ComparisonSize(100, 20)
TARGET = CASES[0]


# -- what is flown -------------------------------------------------------------------------------


def test_contenders_differ_in_scheme_and_trigger_alone_and_cases_in_what_is_met() -> None:
    """Plant, network and trajectory are the same for all who fly a case."""
    for contender, case in SCALE.searched:
        start = contenders.search_start(contender, case, SCALE)
        own = {f"control.{key}" for key in contender.control}
        assert set(contenders.differences(start, case.plant)) <= own | set(case.keys)
        assert not own & set(case.keys)
        assert start.seed == 1001
        assert start.duration == SCALE.search_duration


def test_the_search_never_sees_the_seeds_that_are_compared() -> None:
    """However many runs are asked for, up to a thousand."""
    start = contenders.search_start(CONTENDERS[0], TARGET, SCALE)
    assert not set(range(start.seed, start.seed + SCALE.search_runs)) & set(range(1, 1001))


def test_every_case_has_weights_that_were_searched_for_or_those_of_one_that_has() -> None:
    """All who fly in it are known, and all who fly at another's weights fly there, too."""
    for case in CASES:
        assert set(case.contenders) <= BY_NAME.keys()
        base = BY_CASE[case.weights or case.name]
        assert not base.weights
        assert {each.name for each in SCALE.who(case)} <= {each.name for each in SCALE.who(base)}
        assert base.plant == case.plant
        assert base.effort_mps < math.inf
        assert BESIDE in {each.name for each in SCALE.who(base)}


def test_a_case_may_be_named() -> None:
    """Another than those there are is refused."""
    assert contenders.cases([]) == CASES
    assert [case.name for case in contenders.cases(["gusts", "target"])] == ["gusts", "target"]
    with pytest.raises(ConfigError, match="--cases: got 'gust', expected others; did you mean"):
        contenders.cases(["gust"])


def test_every_contender_in_every_case_comes_along() -> None:
    """Under its name, in one file; with weights that were free, and nothing else changed."""
    pairs = {contenders.entry(*pair): pair for pair in SCALE.searched}
    assert {name.removeprefix("compare/") for name in reading.names(COMPARED)} == set(pairs)
    for name, (contender, case) in pairs.items():
        start = contenders.search_start(contender, case, SCALE)
        scenario, free = reading.load(f"{COMPARED}/{name}"), Rmse(start, SearchLimits()).free()
        there = contenders.differences(start, case.plant)
        here = contenders.differences(scenario, case.plant)
        changed = {key for key, value in here.items() if value != there.get(key)}
        assert changed <= {key.key.removesuffix(".0").removesuffix(".1") for key in free}, name
        assert scenario.control.state_weight[0] == PAPER.control.state_weight[0]
        assert scenario.title == f"{contender.title}, at its best: {case.title}"
    assert "compare" not in " ".join(reading.names())


def test_the_file_of_what_was_found_is_read_as_it(tmp_path: Path) -> None:
    """The file holds what differs from the plant, and where that comes from."""
    contender, case = BY_NAME["committed-gap"], BY_CASE["gusts"]
    start = contenders.search_start(contender, case, SCALE)
    control = replace(start.control, state_weight=(7.1, 1e-4), cost_gap=12.5)
    found = replace(start, control=control)
    file = tmp_path / "mine.toml"
    file.write_text(contenders.to_file([Found(contender, case, found, "A line.")], SCALE))
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


def thresholds(
    contender: Contender, scenario: Scenario, case: str = "gusts"
) -> dict[float | None, bool]:
    """Those of its curve, and which is tuned."""
    points = contenders.flying(contender, BY_CASE[case], scenario, SCALE)
    return {point.threshold: point.tuned for point in points}


def test_a_curve_goes_through_what_was_found_and_rises() -> None:
    """Thresholds around it; whole steps of a period, none of them twice; one point of `always`."""
    gap = replace(PAPER, control=replace(PAPER.control, cost_gap=0.8))
    found = thresholds(BY_NAME["committed-gap"], gap)
    assert list(found) == pytest.approx([0.32, 0.64, 0.8, 1.0, 2.0])
    assert [value for value, tuned in found.items() if tuned] == [0.8]
    assert list(thresholds(BY_NAME["paper-periodic"], PAPER)) == [2, 5, 10, 15, 30]
    often = replace(PAPER, control=replace(PAPER.control, period=2))
    assert list(thresholds(BY_NAME["paper-periodic"], often)) == [1, 2, 3, 6]
    assert thresholds(BY_NAME["paper-every-step"], PAPER) == {None: True}


def test_where_nobody_has_searched_the_weights_of_another_case_meet_what_is_met_there() -> None:
    """One threshold; the network is the case's own, whatever the weights were found with."""
    contender, case = BY_NAME["committed-gap"], BY_CASE["loss-0.5"]
    tuned = contenders.search_start(contender, TARGET, SCALE)
    assert thresholds(contender, tuned, "loss-0.5") == {tuned.control.cost_gap: True}
    lossy = replace(tuned.network.uplink, loss=0.2)
    tuned = replace(tuned, network=replace(tuned.network, uplink=lossy))
    (flying,) = contenders.flying(contender, case, tuned, SCALE)
    assert not flying.control.keys() & case.keys.keys()


# -- what is said of it --------------------------------------------------------------------------

SUMMARY = summarise(PAPER, "paper", flight.fly(replace(PAPER, duration=6.0)).client)


def flew(
    name: str,
    errors: Sequence[float | None],
    *,
    share: float = 0.1,
    threshold: float | None = None,
    tuned: bool = True,
) -> ContenderRuns:
    """A contender with these errors, that sent a share of its 20 packets/s."""
    counts = {"uplink_packets": round(1200 * share), "uplink_bytes": 60_000}
    counts |= {"downlink_packets": 1200, "downlink_bytes": 120_000}
    runs = [
        replace(SUMMARY, rmse_xy=error, event_ratio=share, duration_s=60.0, **counts)
        for error in errors
    ]
    return ContenderRuns(FlownContender(BY_NAME[name], threshold, tuned, {}), runs)


def test_packets_and_bytes_are_of_a_second_of_flight() -> None:
    """Bytes both ways; what has not flown counts in nothing."""
    one = flew("paper-event", [0.1, None, 0.3])
    assert one.estimate("rmse_xy")[0] == pytest.approx(0.2)
    assert one.estimate("uplink_packets_per_s")[0] == pytest.approx(2.0)
    assert one.estimate("total_bytes_per_s")[0] == pytest.approx(3000.0)
    assert one.estimate(BYTES_UP)[0] == pytest.approx(1000.0)
    assert measure(one.runs[1], "uplink_packets_per_s") is None
    assert math.isnan(flew("paper-event", [None]).mean("rmse_xy"))


ERRORS = st.lists(st.tuples(st.floats(0.01, 10.0), st.floats(0.01, 10.0)), min_size=2, max_size=30)


@given(ERRORS, st.floats(0.1, 10.0))
@settings(max_examples=30)
def test_a_ratio_lies_in_its_interval_and_goes_with_what_is_compared(
    errors: list[tuple[float, float]], factor: float
) -> None:
    """Ratio of the means; twice the error is twice the ratio, and its interval."""
    ours, theirs = zip(*errors, strict=True)
    found = ratio(flew("paper-event", ours), flew("paper-periodic", theirs))
    more = ratio(flew("paper-event", np.multiply(ours, factor)), flew("paper-periodic", theirs))
    assert found is not None
    assert more is not None
    value, low, high = found
    assert value == pytest.approx(np.mean(ours) / np.mean(theirs))
    assert low <= high + 1e-9
    assert min(np.divide(ours, theirs)) - 1e-9 <= low
    assert high <= max(np.divide(ours, theirs)) + 1e-9
    np.testing.assert_allclose(more, np.multiply(found, factor))


def test_an_interval_is_of_pairs() -> None:
    """What varies from seed to seed for both alike does not widen it; unpaired it would."""
    rng = np.random.default_rng(3)
    seeds = rng.uniform(0.1, 1.0, 50)
    found = ratio(flew("paper-event", 0.5 * seeds), flew("paper-periodic", seeds))
    assert found == pytest.approx((0.5, 0.5, 0.5))
    mixed = ratio(flew("paper-event", 0.5 * rng.permutation(seeds)), flew("paper-periodic", seeds))
    assert mixed is not None
    assert mixed[2] - mixed[1] > 0.05


def test_a_bootstrap_is_an_interval_of_students_where_both_apply() -> None:
    """Errors spread little, so that the ratio of means is nearly linear."""
    rng = np.random.default_rng(4)
    ours, theirs = 1.0 + 0.05 * rng.standard_normal((2, 100))
    found = ratio(flew("paper-event", ours), flew("paper-periodic", theirs))
    assert found is not None
    half = 1.984 * np.std(ours - theirs, ddof=1) / math.sqrt(100)
    assert found[1] == pytest.approx(found[0] - half, abs=0.2 * half)
    assert found[2] == pytest.approx(found[0] + half, abs=0.2 * half)


def test_seeds_that_did_not_fly_in_both_are_left_out() -> None:
    """Fewer than two common seeds are no comparison."""
    ours, theirs = flew("paper-event", [1.0, None, 3.0]), flew("paper-periodic", [2.0, 2.0, 2.0])
    found = ratio(ours, theirs)
    assert found is not None
    assert found[0] == pytest.approx(1.0)
    assert ratio(flew("paper-event", [1.0, None]), flew("paper-periodic", [2.0, 2.0])) is None


CLAIM = Claim("committed-gap", "committed-periodic", at_most={"target": 0.9})
PERIODIC = flew("committed-periodic", [1.0, 1.1, 1.2])


def curve(*points: tuple[float, float, float]) -> list[ContenderRuns]:
    """Curve of the cost gap: threshold, share of packets, error; the first of them is tuned."""
    return [
        flew(
            "committed-gap",
            [error, 1.1 * error, 1.2 * error],
            share=share,
            threshold=threshold,
            tuned=threshold == points[0][0],
        )
        for threshold, share, error in points
    ]


def test_what_sends_too_much_is_judged_at_the_next_threshold_that_does_not() -> None:
    """The best of the curve is not taken: it would be chosen on the seeds that are reported."""
    judged = judge(
        CLAIM, TARGET, [*curve((1, 0.11, 0.5), (2, 0.09, 0.8), (8, 0.05, 0.7)), PERIODIC]
    )
    assert judged.ours.what.threshold == 2
    assert judged.ratio is not None
    assert judged.ratio[0] == pytest.approx(0.8)
    assert judged.holds
    never = judge(CLAIM, TARGET, [*curve((1, 0.3, 0.5), (2, 0.2, 0.5)), PERIODIC])
    assert never.holds is False
    sparse = judge(CLAIM, TARGET, [*curve((1, 0.1, 0.5), (2, 0.09, 0.8)), PERIODIC])
    assert sparse.ours.what.threshold == 1


def test_a_claim_holds_with_all_of_its_interval_or_not_at_all() -> None:
    """Where nothing is asked for, a claim neither holds nor fails."""
    assert not judge(CLAIM, TARGET, [*curve((1, 0.1, 0.95)), PERIODIC]).holds
    wide = flew("committed-gap", [0.1, 0.1, 1.9], threshold=1)
    judged = judge(CLAIM, TARGET, [wide, PERIODIC])
    assert judged.ratio is not None
    assert judged.ratio[0] < 0.9 < judged.ratio[2]
    assert judged.holds is False
    assert judge(CLAIM, CASES[-1], [*curve((1, 0.1, 0.5)), PERIODIC]).holds is None


def test_a_share_of_the_steps_may_be_the_limit() -> None:
    """Against one that sends at every step, the same packets would be no limit."""
    claim = Claim("committed-gap", "paper-every-step", SHARE, {"target": 0.75})
    every = flew("paper-every-step", [1.0, 1.1, 1.2], share=1.0)
    assert judge(claim, TARGET, [*curve((1, 0.09, 0.5)), every]).holds
    assert not judge(claim, TARGET, [*curve((1, 0.11, 0.5)), every]).holds


def test_what_is_equal_may_be_bytes() -> None:
    """Packets of one may be longer than those of another that sends as often."""
    claim = Claim("committed-gap", "committed-periodic", BYTES_UP, {"target": 0.9})
    few = [replace(run, uplink_bytes=50_000) for run in PERIODIC.runs]
    assert judge(claim, TARGET, [*curve((1, 0.1, 0.5)), PERIODIC]).holds
    assert not judge(
        claim, TARGET, [*curve((1, 0.1, 0.5)), ContenderRuns(PERIODIC.what, few)]
    ).holds


def test_a_run_that_went_astray_moves_the_mean_and_not_the_median() -> None:
    """Both are told, of a contender and of a ratio."""
    astray = flew("committed-gap", [0.5, 0.6, 0.7, 50.0, 0.6], threshold=1)
    steady = flew("committed-periodic", [1.2, 1.2, 1.2, 1.2, 1.2])
    assert astray.median() == pytest.approx(0.6)
    judged = judge(CLAIM, TARGET, [astray, steady])
    assert judged.medians == pytest.approx(0.5)
    assert judged.ratio is not None
    assert judged.ratio[0] > 8.0
    assert flew("committed-gap", [None]).median() is None


def test_nobodys_rank_is_hidden() -> None:
    """By mean error in each case; who has not flown comes last."""
    here = [flew("paper-event", [0.3]), flew("committed-gap", [0.2]), flew("feedback-gap", [None])]
    there = [flew("paper-event", [0.3]), flew("committed-gap", [0.4]), flew("feedback-gap", [0.1])]
    table = ranks_table([ComparedCase(TARGET, here), ComparedCase(BY_CASE["loss-0.5"], there)])
    assert [row[1:] for row in table.rows] == [
        ("2: 0.300 @ 10%", "2: 0.300 @ 10%"),
        ("1: 0.200 @ 10%", "3: 0.400 @ 10%"),
        ("3: – @ –", "1: 0.100 @ 10%"),
    ]
    assert len(table.csv.splitlines()) == 1 + 2 * 3


def test_what_is_claimed_is_what_was_asked_for() -> None:
    """Every claim is about contenders and cases that exist."""
    for claim in CLAIMS:
        assert {claim.ours, claim.theirs} <= BY_NAME.keys()
        assert set(claim.at_most) <= BY_CASE.keys()


# -- the command ---------------------------------------------------------------------------------

TUNE = ["compare", "--quick", "--tune", "--generations", "1"]
FLOWN = 38
"""Runs of a quick comparison: one contender at one threshold, three at three, three times; and in
a case that nobody has searched all at one, twice."""


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of quick searches, with the file of the weights that they have found."""
    folder = tmp_path_factory.mktemp("tuned")
    assert main([*TUNE, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def out(tuned: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a quick comparison."""
    folder = tmp_path_factory.mktemp("compare")
    weights = str(tuned / "weights.toml")
    assert main(["compare", "--quick", "--weights", weights, "--out", str(folder)]) == 0
    return folder


def test_every_contender_gets_the_same_search(tuned: Path) -> None:
    """Seeds, points, flights and limits; what it found is its scenario."""
    weights, searches = tuned / "weights.toml", list((tuned / "searches").iterdir())
    assert len(searches) == len(reading.names(str(weights))) == len(LOOKED_AT)
    for folder in searches:
        head = tomllib.loads((folder / "settings.toml").read_text())
        (line,) = (folder / "journal.jsonl").read_text().splitlines()
        _, generation = json.loads(line)
        effort = (head["runs"], head["population"], head["sigma"], len(generation))
        assert effort == (2, 4, 0.1, 4)
        limits = (head["packets"], head["effort_mps"], head["saturated"])
        assert limits == (0.1, TARGET.effort_mps, contenders.SATURATED)
        best = min(generation, key=lambda point: point["score"])
        found = reading.load(f"{weights}/{folder.name}")
        assert found.control.input_weight == best["keys"]["control.input_weight"]
        assert found.duration == PAPER.duration


def test_searches_that_are_done_are_not_done_again(
    tuned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A repeated command reads their journals, and writes the same."""
    kept = {path: path.read_bytes() for path in tuned.rglob("*") if path.is_file()}
    monkeypatch.setattr(pool.Crew, "share", None)
    assert main([*TUNE, "--out", str(tuned)]) == 0
    assert {path: path.read_bytes() for path in tuned.rglob("*") if path.is_file()} == kept


def rows(file: Path) -> list[dict[str, str]]:
    """Rows of a table."""
    return list(csv.DictReader(file.read_text().splitlines()))


def test_the_tables_are_what_each_contender_flew(out: Path, tuned: Path) -> None:
    """Means over the seeds from 1 on, of the scenario in the file of weights."""
    table = rows(out / "contenders.csv")
    assert [row["contender"] for row in table] == [*LOOKED_AT] * 2
    (row,) = [row for row in table if (row["case"], row["contender"]) == ("target", "feedback-gap")]
    found = reading.load(f"{tuned / 'weights.toml'}/feedback-gap-target")
    scenario = replace(found, duration=12.0)
    runs = [
        summarise(replace(scenario, seed=seed), "", each.client, each.server, each.netem)
        for seed, each in enumerate(flight.fly_batch(scenario, [1, 2, 3]), start=1)
    ]
    errors = [run.rmse_xy for run in runs]
    packets = [run.uplink_packets for run in runs]
    assert float(row["rmse_xy"]) == pytest.approx(np.mean(errors))
    assert float(row["rmse_xy_median"]) == pytest.approx(np.median(errors))
    assert float(row["uplink_packets_per_s"]) == pytest.approx(np.mean(packets) / 12.0)
    assert float(row["effort_mps"]) == pytest.approx(np.mean([run.effort_mps for run in runs]))
    assert float(row["threshold"]) == scenario.control.cost_gap
    (weights,) = [row for row in rows(out / "weights.csv") if row["contender"] == "feedback-gap"]
    assert float(weights["control.cost_gap"]) == pytest.approx(scenario.control.cost_gap, rel=1e-3)
    ranks = [row["rank"] for row in rows(out / "ranks.csv") if row["case"] == "loss-0.5"]
    assert sorted(ranks) == ["1", "2", "3", "4"]


def test_the_curves_are_there_as_numbers_and_pictures(out: Path) -> None:
    """A row for each point, one of each contender tuned, and PNG and PDF beside it."""
    assert (out / "trade-target.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "trade-target.pdf").read_bytes().startswith(b"%PDF")
    points = rows(out / "trade-target.csv")
    assert len(points) == 10
    assert [row["contender"] for row in points if row["tuned"] == "true"] == [*LOOKED_AT]
    assert all(row["flown"] == row["runs"] == "3" for row in points)
    page = (out / "report.html").read_text()
    for name in LOOKED_AT:
        assert BY_NAME[name].title.replace("'", "&#39;") in page
    assert "http" not in page
    assert "floor" in page


def test_where_the_reference_is_known_it_is_flown_without_packets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the weights of the contender with feedback aboard; nobody with packets is nearer."""
    known = [BY_NAME[name] for name in ("paper-every-step", BESIDE)]
    monkeypatch.setattr(contenders, "CONTENDERS", known)
    argv = ["compare", "--quick", "--cases", "wind-0.3", "--out", str(tmp_path)]
    assert main([*argv, "--tune", "--generations", "1"]) == 0
    assert main([*argv, "--weights", str(tmp_path / "weights.toml")]) == 0
    table = {row["contender"]: row for row in rows(tmp_path / "contenders.csv")}
    assert list(table) == [*(each.name for each in known), ABOARD.name]
    assert float(table[ABOARD.name]["uplink_packets_per_s"]) == 0.0
    errors = {name: float(row["rmse_xy"]) for name, row in table.items()}
    assert errors[ABOARD.name] < 1.1 * errors[BESIDE]
    assert errors[ABOARD.name] < 0.5 * errors["paper-every-step"]


def test_the_second_time_it_only_draws(
    out: Path, tuned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second run flies nothing, and says what the first one said."""
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    weights = str(tuned / "weights.toml")
    assert main(["compare", "--quick", "--weights", weights, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "1 figures; 0 runs flown" in said
    assert "ratios that are asked for hold" in said
    changed = {path.name for path, content in kept.items() if path.read_bytes() != content}
    assert changed == {"report.html", "calls.jsonl"}
    calls = [json.loads(line)["runs"] for line in (out / "calls.jsonl").read_text().splitlines()]
    assert calls[:2] == [FLOWN, 0]


def test_other_weights_are_another_comparison(
    out: Path, tuned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was flown with those of before is not mixed with them."""
    file = tmp_path / "mine.toml"
    weights = (tuned / "weights.toml").read_text()
    file.write_text(weights.replace("input_weight = ", "input_weight = 77", 1))
    assert main(["compare", "--quick", "--weights", str(file), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"compare: {out / 'sweeps' / 'target'}: grid: got [")
    assert said.endswith("], to go on there; or another --out\n")


def test_weights_that_nobody_has_searched_for_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rather than the plant's own, in silence."""
    file = tmp_path / "mine.toml"
    argv = ["compare", "--quick", "--weights", str(file), "--out", str(tmp_path)]
    assert main(argv) == 2
    said = f"compare: {file}: cannot be read: No such file or directory"
    assert capsys.readouterr().err.strip() == said
    file.write_text('["paper-every-step-target"]\nextends = "target"\n')
    assert main(argv) == 2
    said = (
        f"compare: {file}: got no table 'paper-event-target', "
        "expected every contender in every case, as --tune writes them"
    )
    assert capsys.readouterr().err.strip() == said


@pytest.mark.long
def test_ctrl_c_ends_a_search_in_order_and_the_same_command_goes_on(
    tuned: Path, tmp_path: Path
) -> None:
    """What is in its journal stays there."""
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
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert f"of {2 * len(LOOKED_AT)} generations done; the same command goes on" in said
    assert not (tmp_path / "weights.toml").exists()
    flown = journal.read_text()
    for name in LOOKED_AT[1:]:  # a generation of theirs is done
        shutil.copytree(
            tuned / "searches" / f"{name}-target",
            journal.parents[1] / f"{name}-target",
            dirs_exist_ok=True,
        )
    assert main([*TUNE, "--out", str(tmp_path)]) == 0
    assert journal.read_text().startswith(flown)
    assert len(reading.names(str(tmp_path / "weights.toml"))) == len(LOOKED_AT)


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
    """In one line, before anything is written."""
    assert main(["compare", "--out", str(tmp_path / "out"), *argv]) == 2
    assert capsys.readouterr().err.strip() == f"compare: {said}"
    assert not (tmp_path / "out").exists()
