"""Moments: what went wrong in a flight, in comparison with a perfect flight.

    failure      a vehicle could not fly, or not to the end
    brake        a vehicle brakes, lands or stands still, until it follows a plan again
    error        a vehicle is much farther from its reference than in the perfect flight
    separation   two vehicles of a mission came nearly within the required separation, or closer
    packets      the server sends far more packets in a second than in the perfect flight
    path         a path was taken for dead although most of its packets arrived

The perfect flight has the same reference and wind, every packet arrives at once, and nothing else
is wrong (`units.perfect`). The flight's own median would be no good comparison: in a flight that is
bad throughout, nothing would exceed it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from skytether.explain.flying import CaseOutcome, Track
from skytether.shared.endpoints.directions import FLIGHT
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, Reason
from skytether.shared.telemetry.summary import STOPPED, WORSE
from skytether.shared.wire.protocol import Mode

FAR_TIMES = 3.0
"""An error is large above this multiple of the usual error, plus `FAR_STEPS`."""
FAR_STEPS = 2.0
"""Margin of the bound on errors, in steps at full speed: two steps correct any smaller error."""
AROUND_S = 1.0
"""The usual error at a step is the perfect flight's largest error within this time of it [s]."""
AFTER_S = 5.0
"""Time after a moment within which its largest error is searched for [s]."""
PAUSE_S = 1.0
"""A moment lasts while the error exceeds half its bound within this time before or after [s]."""
NEAR = 1.05
"""Two vehicles are too near below this multiple of the required separation."""
WASTED_TIMES, WASTED_PER_S = 3.0, 10.0
"""Plans are wasted if their rate exceeds this multiple of the perfect flight's rate, and exceeds
that rate by more than this [1/s]."""

ALIVE = 0.5
"""A path was not dead if a larger share of its packets arrived."""
WARM_S = 5.0
"""Time of flight before which many plans are normal, because vehicles have just started [s]."""

Kind = Literal["failure", "brake", "error", "separation", "packets", "path"]


@dataclass(frozen=True, slots=True)
class Moment:
    """Stretch of a flight in which something went wrong."""

    kind: Kind
    vehicle: int
    """Number of the vehicle, from 1; 0 for all vehicles together."""
    start_s: float
    """Time of flight at which the moment begins [s], on the same clock as `FlightEvent.time_ns`."""
    end_s: float
    says: str
    """Description of the moment: a sentence without subject."""
    figure: float
    """Largest error during the moment [m], or smallest separation [m], or rate of packets [1/s]."""
    usual: float
    """Value of `figure` in the perfect flight."""
    level: float
    """The moment occurs in another flight if `measured` returns at least this for that flight."""
    calm: float
    """The moment is clearly averted if `measured` returns at most this: `usual` plus a quarter of
    the excess. `level` is `usual` plus half of the excess."""


def moments(flown: CaseOutcome, perfect: CaseOutcome, scenario: Scenario) -> list[Moment]:
    """Moments of a flight in order of time, without errors that result from a brake."""
    usual = {track.vehicle: track for track in perfect.tracks}
    found = [
        moment
        for track in flown.tracks
        for moment in _of_vehicle(track, usual.get(track.vehicle), scenario)
    ]
    found += [*_too_near(flown, perfect, scenario), *_wasted(flown, perfect), *_alive(flown)]
    at_s = flown.failed_s
    # A flight that ends while the vehicle brakes is explained by the brake.
    if flown.failure and not any(each.end_s >= at_s - AROUND_S for each in found):
        found.append(Moment("failure", 0, at_s, at_s, flown.failure, 0.0, 0.0, 1.0, 0.0))
    return sorted(found, key=lambda each: (each.start_s, each.vehicle))


def worst(found: Sequence[Moment]) -> Moment:
    """Default moment to explain: of all moments of the gravest kind, the farthest from `usual`."""

    def weight(each: Moment) -> tuple[int, float]:
        return WEIGHTS[each.kind], abs(each.figure - each.usual)

    return max(found, key=weight)


