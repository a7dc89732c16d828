"""Faults in flights of an autopilot: the vehicle's reaction, its distances, and its end state.

`python -m bench.failsafe` flies the scenario `autopilot`, a figure eight over the paper's network,
in calm air and in virtual time, with both of the scripted autopilot's flavours. A fault happens
FAULT_S into each flight, and the vehicle is observed for WATCHED_S. If the vehicle continues its
mission, distances count until then.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np

from bench import autopilots
from bench.harness import Study, TextTable
from skytether.autopilot.faults import FaultName, ScriptedFault
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.autopilot.flight import PilotedVehicle
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.events.flight import ModeChanged
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.sim import flight
from skytether.sim.world import World

FAULT_S, WATCHED_S, FOR_A_WHILE_S = 15.0, 40.0, 5.0
"""Time of flight of the fault, time for which the vehicle is observed after it, and length of a
fault that ends by itself [s]."""
DURATION_S = FAULT_S + WATCHED_S + 5.0
"""Length of the flight [s]; its regular end comes after the observed time."""
TRACK = str(Mode.TRACK).upper()
STILL_MPS = 0.1
"""Horizontal speed below which the vehicle is at rest [m/s]."""

CaseName = Literal[
    "link cut",
    "link cut for 5 s",
    "server killed",
    "client killed",
    "autopilot sends nothing",
    "autopilot sends nothing for 5 s",
    "pilot takes over",
    "battery low",
    "estimate lost",
    "second commander",
    "position leaps",
]
SCRIPTED: dict[CaseName, FaultName] = {
    "autopilot sends nothing": "silence",
    "autopilot sends nothing for 5 s": "silence",
    "pilot takes over": "pilot",
    "battery low": "battery",
    "estimate lost": "estimate",
    "second commander": "commander",
    "position leaps": "leap",
}
"""Faults of the autopilot itself."""
ENDING = frozenset({"link cut for 5 s", "autopilot sends nothing for 5 s"})
Cell = tuple[CaseName, FlavourName, int]
"""Fault, flavour of the autopilot, and seed."""
Ending = Literal["flies on", "hovers", "moves", "has landed", "pilot has it"]
Changes = tuple[tuple[str, float], ...]
"""Modes in order, and the time at which each began, counted from the fault [s]."""


class FaultOutcome(NamedTuple):
    case: CaseName
    flavour: FlavourName
    seed: int
    modes: Changes
    """Modes of the client's failsafe."""
    autopilot: Changes
    moved_m: float
    """Largest horizontal distance from its position at the fault [m]."""
    off_path_m: float
    """Largest horizontal distance from the nearest point of the desired path [m]."""
    still_s: float | None
    """Time until the horizontal speed was below STILL_MPS [s]; None if it never was."""
    down_s: float | None
    """Time until the motors were off [s]; None if they never were."""
    ending: Ending


def scenario_of(flavour: FlavourName, seed: int) -> Scenario:
    cell = autopilots.Cell("skytether", flavour, autopilots.CALM, seed)
    return msgspec.structs.replace(autopilots.scenario_of(cell), duration=DURATION_S)


@cache
def beginning(flavour: FlavourName, seed: int) -> tuple[float, float]:
    """Times at which the motors are switched on and the first step begins, without a fault [s]."""
    scenario = msgspec.structs.replace(scenario_of(flavour, seed), duration=1.0, settle=0.0)
    autopilot, _ = autopilots.autopilot_of(scenario, flavour)
    record = flight.fly(scenario, beside={"autopilot": autopilot})
    assert autopilot.flight.armed_ns is not None
    return autopilot.flight.armed_ns / SECOND_NS, autopilots.began_ns(record) / SECOND_NS


def fly(case: CaseName, flavour: FlavourName, seed: int) -> FaultOutcome:
    scenario, (armed_s, began_s) = scenario_of(flavour, seed), beginning(flavour, seed)
    fault_s = began_s + FAULT_S
    end_s = fault_s + FOR_A_WHILE_S if case in ENDING else None
    changes: list[tuple[float, Mapping[str, Any]]] = []
    actions: list[tuple[float, Callable[[World], None]]] = []
    faults: list[ScriptedFault] = []
    if case in SCRIPTED:
        since, until = (
            None if time_s is None else seconds_to_ns(time_s - armed_s)
            for time_s in (fault_s, end_s)
        )
        faults.append(ScriptedFault(SCRIPTED[case], since or 0, until))
    elif case.startswith("link cut"):
        losses = [(fault_s, 1.0)]
        if end_s is not None:
            losses.append((end_s, scenario.uplink.loss))
        changes += [
            (time_s, {f"network.{way}.loss": loss for way in ("uplink", "downlink")})
            for time_s, loss in losses
        ]
    else:
        host = "server" if case == "server killed" else f"client {seed}.1"
        actions.append((fault_s, lambda world: world.stop(host)))
    autopilot, truth = autopilots.autopilot_of(scenario, flavour, faults)
    aboard, modes_aboard, down_s = autopilot.flight, list[tuple[str, float]](), np.inf

    def watch() -> bool:
        nonlocal down_s
        now_s = aboard.now_ns / SECOND_NS
        if not modes_aboard or modes_aboard[-1][0] != aboard.mode_name:
            modes_aboard.append((aboard.mode_name, now_s))
        if aboard.armed_ns is not None and not aboard.armed:
            down_s = min(down_s, now_s - fault_s)
        return now_s >= fault_s + WATCHED_S

    record = flight.fly(
        scenario, beside={"autopilot": autopilot}, changes=changes, actions=actions, stopped=watch
    )

    def since_fault(changes: Sequence[tuple[str, float]]) -> Changes:
        later = [(name, time_s - fault_s) for name, time_s in changes]
        return tuple((name, time_s) for name, time_s in later if time_s >= 0.0)

    modes = since_fault(
        [
            (event.after.upper(), time_ns / SECOND_NS)
            for time_ns, _, event in record.events
            if isinstance(event, ModeChanged) and event.before != event.after
        ]
    )
    on_s = next((time_s for name, time_s in modes if name == TRACK), WATCHED_S)
    rows = truth.rows()
    times_s = rows["time_ns"] / SECOND_NS - fault_s
    seen = (times_s >= 0.0) & (times_s <= on_s)
    speeds = np.linalg.norm(rows["state"][seen, :2, 1], axis=1)
    positions = rows["state"][seen, :2, 0]
    still = np.flatnonzero(speeds < STILL_MPS)
    return FaultOutcome(
        case,
        flavour,
        seed,
        modes=modes,
        # On the ground PX4 returns to the mode requested last.
        autopilot=tuple(change for change in since_fault(modes_aboard) if change[1] < down_s),
        moved_m=_largest(positions - positions[0]),
        off_path_m=_off_path(scenario, positions),
        still_s=float(times_s[seen][still[0]]) if len(still) else None,
        down_s=down_s if np.isfinite(down_s) else None,
        ending=_ending(aboard, speeds[-1], modes),
    )


