"""Explanations of what went wrong by itself, each of them checked by flights that know no search.

`python -m bench.explain` flies scenarios over bad networks, from one seed on, until something goes
wrong, and explains the gravest moment. Two flights check the cause: with it alone the moment comes
about, and without it it does not. Each is flown from keys, as anybody could: the network's text has
the impairment `delivered`, with the times of the explanation.
"""

import sys
import time
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from itertools import groupby
from typing import Any, NamedTuple

import msgspec
import numpy as np

from bench.harness import Study, TextTable
from skytether.explain.cases import Bad, FlightCase, Setting, Unit, Unmet, UsualDelay
from skytether.explain.explanation import Explanation, explain
from skytether.explain.flying import CaseOutcome, fly, outcome
from skytether.explain.moments import AFTER_S, Moment, comes_about
from skytether.explain.units import SETTINGS, SPREAD
from skytether.shared.events.flight import FlowOpened
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys, value
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Record
from skytether.shell.commandline import command
from skytether.sim import flight

FIRST, APART = 9301, 50
"""Seed at which the search for a first moment begins, and how many later the next one begins."""
BURSTS = "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.1, 2.0)"
HALF_LOST = "paper(0.4, 0.02, 2.0) & loss(0.6)"
SWAP: Mapping[str, Any] = {
    "reference.shape": "swap(8)",
    "duration": 30.0,
    "link.timeout_s": 7.5,  # with one of 30 s, as it has, nothing goes wrong in 30 s
}
ROUTE: Mapping[str, Any] = {
    "reference.shape": "waypoints",
    "reference.points_m": [[0, 0], [4, 0], [4, 3], [-2, 3], [0, 0]],
}


class Flight(NamedTuple):
    """Scenario, its network if it has not its own, further keys, and the number of vehicles."""

    scenario: str
    network: str = ""
    keys: Mapping[str, Any] = {}
    vehicles: int = 1


LONG_BURSTS = "paper(0.4, 0.02, 2.0) & gilbert_elliott(0.2, 6.0)"
FLIGHTS: Mapping[str, Flight] = {
    "demo, bursts": Flight("demo", BURSTS),
    "demo, loss 0.6": Flight("demo", HALF_LOST),
    "target, bursts": Flight("target", BURSTS),
    "target, loss 0.6": Flight("target", HALF_LOST),
    "paper, loss 0.6": Flight("paper", HALF_LOST),
    "paper, bursts": Flight("paper", BURSTS),
    "two links": Flight("demo-two-links"),
    "swap(8), bursts of 6 s": Flight("swap", LONG_BURSTS, SWAP, 8),
    "route, bursts": Flight("demo", BURSTS, ROUTE),
    "5g-outage, time-out 1.5 s": Flight("5g-outage", keys={"link.timeout_s": 1.5}),
    "5g-rural-queue": Flight("5g-rural-queue"),
}
PATHS = ("uplink", "downlink")


class Cell(NamedTuple):
    flight: str
    number: int
    """Which of its moments, from 1 on."""


class Explained(msgspec.Struct, frozen=True):
    """An explanation, and what became of its checks."""

    cell: Cell
    seed: int
    moment: str
    why: str
    units: int
    flights: int
    cpu_s: float
    alone: bool
    """Whether the moment comes about with the cause alone."""
    averted: bool | None
    """Whether it does not without the cause; None: the cause is the scenario itself."""


def scenario_of(each: Flight, seed: int) -> Scenario:
    table = reading.to_table(reading.load(each.scenario))
    network = dict.fromkeys(("network.uplink", "network.downlink"), each.network)
    set_keys({"seed": seed, **each.keys, **(network if each.network else {})}, table)
    return reading.check(table, "bench", any_network=True)