WEIGHTS: Mapping[Kind, int] = {
    "failure": 3,
    "separation": 2,
    "brake": 2,
    "error": 1,
    "packets": 0,
    "path": 0,
}


def measured(moment: Moment, outcome: CaseOutcome) -> float:
    """Size of a moment in another flight; the moment occurs there if it reaches `moment.level`."""
    around = moment.start_s - AROUND_S, moment.end_s + AROUND_S
    match moment.kind:
        case "failure":
            size = float(bool(outcome.failure))
        case "brake":
            track, size = _track(outcome, moment.vehicle), 1.0
            if track is not None:  # None: the vehicle never flew
                size = float(np.isin(track.mode[_within(track.time_s, *around)], WORSE).sum())
        case "error":
            size = error_m(moment, outcome)
        case "separation":
            size = -_least(outcome.separation_m[_within(outcome.separation_s, *around)])
        case "packets":
            size = _rate(outcome, *around)
        case "path":
            found = [each for each in _alive(outcome) if each.vehicle == moment.vehicle]
            size = float(sum(around[0] <= each.start_s <= around[1] for each in found))
    return size


def comes_about(moment: Moment, outcome: CaseOutcome) -> bool:
    return measured(moment, outcome) >= moment.level


def is_averted(moment: Moment, outcome: CaseOutcome) -> bool:
    """Whether a flight clearly averts the moment: `measured` is at most `moment.calm`."""
    return measured(moment, outcome) <= moment.calm


def error_m(moment: Moment, outcome: CaseOutcome) -> float:
    """Largest error during the moment and shortly after it [m], of the moment's vehicle, or of all
    vehicles if its number is 0.
    """
    errors = [
        track.error_m[_within(track.time_s, moment.start_s - AROUND_S, moment.end_s + AFTER_S)]
        for track in outcome.tracks
        if moment.vehicle in (track.vehicle, 0)
    ]
    return float(max((error.max(initial=0.0) for error in errors), default=np.nan))


def _of_vehicle(track: Track, usual: Track | None, scenario: Scenario) -> Iterator[Moment]:
    time_s, error = track.time_s, track.error_m
    normal = np.zeros(len(error)) if usual is None else _usual_m(track, usual)
    braked = _runs(np.isin(track.mode, WORSE), np.isin(track.mode, STOPPED))
    step_mps = scenario.control.dt * float(np.max(scenario.u_max * scenario.true_gain))
    bound = FAR_TIMES * normal + FAR_STEPS * step_mps
    is_far = (error > bound) & (track.step_s >= scenario.settled_s)

    def moment(kind: Kind, says: str, first: int, end: int, until: int) -> Moment:
        start_s, end_s = time_s[[first, end - 1]].tolist()
        figures = float(error[first:until].max()), float(normal[first:until].max())
        levels = (1.0, 0.0) if kind == "brake" else _levels(*figures)
        return Moment(kind, track.vehicle, start_s, end_s, says, *figures, *levels)

    for first, end in braked:
        until = int(np.searchsorted(time_s, time_s[end - 1] + AFTER_S))
        says = f"{DOES[Mode(track.mode[first])]} ({Reason(track.reason[first])})"
        yield moment("brake", says, first, end, until)
        is_far[first:until] = False
    gap = np.ones(2 * round(PAUSE_S / scenario.control.dt) + 1)
    goes_on = np.convolve(error > bound / 2.0, gap, "same") > 0.5
    for first, end in _runs(is_far, goes_on):
        yield moment("error", "was far off", first, end, end)


def _levels(figure: float, usual: float) -> tuple[float, float]:
    """`level` and `calm` of a moment: `usual` plus half, and plus a quarter, of the excess."""
    return usual + 0.5 * (figure - usual), usual + 0.25 * (figure - usual)


