"""`fly` flies a case in virtual time and returns its outcome; only this module of `explain` flies.

A case and its outcome can be sent to another process and back.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from skytether.explain import doubled
from skytether.explain.cases import FlightCase, Lane, Stall
from skytether.netem.impairments.draws import SLOT_NS
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import Failure, FlowOpened, Flying
from skytether.shared.events.paths import PathDied
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Record, Rows, trace_hash
from skytether.shared.telemetry.server_ticks import are_plans, flows
from skytether.shared.telemetry.summary import position_error, separations
from skytether.shared.wire.protocol import Mode
from skytether.sim import flight
from skytether.sim.world import World
from skytether.theorem.judgement import Judgement, judged
from skytether.theorem.waits import Reason, questions

JUST_NS, BEFORE_NS = SECOND_NS // 5, 2 * SECOND_NS
"""Least and largest age of the packets that show whether a path was dead [ns]; newer packets may
still be under way."""


@dataclass(frozen=True, slots=True)
class Track:
    """Steps of a vehicle, from its first plan on; each array has a row per step."""

    vehicle: int
    began_s: float
    """Time of flight at step 0 [s]."""
    step_s: Array
    """Time of each step since step 0 [s]; shape (n,)."""
    position_m: Array
    """Position [m]; shape (n, axes)."""
    error_m: Array
    """Distance from the reference [m]; 0 on a mission, which has goals and no reference."""
    mode: Indices
    reason: Indices

    @property
    def time_s(self) -> Array:
        """Time of flight of each step, counted as in events [s]; shape (n,)."""
        return self.began_s + self.step_s


@dataclass(frozen=True, slots=True)
class Packets:
    """Packets that entered the network; each array has a row per packet."""

    time_s: Array
    """Time of flight at which the packet entered the network [s]."""
    lane: list[Lane]
    slot: Indices
    """Slot in which the packet entered, in milliseconds from the flow's first packet."""
    delay_s: Array
    lost: Flags
    is_plan: Flags


class Death(NamedTuple):
    """Decision of the vehicle or the server that a path is dead."""

    time_s: float
    """Time of flight at the decision [s]."""
    vehicle: int
    path: int
    direction: int
    """Direction of the dead path: UPLINK if the server decided, DOWNLINK if the vehicle did."""
    arrived: float
    """Share of the packets sent over the path shortly before the decision that arrived."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """Result of flying a case."""

    tracks: tuple[Track, ...]
    packets: Packets
    began_s: dict[Lane, float]
    """Time of flight at the first packet of each lane [s]."""
    separation_s: Array
    separation_m: Array
    """Smallest distance between two vehicles of a mission at the times `separation_s` [m]."""
    failure: str
    """Reason why a vehicle could not fly; empty if all flew."""
    failed_s: float
    """Time of flight of the failure [s]; 0 if there was none."""
    deaths: tuple[Death, ...]
    packets_per_s: float
    trace: str
    """Hash of the vehicles' rows, see `trace_hash`."""
    judgement: Judgement | None = None
    """Whether the assumptions of the separation theorem held, and which vehicle waited for which;
    None without a mission."""


FlyAll: TypeAlias = Callable[[Sequence[FlightCase]], list[CaseOutcome]]
"""Function that flies cases, and returns their outcomes in order; may raise `Interrupted`."""


def fly(case: FlightCase) -> CaseOutcome:
    """Fly a case; raises ConfigError if it cannot be flown."""
    scenario = case.flown()
    reached_s = 0

    def on_second(flown_s: int) -> None:
        nonlocal reached_s
        reached_s = flown_s

    until_s, reasons = case.until_s, list[Reason]()
    actions = [action for stall in case.stalls for action in _actions(stall, case)]
    if case.double is not None:
        actions += doubled.actions(case.double, scenario)
    if scenario.keeps_apart:
        actions += questions(scenario, reasons)
    record = flight.fly(
        scenario,
        vehicles=case.vehicles,
        secure=case.secure,
        changes=[(each.at_s, {each.key: each.value}) for each in case.commands],
        standby=case.standby,
        actions=actions,
        on_second=on_second,
        stopped=None if until_s is None else lambda: reached_s >= until_s,
    )
    return outcome(scenario, record, reasons)


def _actions(stall: Stall, case: FlightCase) -> Iterable[tuple[float, Callable[[World], None]]]:
    seed, vehicles = case.scenario.seed, range(1, case.vehicles + 1)
    clients = [f"client {seed}.{vehicle}" for vehicle in vehicles]
    for host in ["server"] if stall.process == "server" else clients:
        yield stall.at_s, partial(World.freeze, name=host)
        if math.isfinite(stall.for_s):
            yield stall.at_s + stall.for_s, partial(World.thaw, name=host)


