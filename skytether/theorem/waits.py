"""Waits: which vehicle of a mission waited for which, and for which packet.

The server sends a vehicle a motion every `motion.SPACING` steps, unless it has arrived or waits

    to begin          until every vehicle of the mission flies a first motion
    acknowledgement   until the server has observed whether the vehicle flies its newest motion
    way               because no motion towards its goal keeps away from another vehicle, or a zone

The first two kinds follow from the rows of a record. Waits for a way are only in the server's
figures (`waits`), which `questions` reads at each decision while the flight is flown again.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.motion import SPACING
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, Record, Rows
from skytether.shared.telemetry.server_ticks import are_plans, begin_ns, flows, ticks
from skytether.sim import flight
from skytether.sim.world import World
from skytether.theorem.hypotheses import Flown, began_ns, flown

AT_ONCE_S = 1e-3
"""Tolerance of times [s]."""
OTHER = re.compile(r"vehicle (\d+)( to pass)?|a zone")
"""Regular expression for the server's text about a vehicle that waits for a free way."""

Reason: TypeAlias = tuple[float, int, str]
"""Time of flight [s], vehicle, and the server's text about what the vehicle waits for."""
Question: TypeAlias = tuple[float, Callable[[World], None]]
"""Action in a flight: time [s], and function that is called at this time; see `flight.fly`."""
Kind = Literal["to begin", "acknowledgement", "way"]


@dataclass(frozen=True, slots=True)
class Wait:
    """Time for which the server sent a vehicle no motion, and why."""

    kind: Kind
    vehicle: int
    start_s: float
    """Time of flight at which the wait begins [s]."""
    for_s: float
    other: int = 0
    """Number of the vehicle that is waited for; 0 if there is none, as in a wait for a zone."""
    motion_s: float = math.nan
    """Time at which the server sent the unacknowledged motion of `vehicle` or of `other` [s]."""
    plans: tuple[int, int] = (0, 0)
    """Number of packets with this motion, and number of these that were lost."""
    reports: tuple[int, int] = (0, 0)
    """Number of packets from the vehicle since it flew this motion, and number of those lost."""

    @property
    def end_s(self) -> float:
        return self.start_s + self.for_s

    @property
    def lost(self) -> int:
        return self.plans[1] + self.reports[1]


@dataclass(frozen=True, slots=True)
class _Vehicle:
    """Vehicle, with the ticks at which the server sent its motions and knew of their acceptance."""

    flown: Flown
    time_s: Array
    """Time of flight of each server tick with this vehicle [s]."""
    sent_at: Indices
    """Number of the tick at which each motion was sent first."""
    heard_at: Indices
    """Tick number at which the server knew whether a motion was accepted, or the last tick."""
    is_heard: Flags
    """Whether the server knew at the tick in `heard_at` if the motion was accepted."""
    accepted: Indices
    """Step from which the vehicle flew each motion; -1 for a motion that was never flown."""

    @property
    def begins_s(self) -> float:
        """Time at which the server learns that the vehicle flies its first motion [s]."""
        return float(self.time_s[self.heard_at[np.argmax(self.accepted >= 0)]])


def questions(scenario: Scenario, reasons: list[Reason]) -> Iterator[Question]:
    """Actions that append the server's texts about waiting vehicles, once for each decision."""

    def ask(world: World) -> None:
        for vehicle, figures in world.endpoint(flight.SERVER[0]).figures()["by_vehicle"].items():
            time_s = world.now_ns / SECOND_NS
            reasons.append((time_s, int(vehicle), figures.get("waits") or ""))

    every_s = SPACING * scenario.control.dt
    for number in range(int((scenario.link.connect_s + scenario.duration) / every_s)):
        yield number * every_s, ask


def waits(record: Record, scenario: Scenario, reasons: Sequence[Reason] = ()) -> tuple[Wait, ...]:
    """Waits of all vehicles of a mission, the longest first.

    Args:
        record: flight in virtual time.
        reasons: the server's texts every SPACING steps; if empty, waits for a way are left out.
    """
    vehicles = list(_vehicles(record, scenario))
    found, is_plan = [*_to_begin(vehicles)], are_plans(record, record.netem, scenario.dt_ns)
    for each in vehicles:
        found += _acknowledgements(record, is_plan, each, scenario.control.dt)
    found += _ways(reasons, found, SPACING * scenario.control.dt)
    return tuple(sorted(found, key=lambda wait: -wait.for_s))


