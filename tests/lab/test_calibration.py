"""Search for parameters that the paper does not print: free keys, scores, journal."""

import json
import shutil
import tomllib
from pathlib import Path

import pytest
from msgspec.structs import replace

from helpers import refusal, refused_before_writing
from skytether.__main__ import main
from skytether.lab.engine import calibration
from skytether.lab.engine.calibration import (
    COLUMNS,
    ONLY,
    TABLE_1,
    UNFLYABLE,
    Rmse,
    SearchLimits,
    Table1,
)
from skytether.lab.engine.intervals import interval
from skytether.lab.engine.search import (
    Free,
    Objective,
    Optimiser,
    SearchPoint,
    Values,
    check_free,
    put,
)
from skytether.lab.engine.sweep import summaries
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import value

pytestmark = pytest.mark.usefixtures("here")

PAPER = reading.load("paper")
RADIUS = Free("reference.radius_m", 0.5, 5.0)
LAG = Free("model.tau_s.0", 0.2, 2.0)
TENTH = SearchLimits(packets=0.1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reference.radius_m", "got 'reference.radius_m', expected KEY=LOW:HIGH"),
        ("reference.radius_m=1", "got 'reference.radius_m=1', expected KEY=LOW:HIGH"),
        ("reference.radius_m=a:b", "got 'reference.radius_m=a:b', expected KEY=LOW:HIGH"),
        ("reference.radius_m=1:2:3", "got 'reference.radius_m=1:2:3', expected KEY=LOW:HIGH"),
        (
            "reference.radius_m=2:1",
            "reference.radius_m: got the bounds 2:1, expected 0 < LOW < HIGH",
        ),
        (
            "reference.radius_m=0:1",
            "reference.radius_m: got the bounds 0:1, expected 0 < LOW < HIGH",
        ),
        (
            "reference.radius_m=1:inf",
            "reference.radius_m: got the bounds 1:inf, expected 0 < LOW < HIGH",
        ),
    ],
)
def test_a_free_key_that_is_none_is_refused(text: str, said: str) -> None:
    assert refusal(lambda: Free.parse(text)) == f"--free: {said}"


def test_a_free_key_is_read_as_it_is_meant() -> None:
    assert Free.parse("model.tau_s.0=0.2:2") == LAG
    assert put(PAPER, {LAG: 0.5, RADIUS: 2.0}) == replace(
        PAPER,
        model=replace(PAPER.model, tau_s=(0.5,)),
        reference=replace(PAPER.reference, radius_m=2.0),
    )


@pytest.mark.parametrize(
    ("free", "said"),
    [
        (Free("reference.radius", 1.0, 2.0), "got reference.radius, expected the key of a number"),
        (Free("model.tau_s.7", 1.0, 2.0), "got model.tau_s.7, expected the key of a number"),
        (Free("control.trigger", 1.0, 2.0), "got control.trigger, expected the key of a number"),
        (
            Free("reference.radius_m", 3.0, 5.0),
            "reference.radius_m: got the bounds 3 to 5, expected bounds around 1.55",
        ),
    ],
)
def test_what_cannot_be_searched_for_is_refused(free: Free, said: str) -> None:
    assert refusal(lambda: check_free([free], PAPER)).startswith(f"--free: {said}")


def off_by(share: float) -> Values:
    return {
        column: {name: value * (1.0 + share) for name, value in entries.items()}
        for column, entries in TABLE_1.items()
    }


def test_the_score_is_the_squares_of_the_deviations_and_punishes_those_out_of_tolerance() -> None:
    assert Table1().score(TABLE_1) == 0.0
    assert Table1().score(off_by(0.05)) == pytest.approx(10 * 0.05**2)
    assert Table1().score(off_by(0.15)) == pytest.approx((9 * 10 + 1) * 0.15**2)
    assert Table1().score(off_by(float("nan"))) == UNFLYABLE
    assert calibration.is_admissible(off_by(-0.09))
    assert not calibration.is_admissible(off_by(0.11))
    assert set(COLUMNS) == set(TABLE_1)


