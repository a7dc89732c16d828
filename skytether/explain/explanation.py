"""Explanation of a flight, step by step; after an interruption the finished steps remain."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec

from skytether.explain import causes, remedies, units, words
from skytether.explain.cases import FlightCase
from skytether.explain.causes import Cause, Rescues
from skytether.explain.doubles import Nearness, nearness
from skytether.explain.flying import CaseOutcome, FlyAll, Track, fly
from skytether.explain.moments import WEIGHTS, Moment, moments, worst
from skytether.explain.remedies import Remedy
from skytether.shared.base.errors import ConfigError

AT_MAX_S = 2.0
"""Largest distance of a moment from the requested time [s]."""
CURVES_MAX = 2
"""Largest number of flights, each without one part of the cause, that the picture shows."""
STEPS = 6
"""Number of steps of an explanation, not counting flights of other seeds."""
FIRST = "what went wrong"
"""Name of the first step, as the progress bar shows it."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of a flight so far; results of steps that are not finished are None."""

    name: str
    """Name of the scenario."""
    seed: int
    moments: tuple[Moment, ...]
    """Moments at which something went wrong, in order of time."""
    moment: Moment | None
    """Moment that is explained; None if nothing went wrong."""
    flown: CaseOutcome
    """Outcome of the explained flight."""
    cause: Cause | None = None
    rescues: Rescues | None = None
    remedies: tuple[Remedy, ...] | None = None
    """Flights with other keys; the first is the explained flight."""
    nearness: Nearness | None = None
    """Distances of a double from the recorded flight; None for a flight in virtual time."""
    curves: tuple[tuple[str, CaseOutcome], ...] = ()
    """Label and outcome of flights to draw: without a part of the cause, and with a remedy."""

    def __str__(self) -> str:
        said = words.text(self.moments, self.moment, self.cause, self.rescues, self.remedies)
        if self.nearness is not None:
            said = f"A double of the flight, {self.nearness}:\n{said}"
        return f"{said}\n\n{of_mission}" if (of_mission := self.flown.judgement) else said

    def to_json(self, following: str = "") -> bytes:
        """The explanation so far as JSON: all its fields except flights. Further fields are a
        mission's judgement, the text, and `next`: name of the next step, empty at the end.
        """
        names = "name", "seed", "moments", "moment", "nearness", "cause", "rescues", "remedies"
        fields = {name: getattr(self, name) for name in names}
        fields |= {"judgement": self.flown.judgement}
        return msgspec.json.encode({**fields, "text": str(self), "next": following})


def explain(
    case: FlightCase,
    name: str,
    fly_all: FlyAll,
    *,
    at_s: float | None = None,
    vehicle: int | None = None,
    seeds: int = 0,
    at_once: int = 1,
    recorded: Track | None = None,
) -> Iterator[tuple[str, Explanation]]:
    """Yield the explanation of a flight after each step, and the name of the next step.

    Args:
        name: name of the scenario.
        at_s: time of flight of the moment to explain [s]; None: the gravest moment.
        vehicle: vehicle of the moment to explain; None: any.
        seeds: number of flights of each remedy with other seeds.
        at_once: number of flights that `fly_all` flies side by side.
        recorded: track of the recorded flight, if the case is its double.

    Raises:
        ConfigError: there is no moment at that time, or the double is too far from the recording.
    """
    flown, perfect = fly_all([case, units.perfect(case)])
    found = tuple(moments(flown, perfect, case.scenario))
    moment = _chosen(found, at_s, vehicle)
    near = nearness(flown, recorded, moment, case.scenario.settled_s) if recorded else None
    known = Explanation(name, case.scenario.seed, found, moment, flown, nearness=near)
    if moment is None:
        yield "", known
        return
    yield "what suffices", known
    cause, here = causes.cause(case, moment, flown, fly_all, at_once)
    yield "what is needed", (known := replace(known, cause=cause))
    cause, without = causes.needed(cause, here, moment, fly_all)
    known = replace(known, cause=cause, curves=_curves(cause, without))
    yield "single packets", known
    rescues = causes.rescues(cause, here, moment, flown, fly_all)
    yield "how long an outage must be", (known := replace(known, rescues=rescues))
    cause = causes.lengths(cause, here, moment, fly_all)
    yield "remedies", (known := replace(known, cause=cause))
    tried, outcomes = remedies.remedies(cause, case, moment, fly_all)
    known = replace(known, remedies=tuple(tried))
    if len(tried) > 1:
        shown = next((i for i, each in enumerate(tried) if each.averts), 1)
        curves = (*known.curves, (tried[shown].name, outcomes[shown]))
        known = replace(known, curves=curves)
    yield "other seeds", known
    others = range(known.seed + 1, known.seed + 1 + seeds)
    for number, each in enumerate(tried if seeds else ()):
        tried[number] = remedies.with_others(each, case, others, fly_all)
        yield "other seeds", (known := replace(known, remedies=tuple(tried)))