def outcome(scenario: Scenario, record: Record, reasons: Sequence[Reason] = ()) -> CaseOutcome:
    """Outcome of a flight in virtual time, from its record; `reasons`: see `waits`."""
    began_ns = _lanes_began_ns(record)
    flying_ns = {
        each.event.vehicle: each.time_ns for each in record.events if isinstance(each.event, Flying)
    }
    tracks, flown, began_s = [], [], []
    for vehicle in np.unique(record.client["vehicle"]).tolist():
        rows = record.client[record.client["vehicle"] == vehicle]
        began = flying_ns[vehicle] / SECOND_NS
        if (rows["mode"] == Mode.TRACK).any():
            flown.append(rows)
            began_s.append(began)
            tracks.append(track(scenario, rows, record.server, vehicle, began))
    dt_s, scale = scenario.control.dt, scenario.mission.height_scale if scenario.keeps_apart else 1
    times_s, nearest_m = separations(flown, began_s, dt_s, scale)
    return CaseOutcome(
        tuple(tracks),
        _packets(scenario, record, began_ns),
        {lane: ns / SECOND_NS for lane, ns in began_ns.items()},
        times_s,
        nearest_m if scenario.keeps_apart else np.full(len(times_s), np.nan),
        str(record.failure or ""),
        next(
            (each.time_ns / SECOND_NS for each in record.events if isinstance(each.event, Failure)),
            0.0,
        ),
        tuple(_deaths(record)),
        len(record.netem) / max(1.0, float(np.ptp(record.netem["arrived_ns"])) / SECOND_NS),
        trace_hash(record.client),
        judged(record, scenario, reasons) if scenario.keeps_apart else None,
    )


def track(scenario: Scenario, rows: Rows, server: Rows, vehicle: int, began_s: float) -> Track:
    """Track of a vehicle, from its own rows and the server's rows."""
    flown = rows[np.argmax(rows["mode"] == Mode.TRACK) :]
    if scenario.keeps_apart:  # on a mission the reference is the next goal, which is far away
        error_m = np.zeros(len(flown))
    else:
        error_m = np.linalg.norm(position_error(scenario, flown, server), axis=1)
    step_s = flown["step"] * scenario.control.dt
    modes, reasons = flown["mode"].astype(np.int64), flown["reason"].astype(np.int64)
    return Track(vehicle, began_s, step_s, flown["state"][..., 0], error_m, modes, reasons)


def _deaths(record: Record) -> Iterator[Death]:
    flow, packets = {vehicle: flow for flow, vehicle in flows(record).items()}, record.netem
    for each in record.events:
        if not isinstance(each.event, PathDied):
            continue
        way = UPLINK if each.process == "server" else DOWNLINK
        since_ns = each.time_ns - packets["arrived_ns"]
        is_own = (packets["direction"] == way) & (packets["path"] == each.event.path)
        is_own &= packets["flow"] == flow.get(each.event.vehicle, 0)
        lost = packets["lost"][is_own & (since_ns > JUST_NS) & (since_ns < BEFORE_NS)]
        if len(lost):
            at, arrived = (each.event.vehicle, each.event.path, way), 1.0 - float(lost.mean())
            yield Death(each.time_ns / SECOND_NS, *at, arrived)


def _lanes_began_ns(record: Record) -> dict[Lane, int]:
    """Time of the first packet of each flow, for both directions [ns]."""
    began: dict[Lane, int] = {}
    for time_ns, host, event in record.events:
        if isinstance(event, FlowOpened):
            path = int(host.partition("/")[2] or 1) - 1
            for direction in (UPLINK, DOWNLINK):
                began[path, direction, event.flow] = time_ns
    return began


def _packets(scenario: Scenario, record: Record, began_ns: Mapping[Lane, int]) -> Packets:
    """Packets of a flight, in the order in which they entered the network."""
    rows = record.netem[np.argsort(record.netem["arrived_ns"], kind="stable")]
    names = rows["path"].tolist(), rows["direction"].tolist(), rows["flow"].tolist()
    lanes: list[Lane] = list(zip(*names, strict=True))
    since_ns = rows["arrived_ns"] - np.array([began_ns[lane] for lane in lanes], dtype=np.int64)
    return Packets(
        rows["arrived_ns"] / SECOND_NS,
        lanes,
        since_ns // SLOT_NS,
        rows["delay_ns"] / SECOND_NS,
        rows["lost"].copy(),
        are_plans(record, rows, scenario.dt_ns),
    )