def weighs(trigger: str) -> Rmse:
    """Objective of the smallest error at a tenth of the steps, with a trigger."""
    return Rmse(replace(PAPER, control=replace(PAPER.control, trigger=trigger)), TENTH)


def flew(
    rmse_xy: float | None,
    event_ratio: float,
    most: float,
    effort_mps: float = 0.1,
    saturated: float = 0.0,
) -> Values:
    here = {"rmse_xy": rmse_xy, "event_ratio": event_ratio, "event_ratio_most": most}
    return {ONLY: {**here, "effort_mps": effort_mps, "saturated": saturated}}


def test_the_smallest_error_may_not_be_bought_with_packets() -> None:
    """With an event trigger, the score uses the upper end of the event ratio's interval."""
    event, every = weighs("state_gap"), weighs("always")
    assert event.score(flew(0.2, 0.08, 0.09)) == 0.2
    assert event.score(flew(0.2, 0.09, 0.11)) == pytest.approx(0.2 * 1.1**3)
    assert event.score(flew(0.1, 0.2, 0.2)) == pytest.approx(0.8)
    assert every.score(flew(0.1, 1.0, 1.0)) == 0.1
    assert every.score(flew(None, 1.0, 1.0)) == UNFLYABLE
    told, clock = weighs("state_gap(3.6, 1.5) & budget(5, 2)"), weighs("periodic(2) | silence(1)")
    assert told.score(flew(0.1, 0.2, 0.2)) == pytest.approx(0.8)
    assert clock.score(flew(0.1, 0.5, 0.5)) == 0.1


def test_the_smallest_error_may_not_be_bought_with_effort() -> None:
    limited = Rmse(weighs("always").scenario, SearchLimits(effort_mps=0.3, saturated=0.1))
    assert limited.score(flew(0.2, 1.0, 1.0, effort_mps=0.3, saturated=0.1)) == 0.2
    assert limited.score(flew(0.2, 1.0, 1.0, effort_mps=0.33)) == pytest.approx(0.2 * 1.1**3)
    assert limited.score(flew(0.2, 1.0, 1.0, saturated=0.2)) == pytest.approx(0.2 * 2**3)
    both = limited.score(flew(0.2, 1.0, 1.0, effort_mps=0.6, saturated=0.2))
    assert both == pytest.approx(0.2 * 2**6)
    assert weighs("always").score(flew(0.2, 1.0, 1.0, effort_mps=9.0, saturated=1.0)) == 0.2


def test_what_is_searched_for_follows_from_the_trigger_and_from_what_is_on() -> None:
    """Fixed are the position's weight, because only ratios matter, and keys that are 0 for
    "off".
    """
    weights = {
        "control.state_weight.1",
        "control.terminal_weight.0",
        "control.terminal_weight.1",
        "control.input_weight",
        "control.change_weight",
    }
    assert {key.key for key in weighs("always").free()} == weights
    own = {f"control.trigger.state_gap.{name}" for name in ("epsilon", "decay_rate")}
    assert {key.key for key in weighs("state_gap").free()} == weights | own
    off = replace(PAPER, control=replace(PAPER.control, trigger="always", change_weight=0.0))
    assert {key.key for key in Rmse(off, TENTH).free()} == weights - {"control.change_weight"}
    learns = replace(off.control, scheme="committed", observer_s=2.0, change_weight=0.1)
    committed = Rmse(replace(off, control=learns), TENTH)
    assert {key.key for key in committed.free()} == weights | {"control.observer_s"}


@pytest.mark.parametrize(
    ("trigger", "keys"),
    [
        ("periodic", []),
        ("cost_gap & budget(5, 2)", ["control.trigger.cost_gap"]),
        ("deviation(1) | silence(1)", ["control.trigger.deviation"]),
        ("cost_gap | (cost_gap & always)", ["control.trigger.cost_gap"]),
    ],
)
def test_a_trigger_has_the_keys_of_the_policies_in_it(trigger: str, keys: list[str]) -> None:
    assert [key.key for key in calibration.trigger_keys(trigger)] == keys


