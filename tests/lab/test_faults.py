"""`torture.faults`: schedules of faults are drawn, shrunk, written and read."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.engine import SHORTEST_NS, dumps, shrink
from fuzz.torture.faults import (
    RANGES,
    FaultKind,
    ScheduledFault,
    Trial,
    loads,
    schedule,
)
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS

MINUTE_NS = 60 * SECOND_NS
DRAWN = [schedule(stream(seed, "faults"), MINUTE_NS) for seed in range(300)]


def test_the_same_seed_draws_the_same_schedule() -> None:
    again = [schedule(stream(seed, "faults"), MINUTE_NS) for seed in range(300)]
    assert again == DRAWN
    assert len(set(DRAWN)) == len(DRAWN)


def test_every_kind_is_drawn_everywhere_within_its_range() -> None:
    faults = [fault for drawn in DRAWN for fault in drawn]
    assert set(RANGES) == set(FaultKind)
    places = {(kind, where) for kind in FaultKind for where in RANGES[kind].where}
    assert {(fault.kind, fault.where) for fault in faults} == places
    for fault in faults:
        bounds = RANGES[fault.kind]
        assert 0 <= fault.start_ns < MINUTE_NS
        shortest_s, longest_s = bounds.length_s
        assert fault.length_ns / SECOND_NS <= longest_s
        assert fault.length_ns / SECOND_NS >= shortest_s or fault.end_ns == MINUTE_NS
        assert bounds.amount[0] <= abs(fault.amount) <= bounds.amount[1]
    for kind, bounds in RANGES.items():
        signs = {fault.amount > 0 for fault in faults if fault.kind == kind}
        assert signs == ({True, False} if bounds.signed else {True})


def test_a_schedule_is_in_order_and_has_a_fault_every_five_seconds() -> None:
    """One more on average over many, and at least one in the shortest flight."""
    assert all(list(drawn) == sorted(drawn, key=lambda fault: fault.start_ns) for drawn in DRAWN)
    assert sum(map(len, DRAWN)) / len(DRAWN) == pytest.approx(13.0, rel=0.1)
    assert len(schedule(stream(1), 1)) == 1


def test_a_schedule_is_one_line_and_comes_back_as_it_was() -> None:
    for drawn in DRAWN:
        trial = Trial(3, drawn)
        line = dumps(trial)
        assert "\n" not in line
        assert loads(line) == trial


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "truncated"),
        ('{"seed":1,"faults":[{}]}', "missing required field `kind`"),
        (dumps(Trial(1, DRAWN[0])).replace(DRAWN[0][0].kind, "rain"), "Invalid enum value 'rain'"),
        (dumps(Trial(1, (replace(DRAWN[0][0], start_ns=-1),))), ">= 0"),
        (
            dumps(Trial(1, (ScheduledFault(FaultKind.FREEZE, "both", 0, 1, 1.0),))),
            "got 'both', expected server or client",
        ),
    ],
)
def test_what_is_no_schedule_is_refused(line: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        loads(line)


@settings(max_examples=200)
@given(st.integers(0, 299), st.data())
def test_a_schedule_shrinks_to_the_faults_that_matter(seed: int, data: st.DataObject) -> None:
    """For any set of relevant faults; each is shortened to within a factor of two."""
    drawn = DRAWN[seed]
    culprits = data.draw(st.sets(st.sampled_from(drawn), min_size=1, max_size=3))
    needed_ns = {fault.start_ns: fault.length_ns // 5 for fault in culprits}

    def fails(faults: tuple[ScheduledFault, ...]) -> bool:
        length_ns = {fault.start_ns: fault.length_ns for fault in faults}
        return all(length_ns.get(start, -1) >= least for start, least in needed_ns.items())

    shrunk = shrink(drawn, fails)
    assert [fault.start_ns for fault in shrunk] == sorted(needed_ns)
    assert fails(shrunk)
    for fault in shrunk:
        assert fault.length_ns < 2 * max(needed_ns[fault.start_ns] + 1, SHORTEST_NS)


def test_what_fails_whatever_happens_shrinks_to_nothing() -> None:
    assert shrink(DRAWN[0], lambda _: True) == ()


def test_shrinking_asks_seldom() -> None:
    """For two relevant faults of 1000, less than a tenth of the calls of one by one."""
    many = tuple(ScheduledFault(FaultKind.STEP, "server", start, 0, 1.0) for start in range(1000))
    asked = []

    def fails(faults: tuple[ScheduledFault, ...]) -> bool:
        asked.append(len(faults))
        return {many[17], many[803]} <= set(faults)

    assert shrink(many, fails) == (many[17], many[803])
    assert len(asked) < 100
