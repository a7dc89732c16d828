"""State of a mission: the motions that each vehicle may fly, as far as the server knows.

Observations, which acknowledge motions, and the motions that are sent keep it up; `mission_planner`
plans by it. The steps of all vehicles are brought onto one grid here, so that motions can be
compared.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from skytether.server.common.clock import ClockMap, StepError
from skytether.server.missions.possible_motions import NEVER, PossibleMotion, PossibleMotions
from skytether.server.missions.vehicle_motions import SentMotion, VehicleMotions, repeats_after
from skytether.shared.base.kernel import B1, F1, I1, kernel
from skytether.shared.law.model import ALTITUDE, Array, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, Motion, resting
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import NO_HORIZON, Mode, Observation

LONGEST = (INTERVALS + JOIN_MAX) * SPACING
"""Steps that a motion takes at most."""
RESTART_STEPS = 20
"""Steps after a client has begun anew up to which an observation may be of its earlier life."""
PLAN_DUE, REPEAT_DUE = 1, 2
"""Flags in `MissionState.due`: a motion may be planned for the vehicle at this step; its last
motion is sent once more."""


class VehicleRows(NamedTuple):
    """Numbers of all rows; each of shape (capacity,)."""

    ahead: I1
    """Steps by which the vehicle is ahead of the grid in common."""
    aligned: B1
    """Whether `ahead` is known."""
    heard: B1
    """Whether an observation has come in this session."""
    number: I1
    """Number of the vehicle that was observed last."""
    observed_step: I1
    """Step of its newest observation; -1 before any."""
    lands: I1
    """First step at which it may begin to land, or NEVER."""
    unknown_until: I1
    """Last step at which the vehicle may fly a motion that another server has sent."""
    sent_step: I1
    """Step of the motion that was sent last and is not acknowledged; 0 of none."""
    repeats_for: I1
    """Steps after that up to which it is sent once more, see `VehicleMotions.repeats`."""
    early: F1
    """Error of the step that is counted for the vehicle, see `clock.StepError`."""
    late: F1
    """Error of the step the other way."""

    @classmethod
    def of(cls, capacity: int) -> Self:
        """Numbers of rows of which nothing is known."""
        ahead, number, sent_step, repeats_for = np.zeros((4, capacity), dtype=np.int64)
        aligned, heard = np.zeros((2, capacity), dtype=np.bool_)
        observed_step, unknown_until = np.full((2, capacity), -1, dtype=np.int64)
        lands = np.full(capacity, NEVER)
        early, late = np.zeros((2, capacity))
        numbers = number, observed_step, lands, unknown_until, sent_step, repeats_for
        return cls(ahead, aligned, heard, *numbers, early, late)


class MissionState:
    """Vehicles of a mission, the motions that each may fly, and their places on one grid of steps.

    Args:
        scenario: what is asked for, as `mission` says it.
        terms: the rule of flight.
        capacity: number of vehicles there can be.
        block: number of vehicles that are decided on at a time.
        references: where each vehicle wants to be, by its number.
        number_of: number of the vehicle in a row.
        clock: step of each vehicle, and the error of that.
    """

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        capacity: int,
        block: int,
        references: Callable[[int], Reference],
        number_of: Callable[[int], int],
        clock: ClockMap,
    ) -> None:
        self._clock, self._dt_ns = clock, terms.dt_ns
        self.counts: Counter[str] = Counter()
        self.left_tube: list[tuple[int, float]] = []
        """Vehicles that have left their tube since this was emptied, and how far outside they were
        [m]."""
        self.state = np.zeros((capacity, terms.axes, 2))
        """States that were observed last; shape (capacity, axes, 2)."""
        self.vehicles: dict[int, VehicleMotions] = {}
        """Motions of the vehicles, and what is decided on them, by row."""
        self.number_of = number_of
        """Number of the vehicle in a row."""
        self._references = references
        goals = scenario.make_reference()
        self.absent = set(goals.vehicles) if isinstance(goals, Mission) else set[int]()
        """Numbers of vehicles on the mission that were not yet at rest where it begins."""
        self._tube_m, self._dt_s, self._join = scenario.mission.tube_m, terms.dt_s, terms.join
        self._land_after = terms.land_after if scenario.lands else NEVER
        """Steps of hovering in silence after which a vehicle lands."""
        self._tau_s, self._braking = max(terms.tau_s), 2.0 * terms.brake_mps2
        """Time constant and deceleration with which it comes to rest without a motion [s, m/s²]."""
        self.now = 0
        """Step on the grid in common: number of whole steps on the server's clock."""
        self.rows = VehicleRows.of(capacity)
        """Numbers of all rows."""
        self._all = np.arange(capacity)
        self.observed_step: Indices = self.rows.observed_step
        """Step of the newest observation; shape (capacity,)."""
        self.due, self._moved_by = np.zeros((2, block), dtype=np.int64)
        """Scratch of `align`: what is to be done for each vehicle, PLAN_DUE and REPEAT_DUE, and by
        how many steps its place on the grid has changed."""
        scale = np.ones(terms.axes)
        scale[ALTITUDE:] = scenario.mission.height_scale
        self.possible = PossibleMotions(scale, terms.dt_s)
        """All motions that may be flown, as of the last `update_possible`."""
        self._is_updated = False
        """Whether `possible` is as of the present step."""
        self._changed: set[int] = set()
        """Rows of which the motions, the distance kept from these, or the place on the grid have
        changed since then."""
        self.decided: set[int] = set()
        """Rows of the vehicles that have a motion to be sent at their newest step."""
        self.restarted: dict[int, int] = {}
        """Step at which the client of a vehicle has begun anew without what it kept, by row: until
        it is observed, the vehicle may stand anywhere on its motions."""
        self.foreign: int | None = None
        """Row of a vehicle that may still fly a motion of another server; None of none."""

    def forget(self, row: int) -> None:
        """Take note that a session is over; motions stay, for the vehicle goes on with them."""
        self.observed_step[row] = -1
        self.rows.heard[row] = False
        if row in self.vehicles:
            # Another life of the vehicle counts steps of its own.
            self.vehicles[row].goal = None

    def restart(self, row: int) -> bool:
        """Take note that the client of a vehicle has begun anew; whether that is news."""
        vehicle = self.vehicles.get(row)
        if vehicle is None or row in self.restarted:
            return False
        self.restarted[row] = self.now + self.ahead(row)
        vehicle.outside_m = max(vehicle.outside_m, self._stopping_m(vehicle))
        self._changed.add(row)
        return True

    def brakes_m(self, vehicle: VehicleMotions) -> float:
        """Distance that a vehicle without a motion, which brakes, still flies from where it was
        observed until it is at rest [m]; 0 of one with a motion.
        """
        brakes = vehicle.in_force is not None and vehicle.in_force.step < 0
        return self._stopping_m(vehicle) if brakes else 0.0

    def ahead(self, row: int) -> int:
        """Steps by which a vehicle is ahead of the grid in common."""
        return int(self.rows.ahead[row])

    def possible_motion(self, row: int, motion: Motion) -> PossibleMotion:
        """A motion that a vehicle may fly, by the steps in common."""
        return PossibleMotion(self.in_common(row, motion), self.lands(row), self.error(row))

    def in_common(self, row: int, motion: Motion) -> Motion:
        """A motion of a vehicle, by the steps in common."""
        return motion._replace(first=motion.first - self.ahead(row))

    def lands(self, row: int) -> int:
        """First step in common at which a vehicle may begin to land, or NEVER."""
        lands = int(self.rows.lands[row])
        return lands if lands == NEVER else lands - self.ahead(row)

    def error(self, row: int) -> StepError:
        """Error of the step that is counted for a vehicle."""
        return StepError(float(self.rows.early[row]), float(self.rows.late[row]))

    def note_sent(self, row: int, step: int, motion: Motion) -> None:
        """Take note of a motion that is sent with the packet of a step."""
        vehicle = self.vehicles[row]
        vehicle.sent.append(SentMotion(step, motion))
        self._mark_changed(row, vehicle)

    def unknown(self) -> int | None:
        """Number of a vehicle that may fly where the server does not know; None if there is none.

        A server that begins anew has not heard it yet, or it flies a motion of the server before.
        """
        unheard = self.absent.difference(self.rows.number[list(self.vehicles)].tolist())
        if unheard:
            return min(unheard)
        return None if self.foreign is None else self.number_of(self.foreign)

    def begins_at(self, number: int) -> Array:
        """Place where a vehicle begins its mission [m]; shape (axes,)."""
        place: Array = self._references(number)(np.zeros(()))[:, 0]
        return place

    def observe(self, row: int, observation: Observation) -> bool:
        """Take an observation; False if it is not newer than the last.

        Args:
            row: row of the vehicle.
            observation: the observation.
        """
        if observation.step <= self.observed_step[row]:
            return False
        k = observation.step
        # One that was made before the client began anew says nothing of where it stands.
        if k > self.restarted.get(row, k) + RESTART_STEPS or not self.rows.heard[row]:
            self.restarted.pop(row, None)
        self.observed_step[row] = k
        self.state[row] = observation.state
        vehicle = self.vehicles.setdefault(row, VehicleMotions())
        self.rows.number[row] = self.number_of(row)
        if observation.in_force == NO_HORIZON:
            # It hovers, or comes to rest, where it is: nothing else was ever taken, or all ended.
            vehicle.in_force = SentMotion(-1, resting(k, self._place(row, observation.state[:, 0])))
            vehicle.is_foreign = False
            # Nor is anything taken that was sent in an earlier session.
            if not observation.takes or not self.rows.heard[row]:
                vehicle.sent.clear()
        elif vehicle.in_force is None or vehicle.in_force.step != observation.in_force:
            taken = next((each for each in vehicle.sent if each.step == observation.in_force), None)
            vehicle.is_foreign = taken is None
            if taken is None:  # of another server, or of a vehicle that was in this row before
                self.rows.unknown_until[row] = observation.in_force + LONGEST
                taken = SentMotion(observation.in_force, resting(k, observation.state[:, 0]))
            vehicle.in_force = taken
        flies_on = k <= self.rows.unknown_until[row]
        if flies_on:
            self.foreign = row
        if flies_on or vehicle.is_foreign:
            # Also at the first observation after that motion has ended: it rests there, and not
            # where it was observed before, on its way.
            vehicle.in_force = SentMotion(
                vehicle.in_force.step, resting(k, observation.state[:, 0])
            )
            vehicle.is_foreign = flies_on
        self._expect_landing(row, observation)
        newest, motion = vehicle.in_force
        self._measure(row, vehicle, motion.at(np.array([float(k)]), self._dt_s)[0][0])
        while vehicle.sent and (
            vehicle.sent[0].step <= newest or vehicle.sent[0].step + self._join < k
        ):
            gone = vehicle.sent.popleft()
            self.counts["horizons_lost"] += gone.step > newest
            vehicle.adapt_copies(gone.step == newest and k <= observation.since + 1)
        self.rows.heard[row] = True
        self._mark_changed(row, vehicle)
        return True

    def _mark_changed(self, row: int, vehicle: VehicleMotions) -> None:
        """Mark a row whose motions that may be flown, or be sent again, have changed."""
        self._changed.add(row)
        vehicle.repeat = None
        self.rows.sent_step[row], self.rows.repeats_for[row] = vehicle.repeats

    def _expect_landing(self, row: int, observation: Observation) -> None:
        """Take note of the first step at which a vehicle may begin to land."""
        k, lands = observation.step, self.rows.lands
        if self._land_after == NEVER:
            return
        match observation.mode:
            # In its first observation it may be another life, which counts steps of its own.
            case Mode.HOVER if lands[row] < NEVER and self.rows.heard[row]:
                # It may have hovered in silence for long, but not since before an earlier step.
                lands[row] = max(lands[row], k)
            case Mode.HOVER | Mode.LAND | Mode.MANUAL | Mode.FAULT:
                lands[row] = k
            case _:
                lands[row] = k + self._land_after

    def _measure(self, row: int, vehicle: VehicleMotions, expected: Array) -> None:
        """Take note of how far a vehicle may be from where its motion has it."""
        number, state = self.number_of(row), self.state[row]
        assert vehicle.in_force is not None
        outside_m = float(np.linalg.norm(expected - state[:, 0])) - self._tube_m
        vehicle.speed_mps = float(np.linalg.norm(state[:, 1]))
        if vehicle.in_force.step < 0:
            outside_m = max(outside_m, self.brakes_m(vehicle))
        elif outside_m <= 0.0:
            self.absent.discard(number)
        elif number not in self.absent:
            self.counts["left_tube"] += 1
            if not vehicle.outside_m:
                self.left_tube.append((number, outside_m))
        vehicle.outside_m = 0.0 if number in self.absent else max(outside_m, 0.0)

    def _stopping_m(self, vehicle: VehicleMotions) -> float:
        """Distance in which a vehicle that brakes comes to rest [m]."""
        return vehicle.speed_mps * (self._tau_s + vehicle.speed_mps / self._braking)

    def _place(self, row: int, observed: Array) -> Array:
        """Resting place of a vehicle without a motion: where it begins its mission, or is."""
        number = self.number_of(row)
        if number not in self.absent:
            return observed
        first = self.begins_at(number)
        return first if np.linalg.norm(first - observed) < self._tube_m else observed

    def align(self, rows: Indices, step: Indices) -> None:
        """Bring the steps of all vehicles onto one grid; nothing is to be sent yet."""
        n, self._is_updated = len(rows), False
        self.now = self._clock.tick_ns // self._dt_ns
        moved, foreign = _align(rows, step, self.now, self.rows, self.due, self._moved_by)
        # Of all rows, for others keep apart from those that are silent too.
        counted = self.now + self.rows.ahead
        self._clock.step_errors(self._all, counted, self.rows.early, self.rows.late)
        for row in self.restarted:
            self.rows.late[row] = max(self.rows.late[row], float(LONGEST))
        if moved:
            self._changed.update(rows[self._moved_by[:n] != 0].tolist())
        if self.decided:
            for row in self.decided.intersection(rows.tolist()):
                self.vehicles[row].next = None
                self._changed.add(row)
                self.decided.remove(row)
        self.foreign = None if foreign < 0 else foreign

    def update_possible(self) -> None:
        """Replace the possible motions of all vehicles of which these have changed; once a step."""
        if self._is_updated:
            return
        self._is_updated = True
        for row in self._changed & self.vehicles.keys():
            each = self.vehicles[row]
            # Also motions whose acknowledgement is still under way.
            motions = [self.possible_motion(row, motion) for motion in each.motions()]
            self.possible.replace(row, motions, each.outside_m)
        self._changed.clear()
        self.possible.set_errors(self.rows.early, self.rows.late)

    def goal(self, row: int) -> Array:
        """Goal of a vehicle at the present step [m]; shape (axes,)."""
        k = self.now + self.ahead(row)
        wanted = self._references(self.number_of(row))(np.array(k * self._dt_s))
        return np.ascontiguousarray(wanted[:, 0])  # kernels reckon with that

    def resting_places(self, row: int) -> list[Array]:
        """Resting places of all vehicles but one [m]."""
        places = []
        for other, each in self.vehicles.items():
            motions, now = each.motions(), self.now + self.rows.ahead[other]
            if other != row and motions and all(motion.last <= now for motion in motions):
                places.append(motions[0].position[-1])
        return places


