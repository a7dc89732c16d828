"""Benchmarks at their smallest size: they run, and write their tables and figures.

Solvers that are not installed are left out; no test asserts a time.
"""

import json
import re
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from bench import (
    environments,
    flood,
    link,
    motions,
    netem,
    program,
    restarts,
    solvers,
    starting,
    tick,
    versions,
    wire,
)
from bench.__main__ import DOCUMENT, LACKS, ROOT, SECTIONS, machines, write
from bench.airspace import PlannedFleet
from bench.contestants import NOTHING, OURS, TUNED, TUNINGS, Tuning, contestants
from bench.harness import (
    HOT,
    PACED,
    TextTable,
    WakeLateness,
    interleave,
    machine,
    refresh,
)
from bench.problems import RecordedProblems, listening, record
from bench.reference import Reference
from skytether.server.controller import BLOCK
from skytether.server.mpc.exact import ExactSolver

pytestmark = pytest.mark.long

TINY = MappingProxyType(
    {
        "netem": netem.NetemBenchmarkOptions(runs=1, seconds=1, rate=1000, loads=((1000, 3),)),
        "program": program.ProgramCounts(20, 5, seconds=1, lossy_s=1, losses=(0.02,)),
        "solvers": solvers.SolversCounts(hot=6, paced=2, tuning=3),
        "tick": tick.TickCounts(6, 2, 3, 20, 2, 2, 20, 2, (1, 4, 20), 2),
        "wire": wire.WireCounts(each=10),
        "link": link.LinkCounts(
            packets=60, handshakes=60, vehicles=2, seconds=0.5, turns=1, seeds=1
        ),
        "flood": flood.FloodCounts(seconds=1, forged=2000, hellos=200, lead_s=0.5),
        "motions": motions.MotionsCounts(fleets=(4,), shares=(0.5,), duration=8.0),
        "restarts": restarts.RestartsCounts(kills=1, stops=0, flight_s=0.5, subjects=("netem",)),
        "starting": starting.StartingCounts(warm=1, cold=0),
        "environments": environments.EnvironmentsCounts(turns=1, seconds=0.01, robots=2),
    }
)


@pytest.fixture(scope="module")
def results() -> Iterator[dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tick, "SETTLE", 2)
        patch.setattr(solvers, "TUNINGS", TUNINGS[::8])
        # The other kinds are in tests/lab/test_flood.py.
        patch.setattr(flood, "KINDS", (flood.HELLOS,))
        yield _results()


def _results() -> dict[str, Any]:
    return {
        name: {"machine": machine(), **section.measure(TINY[name])}
        for name, section in SECTIONS.items()
        if name not in LACKS or not LACKS[name]()
    }


@pytest.fixture(scope="module")
def saturated() -> RecordedProblems:
    return record(solvers.flights()["saturated"], 1000)


def test_the_tables_of_the_document_are_written(results: Mapping[str, Any], tmp_path: Path) -> None:
    file, document = tmp_path / "a.json", tmp_path / "b.md"
    document.write_text(DOCUMENT.read_text())
    write(results, file, document, tmp_path)
    assert set(json.loads(file.read_text())) == set(results)
    assert (tmp_path / tick.FIGURE.name).read_bytes().startswith(b"\x89PNG")
    places = set(re.findall("<!-- table: (.*) -->", document.read_text()))
    made = {"machine": machines(results)}
    for name in results:
        made |= SECTIONS[name].tables(results[name])
    assert places - set(made) <= LACKS.keys()
    assert all(made[name].markdown() in document.read_text() for name in places & set(made))
    before = json.loads(file.read_text())
    write({"wire": {**results["wire"], "nothing": {"p50_us": 1.0, "p99_us": 2.0}}}, file, document)
    after = json.loads(file.read_text())
    assert after["wire"]["nothing"] == {"p50_us": 1.0, "p99_us": 2.0}
    assert {**after, "wire": 0} == {**before, "wire": 0}


def test_the_exact_solver_is_found_exact(results: Mapping[str, Any]) -> None:
    for flight in solvers.flights():
        assert results["solvers"][flight]["contestants"][OURS]["error"] < 1e-6


def test_the_flights_are_what_they_are_called(
    results: Mapping[str, Any], saturated: RecordedProblems
) -> None:
    assert results["solvers"]["smooth"]["active"] == 0.0
    assert saturated.active() > 0.2


def test_a_fleet_that_is_listened_to_flies_the_same() -> None:
    scenario, count = tick.mixes()["half"], BLOCK + 2
    fleet = PlannedFleet(scenario, count)
    with listening() as listeners:
        heard = PlannedFleet(scenario, count)
    first, later = listeners
    for _ in range(3):
        for each in (fleet, heard):
            each.plan()
            each.fly()
        np.testing.assert_array_equal(heard.x, fleet.x)
    shape = (2, count, 2, scenario.control.horizon)
    assert [each.shape for each in first.recorded()] == [shape] * 2
    assert [each.shape for each in later.recorded(2)] == [shape] * 2
    gradient, guess = later.recorded()
    assert gradient.shape == guess.shape == (2, 2 * count, *shape[2:])


