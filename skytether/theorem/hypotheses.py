"""Hypotheses: whether the assumptions of the theorem of separation held in a flight, with margins.

docs/together-proof.md has the theorem and its five conditions. This module checks them from the
record of a flight, at each step of each vehicle: the vehicle's rows have its position and the
motion in force, the server's rows have the motions. In flight the server checks the same
conditions, but from the vehicles' observations alone.

A motion is recorded as its first state and the inputs of `control.horizon` steps, which are
extrapolated to the next multiple of 10 steps. A motion may last up to 140 steps, so with a horizon
of 131 steps or more all steps are checked. Otherwise later steps are checked only if the motion has
come to rest before them. Clocks and their bounds are not recorded at each step; the server only
counts violations.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from skytether.client.failsafe import STALL_NS
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.events.flight import ClockContradicted, Flying, SteppedLate
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.motion import SPACING
from skytether.shared.missions.derived import zones
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record, Rows
from skytether.shared.telemetry.server_ticks import ticks
from skytether.shared.telemetry.summary import nearest, track

RESTS_MPS = 1e-3
"""Speed below which a motion has come to rest [m/s]."""
UNCHECKED = math.nan
"""Margin of a hypothesis that the record does not determine."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Assumption or conclusion of the theorem, checked in a flight."""

    condition: int
    """Number of the theorem's condition; 0 for its conclusion."""
    name: str
    margin: float
    """Smallest distance from the bound [`unit`]. Negative: violated; infinite: the condition never
    applied; NaN: not checked."""
    unit: str
    vehicles: tuple[int, ...] = ()
    """Vehicle or pair of vehicles with the smallest margin."""
    step: int | None = None
    """Step of the smallest margin, as counted by the first of `vehicles`."""
    checked: float = 1.0
    """Share of the steps or motions that could be checked from the record; 0 if the hypothesis is
    checked by a counter."""

    @property
    def is_held(self) -> bool | None:
        """Whether the hypothesis held wherever it was checked; None if it was not checked."""
        return None if math.isnan(self.margin) else self.margin >= 0.0


@dataclass(frozen=True, slots=True)
class Motions:
    """Recorded motions of a vehicle, in order of their steps."""

    step: Indices
    """First step of each motion; shape (n,)."""
    position: Array
    """Positions of each motion at its steps [m]; shape (n, H + 1, axes)."""
    moves: Indices
    """Number of steps until each motion comes to rest; H + 1 if its end is not recorded."""

    @property
    def recorded(self) -> int:
        """Number H of recorded steps of a motion."""
        return self.position.shape[1] - 1

    @property
    def is_whole(self) -> Flags:
        """Whether each motion comes to rest within its recorded steps."""
        whole: Flags = self.moves <= self.recorded
        return whole


def motions(scenario: Scenario, plan: Rows) -> Motions:
    """Motions of a vehicle, from the rows of its plans."""
    step, first = np.unique(plan["step"], return_index=True)
    plan, model, dt_s = plan[first], scenario.terms().model, scenario.control.dt
    inputs = plan["inputs"].astype(np.float64)
    velocity = np.empty((len(plan), inputs.shape[2] + 1, inputs.shape[1]))
    velocity[:, 0] = plan["state"][:, :, 1]
    for k in range(inputs.shape[2]):
        velocity[:, k + 1] = model.a11 * velocity[:, k] + model.b1 * inputs[:, :, k]
    for _ in range(-inputs.shape[2] % SPACING):  # extrapolate to the next knot
        velocity = np.append(velocity, 2.0 * velocity[:, -1:] - velocity[:, -2:-1], axis=1)
    # Between knots, and so between steps, a motion's acceleration is constant.
    moved = np.cumsum(0.5 * dt_s * (velocity[:, :-1] + velocity[:, 1:]), axis=1)
    position = np.repeat(plan["state"][:, None, :, 0], velocity.shape[1], axis=1)
    position[:, 1:] += moved
    is_moving = np.abs(velocity).max(axis=2, initial=0.0) > RESTS_MPS
    last = velocity.shape[1] - np.argmax(is_moving[:, ::-1], axis=1)
    return Motions(step, position, np.where(is_moving.any(axis=1), last, 0))