def fly_cell(cell: Cell) -> Explained:
    """Explanation of the first flight from the cell's seed on in which something went wrong."""
    each, flights = FLIGHTS[cell.flight], 0

    def fly_all(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
        nonlocal flights
        flights += len(cases)
        return [fly(case) for case in cases]

    seed = FIRST + APART * (cell.number - 1)
    while True:  # each of FLIGHTS has one soon
        case = FlightCase(scenario_of(each, seed), each.vehicles)
        flights, began_s = 0, time.process_time()
        *_, (_, known) = explain(case, cell.flight, fly_all)
        spent_s = time.process_time() - began_s
        if known.moment is not None and known.cause is not None:
            among, checks = known.cause.among, checked(known, case)
            moment, cause = said(known.moment), why(known)
            return Explained(cell, seed, moment, cause, among, flights, spent_s, *checks)
        seed += 1


def said(moment: Moment) -> str:
    return f"{moment.start_s:.1f} s: {moment.says.partition(' (')[0]}"


def why(known: Explanation) -> str:
    """Sentence of the explanation with the cause."""
    said = next(line for line in str(known).splitlines() if line.startswith("Why: "))
    return said.removeprefix("Why: ").partition(". With all")[0].removesuffix(".")


# -- checks ----------------------------------------------------------------------------------------


class Stretch(NamedTuple):
    """Time of a flow on a path and in a direction, in which packets are delivered [s]."""

    path: int
    direction: int
    flow: int
    at_s: float
    until_s: float
    most_s: float
    """Longest delay of a packet that is delivered [s]."""


def checked(known: Explanation, case: FlightCase) -> tuple[bool, bool | None]:
    """Whether the moment comes about with the cause alone, and whether it does not without."""
    moment, cause = known.moment, known.cause
    assert moment is not None
    assert cause is not None
    record = flight.fly(case.scenario, vehicles=case.vehicles)
    window = cause.since_s, moment.end_s + AFTER_S
    first = {part.unit for part in cause.parts}
    gone = {part.unit for part in cause.averting} or first
    listed = {part.unit for part in (*cause.parts, *cause.averting, *cause.others)} | {Unmet()}

    def comes_without(gone: Set[Unit], keys: Mapping[str, Any]) -> bool:
        delivered = _delivered(record, gone, listed - gone, window)
        scenario = changed(case.scenario, [*delivered], keys)
        flown = flight.fly(scenario, vehicles=case.vehicles)
        return comes_about(moment, outcome(scenario, flown))

    alone = comes_without(listed - first, _neutral(case.scenario, first))
    if not first:
        return alone, None
    keys = dict(key for each in gone if isinstance(each, Setting) for key in each.keys)
    return alone, not comes_without(gone, keys)


def changed(
    scenario: Scenario, delivered: Collection[Stretch], keys: Mapping[str, Any]
) -> Scenario:
    """Scenario with other keys, and with packets that are delivered; see `delivered`."""
    table = reading.to_table(scenario)
    set_keys(keys, table)
    scenario = reading.check(table, "bench", any_network=True, checked=scenario)
    network = scenario.network
    own: list[Any] = [*network.paths] or [network]
    for (path, direction), some in groupby(sorted(delivered), lambda each: each[:2]):
        numbers = [
            f"{each.flow}, {each.at_s:.3f}, {each.until_s - each.at_s:.3f}, {each.most_s:.6f}"
            for each in some
        ]
        # Not by a key, whose text may have a thousand characters.
        name = PATHS[direction]
        text = f"{getattr(own[path], name) or 'none'} & delivered({', '.join(numbers)})"
        own[path] = msgspec.structs.replace(own[path], **{name: text})
    if network.paths:
        network = msgspec.structs.replace(network, paths=tuple(own))
    else:
        (network,) = own
    return msgspec.structs.replace(scenario, network=network)


def _flows(record: Record) -> Iterator[tuple[int, int, float]]:
    """Path, flow, and the time of its first packet [s]."""
    for time_ns, host, event in record.events:
        if isinstance(event, FlowOpened):
            yield int(host.partition("/")[2] or 1) - 1, event.flow, time_ns / 1e9


def _usual_s(record: Record, path: int, direction: int) -> float:
    """Longest delay of a packet that is not late, see docs/explain.md [s]."""
    rows = record.netem
    own = rows[(rows["path"] == path) & (rows["direction"] == direction) & ~rows["lost"]]
    half, upper = np.quantile(own["delay_ns"], (0.5, 0.75)) / 1e9 if len(own) else (0.0, 0.0)
    return float(half + SPREAD * (upper - half))


def _delivered(
    record: Record, gone: Set[Unit], left: Set[Unit], window: tuple[float, float]
) -> Iterator[Stretch]:
    """Times at which packets are delivered: those of losses and delays that are gone, or all but
    those that are left, if the usual delay is gone, or what else the network loses.
    """
    for path, flow, began_s in _flows(record):
        for direction in (UPLINK, DOWNLINK):
            lane = path, direction, flow
            at_s, end_s = (max(0.0, time_s - began_s) for time_s in window)
            at_once = UsualDelay(direction) in gone
            most_s = 0.0 if at_once else _usual_s(record, path, direction)
            whole = at_once or Unmet() in gone
            bad = (u for u in (left if whole else gone) if isinstance(u, Bad) and u.lane == lane)
            for each in sorted(bad, key=lambda one: one.first):
                first_s, until_s = each.first * 1e-3, each.end * 1e-3
                if not whole:
                    yield Stretch(*lane, first_s, until_s, most_s)
                elif first_s > at_s:
                    yield Stretch(*lane, at_s, first_s, most_s)
                at_s = max(at_s, until_s)
            if whole and end_s > at_s:
                yield Stretch(*lane, at_s, end_s, most_s)


def _neutral(scenario: Scenario, kept: Collection[Unit]) -> dict[str, Any]:
    """Keys without wind, noise and the like, but for those that are kept."""
    table, names = reading.to_table(scenario), {u.name for u in kept if isinstance(u, Setting)}
    return {
        key: own
        for name, keys in SETTINGS
        if name not in names
        for key, own in keys
        if value(table, key) != own
    }


# -- the table -------------------------------------------------------------------------------------


def cells(moments: int) -> list[Cell]:
    return [Cell(name, number) for name in FLIGHTS for number in range(1, moments + 1)]


def tables(found: Sequence[Explained]) -> dict[str, TextTable]:
    rows = [
        [
            f"{each.cell.flight}, seed {each.seed}",
            each.moment,
            each.why,
            str(each.units),
            str(each.flights),
            f"{each.cpu_s:.1f}",
            "occurs" if each.alone else "DOES NOT",
            {True: "does not", False: "OCCURS", None: ""}[each.averted],
        ]
        for each in found
    ]
    headings = ["flight", "moment", "cause", "units", "flights", "CPU [s]", "alone", "without"]
    return {"explain moments": TextTable(headings, rows)}


STUDY = Study(__doc__, cells, fly_cell, Explained, tables, seeds=3)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "explain"))
