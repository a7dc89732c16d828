"""Explanation of a flight, ever more complete: whoever interrupts it keeps what is there."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec

from skytether.explain import causes, mission, remedies, units, words
from skytether.explain.cases import Case
from skytether.explain.causes import Cause, Rescues
from skytether.explain.flying import FlyAll, Outcome, fly
from skytether.explain.moments import WEIGHTS, Moment, moments, worst
from skytether.explain.remedies import Remedy
from skytether.shared.base.errors import ConfigError

AT_MAX_S = 2.0
"""Largest distance of a moment from the time that is asked for [s]."""
CURVES_MAX = 2
"""Largest number of flights without a part that are drawn."""
STEPS = 6
"""Number of steps of an explanation, without those of other seeds."""
FIRST = "what went wrong"
"""Name of the first step, as the progress bar shows it."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """What is known of why a flight went as it did; None for what is not known yet."""

    name: str
    """Name of the scenario."""
    seed: int
    moments: tuple[Moment, ...]
    """What went wrong, in order of time."""
    moment: Moment | None
    """The one that is explained; None if there is none."""
    flown: Outcome
    """The flight as it was."""
    cause: Cause | None = None
    rescues: Rescues | None = None
    remedies: tuple[Remedy, ...] | None = None
    """Other keys; the first is the flight as it was."""
    curves: tuple[tuple[str, Outcome], ...] = ()
    """Flights to draw beside it: without a part of the cause, and with a remedy."""

    def __str__(self) -> str:
        said = words.text(self.moments, self.moment, self.cause, self.rescues, self.remedies)
        of_mission = mission.text(self.flown.hypotheses, self.flown.waits)
        return f"{said}\n\n{of_mission}" if of_mission else said

    def to_json(self, following: str = "") -> bytes:
        """What is known, as JSON: the fields without the flights, those of a mission, the text, and
        the step that comes next; empty if all is known.
        """
        names = "name", "seed", "moments", "moment", "cause", "rescues", "remedies"
        fields = {name: getattr(self, name) for name in names}
        fields |= {name: getattr(self.flown, name) for name in ("hypotheses", "waits")}
        return msgspec.json.encode({**fields, "text": str(self), "next": following})


def explain(
    case: Case,
    name: str,
    fly_all: FlyAll,
    *,
    at_s: float | None = None,
    seeds: int = 0,
    at_once: int = 1,
) -> Iterator[tuple[str, Explanation]]:
    """Explanation of a flight after each step, and a word for the step that comes next.

    Args:
        name: name of the scenario.
        at_s: time in the flight of the moment to explain [s]; None: the gravest.
        seeds: number of flights of other seeds with each remedy.
        at_once: number of flights that `fly_all` flies side by side.

    Raises:
        ConfigError: there is no moment at that time.
    """
    flown, perfect = fly_all([case, units.perfect(case)])
    found = tuple(moments(flown, perfect, case.scenario))
    moment = _chosen(found, at_s)
    known = Explanation(name, case.scenario.seed, found, moment, flown)
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


def _chosen(found: Sequence[Moment], at_s: float | None) -> Moment | None:
    """Moment to explain; raises ConfigError if there is none at the time that is asked for."""
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
        # Times are printed with a tenth of a second; of several moments at once, the one that
        # begins then is meant.
        return round(distance_s(each), 1), round(abs(each.start_s - at_s), 1), -WEIGHTS[each.kind]

    return min(near, key=order)


def _curves(cause: Cause, without: Sequence[Outcome]) -> tuple[tuple[str, Outcome], ...]:
    """The flight without each of the first parts of a cause that are needed."""
    needed = [
        (f"without the {causes.named(part.unit)}", each)
        for part, each in zip(cause.parts, without, strict=True)
        if part.is_needed
    ]
    return tuple(needed[:CURVES_MAX])


def explained(
    case: Case,
    name: str,
    *,
    at_s: float | None = None,
    seeds: int = 0,
    trace: str = "",
    on_flight: Callable[[int, str], None] = lambda *_: None,
) -> Explanation:
    """Whole explanation, flown in this process; arguments as of `explain`.

    Args:
        trace: see `check_same`; empty: whatever comes of the case is explained.
        on_flight: called before each flight with the number of steps done, and a word for the one
            under way.

    Raises:
        ConfigError: the flight of the case is another one than that of the record.
    """
    done, step = 0, FIRST

    def fly_all(cases: Sequence[Case]) -> list[Outcome]:
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


def check_same(flown: Outcome, trace: str, name: str) -> None:
    """Refuse a record, by the hash of its vehicles' rows, that does not come about again.

    Raises:
        ConfigError: names the flight.
    """
    if flown.trace != trace:
        expected = "one in virtual time by this version, without changes or faults"
        raise ConfigError(f"{name}: its flight does not come about again, expected {expected}")