def test_a_point_is_its_flights_with_an_upper_end_of_what_they_send() -> None:
    """Mean, and the upper end of the 95 % interval; None if a flight failed."""
    short = replace(PAPER, duration=4.0, settle=0.0)
    here = Rmse(short, TENTH).fly(short, [5, 6, 7])[ONLY]
    runs = summaries("", short, [5, 6, 7])
    ratios = [run.event_ratio for run in runs if run.event_ratio is not None]
    mean, half = interval(ratios)
    assert mean is not None
    assert half is not None
    assert here["event_ratio"] == pytest.approx(mean)
    assert here["event_ratio_most"] == pytest.approx(mean + half)
    assert here["rmse_xy"] == pytest.approx(sum(run.rmse_xy or 0.0 for run in runs) / 3)
    deaf = "loss(1)"
    deaf = replace(short, network=replace(short.network, uplink=deaf))
    assert Rmse(deaf, TENTH).score(Rmse(deaf, TENTH).fly(deaf, [5])) == UNFLYABLE


def test_a_search_begins_where_it_was_told_to() -> None:
    search = Optimiser(PAPER, [RADIUS, LAG], population=5, sigma=0.3, seed=1)
    first, *others = search.ask()
    assert search.values(first) == pytest.approx(search.values(PAPER), rel=1e-3)
    for other in others:
        assert 0.5 <= other.reference.radius_m <= 5.0
        assert 0.2 <= other.model.tau_s[0] <= 2.0


def test_a_search_told_the_same_proposes_the_same() -> None:
    searches = [Optimiser(PAPER, [RADIUS, LAG], population=5, sigma=0.3, seed=1) for _ in range(2)]
    proposed = []
    for search in searches:
        for _ in range(3):
            search.ask()
            search.tell([3.0, 1.0, 2.0, 5.0, 4.0])
        proposed.append(search.ask())
    assert proposed[0] == proposed[1]


SHORT = ["--duration", "2", "--settle", "0", "--runs", "2", "--population", "4", "--workers", "1"]
ARGV = ["calibrate", "paper", *SHORT, "--free", "reference.radius_m=0.5:5", "model.tau_s.0=0.2:2"]


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("search")
    assert main([*ARGV, "--generations", "2", "--out", str(out)]) == 0
    return out


def flown(out: Path, objective: Objective) -> list[SearchPoint]:
    free = [
        key.partition("=")[0] for key in tomllib.loads((out / "settings.toml").read_text())["free"]
    ]
    points = []
    for line in (out / "journal.jsonl").read_text().splitlines():
        name, values = json.loads(line)[1]
        keys = dict(zip(free, json.loads(name), strict=True))
        points.append(SearchPoint(keys, values, objective.score(values)))
    return points


def test_the_best_point_of_all_is_kept(searched: Path) -> None:
    points = flown(searched, Table1())
    assert len(points) == 8
    best = min(points, key=lambda point: point.score)
    found = reading.load(str(searched / "best.toml"))
    assert found.reference.radius_m == best.keys["reference.radius_m"]
    assert found.model.tau_s == (best.keys["model.tau_s.0"],)