@pytest.mark.parametrize("name", sorted(contestants(TUNINGS[0]).keys() - {NOTHING}))
def test_contestants_solve_the_same_problems(name: str, saturated: RecordedProblems) -> None:
    """All forms of the problem have the same solution; OSQP is only close, at its own tolerance."""
    entry = solvers.SolverEntry(contestants(TUNINGS[0])[name], saturated)
    for i in range(20):
        entry.tick(i)
    assert entry.unsolved() == 0
    exact = solvers.SolverEntry(ExactSolver, saturated)
    for i in range(20):
        exact.tick(i)
    np.testing.assert_allclose(entry.inputs(), exact.inputs(), rtol=0, atol=1e-3)


@pytest.mark.parametrize("tuning", TUNINGS[::8], ids=str)
def test_every_form_of_osqp_is_the_same_problem(
    tuning: Tuning, saturated: RecordedProblems
) -> None:
    ours, theirs = (solvers.SolverEntry(make, saturated) for make in (ExactSolver, tuning.make))
    for i in range(5):
        ours.tick(i)
        theirs.tick(i)
    np.testing.assert_allclose(theirs.inputs(), ours.inputs(), rtol=0, atol=1e-4)


def test_what_is_not_installed_does_not_compete() -> None:
    names = contestants(TUNINGS[0])
    assert {OURS, TUNED} < names.keys()
    assert ("PIQP" in names) == (find_spec("piqp") is not None)


@pytest.mark.skipif(find_spec("quadprog") is None, reason="quadprog is not installed")
def test_the_reference_is_the_same_whoever_finds_it(
    monkeypatch: pytest.MonkeyPatch, saturated: RecordedProblems
) -> None:
    reference = Reference(saturated.problem.hessian[0], saturated.problem.mpc.bounds[0])
    gradients = saturated.gradient[0, ::50, 0]
    by_quadprog = [reference.solve(gradient) for gradient in gradients]
    monkeypatch.setattr("bench.reference.find_spec", lambda _: None)
    by_scipy = [reference.solve(gradient) for gradient in gradients]
    np.testing.assert_allclose(by_scipy, by_quadprog, rtol=0, atol=1e-14)


def test_contestants_take_turns_at_the_same_problems() -> None:
    """Mode "hot": in a row, after a warm-up; "paced": one by one, each after a pause."""
    done: list[tuple[str, int]] = []
    contest = {name: lambda i, name=name: done.append((name, i)) for name in "ab"}
    lateness = WakeLateness()
    spent = interleave(contest, 3, PACED, lateness, "paced")
    assert [i for _, i in done] == [0, 0, 1, 1, 2, 2]
    assert {len(durations) for durations in spent.values()} == {3}
    assert len(lateness.late_ns) == 6
    done.clear()
    spent = interleave(contest, 2 * HOT.turn, HOT, lateness, "hot")
    assert len({name for name, _ in done[: HOT.turn]}) == 1
    assert {len(durations) for durations in spent.values()} == {2 * (HOT.turn - 1)}


def test_a_checkout_is_compared_with_itself(
    results: Mapping[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    tiny = versions.VersionsCounts(1, 1, (2,), 1, 3, 1, 1, 0.5)
    monkeypatch.setattr(versions, "QUICK", tiny)
    monkeypatch.setattr(tick, "tune", lambda *_: {})
    monkeypatch.setattr(tick, "fleets", lambda *_: results["tick"]["fleets"])
    file = tmp_path / "versions.json"
    assert versions.main([str(ROOT), "--quick", "--json", str(file)]) == 0
    result = json.loads(file.read_text())
    assert result["before"] == result["after"]
    assert result["after"]["folder"] == str(ROOT)
    assert list(result["contests"]) == [contest.title for contest in versions.contests(tiny)]
    versus, planning = versions.tables(result).values()
    assert [row[0] for row in versus.rows] == list(result["contests"])
    assert len(planning.rows) == len(tick.mixes())
    for figures in result["contests"].values():
        assert min(figures[side]["p50"] for side in versions.SIDES) > 0.0
    assert "vehicle-steps per core-second" in " ".join(capsys.readouterr().out.split())


def test_a_folder_that_is_no_checkout_is_not_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert versions.main([str(tmp_path), "--quick"]) == 1
    expected = f"{tmp_path}: got a folder without benchmarks, expected a checkout\n"
    assert capsys.readouterr().err == expected


def test_a_commit_is_compared_in_a_folder_that_goes_at_the_end() -> None:
    """A checkout is named by its commit or its folder; anything else is refused in one line."""
    if not (ROOT / ".git").exists():
        pytest.skip("no repository here")
    with versions.checkout("HEAD") as folder:
        assert (folder / "pyproject.toml").exists()
    assert not folder.exists()
    expected = "nowhere-at-all: expected a folder or a commit"
    with pytest.raises(ValueError, match=expected), versions.checkout("nowhere-at-all"):
        pass


def test_a_table_without_a_place_is_an_error() -> None:
    table = TextTable(["a", "b"], [["1", "2"]])
    text = refresh("x\n<!-- table: one -->\nold\n<!-- end -->\ny\n", {"one": table})
    assert (
        text
        == "x\n<!-- table: one -->\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n\n<!-- end -->\ny\n"
    )
    with pytest.raises(ValueError, match="table two: got 0 places in the document, expected 1"):
        refresh(text, {"two": table})
