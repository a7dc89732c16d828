"""Faults in flights of an autopilot: the vehicle's reaction, its distances, and its end state.

`python -m bench.failsafe` flies the scenario `autopilot`, a figure eight over
the paper's network, in calm air and in virtual time, with both of the scripted autopilot's
flavours. A fault happens FAULT_S into each flight, and the vehicle is observed for WATCHED_S. If it
flies on, distances are those until then. With --write, the tables go into docs/fly-a-real-one.md.
"""

import io
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import msgspec
import numpy as np
import tyro

from bench import autopilots
from bench.harness import TextTable, refresh
from skytether.autopilot.endpoint import Autopilot
from skytether.autopilot.faults import FaultName, Script, ScriptedFault
from skytether.autopilot.flavours import FlavourName, FlightMode
from skytether.client import vehicles
from skytether.client.endpoint import Client
from skytether.lab.commands.pool import Flags, study
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base import files
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.core.events import Event, Flying, ModeChanged
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import TRUTH_COLUMNS, Recorder, parse
from skytether.shared.wire.protocol import Mode
from skytether.shell import command
from skytether.sim import straight
from skytether.sim.flight import BOOT_ID, MIDNIGHT_NS, plan_changes
from skytether.sim.world import Clock, World

DOCUMENT = Path(__file__).parents[1] / "docs" / "fly-a-real-one.md"
FAULT_S, WATCHED_S, FOR_A_WHILE_S = 15.0, 40.0, 5.0
"""Time of flight of the fault, time for which the vehicle is observed after it, and length of a
fault that ends by itself [s]."""
DURATION_S = FAULT_S + WATCHED_S + 5.0
"""Length of the flight [s], so long that its regular end is not observed."""
LAUNCH_S = 60.0
"""Longest time until the flight begins [s]."""
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
"""Faults that end by themselves."""
Ending = Literal["flies on", "hovers", "moves", "has landed", "pilot has it"]
Changes = tuple[tuple[str, float], ...]
"""Modes in order, and the time at which each began, counted from the fault [s]."""


class FaultOutcome(NamedTuple):
    """Vehicle's behaviour after a fault."""

    case: CaseName
    flavour: FlavourName
    seed: int
    modes: Changes
    """Modes of the client's failsafe."""
    autopilot: Changes
    """Modes of the autopilot."""
    moved_m: float
    """Largest horizontal distance from its position at the fault [m]."""
    off_path_m: float
    """Largest horizontal distance from the nearest point of its desired path [m]."""
    off_reference_m: float
    """Largest horizontal distance from its moving reference [m]."""
    still_s: float
    """Time until its horizontal speed was below STILL_MPS [s]; NaN for never."""
    down_s: float
    """Time until its motors were off [s]; NaN for never."""
    ending: Ending


def scenario_of(flavour: FlavourName, seed: int) -> Scenario:
    """Scenario that is flown."""
    cell = autopilots.Cell("skytether", flavour, autopilots.CALM, seed)
    return msgspec.structs.replace(autopilots.scenario_of(cell), duration=DURATION_S)