def test_a_search_goes_on_from_its_journal_though_a_line_was_cut(
    searched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Killed during its second generation, it continues to the same journal, byte for byte."""
    whole = (searched / "journal.jsonl").read_text()
    shutil.copy(searched / "settings.toml", tmp_path)
    (tmp_path / "journal.jsonl").write_text(whole[: -len(whole.splitlines()[-1]) // 2])
    assert main([*ARGV, "--generations", "2", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "journal.jsonl").read_text() == whole
    assert "of 8 points have every entry within tolerance" in capsys.readouterr().out


def test_the_smallest_error_is_searched_for_and_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["calibrate", "paper", "--objective", "rmse", "--packets", "0.3", *SHORT]
    assert main([*argv, "--generations", "2", "--out", str(tmp_path)]) == 0
    settings = tomllib.loads((tmp_path / "settings.toml").read_text())
    assert (settings["objective"], settings["packets"]) == ("rmse", 0.3)
    points = flown(tmp_path, Rmse(PAPER, SearchLimits(packets=0.3)))
    best = min(points, key=lambda point: point.score)
    found = reading.load(str(tmp_path / "best.toml"))
    key = "control.trigger.state_gap.epsilon"
    assert value(reading.to_table(found), key) == best.keys[key]
    assert found.control.state_weight == (
        PAPER.control.state_weight[0],
        best.keys["control.state_weight.1"],
    )
    assert points[0].keys["control.input_weight"] == PAPER.control.input_weight
    assert best.score <= points[0].score
    said = capsys.readouterr().out
    assert f"{best.values[ONLY]['rmse_xy']:.4f}" in said
    assert f"{best.values[ONLY]['event_ratio']:.4f}" in said
    assert main([*argv, "--packets", "0.2", "--generations", "2", "--out", str(tmp_path)]) == 2
    assert "packets: got 0.2, expected 0.3 to continue there" in capsys.readouterr().err


def test_another_search_in_the_same_folder_is_refused(
    searched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The search would use scores of other flights."""
    assert main([*ARGV, "--settle", "1", "--out", str(searched)]) == 2
    said = f"{searched}: settle: got 1.0, expected 0.0 to continue there; or choose another --out"
    assert capsys.readouterr().err.strip() == f"calibrate: {said}"


def test_a_changed_digit_in_a_journal_is_refused(
    searched: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No other check would notice an altered result."""
    shutil.copy(searched / "settings.toml", tmp_path)
    file = tmp_path / "journal.jsonl"
    one, two, *_ = (searched / "journal.jsonl").read_text().splitlines(keepends=True)
    at = two.index('"rmse_x":0.') + 11
    file.write_text(one + two[:at] + str(9 - int(two[at])) + two[at + 1 :])
    assert main([*ARGV, "--generations", "2", "--out", str(tmp_path)]) == 2
    said = f"calibrate: {file}: line 2 has been altered: its checksum is wrong"
    assert capsys.readouterr().err.strip() == said


def test_a_trajectory_edited_between_two_calls_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Scores along two trajectories cannot be compared."""
    table = tmp_path / "path.csv"
    table.write_text("t,x,y\n0,0,0\n5,1,1\n")
    scenario = tmp_path / "mine.toml"
    scenario.write_text('extends = "paper"\nreference = { shape = "csv", file = "path.csv" }\n')
    argv = ["calibrate", str(scenario), *SHORT, "--out", str(tmp_path / "out")]
    argv += ["--free", "model.tau_s.0=0.2:2", "--objective", "rmse", "--runs", "1"]
    assert main([*argv, "--generations", "1"]) == 0
    table.write_text("t,x,y\n0,0,0\n5,1,2\n")
    assert main([*argv, "--generations", "2"]) == 2
    said = capsys.readouterr().err
    assert f"out: files.{table}: got " in said
    assert said.endswith(" to continue there; or choose another --out\n")


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--runs", "0"], "--runs: got 0, expected 1 to 1000"),
        (["--population", "1"], "--population: got 1, expected 4 to 1000"),
        (["--sigma", "0"], "--sigma: got 0, expected more than 0, at most 1"),
        (["--packets", "2"], "--packets: got 2, expected more than 0, at most 1"),
        (["--free", "model.tau_s"], "--free: got 'model.tau_s', expected KEY=LOW:HIGH"),
    ],
)
def test_an_impossible_search_is_refused(
    argv: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused_before_writing(["calibrate", "paper", *argv], tmp_path, capsys)
    assert message == f"calibrate: {said}"