@dataclass(frozen=True, slots=True)
class Flown:
    """Steps of a vehicle, and the motion in force at each; each array has a row per step."""

    vehicle: int
    step: Indices
    position: Array
    """Position at each step [m]; shape (n, axes)."""
    in_force: Indices
    motions: Motions
    motion: Indices
    """Index in `motions` of the motion in force; -1 if no recorded motion is in force."""

    @property
    def off_m(self) -> Array:
        """Distance from the motion in force [m]; NaN if no recorded motion is in force."""
        if not len(self.motions.step):
            return np.full(len(self.step), np.nan)
        stage = self.step - self.in_force
        is_recorded = (stage <= self.motions.recorded) | self.motions.is_whole[self.motion]
        expected = self.motions.position[self.motion, stage.clip(0, self.motions.recorded)]
        off_m: Array = np.linalg.norm(self.position - expected, axis=1)
        return np.where(is_recorded & (self.motion >= 0), off_m, np.nan)

    @property
    def changed(self) -> Indices:
        """Rows at which the motion in force changes, except by a restart of the client."""
        same_run = np.diff(self.step) > 0
        return 1 + np.flatnonzero((np.diff(self.in_force) != 0) & same_run)


def flown(scenario: Scenario, record: Record) -> list[Flown]:
    """Vehicles of a record that have flown a motion."""
    found = []
    for vehicle in np.unique(record.client["vehicle"]).tolist():
        rows = record.client[record.client["vehicle"] == vehicle]
        own = motions(scenario, record.plan[record.plan["vehicle"] == vehicle])
        at = np.searchsorted(own.step, rows["in_force"])
        at = np.where(np.isin(rows["in_force"], own.step), at, -1)
        if (rows["in_force"] >= 0).any():
            place = rows["state"][:, :, 0]
            found.append(Flown(vehicle, rows["step"], place, rows["in_force"], own, at))
    return found


def hypotheses(record: Record, scenario: Scenario) -> tuple[Hypothesis, ...]:
    """Assumptions and conclusions of the theorem, with their smallest margins in a flight.

    Args:
        record: record of a mission's flight, also from a recording of a flight over UDP.
    """
    vehicles = flown(scenario, record)
    if not vehicles:
        return ()
    return (
        *_beginning(scenario, vehicles),
        _tube(scenario, vehicles),
        _steps_in_time(scenario, record),
        _acceptance(scenario, vehicles),
        _flown_to_the_end(scenario, vehicles),
        _all_vehicles(scenario, record, vehicles),
        _clocks(record),
        _separation(scenario, record),
        *_clear(scenario, vehicles),
    )


def broken(found: Sequence[Hypothesis]) -> list[str]:
    """Names of the hypotheses that did not hold, for assertions."""
    return [each.name for each in found if each.is_held is False]


def _least(
    condition: int,
    name: str,
    unit: str,
    margins: Mapping[int, tuple[Indices, Array]],
    at_most: float = UNCHECKED,
) -> Hypothesis:
    """Hypothesis with the smallest margin of all vehicles and steps.

    Args:
        margins: for each vehicle, steps and their margins, NaN if not checked.
        at_most: margin if no vehicle has a step in `margins`.
    """
    count = sum(len(steps) for steps, _ in margins.values())
    each = [
        (float(margin[at]), vehicle, int(steps[at]))
        for vehicle, (steps, margin) in margins.items()
        if np.isfinite(margin).any()
        for at in [int(np.nanargmin(margin))]
    ]
    if not each:
        margin = UNCHECKED if count else at_most
        return Hypothesis(condition, name, margin, unit, checked=float(not count))
    margin, vehicle, step = min(each)
    checked = sum(int(np.isfinite(margin).sum()) for _, margin in margins.values()) / count
    return Hypothesis(condition, name, margin, unit, (vehicle,), step, checked)


def _beginning(scenario: Scenario, vehicles: Sequence[Flown]) -> Iterator[Hypothesis]:
    """Check condition 1 at the first motion of each vehicle."""
    first = {each.vehicle: int(np.argmax(each.in_force >= 0)) for each in vehicles}
    places = {
        each.vehicle: _scaled(scenario, each.position[first[each.vehicle]]) for each in vehicles
    }
    apart_m, pair = _nearest(places)
    margin = apart_m - scenario.mission.separation_m
    steps = {each.vehicle: int(each.step[first[each.vehicle]]) for each in vehicles}
    step = steps[pair[0]] if pair else None
    yield Hypothesis(1, "they begin apart", margin, "m", pair, step)
    margins = {}
    for each in vehicles:
        here = slice(first[each.vehicle], first[each.vehicle] + 1)
        margins[each.vehicle] = each.step[here], scenario.mission.tube_m - each.off_m[here]
    yield _least(1, "each begins at its place", "m", margins)