class Watched:
    """Flight that is observed after a fault.

    Args:
        scenario: scenario that is flown.
        flavour: flavour of the autopilot.
    """

    def __init__(self, scenario: Scenario, flavour: FlavourName) -> None:
        self.scenario = scenario
        self.truth = io.BytesIO()
        """True states: rows of TRUTH_COLUMNS."""
        self.autopilot = Autopilot(
            scenario,
            flavour,
            ready_s=straight.READY_S,
            recorder=Recorder(TRUTH_COLUMNS, self.truth),
        )
        for name, value in autopilots.SAFE[flavour].items():
            self.autopilot.flight.set(name, value)
        self.began_ns: int | None = None
        """Time at which the first step began [ns]."""
        self.modes: list[tuple[str, int]] = []
        """Modes of the client's failsafe, and the time at which each began [ns]."""
        self.flown: list[tuple[str, int]] = []
        """Modes of the autopilot, and the time at which each began [ns]."""
        self.down_ns: int | None = None
        """Time at which the motors were switched off [ns]."""
        self.netem = Proxy(scenario, server=("server", 0), flows=1)
        client = Client(
            scenario, vehicles.make(scenario, 1), server=("netem", 0), vehicle=1, boot_id=BOOT_ID
        )
        entropy = stream(scenario.seed, "entropy").bytes
        self.world = world = World(self._hear)
        world.add("netem", self.netem)
        start_ns = int(stream(scenario.seed, "phase").integers(scenario.dt_ns))
        world.add("client", client, clock=Clock(MIDNIGHT_NS), start_ns=start_ns)
        world.add("autopilot", self.autopilot)
        server = Server(scenario, boot_id=BOOT_ID, entropy=entropy)
        world.add("server", server, clock=Clock(MIDNIGHT_NS))

    def _hear(self, time_ns: int, _: str, event: Event) -> None:
        if isinstance(event, Flying):
            self.began_ns = time_ns
        elif isinstance(event, ModeChanged) and event.before != event.after:
            self.modes.append((event.after.upper(), time_ns))

    def run(self, until: Callable[[], bool], limit_ns: int) -> None:
        """Run until a condition holds, or until a time of the world."""
        flight = self.autopilot.flight

        def over() -> bool:
            if not self.flown or self.flown[-1][0] != flight.mode_name:
                self.flown.append((flight.mode_name, self.world.now_ns))
            if flight.armed_ns is not None and not flight.armed and self.down_ns is None:
                self.down_ns = self.world.now_ns
            return until()

        self.world.run(over, limit_ns=limit_ns)

    def fail(self, case: CaseName) -> None:
        """Inject the fault now."""
        for_ns = seconds_to_ns(FOR_A_WHILE_S) if case in ENDING else None
        if case == "client killed":
            self.world.stop("client")
        elif case == "server killed":
            self.world.stop("server")
        elif case in SCRIPTED:
            flight = self.autopilot.flight
            assert flight.armed_ns is not None
            past_ns = flight.now_ns - flight.armed_ns
            until_ns = None if for_ns is None else past_ns + for_ns
            self.autopilot.script = Script([ScriptedFault(SCRIPTED[case], past_ns, until_ns)])
        else:
            self._cut(for_ns)

    def _cut(self, for_ns: int | None) -> None:
        """Make netem lose all packets from now on, for ever or for a while."""
        loss, both = self.scenario.uplink.loss, ("uplink", "downlink")
        now_s = self.world.now_ns / SECOND_NS
        changes = [(now_s, {f"network.{way}.loss": 1.0 for way in both})]
        if for_ns is not None:
            healed_s = now_s + for_ns / SECOND_NS
            changes.append((healed_s, {f"network.{way}.loss": loss for way in both}))
        plan_changes(self.world, self.scenario, {"netem": self.netem}, changes)


def fly(case: CaseName, flavour: FlavourName, seed: int) -> FaultOutcome:
    """Fly with a fault, and return the vehicle's behaviour."""
    scenario = scenario_of(flavour, seed)
    watched = Watched(scenario, flavour)
    world = watched.world
    watched.run(lambda: watched.began_ns is not None, seconds_to_ns(LAUNCH_S))
    assert watched.began_ns is not None
    fault_ns = watched.began_ns + seconds_to_ns(FAULT_S)
    end_ns = fault_ns + seconds_to_ns(WATCHED_S)
    world.at(fault_ns, partial(watched.fail, case))
    world.at(end_ns, lambda: None)
    watched.run(lambda: world.now_ns >= end_ns, end_ns)

    def since(changes: Sequence[tuple[str, int]]) -> Changes:
        later = [(name, (time_ns - fault_ns) / SECOND_NS) for name, time_ns in changes]
        return tuple((name, time_s) for name, time_s in later if time_s >= 0.0)

    modes = since(watched.modes)
    on_s = next((time_s for name, time_s in modes if name == TRACK), WATCHED_S)
    rows = parse(watched.truth.getvalue())
    times_s = (rows["time_ns"] - fault_ns) / SECOND_NS
    seen = (times_s >= 0.0) & (times_s <= on_s)
    speeds = np.linalg.norm(rows["state"][seen, :2, 1], axis=1)
    positions = rows["state"][seen, :2, 0]
    still = np.flatnonzero(speeds < STILL_MPS)
    down_ns = watched.down_ns
    down_s = np.inf if down_ns is None else (down_ns - fault_ns) / SECOND_NS
    return FaultOutcome(
        case,
        flavour,
        seed,
        modes=modes,
        # On the ground PX4 is in the mode again that was asked for last.
        autopilot=tuple(change for change in since(watched.flown) if change[1] < down_s),
        moved_m=_largest(positions - positions[0]),
        off_path_m=_off_path(scenario, positions),
        off_reference_m=_largest(positions - _reference(scenario, times_s[seen] + FAULT_S)),
        still_s=float(times_s[seen][still[0]]) if len(still) else np.nan,
        down_s=down_s if np.isfinite(down_s) else np.nan,
        ending=_ending(watched, speeds[-1], modes),
    )


