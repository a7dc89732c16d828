"""Cause of a moment: the smallest set of units that suffices for it, and the effect of each unit.

Three groups of units are tried: units shortly before the moment, units from the flight's beginning
on, and the same units together with the usual delay. The search uses the first group without which
the moment does not occur; if there is no such group, the cause is the scenario.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skytether.explain import units
from skytether.explain.cases import (
    Bad,
    Command,
    FlightCase,
    Lane,
    Setting,
    Stall,
    Unit,
    Unmet,
    UsualDelay,
)
from skytether.explain.flying import CaseOutcome, FlyAll
from skytether.explain.moments import AFTER_S, Moment, comes_about, error_m, is_averted
from skytether.explain.smallest import smallest
from skytether.explain.units import PUSH, Circumstances
from skytether.shared.endpoints.directions import FLIGHT

BEFORE_S = 8.0
"""Length of the interval before a moment that is searched first for the moment's cause [s]. It is
longer than two time-outs, a horizon and the delays together."""
SHORTEST_MS = 20
"""Resolution of the bisection for the shortest outage that still causes the moment [ms]."""
PACKETS_MAX = 64
"""Number of newest packets that `rescues` delivers one by one, each in a flight of its own."""


@dataclass(frozen=True, slots=True)
class CausePart:
    """Unit of a cause, and its effect."""

    unit: Unit
    start_s: float
    """Time of flight at the unit's beginning [s]; 0 for permanent units."""
    end_s: float
    is_needed: bool
    """Whether the moment does not occur without this unit."""
    error_m: float
    """Largest error in the flight without this unit [m]."""
    calm_m: float = np.nan
    """Largest error without this unit, wind and model errors [m]; for a real vehicle only."""
    packets: int = 0
    """Number of packets that the unit lost or delayed."""
    plans: int = 0
    """Number of plans among these packets."""
    shortest_s: tuple[float, float] | None = None
    """Lengths of the shortest sufficient outages with the unit's beginning or end [s]; sorted."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Smallest set of units that suffices for a moment."""

    parts: tuple[CausePart, ...]
    """Units of the cause; empty if the scenario itself is the cause."""
    since_s: float
    """Time of flight from which on units were examined [s]."""
    among: int
    """Number of units that were examined."""
    error_m: float
    """Largest error in the flight with this cause alone [m]."""
    averting: tuple[CausePart, ...] = ()
    """Smallest set without which the moment does not occur; empty if `parts` is such a set."""
    others: tuple[CausePart, ...] = ()
    """Losses and late packets that were examined, but are neither in `parts` nor in `averting`."""
    innocent: tuple[tuple[str, float], ...] = ()
    """Groups of units outside the cause, and the change of the error without each group [m]."""


@dataclass(frozen=True, slots=True)
class Packet:
    """Packet that the network lost or delayed."""

    time_s: float
    """Time of flight at which the packet was sent [s]."""
    lane: Lane
    is_plan: bool


@dataclass(frozen=True, slots=True)
class Rescues:
    """Packets of a cause, each of which would have averted the moment if delivered in time."""

    packets: tuple[Packet, ...]
    tried: int