def _tube(scenario: Scenario, vehicles: Sequence[Flown]) -> Hypothesis:
    margins = {}
    for each in vehicles:
        flies = each.in_force >= 0
        margins[each.vehicle] = each.step[flies], scenario.mission.tube_m - each.off_m[flies]
    return _least(2, "each stays in its tube", "m", margins)


def _steps_in_time(scenario: Scenario, record: Record) -> Hypothesis:
    """Check that no step began more than STALL_NS late, by the client's figures and log events."""
    name, most_s = "each step begins in time", STALL_NS / SECOND_NS
    figures = record.figures.get("client", {}).get("by_vehicle", {})
    late_s = {
        int(vehicle): own["late_ms"] * MILLISECOND_NS / SECOND_NS
        for vehicle, own in figures.items()
    }
    at_ns = dict[int, int]()
    for time_ns, _, event in record.events:
        if isinstance(event, SteppedLate):
            at_ns[event.vehicle] = time_ns
            late_s[event.vehicle] = max(event.late_s, late_s.get(event.vehicle, 0.0))
    if not late_s:
        return Hypothesis(2, name, UNCHECKED, "s", checked=0.0)
    vehicle = max(late_s, key=late_s.__getitem__)
    step, began = None, began_ns(record)
    if vehicle in at_ns and vehicle in began:
        step = (at_ns[vehicle] - began[vehicle]) // scenario.dt_ns
    return Hypothesis(2, name, most_s - late_s[vehicle], "s", (vehicle,), step)


def _acceptance(scenario: Scenario, vehicles: Sequence[Flown]) -> Hypothesis:
    """Check that each motion is accepted between its first knot and `link.join_s` later."""
    margins, join = {}, scenario.terms().join
    for each in vehicles:
        taken = each.changed[each.in_force[each.changed] >= 0]
        late = each.step[taken] - each.in_force[taken]
        margin = np.where(late < 0, late, join - late) * scenario.control.dt
        margins[each.vehicle] = each.step[taken], margin
    return _least(2, "motions are accepted in time", "s", margins, np.inf)


def _flown_to_the_end(scenario: Scenario, vehicles: Sequence[Flown]) -> Hypothesis:
    """Check that motions are flown to their end. The margin is the time for which a motion stayed
    in force after its end [s].
    """
    margins = {}
    for each in vehicles:
        left = each.changed[each.in_force[each.changed] < 0]
        motion, since = each.motion[left - 1], each.step[left] - each.in_force[left - 1]
        margin = np.full(len(left), np.nan)
        if len(each.motions.step):
            ends, recorded = each.motions.moves[motion], each.motions.recorded
            # If a motion is not recorded to its end, only leaving it early can be detected.
            is_checked = (motion >= 0) & (each.motions.is_whole[motion] | (since <= recorded))
            margin[is_checked] = (since - ends)[is_checked] * scenario.control.dt
        margins[each.vehicle] = each.step[left], margin
    return _least(3, "motions are flown to the end", "s", margins, np.inf)