def _reference(scenario: Scenario, times_s: Array) -> Array:
    """Horizontal reference positions [m] at some times of flight [s], shape (n,); shape (n, 2)."""
    return scenario.make_reference()(times_s)[:, :2, 0]


def _largest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())


def _off_path(scenario: Scenario, positions: Array) -> float:
    """Largest distance of positions [m], shape (n, 2), from the nearest point of the path [m]."""
    path = _reference(scenario, np.arange(0.0, DURATION_S, 0.02))
    each = [np.linalg.norm(path - position, axis=1).min() for position in positions[::20]]
    return float(max(each))


def _ending(watched: Watched, speed: float, modes: Changes) -> Ending:
    """End state of the vehicle, in words.

    Args:
        watched: the flight.
        speed: its horizontal speed at the end [m/s].
        modes: modes of the client after the fault.
    """
    flight = watched.autopilot.flight
    if not flight.armed:
        return "has landed"
    if flight.mode is FlightMode.PILOT:
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
    "off its reference [m]",
    "stands after [s]",
    "motors off after [s]",
    "in the end",
]


def tables(outcomes: Sequence[FaultOutcome]) -> dict[str, TextTable]:
    """A table for each flavour, by its name."""
    made = {}
    for flavour in get_args(FlavourName):
        rows = [
            _row(case, of_case)
            for case in get_args(CaseName)
            if (of_case := [e for e in outcomes if (e.case, e.flavour) == (case, flavour)])
        ]
        if rows:
            made[f"failsafe {flavour}"] = TextTable(HEADINGS, rows)
    return made


def _row(case: CaseName, outcomes: Sequence[FaultOutcome]) -> list[str]:
    """Row of a fault: range of times over its flights, and largest distances."""
    return [
        case,
        "gone" if case == "client killed" else _sequences([each.modes for each in outcomes]),
        _sequences([each.autopilot for each in outcomes]),
        f"{max(each.moved_m for each in outcomes):.1f}",
        f"{max(each.off_path_m for each in outcomes):.1f}",
        f"{max(each.off_reference_m for each in outcomes):.1f}",
        _span([each.still_s for each in outcomes]),
        _span([each.down_s for each in outcomes]),
        ", or ".join(dict.fromkeys(each.ending for each in outcomes)),
    ]


def _sequences(changes: Sequence[Changes]) -> str:
    """Sequences of modes, and the times of each; flights with equal sequences are merged."""
    alike: dict[tuple[str, ...], list[list[float]]] = {}
    for each in changes:
        names = tuple(name for name, _ in each)
        alike.setdefault(names, []).append([time_s for _, time_s in each])
    told = []
    for names, times in alike.items():
        columns = zip(names, zip(*times, strict=True), strict=True)
        told.append(", ".join(f"{name} {_span(column)}" for name, column in columns) or "no change")
    return "; or ".join(told)


def _span(times_s: Sequence[float]) -> str:
    """Range of some times; "never" for those that never came."""
    known = [time_s for time_s in times_s if not np.isnan(time_s)]
    if not known:
        return "never"
    least, most = f"{min(known):.1f}", f"{max(known):.1f}"
    span = least if least == most else f"{least} to {most}"
    return span if len(known) == len(times_s) else f"{span}, or never"


@dataclass(frozen=True)
class FailsafeBenchmarkOptions:
    """Options of this benchmark."""

    seeds: int = 3
    """Number of seeds, from 1 on."""
    only: tuple[CaseName, ...] = get_args(CaseName)
    """Faults."""
    flavours: tuple[FlavourName, ...] = get_args(FlavourName)
    """Flavours of the autopilot."""
    jobs: int = 1
    """Number of flights at once."""
    write: bool = False
    """Put the tables into docs/fly-a-real-one.md."""


def _fly(cell: tuple[CaseName, FlavourName, int]) -> FaultOutcome:
    """See `fly`; called in a worker."""
    return fly(*cell)


def main(argv: Sequence[str]) -> None:
    """Fly as the command line says, and print the tables."""
    options = tyro.cli(FailsafeBenchmarkOptions, args=argv, description=__doc__)
    cells = product(options.only, options.flavours, range(1, options.seeds + 1))
    outcomes = study(_fly, list(cells), FaultOutcome, {}, None, Flags(options.jobs))
    made = tables(outcomes)
    for title, table in made.items():
        table.show(title)
    if options.write:
        files.write(DOCUMENT, refresh(DOCUMENT.read_text(), made).encode())


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "failsafe"))