def cause(
    case: FlightCase, moment: Moment, flown: CaseOutcome, fly_all: FlyAll, at_once: int
) -> tuple[Cause, Circumstances]:
    """Cause of a moment, without the effects of its parts, and the units that were examined."""
    case = replace(case, until_s=moment.end_s + AFTER_S + 1.0)

    def suffice(cases: Iterable[FlightCase]) -> list[bool]:
        return [comes_about(moment, each) for each in fly_all([*cases])]

    def avert(sets: Sequence[Sequence[Unit]]) -> list[bool]:
        return [not each for each in suffice(here.without(*some) for some in sets)]

    until_s, tried = moment.end_s + AFTER_S, list[tuple[float, Circumstances]]()
    for since_s, with_delay in ((moment.start_s - BEFORE_S, False), (0.0, False), (0.0, True)):
        here = units.circumstances(case, flown, since_s, until_s, with_delay=with_delay)
        (bare,) = fly_all([here.only(())])
        if not comes_about(moment, bare):
            tried.append((since_s, here))
            if is_averted(moment, bare):
                break
    if not tried:
        return Cause((), 0.0, len(here.units) - 1, error_m(moment, bare)), here  # without `Unmet`
    since_s, here = tried[-1]
    met = tuple(each for each in here.units if each != Unmet())
    (is_enough,) = suffice([here.only(met)])
    every = met if is_enough else here.units
    found = smallest(every, lambda some: suffice(map(here.only, some)), at_once)
    alone, without = fly_all([here.only(found), here.without(*found)])
    averting: tuple[Unit, ...] = ()
    if comes_about(moment, without):
        averting = smallest(here.units, avert, at_once)
    first, second = (
        tuple(_part(each, flown) for each in _in_order(some)) for some in (found, averting)
    )
    others = tuple(
        _part(each, flown)
        for each in here.units
        if isinstance(each, Bad) and each not in (*found, *averting)
    )
    counts = max(0.0, since_s), len(met), error_m(moment, alone)
    return Cause(first, *counts, second, others), here


def _in_order(found: Sequence[Unit]) -> list[Unit]:
    """Units of a set, sorted so that single packets come last: there may be many of them."""
    return sorted(found, key=lambda each: isinstance(each, Bad) and each.is_packet)


def _part(unit: Unit, flown: CaseOutcome) -> CausePart:
    if isinstance(unit, Command):
        return CausePart(unit, unit.at_s, unit.at_s, False, np.nan)
    if isinstance(unit, Stall):
        return CausePart(unit, unit.at_s, unit.at_s + unit.for_s, False, np.nan)
    if not isinstance(unit, Bad):
        return CausePart(unit, 0.0, 0.0, False, np.nan)
    began_s, which = flown.began_s[unit.lane], _met(unit, flown)
    plans = int(flown.packets.is_plan[which].sum())
    times = began_s + unit.first * 1e-3, began_s + unit.end * 1e-3
    return CausePart(unit, *times, False, np.nan, packets=len(which), plans=plans)


def _met(unit: Bad, flown: CaseOutcome) -> list[int]:
    """Numbers of the packets that a unit lost or delayed."""
    packets = flown.packets
    within = np.flatnonzero((packets.slot >= unit.first) & (packets.slot < unit.end))
    return [number for number in within.tolist() if packets.lane[number] == unit.lane]


def needed(
    found: Cause, here: Circumstances, moment: Moment, fly_all: FlyAll
) -> tuple[Cause, list[CaseOutcome]]:
    """Fly without each part of a cause, and without each other group of units. Returns the cause
    with the results, and the flights without each part.
    """
    parts, others = found.parts, _groups(found, here)
    cases = [here.without(part.unit) for part in parts]
    cases += [here.without(*group) for group in others.values()]
    calm = [here.without(part.unit, PUSH) for part in parts if PUSH in here.units]
    as_flown, *outcomes = fly_all([here.case, *cases, *calm])
    errors = [error_m(moment, each) for each in outcomes]
    calm_m = errors[len(cases) :] or [np.nan] * len(parts)
    checked = tuple(
        replace(part, is_needed=not comes_about(moment, each), error_m=error, calm_m=least)
        for part, each, error, least in zip(parts, outcomes, errors, calm_m, strict=False)
    )
    differ = [error - error_m(moment, as_flown) for error in errors[len(parts) : len(cases)]]
    innocent = tuple(zip(others, differ, strict=True))
    return replace(found, parts=checked, innocent=innocent), outcomes[: len(parts)]