def _vehicles(record: Record, scenario: Scenario) -> Iterator[_Vehicle]:
    tick, server, join = ticks(record.server), record.server, scenario.terms().join
    left_ns = begin_ns(record, scenario.dt_ns)
    for each in flown(scenario, record):
        is_own = server["vehicle"] == each.vehicle
        rows, sent = server[is_own], each.motions.step
        if not len(rows) or not len(sent) or left_ns is None:
            continue
        at = [np.flatnonzero(each.in_force == first) for first in sent.tolist()]
        accepted = np.array([int(each.step[own[0]]) if len(own) else -1 for own in at])
        # A motion that is not accepted within `join` steps is never accepted.
        certain = np.where(accepted >= 0, accepted, sent + join + 1)
        heard_at = np.searchsorted(rows["observed_step"], certain).clip(0, len(rows) - 1)
        time_s = (left_ns + tick[is_own] * scenario.dt_ns) / SECOND_NS
        is_heard = rows["observed_step"][heard_at] >= certain
        yield _Vehicle(each, time_s, _sent_at(rows, sent), heard_at, is_heard, accepted)


def _sent_at(rows: Rows, sent: Indices) -> Indices:
    """Index of the first row with each step; step numbers by the server's count may go back."""
    first = dict(zip(rows["step"][::-1].tolist(), range(len(rows))[::-1], strict=True))
    return np.array([first[step] for step in sent.tolist()])


def _to_begin(vehicles: Sequence[_Vehicle]) -> Iterator[Wait]:
    """Waits to begin: each vehicle waits for the vehicle that begins last."""
    last = max(vehicles, key=lambda each: each.begins_s, default=None)
    for each in vehicles:
        if last is not None and each.begins_s < last.begins_s:
            for_s = last.begins_s - each.begins_s
            yield Wait("to begin", each.flown.vehicle, each.begins_s, for_s, last.flown.vehicle)


def _acknowledgements(
    record: Record, is_plan: Flags, each: _Vehicle, dt_s: float
) -> Iterator[Wait]:
    """Waits for acknowledgements, with the packets that were waited for.

    Args:
        is_plan: whether each packet of the record has a plan.
    """
    number, began_s = each.flown.vehicle, began_ns(record)[each.flown.vehicle] / SECOND_NS
    flow = next(flow for flow, vehicle in flows(record).items() if vehicle == number)
    is_own = record.netem["flow"] == flow
    packets, carries = record.netem[is_own], is_plan[is_own]
    entered_s, is_down = packets["arrived_ns"] / SECOND_NS, packets["direction"] == DOWNLINK
    for motion in each.is_heard.nonzero()[0].tolist():
        start_s, end_s = each.time_s[[each.sent_at[motion], each.heard_at[motion]]].tolist()
        is_meanwhile = (entered_s > start_s - AT_ONCE_S) & (entered_s < end_s)
        plans = packets["lost"][is_meanwhile & carries]
        flies_s = began_s + float(each.accepted[motion]) * dt_s
        since = is_meanwhile & is_down & (entered_s > flies_s - AT_ONCE_S)
        reports = packets["lost"][since & (each.accepted[motion] >= 0)]
        counts = (len(plans), int(plans.sum())), (len(reports), int(reports.sum()))
        yield Wait("acknowledgement", number, start_s, end_s - start_s, number, start_s, *counts)


def _ways(reasons: Sequence[Reason], others: Sequence[Wait], every_s: float) -> Iterator[Wait]:
    """Waits for a way, with the lost packets for which the other vehicle waited, if any."""
    last: dict[int, tuple[str, Wait]] = {}
    found = []
    for time_s, vehicle, text in reasons:
        before, wait = last.pop(vehicle, ("", None))
        match = OTHER.fullmatch(text)
        if wait is not None and text == before:
            last[vehicle] = text, replace(wait, for_s=time_s + every_s - wait.start_s)
            continue
        found += [wait] * (wait is not None)
        if match:
            other = int(match[1] or 0)
            last[vehicle] = text, Wait("way", vehicle, time_s, every_s, other)
    for wait in (*found, *(each for _, each in last.values())):
        assert wait is not None
        lost = [
            each
            for each in others
            if each.kind == "acknowledgement" and each.vehicle == wait.other and each.lost
            if each.start_s < wait.end_s and each.end_s > wait.start_s
        ]
        if lost:
            most = max(lost, key=lambda each: each.for_s)
            wait = replace(wait, motion_s=most.motion_s, plans=most.plans, reports=most.reports)  # noqa: PLW2901 - completed
        yield wait