def _chosen(
    found: Sequence[Moment], at_s: float | None, vehicle: int | None = None
) -> Moment | None:
    """Choose the moment to explain; raises ConfigError if there is none at the requested time, or
    of the requested vehicle.
    """
    if vehicle is not None:
        vehicles = dict.fromkeys(str(each.vehicle) for each in found)
        found = [each for each in found if each.vehicle == vehicle]
        if not found:
            expected = f"one of {', '.join(vehicles)}" if vehicles else "none"
            raise ConfigError(f"vehicle: got {vehicle}, expected {expected}")
    if at_s is None:
        return worst(found) if found else None

    def distance_s(each: Moment) -> float:
        return max(each.start_s - at_s, at_s - each.end_s, 0.0)

    near = [each for each in found if distance_s(each) <= AT_MAX_S]
    if not near:
        times = ", ".join(f"{each.start_s:.1f}" for each in found)
        expected = f"one of {times}, at which something went wrong" if found else "no time"
        because = "" if found else ": nothing went wrong in this flight"
        raise ConfigError(f"at: got {at_s:g}, expected {expected}{because}")

    def order(each: Moment) -> tuple[float, float, int]:
        # Times are printed in tenths of a second. If several moments are near a printed time, take
        # the moment that begins then.
        return round(distance_s(each), 1), round(abs(each.start_s - at_s), 1), -WEIGHTS[each.kind]

    return min(near, key=order)


def _curves(cause: Cause, without: Sequence[CaseOutcome]) -> tuple[tuple[str, CaseOutcome], ...]:
    """Label and outcome of at most CURVES_MAX flights, each without one needed part of a cause."""
    needed = [
        (f"without the {causes.named(part.unit)}", each)
        for part, each in zip(cause.parts, without, strict=True)
        if part.is_needed
    ]
    return tuple(needed[:CURVES_MAX])


def explained(
    case: FlightCase,
    name: str,
    *,
    at_s: float | None = None,
    seeds: int = 0,
    trace: str = "",
    on_flight: Callable[[int, str], None] = lambda *_: None,
) -> Explanation:
    """Complete explanation, flown in this process; other arguments as for `explain`.

    Args:
        trace: see `check_same`; empty to skip this check.
        on_flight: called before each flight with the number of finished steps and the present
            step's name.

    Raises:
        ConfigError: the flight of the case differs from the recorded one.
    """
    done, step = 0, FIRST

    def fly_all(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
        outcomes = []
        for each in cases:
            on_flight(done, step)
            outcomes.append(fly(each))
        return outcomes

    for following, known in explain(case, name, fly_all, at_s=at_s, seeds=seeds):
        done, step = done + 1, following
        if trace:
            check_same(known.flown, trace, name)
            trace = ""
    return known


def check_same(flown: CaseOutcome, trace: str, name: str) -> None:
    """Refuse a recorded flight that cannot be reproduced: the hash of its vehicles' rows differs.

    Raises:
        ConfigError: the hashes differ; the message names the flight.
    """
    if flown.trace != trace:
        expected = "a flight in virtual time by this version, without changes or faults"
        raise ConfigError(f"{name}: its flight cannot be reproduced, expected {expected}")
