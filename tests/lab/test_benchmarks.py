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
)
from bench.__main__ import DOCUMENT, LACKS, ROOT, SECTIONS, machines, write
from bench.airspace import PlannedFleet
from bench.contestants import NOTHING, OURS, TUNED, contestants
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
        "solvers": solvers.SolversCounts(hot=6, paced=2),
        "tick": tick.TickCounts(6, 2, 20, 2, 2, 20, 2, (1, 4, 20), 2),
        "link": link.LinkCounts(
            packets=60, handshakes=60, vehicles=2, seconds=0.5, turns=1, seeds=1
        ),
        "flood": flood.FloodCounts(seconds=1, forged=2000, hellos=200, lead_s=0.5),
        "motions": motions.MotionsCounts(fleets=(4,), duration=8.0),
        "restarts": restarts.RestartsCounts(kills=1, stops=0, flight_s=0.5, subjects=("netem",)),
        "starting": starting.StartingCounts(warm=1, cold=0),
        "environments": environments.EnvironmentsCounts(turns=1, seconds=0.01, robots=2),
    }
)


@pytest.fixture(scope="module")
def results() -> Iterator[dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tick, "SETTLE", 2)
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
    write({"motions": {**results["motions"], "fleets": []}}, file, document)
    after = json.loads(file.read_text())
    assert after["motions"]["fleets"] == []
    assert {**after, "motions": 0} == {**before, "motions": 0}


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


@pytest.mark.parametrize("name", sorted(contestants("saturated").keys() - {NOTHING}))
def test_contestants_solve_the_same_problems(name: str, saturated: RecordedProblems) -> None:
    """OSQP is only close, at its own tolerance."""
    entry = solvers.SolverEntry(contestants("saturated")[name], saturated)
    for i in range(20):
        entry.tick(i)
    assert entry.unsolved() == 0
    exact = solvers.SolverEntry(ExactSolver, saturated)
    for i in range(20):
        exact.tick(i)
    np.testing.assert_allclose(entry.inputs(), exact.inputs(), rtol=0, atol=1e-3)


def test_what_is_not_installed_does_not_compete() -> None:
    names = contestants("saturated")
    assert {OURS, TUNED} < names.keys()
    assert ("PIQP" in names) == (find_spec("piqp") is not None)


def test_the_reference_is_what_the_exact_solver_finds(saturated: RecordedProblems) -> None:
    reference = Reference(saturated.problem.hessian[0], saturated.problem.mpc.bounds[0])
    proved = np.array([reference.solve(gradient) for gradient in saturated.gradient[0, ::50, 0]])
    every = saturated.gradient[0, ::50].copy()
    exact, _ = ExactSolver(saturated.problem).solve(every, np.zeros_like(every))
    np.testing.assert_allclose(proved, exact[:, 0], rtol=0, atol=1e-12)


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
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = versions.VersionsCounts(1, 1, (2,), 1, 1, 0.5, 1)
    contests = {each.title: each for each in versions.contests(tiny)}
    result = versions.measure(str(ROOT), tiny)
    assert result["before"] == result["after"]
    assert result["after"]["folder"] == str(ROOT)
    assert [row[0] for row in versions.table(result["contests"]).rows] == list(contests)
    for figures in result["contests"].values():
        assert min(figures[side]["p50"] for side in versions.SIDES) > 0.0
    monkeypatch.setattr(versions, "contests", lambda _: list(contests.values())[:1])
    assert versions.main([str(ROOT), "--quick"]) == 0
    assert "one vehicle's tick, hot" in " ".join(capsys.readouterr().out.split())


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