def _usual_m(track: Track, usual: Track) -> Array:
    """Largest error of the perfect flight around each step of a track [m]."""
    first, end = (
        np.searchsorted(usual.step_s, track.step_s + around) for around in (-AROUND_S, AROUND_S)
    )
    return np.array([usual.error_m[a:b].max(initial=0.0) for a, b in zip(first, end, strict=True)])


def _too_near(flown: CaseOutcome, perfect: CaseOutcome, scenario: Scenario) -> Iterator[Moment]:
    if not np.isfinite(flown.separation_m).any():
        return
    bound_m = scenario.mission.separation_m
    near = flown.separation_m < NEAR * bound_m
    for first, end in _runs(near, near):
        start_s, end_s = flown.separation_s[[first, end - 1]].tolist()
        least_m, usual_m = _least(flown.separation_m[first:end]), _least(perfect.separation_m)
        says = f"came within {least_m:.3f} m, where {bound_m:g} m are required"
        levels = _levels(-least_m, -max(least_m, min(usual_m, 2.0 * bound_m)))
        yield Moment("separation", 0, start_s, end_s, says, least_m, usual_m, *levels)


def _wasted(flown: CaseOutcome, perfect: CaseOutcome) -> Iterator[Moment]:
    usual = _rate(perfect, WARM_S, np.inf)
    sent = _sent_s(flown)
    each = np.searchsorted(sent, sent + 1.0) - np.arange(len(sent))
    many = (each > WASTED_TIMES * usual) & (each > usual + WASTED_PER_S) & (sent > WARM_S)
    for first, end in _runs(many, many):
        start_s, end_s, most = sent[first], sent[end - 1] + 1.0, each[first:end].max()
        times, levels = (float(start_s), float(end_s)), _levels(float(most), usual)
        says = f"the server sent {most} plans in a second"
        yield Moment("packets", 0, *times, says, float(most), usual, *levels)


def _alive(flown: CaseOutcome) -> Iterator[Moment]:
    for each in flown.deaths:
        if each.arrived > ALIVE:
            who = f"vehicle {each.vehicle}" if each.direction == DOWNLINK else "the server"
            way = f"{FLIGHT[each.direction]} {each.path + 1}"
            says = f"{who} took {way} for dead ({each.arrived:.0%} arrived)"
            at = each.time_s, each.time_s
            yield Moment("path", each.vehicle, *at, says, each.arrived, 0.0, 1.0, 0.0)


def _sent_s(outcome: CaseOutcome) -> Array:
    """Times at which the server sent a plan [s]; copies of a plan on several paths count once."""
    return np.unique(outcome.packets.time_s[outcome.packets.is_plan])


def _rate(outcome: CaseOutcome, start_s: float, end_s: float) -> float:
    """Largest number of plans in a second that begins between two times [1/s]."""
    sent = _sent_s(outcome)
    begun = sent[(sent >= start_s) & (sent < end_s)]
    return float((np.searchsorted(sent, begun + 1.0) - np.searchsorted(sent, begun)).max(initial=0))


def _runs(begin: Flags, goes_on: Flags) -> list[tuple[int, int]]:
    """First index and end of each stretch: it begins at `begin`, and lasts while `goes_on`."""
    runs, at = [], 0
    while at < len(begin) and begin[at:].any():
        first = at + int(np.argmax(begin[at:]))
        rest = ~(goes_on | begin)[first:]
        at = first + int(np.argmax(rest)) if rest.any() else len(begin)
        runs.append((first, at))
    return runs


def _within(times_s: Array, start_s: float, end_s: float) -> Flags:
    within: Flags = (times_s >= start_s) & (times_s <= end_s)
    return within


def _least(distances_m: Array) -> float:
    return float(np.nanmin(distances_m)) if np.isfinite(distances_m).any() else np.inf


def _track(outcome: CaseOutcome, vehicle: int) -> Track | None:
    return next((track for track in outcome.tracks if track.vehicle == vehicle), None)


DOES = {
    Mode.BRAKE: "braked",
    Mode.LAND: "landed",
    Mode.RETURN: "returned home",
    Mode.FAULT: "stood still with a fault",
}