def _reference(scenario: Scenario, times_s: Array) -> Array:
    return scenario.make_reference()(times_s)[:, :2, 0]


def _largest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())


def _off_path(scenario: Scenario, positions: Array) -> float:
    """Largest distance of positions (n, 2) from the nearest point of the path [m]."""
    path = _reference(scenario, np.arange(0.0, DURATION_S, 0.02))
    nearest_m = [np.linalg.norm(path - position, axis=1).min() for position in positions[::20]]
    return float(max(nearest_m))


def _ending(aboard: PilotedVehicle, speed: float, modes: Changes) -> Ending:
    """End state of the vehicle, in words; `modes` are those of the client after the fault."""
    if not aboard.armed:
        return "has landed"
    if aboard.mode is FlightMode.PILOT:
        return "pilot has it"
    if modes and modes[-1][0] == TRACK:
        return "flies on"
    return "hovers" if speed < STILL_MPS else "moves"


HEADINGS = [
    "what goes wrong",
    "client, after [s]",
    "its autopilot, after [s]",
    "moved [m]",
    "off its path [m]",
    "stands after [s]",
    "outcome, motors off after [s]",
]


def tables(outcomes: Sequence[FaultOutcome]) -> dict[str, TextTable]:
    by_name = {}
    for flavour in get_args(FlavourName):
        rows = [
            _row(case, of_case)
            for case in get_args(CaseName)
            if (of_case := [e for e in outcomes if (e.case, e.flavour) == (case, flavour)])
        ]
        if rows:
            by_name[f"failsafe {flavour}"] = TextTable(HEADINGS, rows)
    return by_name


def _row(case: CaseName, outcomes: Sequence[FaultOutcome]) -> list[str]:
    return [
        case,
        "gone" if case == "client killed" else _sequences([each.modes for each in outcomes]),
        _sequences([each.autopilot for each in outcomes]),
        f"{max(each.moved_m for each in outcomes):.1f}",
        f"{max(each.off_path_m for each in outcomes):.1f}",
        _span([each.still_s for each in outcomes]),
        ", or ".join(dict.fromkeys(each.ending for each in outcomes)) + _down(outcomes),
    ]


def _down(outcomes: Sequence[FaultOutcome]) -> str:
    """Text with the range of times after which the motors were off, beginning with a comma; empty
    if they never were.
    """
    times_s = [each.down_s for each in outcomes]
    return f", {_span(times_s)}" if any(each is not None for each in times_s) else ""


def _sequences(changes: Sequence[Changes]) -> str:
    alike: dict[tuple[str, ...], list[list[float]]] = {}
    for each in changes:
        names = tuple(name for name, _ in each)
        alike.setdefault(names, []).append([time_s for _, time_s in each])
    texts = []
    for names, times in alike.items():
        columns = zip(names, zip(*times, strict=True), strict=True)
        texts.append(
            ", ".join(f"{name} {_span(column)}" for name, column in columns) or "no change"
        )
    return "; or ".join(texts)


def _span(times_s: Sequence[float | None]) -> str:
    came_s = [time_s for time_s in times_s if time_s is not None]
    if not came_s:
        return "never"
    least, most = f"{min(came_s):.1f}", f"{max(came_s):.1f}"
    span = least if least == most else f"{least} to {most}"
    return span if len(came_s) == len(times_s) else f"{span}, or never"


def fly_cell(cell: Cell) -> FaultOutcome:
    return fly(*cell)


def cells(seeds: int) -> list[Cell]:
    """A killed server is left out: its rows are those of a cut link."""
    cases = [each for each in get_args(CaseName) if each != "server killed"]
    return list(product(cases, get_args(FlavourName), range(1, seeds + 1)))


STUDY = Study(__doc__, cells, fly_cell, FaultOutcome, tables, seeds=3)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "failsafe"))
