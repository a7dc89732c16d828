"""Benchmarks of explanations: their checks hold for a cause that is true, and for no other."""

from dataclasses import replace

import pytest

from bench import explain as moments
from bench import made_up_causes
from bench.explain import FLIGHTS, checked, scenario_of
from skytether.explain.cases import Bad, FlightCase
from skytether.explain.explanation import explain
from skytether.explain.flying import fly

pytestmark = pytest.mark.long


def test_a_true_cause_passes_both_checks_and_a_false_one_neither() -> None:
    case = FlightCase(scenario_of(FLIGHTS["demo, bursts"], 9351))
    steps = explain(case, "demo", lambda cases: [fly(each) for each in cases])
    known = next(known for following, known in steps if following == "single packets")
    assert checked(known, case) == (True, True)
    assert known.cause
    (part,) = known.cause.parts
    assert isinstance(part.unit, Bad)
    earlier = replace(part.unit, first=part.unit.first - 1900, end=part.unit.end - 1900)
    other = replace(known.cause, parts=(replace(part, unit=earlier),), others=(part,))
    assert checked(replace(known, cause=other), case) == (False, False)


def test_a_moment_is_found_explained_and_checked() -> None:
    found = moments.fly_cell(moments.Cell("demo, bursts", 2))
    assert (found.seed, found.alone, found.averted) == (9351, True, True)
    assert "one outage of the uplink" in moments.tables([found])["explain moments"].markdown()


def test_what_was_broken_is_named() -> None:
    found = made_up_causes.fly_cell(made_up_causes.Cell("server killed", 1))
    assert found.named == "alone"
    rows = made_up_causes.tables([found])["made-up causes"].rows
    assert rows[-1][:3] == ["all", "1", "1"]