def _groups(found: Cause, here: Circumstances) -> dict[str, list[Unit]]:
    """Units that are in neither `parts` nor `averting` of the cause, by kind."""
    groups: dict[str, list[Unit]] = {}
    for unit in here.units:
        if unit != Unmet() and all(unit != part.unit for part in (*found.parts, *found.averting)):
            groups.setdefault(_group(unit), []).append(unit)
    return groups


def _group(unit: Unit) -> str:
    match unit:
        case Bad():
            what = "late packets" if unit.is_late else "other losses"
            return f"{what} of the {FLIGHT[unit.lane[1]]}"
        case _:
            return named(unit)


WHAT = {
    (False, False): "outage",
    (False, True): "lost packet",
    (True, False): "period of late packets",
    (True, True): "late packet",
}
"""Nouns for bad stretches, by `is_late` and `is_packet`."""


def named(unit: Unit) -> str:
    """Noun for a unit, without an article."""
    match unit:
        case Setting():
            return unit.name
        case UsualDelay():
            return f"usual delay of the {FLIGHT[unit.direction]}"
        case Command():
            return f"change of {unit.key} to {unit.value}"
        case Unmet():
            return "what else the network loses"
        case Stall():
            what = "stall" if np.isfinite(unit.for_s) else "death"
            return f"{what} of the {unit.process}"
        case Bad():
            return f"{WHAT[unit.is_late, unit.is_packet]} of {lane_name(unit.lane)}"


def lane_name(lane: Lane) -> str:
    path, direction, flow = lane
    return f"{FLIGHT[direction]} {path + 1}" + (f" of vehicle {flow + 1}" if flow else "")


def rescues(
    found: Cause, here: Circumstances, moment: Moment, flown: CaseOutcome, fly_all: FlyAll
) -> Rescues:
    """Packets of the cause, sent before the moment, whose delivery alone averts the moment."""
    packets = flown.packets
    bad = [part.unit for part in found.parts if isinstance(part.unit, Bad)]
    numbers = sorted(number for unit in bad for number in _met(unit, flown))
    numbers = [each for each in numbers if packets.time_s[each] < moment.start_s][-PACKETS_MAX:]
    slots = packets.slot[numbers].tolist()
    lost = [Bad(packets.lane[at], slot, slot + 1) for at, slot in zip(numbers, slots, strict=True)]
    averting = tuple(
        Packet(float(packets.time_s[at]), packets.lane[at], bool(packets.is_plan[at]))
        for at, each in zip(numbers, fly_all([*map(here.without, lost)]), strict=True)
        if not comes_about(moment, each)
    )
    return Rescues(averting, len(numbers))


def lengths(found: Cause, here: Circumstances, moment: Moment, fly_all: FlyAll) -> Cause:
    """Add to a cause the shortest sufficient length of each needed outage, found by bisection.

    Bisection assumes that the moment also occurs with every longer outage.
    """
    tasks = [
        (number, from_end, part.unit)
        for number, part in enumerate(found.parts)
        for from_end in (False, True)
        if isinstance(part.unit, Bad) and part.is_needed and not part.unit.is_packet
    ]
    low = [0] * len(tasks)
    high = [unit.end - unit.first for _, _, unit in tasks]
    while open_ := [i for i in range(len(tasks)) if high[i] - low[i] > SHORTEST_MS]:
        middle = {i: (low[i] + high[i]) // 2 for i in open_}
        cases = []
        for i in open_:
            _, from_end, unit = tasks[i]
            healed = (
                replace(unit, end=unit.end - middle[i])
                if from_end
                else replace(unit, first=unit.first + middle[i])
            )
            cases.append(here.without(healed))
        for i, each in zip(open_, fly_all(cases), strict=True):
            (high if comes_about(moment, each) else low)[i] = middle[i]
    parts = list(found.parts)
    for number in {number for number, _, _ in tasks}:
        least, most = sorted(high[i] for i, task in enumerate(tasks) if task[0] == number)
        parts[number] = replace(parts[number], shortest_s=(least * 1e-3, most * 1e-3))
    return replace(found, parts=tuple(parts))