@kernel
def _align(
    rows: I1, step: I1, now: int, vehicles: VehicleRows, due: I1, moved_by: I1
) -> tuple[int, int]:
    """Bring vehicles onto one grid, and find what is to be done for each.

    Args:
        rows, step: the vehicles, and the step of each; shape (n,).
        now: step on the grid.
        vehicles: see `MissionState.rows`.
        due: output: PLAN_DUE, REPEAT_DUE, both or 0; shape (n,) at least.
        moved_by: output: change of the place on the grid [steps]; shape (n,) at least.

    Returns:
        the number of vehicles whose place on the grid has changed, and the row of a vehicle that
        may still fly a motion of another server, or -1.
    """
    moved, foreign = 0, -1
    for i in range(len(rows)):
        row = rows[i]
        moved_by[i] = step[i] - now - vehicles.ahead[row]
        moved += moved_by[i] != 0
        vehicles.ahead[row], vehicles.aligned[row] = step[i] - now, True
        due[i] = 0
        if vehicles.heard[row] and (step[i] - vehicles.number[row]) % SPACING == 0:
            due[i] |= PLAN_DUE
        if repeats_after(step[i] - vehicles.sent_step[row], vehicles.repeats_for[row]):
            due[i] |= REPEAT_DUE
    for row in range(len(vehicles.heard)):
        if (
            foreign < 0
            and vehicles.heard[row]
            and vehicles.observed_step[row] <= vehicles.unknown_until[row]
        ):
            foreign = row
    return moved, foreign
