"""Flights of an autopilot over a bad network, by Skytether and by set-points alone.

`python -m bench.autopilots` flies a figure eight over the paper's network with both flavours of the
scripted autopilot, in calm air and in wind, in virtual time. The contenders are Skytether with
`vehicle.kind = "mavlink"`, and set-points sent directly by each of the laws of `bench.laws`. All
contenders fly with the same seeds of network and wind, counted from each flight's start. Each
flight is repeated with the network cut for a while.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np

from bench import straight
from bench.harness import Study, TextTable
from bench.laws import Law
from bench.straight import state_at, summary_of, within
from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.faults import ScriptedFault
from skytether.autopilot.flavours import FlavourName
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Flying
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, Record, Rows
from skytether.shared.telemetry.summary import Summary, position_error, summarise
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.sim import flight

Air = Literal["calm", "wind"]
INPUTS: dict[str, Any] = {
    "scheme": "committed",
    "trigger": "cost_gap | silence(1)",
    "observer_s": 4.0,
    "terminal_weight": [50.0, 20.0],
    "input_reference": True,
}
"""Keys of `control` for contenders that send inputs."""
OURS: dict[str, dict[str, dict[str, Any]]] = {
    "skytether": {},
    "skytether, inputs": {
        "control": INPUTS,
        "vehicle": {"report": "always"},
        "link": {"heartbeat_s": 0.1, "timeout_s": 1.0},
    },
    "skytether, patient": {
        "control": INPUTS | {"dt": 0.1},
        "vehicle": {"report": "always"},
        "link": {"heartbeat_s": 0.1, "timeout_s": 8.0, "age_max_s": 12.0},
    },
}
"""Contenders with Skytether, and the keys that differ from the scenario. The scenario sends the
desired trajectory; the other two contenders send inputs. "patient" flies its plan to the end, 8 s,
even if the server is silent; the first two brake after two seconds and after one."""
CALM: Air = "calm"
WIND: Air = "wind"
LEADS: dict[FlavourName, tuple[float, float]] = {"ardupilot": (0.55, 1.1), "px4": (0.85, 1.4)}
"""Lead times of the laws `targets` and `lead` [s], tuned by hand in calm air: with a real
ArduCopter, and with the simulated PX4."""
MODELS: dict[FlavourName, dict[str, Any]] = {
    "ardupilot": {},
    "px4": {
        "gain": [0.77, 0.77, 0.94],
        "tau_s": [0.47, 0.47, 0.23],
        "dead_time_s": [0.13, 0.13, 0.04],
    },
}
"""Keys of the model, identified with steps of 1 m/s, that differ from the scenario. Skytether is
not tuned to these flights."""
SAFE: dict[FlavourName, dict[str, float]] = {
    "ardupilot": {"GUID_TIMEOUT": 1.0, "FS_GCS_ENABLE": 5, "SYSID_MYGCS": 245},
    "px4": {"COM_OBL_RC_ACT": 4},
}
"""Autopilot parameters that Skytether demands before it flies."""
WINDY = {"steady_wind_mps": [6.0, 0.0, 0.0], "turbulence_mps": 6.0}
"""Keys of the vehicle for flights in a wind of 6 m/s with turbulence."""
SEEDS = 5
CUT_S, HEALED_S, WATCHED_S = 15.0, 20.0, 32.0
"""Times of flight at which the network is cut, at which it is restored, and until which the largest
error is evaluated [s]."""


class Cell(NamedTuple):
    """Combination that is flown with one seed."""

    contender: str
    flavour: FlavourName
    air: Air
    seed: int


class FlownCell(msgspec.Struct, frozen=True, kw_only=True):
    """Flight of a contender, and its repetition with the network cut for a while."""

    contender: str
    flavour: FlavourName
    air: Air
    seed: int
    whole: Summary
    """Figures with an intact network; packets are counted from the first step to the last."""
    cut: Summary
    """Figures of the flight with the cut."""
    largest_m: float
    """Largest error in the flight with the cut, from the cut until well after its end [m]."""


def contenders(flavour: FlavourName) -> dict[str, Law | None]:
    """Laws of the contenders by name; None for Skytether."""
    targets_s, lead_s = LEADS[flavour]
    return {
        "velocity": Law("velocity", gain=0.3),
        "targets": Law("targets"),
        "targets with lead": Law("targets", targets_s),
        "lead, gain 0.3": Law("lead", lead_s, 0.3),
        "lead, gain 0.5": Law("lead", lead_s, 0.5),
        "lead, gain 0.5, T - 0.1 s": Law("lead", lead_s - 0.1, 0.5),
        "lead, gain 0.5, T + 0.1 s": Law("lead", lead_s + 0.1, 0.5),
        **dict.fromkeys(OURS),
    }


def scenario_of(cell: Cell, model: Mapping[str, Any] | None = None) -> Scenario:
    """Scenario of a cell: the same for all contenders, except for keys that only Skytether uses.

    Args:
        model: keys of the model that Skytether uses; default: those of `MODELS`.
    """
    table = reading.to_table(reading.load("autopilot"))
    table["seed"] = cell.seed
    table["model"] |= MODELS[cell.flavour] if model is None else model
    table["vehicle"] |= {"address": "udpout:autopilot:0", **(WINDY if cell.air == WIND else {})}
    for name, keys in OURS.get(cell.contender, {}).items():
        table[name] |= keys
    return reading.check(table, "autopilot")


def began_ns(flown: Record) -> int:
    return next(each.time_ns for each in flown.events if isinstance(each.event, Flying))


Changes = Sequence[tuple[float, Mapping[str, Any]]]


def fly(scenario: Scenario, law: Law | None, flavour: FlavourName, changes: Changes = ()) -> Record:
    """Fly a contender; the record has true states, and packets from the first step to the last."""
    if law is not None:
        return straight.fly(scenario, law, flavour, changes)
    autopilot, truth = autopilot_of(scenario, flavour)
    record = flight.fly(scenario, beside={"autopilot": autopilot}, changes=changes)
    return as_it_was(scenario, record, truth.rows())


def autopilot_of(
    scenario: Scenario, flavour: FlavourName, faults: Sequence[ScriptedFault] = ()
) -> tuple[Autopilot, MemoryRecorder]:
    """Autopilot that is ready to fly, and the recorder of its true states."""
    truth = MemoryRecorder(TRUTH_COLUMNS)
    autopilot = Autopilot(
        scenario, flavour, ready_s=straight.READY_S, faults=faults, recorder=truth
    )
    for name, value in SAFE[flavour].items():
        autopilot.flight.set(name, value)
    return autopilot, truth


def as_it_was(scenario: Scenario, flown: Record, truth: Rows) -> Record:
    """Record of Skytether's flight with true states, and packets from the first step to the last.

    Args:
        flown: record of the flight, with states as estimated aboard.
        truth: rows of `autopilot.endpoint.TRUTH_COLUMNS`, on the clock of the record's events.
    """
    times_ns = began_ns(flown) + flown.client["step"] * scenario.dt_ns
    client = flown.client.copy()
    client["state"] = state_at(truth, times_ns)[:, : scenario.model.axes]
    netem = within(flown.netem, times_ns, scenario.dt_ns)
    return replace(flown, client=client, netem=netem)


def fly_cell(cell: Cell) -> FlownCell:
    scenario = scenario_of(cell)
    law = contenders(cell.flavour)[cell.contender]
    whole = fly(scenario, law, cell.flavour)
    began_s = began_ns(whole) / SECOND_NS
    both = ("uplink", "downlink")
    changes = [
        (began_s + CUT_S, {f"network.{way}.loss": 1.0 for way in both}),
        (began_s + HEALED_S, {f"network.{way}.loss": scenario.uplink.loss for way in both}),
    ]
    cut = fly(scenario, law, cell.flavour, changes)
    return judged(cell, scenario, whole, cut)


def judged(
    cell: Cell, scenario: Scenario, whole: Record, cut: Record, *, secure: bool = False
) -> FlownCell:
    """Figures of both flights of a cell: with an intact network, and with the cut."""
    times_s = cut.client["step"] * scenario.control.dt
    watched = (times_s >= CUT_S) & (times_s < WATCHED_S)
    errors = np.linalg.norm(position_error(scenario, cut.client)[watched], axis=1)
    whole_summary, cut_summary = (
        summarise(scenario, "autopilot", record.client, record.server, record.netem, secure=secure)
        if cell.contender in OURS
        else summary_of(scenario, record)
        for record in (whole, cut)
    )
    return FlownCell(
        **cell._asdict(), whole=whole_summary, cut=cut_summary, largest_m=float(errors.max())
    )


OF_AIR = [
    "RMSE xy [m] (least to most)",
    f"largest error in a cut of {HEALED_S - CUT_S:g} s [m]",
    "packets/s up, down",
]
"""Headings of what a table has for each air."""


def tables(flights: Sequence[FlownCell]) -> dict[str, TextTable]:
    """Tables by flavour."""
    by_name = {}
    for flavour in get_args(FlavourName):
        of_case = [each for each in flights if each.flavour == flavour]
        airs = [air for air in get_args(Air) if any(each.air == air for each in of_case)]
        flown = {each.contender for each in of_case}
        rows = [
            [name, *(cell for air in airs for cell in figures(of_case, name, air))]
            for name in contenders(flavour)
            if name in flown
        ]
        if rows:
            headings = [f"{air}: {OF_AIR[0]}" for air in airs]
            columns = [each for heading in headings for each in (heading, *OF_AIR[1:])]
            by_name[flavour] = TextTable(["set-points", *columns], rows)
    return by_name


def figures(flights: Sequence[FlownCell], name: str, air: str) -> list[str]:
    """Cells of a contender in an air: means over its flights; for the cut, the largest error and
    failures. Empty texts if it has not flown.
    """
    flown = [each for each in flights if (each.contender, each.air) == (name, air)]
    if not flown:
        return [""] * len(OF_AIR)
    errors = [each.whole.rmse_xy or np.nan for each in flown]

    def a_second(key: str) -> float:
        return float(np.mean([getattr(each.whole, key) / each.whole.duration_s for each in flown]))

    flying = {str(Mode.TRACK), str(Mode.COAST)}
    on = sum(each.cut.mode in flying for each in flown)
    ended = "" if on == len(flown) else f", {on} of {len(flown)} fly on"
    return [
        f"{np.mean(errors):.3f} ({min(errors):.3f} to {max(errors):.3f})",
        f"{max(each.largest_m for each in flown):.2f}{ended}",
        f"{a_second('uplink_packets'):.1f}, {a_second('downlink_packets'):.1f}",
    ]


def cells(seeds: int) -> list[Cell]:
    kinds = product(get_args(FlavourName), get_args(Air))
    return [
        Cell(name, flavour, air, seed)
        for flavour, air in kinds
        for name in contenders(flavour)
        for seed in range(1, seeds + 1)
    ]


STUDY = Study(__doc__, cells, fly_cell, FlownCell, tables, SEEDS)
document_tables = STUDY.document_tables

if __name__ == "__main__":
    sys.exit(command.main(STUDY.main, sys.argv[1:], "autopilots"))