def _all_vehicles(scenario: Scenario, record: Record, vehicles: Sequence[Flown]) -> Hypothesis:
    """Check that the server had observed all vehicles before it sent the first motion that moves.
    The margin is the time from the first observation of the last vehicle to that sending [s].
    """
    name, mission = "the server observes all first", scenario.make_reference()
    assert isinstance(mission, Mission)
    server = record.server
    observed = set(np.unique(server["vehicle"][server["observed_step"] >= 0]).tolist())
    missing = ({each.vehicle for each in vehicles} | {*mission.vehicles}) - observed
    if not len(server) or not len(record.plan):
        return Hypothesis(4, name, UNCHECKED, "s", checked=0.0)
    if missing:
        return Hypothesis(4, name, -np.inf, "s", tuple(sorted(missing)))
    tick = ticks(server)
    first = {
        vehicle: int(tick[(server["vehicle"] == vehicle) & (server["observed_step"] >= 0)][0])
        for vehicle in sorted(observed)
    }
    last = max(first, key=first.__getitem__)
    moving = {
        (each.vehicle, step)
        for each in vehicles
        for step in each.motions.step[each.motions.moves > 0].tolist()
    }
    sent = server["event"].nonzero()[0]
    keys = zip(server["vehicle"][sent].tolist(), server["step"][sent].tolist(), strict=True)
    begun = [int(tick[at]) for at, key in zip(sent.tolist(), keys, strict=True) if key in moving]
    if not begun:
        return Hypothesis(4, name, np.inf, "s", (last,))
    step = server["step"][(tick == first[last]) & (server["vehicle"] == last)]
    margin = (begun[0] - first[last]) * scenario.control.dt
    return Hypothesis(4, name, margin, "s", (last,), int(step[0]))


def _clocks(record: Record) -> Hypothesis:
    """Check that no clock sample contradicted the clock's bounds, by the server's counters and log
    events `ClockContradicted`; rows contain no clocks.
    """
    name = "no clock contradicts its bounds"
    if "server" not in record.figures:
        return Hypothesis(5, name, UNCHECKED, "samples", checked=0.0)
    contradicted = [
        each.event.vehicle for each in record.events if isinstance(each.event, ClockContradicted)
    ]
    count = record.figures["server"].get("counts", {}).get("clock_steps", 0) + len(contradicted)
    margin = -float(count) if count else np.inf
    return Hypothesis(5, name, margin, "samples", tuple(sorted({*contradicted})), checked=0.0)


def _separation(scenario: Scenario, record: Record) -> Hypothesis:
    """Check the conclusion of the theorem: the separation of vehicles."""
    name, began, dt_s = "they keep apart", began_ns(record), scenario.control.dt
    tracks = {
        vehicle: track(rows, began[vehicle] / SECOND_NS, dt_s, scenario.mission.height_scale)
        for vehicle in sorted(began)
        for rows in [record.client[record.client["vehicle"] == vehicle]]
        if len(rows)
    }
    times_s, apart_m = nearest([*tracks.values()], dt_s)
    if not np.isfinite(apart_m).any():
        return Hypothesis(0, name, UNCHECKED, "m", checked=0.0)
    at_s = times_s[int(np.nanargmin(apart_m))]
    places = {
        vehicle: np.array([np.interp(at_s, own_s, x, np.nan, np.nan) for x in at.T])
        for vehicle, (own_s, at) in tracks.items()
    }
    margin = float(np.nanmin(apart_m)) - scenario.mission.separation_m
    _, pair = _nearest(places)
    step = round((at_s - began[pair[0]] / SECOND_NS) / dt_s)
    return Hypothesis(0, name, margin, "m", pair, step)


def _clear(scenario: Scenario, vehicles: Sequence[Flown]) -> Iterator[Hypothesis]:
    """Check the distance from the scenario's zones; zones set in flight are not checked."""
    if around := zones(scenario):
        margins = {}
        for each in vehicles:
            flies = each.in_force >= 0
            margins[each.vehicle] = (
                each.step[flies],
                around.clearance(each.position[flies]).min(axis=1),
            )
        yield _least(0, "they keep out of zones", "m", margins)


def began_ns(record: Record) -> dict[int, int]:
    """Time of flight at step 0 of each vehicle [ns]."""
    return {
        each.event.vehicle: each.time_ns for each in record.events if isinstance(each.event, Flying)
    }


def _scaled(scenario: Scenario, place: Array) -> Array:
    """Position with the height scaled as for distances between vehicles [m]."""
    scale = np.ones(len(place))
    scale[2:] = scenario.mission.height_scale
    return place * scale


def _nearest(places: Mapping[int, Array]) -> tuple[float, tuple[int, ...]]:
    """Smallest distance between two positions [m], and their vehicles; NaN for fewer than two."""
    apart = {
        pair: float(np.linalg.norm(places[pair[0]] - places[pair[1]]))
        for pair in combinations(places, 2)
    }
    apart = {pair: apart_m for pair, apart_m in apart.items() if math.isfinite(apart_m)}
    if not apart:
        return UNCHECKED, ()
    pair = min(apart, key=apart.__getitem__)
    return apart[pair], pair
