"""Mission state: the motions that each vehicle may fly, as far as the server knows.

The state is updated by observations, which acknowledge motions, and by each motion sent;
`mission_planner` plans with the state. Here the steps of all vehicles are mapped to one common time
grid, so that motions can be compared.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from skytether.server.missions.led_vehicles import LedVehicles
from skytether.server.missions.possible_motions import NEVER, PossibleMotion, PossibleMotions
from skytether.server.missions.vehicle_motions import SentMotion, VehicleMotions, repeats_after
from skytether.server.planning.clock import ClockMap, StepError
from skytether.shared.base.kernel import B1, F1, I1, kernel
from skytether.shared.events.flight import Event
from skytether.shared.law.model import ALTITUDE, Array, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, Motion, resting
from skytether.shared.law.terms import Terms
from skytether.shared.missions.derived import lands
from skytether.shared.missions.events import LeftMotion, LeftTube
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.protocol import NO_HORIZON, Mode, Observation

LONGEST = (INTERVALS + JOIN_MAX) * SPACING
"""Largest duration of a motion [steps]."""
RESTART_STEPS = 20
"""Number of steps after a client's restart in which older observations may still arrive."""
PLANNED = np.arange(1.0, INTERVALS + 1.0)
"""Numbers n of a motion's planned knots."""
PLAN_DUE, REPEAT_DUE = 1, 2
"""Flags in `MissionState.due`: a motion may be planned for the vehicle at this step, and the
vehicle's latest motion is sent again at this step."""


class VehicleRows(NamedTuple):
    """Data of all vehicles, by row; each array has the shape (capacity,)."""

    ahead: I1
    """Step of the vehicle by the server's count, minus the step of the common time grid."""
    aligned: B1
    heard: B1
    """Whether an observation has arrived in this session."""
    number: I1
    """Number of the vehicle that was last observed in the row."""
    observed_step: I1
    """Step of the vehicle's newest observation; -1 before the first."""
    lands: I1
    """First step at which the vehicle may begin to land, or NEVER."""
    unknown_until: I1
    """Last step at which the vehicle may fly a motion of another server; -1 if none."""
    sent_step: I1
    """Step of the latest motion sent, if this motion is not yet acknowledged; otherwise 0."""
    repeats_for: I1
    """Number of steps for which the latest motion is repeated, see `VehicleMotions.repeats`."""
    early: F1
    """Largest number of steps by which the vehicle may be ahead of its step `now + ahead` by the
    server's count, see `StepError`."""
    late: F1
    """Largest number of steps by which the vehicle may be behind its step by the server's count."""

    @classmethod
    def of(cls, capacity: int) -> Self:
        ahead, number, sent_step, repeats_for = np.zeros((4, capacity), dtype=np.int64)
        aligned, heard = np.zeros((2, capacity), dtype=np.bool_)
        observed_step, unknown_until = np.full((2, capacity), -1, dtype=np.int64)
        lands = np.full(capacity, NEVER)
        early, late = np.zeros((2, capacity))
        counters = number, observed_step, lands, unknown_until, sent_step, repeats_for
        return cls(ahead, aligned, heard, *counters, early, late)


class MissionState:
    """Vehicles of a mission, the motions that each may fly, and the offset of each vehicle's steps
    from a common time grid.

    Args:
        block: largest number of vehicles in one call of `align`.
        references: goal of each vehicle over time, by its number.
        number_of: number of the vehicle in a row.
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
        self.events: list[Event] = []
        """Events for the operator; the caller removes them from the list."""
        self.margins = {"tube": 0.0, "join": 0.0}
        """Largest distance of a vehicle from its motion, and largest time after a motion's first
        knot at which it was accepted, each as a share of the value that the theorem assumes."""
        self.state = np.zeros((capacity, terms.axes, 2))
        """Newest observed states [m, m/s]; shape (capacity, axes, 2)."""
        self.vehicles: dict[int, VehicleMotions] = {}
        self.number_of = number_of
        self._references = references
        mission = scenario.make_reference()
        self.absent = set(mission.vehicles) if isinstance(mission, Mission) else set[int]()
        """Numbers of the mission's vehicles that have not yet been at rest at their start."""
        self.is_show = isinstance(mission, Mission) and mission.is_show
        """Whether vehicles follow timed paths."""
        self._tube_m, self._dt_s, self._join = (
            scenario.section(MissionConfig).tube_m,
            terms.dt_s,
            terms.join,
        )
        self._dead_time_s = terms.dead_time_s
        self.kept_steps = -(-terms.join // SPACING) * SPACING
        """Number of steps from the first knot for which a new motion equals the motion in force."""
        self._land_after = terms.land_after if lands(scenario) else NEVER
        """Number of steps without packets after which a hovering vehicle lands."""
        self._tau_s, self._braking = max(terms.tau_s), 2.0 * terms.brake_mps2
        """Time constant [s] and twice the deceleration [m/s²] of braking without a motion."""
        self.now = 0
        """Present step on the common time grid, which counts steps of the server's clock."""
        self.rows = VehicleRows.of(capacity)
        self._all = np.arange(capacity)
        self.observed_step: Indices = self.rows.observed_step
        self.due, self._moved_by = np.zeros((2, block), dtype=np.int64)
        """Output of `align` for each vehicle: PLAN_DUE and REPEAT_DUE as bits, and the change of
        `rows.ahead` [steps]."""
        scale = np.ones(terms.axes)
        scale[ALTITUDE:] = scenario.section(MissionConfig).height_scale
        self.possible = PossibleMotions(scale, terms.dt_s)
        """All motions that may be flown, as of the last `update_possible`."""
        self._is_updated = False
        """Whether `possible` has been updated for the present step."""
        self._changed: set[int] = set()
        """Rows whose motions, extra distance or offset from the time grid have changed since the
        last `update_possible`."""
        self.decided: set[int] = set()
        """Rows of the vehicles to which a new motion is to be sent at their newest step."""
        self.restarted: dict[int, int] = {}
        """Step of a client's restart without saved state, by row. The vehicle may be anywhere on
        its motions until it is observed after the restart."""
        self.foreign: int | None = None
        """Row of a vehicle that may still fly a motion of another server; None if there is none."""
        self.led_vehicles = LedVehicles()

    def forget(self, row: int) -> None:
        """End a vehicle's session, but keep its motions, because the vehicle still flies them."""
        self.observed_step[row] = -1
        self.rows.heard[row] = False
        if row in self.vehicles:
            # Another run of the client numbers its steps from 0 again.
            self.vehicles[row].goal = None

    def restart(self, row: int) -> bool:
        """Note that a vehicle's client has restarted; return False if it was noted before."""
        vehicle = self.vehicles.get(row)
        if vehicle is None or row in self.restarted:
            return False
        self.restarted[row] = self.now + self.ahead(row)
        vehicle.outside_m = max(vehicle.outside_m, self._stopping_m(vehicle))
        self._changed.add(row)
        return True

    def follow(self, row: int, lead: Lead | None) -> None:
        """Note which server leads a vehicle.

        If this server begins to lead the vehicle, `lead` contains the motion in force. The vehicle
        drops plans with earlier leadership numbers, so the vehicle can fly no other motion.
        """
        if self.led_vehicles.follow(row, lead):
            assert lead is not None
            self._take_over(row, lead)

    def _take_over(self, row: int, lead: Lead) -> None:
        vehicle = self.vehicles.setdefault(row, VehicleMotions())
        self.rows.number[row] = self.number_of(row)
        vehicle.sent.clear()
        vehicle.next = None
        self.observed_step[row] = lead.step - 1  # older observations may show an older motion
        knots = np.asarray(lead.knots, dtype=np.float64)
        if lead.in_force is not None and lead.spacing == SPACING and knots.size:
            position, velocity = np.ascontiguousarray(knots.transpose(2, 1, 0))
            motion = Motion(lead.in_force, position, velocity)
            vehicle.in_force, vehicle.is_foreign = SentMotion(lead.in_force, motion), False
            self.rows.unknown_until[row] = -1
        self._mark_changed(row, vehicle)

    def rests(self, row: int) -> bool:
        """Whether the vehicle was observed at the end of every motion that it may fly, or another
        server leads it.
        """
        vehicle = self.vehicles.get(row)
        if vehicle is None or not self.led_vehicles.leads(row):
            return True
        k = int(self.observed_step[row])
        ends = [motion.last for motion in vehicle.motions()]
        return k > self.rows.unknown_until[row] and all(last <= k for last in ends)

    def brakes_m(self, vehicle: VehicleMotions) -> float:
        """Distance in which a vehicle without a motion will stop [m]; 0 if it has a motion."""
        brakes = vehicle.in_force is not None and vehicle.in_force.step < 0
        return self._stopping_m(vehicle) if brakes else 0.0

    def ahead(self, row: int) -> int:
        return int(self.rows.ahead[row])

    def possible_motion(self, row: int, motion: Motion) -> PossibleMotion:
        return PossibleMotion(self.in_common(row, motion), self.lands(row), self.error(row))

    def in_common(self, row: int, motion: Motion) -> Motion:
        """Motion of a vehicle, converted to steps of the common time grid."""
        return motion._replace(first=motion.first - self.ahead(row))

    def lands(self, row: int) -> int:
        """First step on the common time grid at which a vehicle may begin to land, or NEVER."""
        lands = int(self.rows.lands[row])
        return lands if lands == NEVER else lands - self.ahead(row)

    def error(self, row: int) -> StepError:
        return StepError(float(self.rows.early[row]), float(self.rows.late[row]))

    def note_sent(self, row: int, step: int, motion: Motion) -> None:
        vehicle = self.vehicles[row]
        vehicle.sent.append(SentMotion(step, motion))
        self._mark_changed(row, vehicle)

    def unknown(self) -> int | None:
        """Number of a vehicle whose possible positions are unknown; None if there is none.

        Either the server has not observed the vehicle since the server started, or the vehicle
        flies a motion of another server.
        """
        unheard = self.absent.difference(self.rows.number[list(self.vehicles)].tolist())
        if unheard:
            return min(unheard)
        return None if self.foreign is None else self.number_of(self.foreign)

    def begins_at(self, number: int) -> Array:
        place: Array = self._references(number)(np.zeros(()))[:, 0]
        return place

    def observe(self, row: int, observation: Observation) -> bool:
        """Process an observation; return False if the observation is not newer than the last."""
        if observation.step <= self.observed_step[row]:
            return False
        k = observation.step
        # An observation from before the client's restart does not show where the vehicle is now.
        if k > self.restarted.get(row, k) + RESTART_STEPS or not self.rows.heard[row]:
            self.restarted.pop(row, None)
        self.observed_step[row] = k
        self.state[row] = observation.state
        vehicle = self.vehicles.setdefault(row, VehicleMotions())
        self.rows.number[row] = self.number_of(row)
        self._watch(row, vehicle, observation)
        if observation.in_force == NO_HORIZON:
            # The vehicle hovers, or brakes: it has not accepted a motion, or has ended all motions.
            vehicle.in_force = SentMotion(-1, resting(k, self._place(row, observation.state[:, 0])))
            vehicle.is_foreign = False
            # The vehicle will not accept motions of an earlier session, either.
            if not observation.takes or not self.rows.heard[row]:
                vehicle.sent.clear()
        elif vehicle.in_force is None or vehicle.in_force.step != observation.in_force:
            accepted = next(
                (candidate for candidate in vehicle.sent if candidate.step == observation.in_force),
                None,
            )
            vehicle.is_foreign = accepted is None
            if accepted is None:  # a motion of another server, or of the row's previous vehicle
                self.rows.unknown_until[row] = observation.in_force + LONGEST
                accepted = SentMotion(observation.in_force, resting(k, observation.state[:, 0]))
            vehicle.in_force = accepted
        flies_on = k <= self.rows.unknown_until[row]
        if flies_on:
            self.foreign = row
        if flies_on or vehicle.is_foreign:
            # This is also done once after another server's motion has ended: the vehicle then rests
            # at the end of that motion, not at a position observed earlier.
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
            oldest = vehicle.sent.popleft()
            self.counts["horizons_lost"] += oldest.step > newest
            vehicle.adapt_copies(oldest.step == newest and k <= observation.since + 1)
        self.rows.heard[row] = True
        self._mark_changed(row, vehicle)
        return True

    def _watch(self, row: int, vehicle: VehicleMotions, observation: Observation) -> None:
        """Check the theorem's assumptions about motions: each is accepted in time, and flown to its
        end.
        """
        before = vehicle.in_force
        if before is None or not self.rows.heard[row] or observation.in_force == before.step:
            return
        if observation.in_force != NO_HORIZON:
            share = (observation.since - observation.in_force) / self._join
            self.margins["join"] = max(self.margins["join"], share)
            if share > 1.0:
                self.counts["joined_late"] += 1
        elif before.step >= 0 and before.motion.last > observation.step:
            self.counts["left_motion"] += 1
            left_s = (before.motion.last - observation.step) * self._dt_s
            self.events.append(LeftMotion(vehicle=self.number_of(row), left_s=left_s))

    def _mark_changed(self, row: int, vehicle: VehicleMotions) -> None:
        self._changed.add(row)
        vehicle.repeat = None
        self.rows.sent_step[row], self.rows.repeats_for[row] = vehicle.repeats

    def _expect_landing(self, row: int, observation: Observation) -> None:
        """Update the first step at which a vehicle may begin to land."""
        k, lands = observation.step, self.rows.lands
        if self._land_after == NEVER:
            return
        match observation.mode:
            # At the first observation `lands` is no bound: an earlier run counted other steps.
            case Mode.HOVER if lands[row] < NEVER and self.rows.heard[row]:
                # The vehicle may land from now on, but not before the step computed earlier.
                lands[row] = max(lands[row], k)
            case Mode.HOVER | Mode.LAND | Mode.MANUAL | Mode.FAULT:
                lands[row] = k
            case _:
                lands[row] = k + self._land_after

    def _measure(self, row: int, vehicle: VehicleMotions, expected: Array) -> None:
        """Update the distance of a vehicle outside its tube, and its speed."""
        number, state = self.number_of(row), self.state[row]
        assert vehicle.in_force is not None
        outside_m = float(np.linalg.norm(expected - state[:, 0])) - self._tube_m
        vehicle.speed_mps = float(np.linalg.norm(state[:, 1]))
        if vehicle.in_force.step >= 0 and number not in self.absent:
            self.margins["tube"] = max(self.margins["tube"], 1.0 + outside_m / self._tube_m)
        if vehicle.in_force.step < 0:
            outside_m = max(outside_m, self.brakes_m(vehicle))
        elif outside_m <= 0.0:
            self.absent.discard(number)
        elif number not in self.absent:
            self.counts["left_tube"] += 1
            if not vehicle.outside_m:
                self.events.append(LeftTube(vehicle=number, off_m=outside_m))
        vehicle.outside_m = 0.0 if number in self.absent else max(outside_m, 0.0)

    def _stopping_m(self, vehicle: VehicleMotions) -> float:
        return vehicle.speed_mps * (self._tau_s + vehicle.speed_mps / self._braking)

    def _place(self, row: int, observed: Array) -> Array:
        """Resting position of a vehicle without a motion: its start if nearby, else `observed`."""
        number = self.number_of(row)
        if number not in self.absent:
            return observed
        first = self.begins_at(number)
        return first if np.linalg.norm(first - observed) < self._tube_m else observed

    def align(self, rows: Indices, step: Indices) -> None:
        """Map steps of all vehicles to the common time grid, and discard motions not yet sent."""
        n, self._is_updated = len(rows), False
        self.now = self._clock.tick_ns // self._dt_ns
        moved, foreign = _align(rows, step, self.now, self.rows, self.due, self._moved_by)
        # All rows, because vehicles also avoid a vehicle whose packets do not arrive.
        counted = self.now + self.rows.ahead
        self._clock.step_errors(self._all, counted, self.rows.early, self.rows.late)
        for row, since in self.restarted.items():
            # When its client restarted, the vehicle may have stopped anywhere on its motion.
            stands = float(LONGEST + counted[row] - since)
            self.rows.late[row] = max(self.rows.late[row], stands)
        if moved:
            self._changed.update(rows[self._moved_by[:n] != 0].tolist())
        self.led_vehicles.observed(rows, self.observed_step)
        if self.decided:
            for row in self.decided.intersection(rows.tolist()):
                self.vehicles[row].next = None
                self._changed.add(row)
                self.decided.remove(row)
        self.foreign = None if foreign < 0 else foreign

    def update_possible(self) -> None:
        if self._is_updated:
            return
        self._is_updated = True
        for row in self._changed & self.vehicles.keys():
            vehicle = self.vehicles[row]
            # Unacknowledged motions are included.
            motions = [self.possible_motion(row, motion) for motion in vehicle.motions()]
            self.possible.replace(row, motions, vehicle.outside_m)
        self._changed.clear()
        self.possible.set_errors(self.rows.early, self.rows.late)

    def goal(self, row: int) -> Array:
        """Present goal of a vehicle [m]; shape (axes,). In a show it is the point of the vehicle's
        path at the time when a motion planned now would end.
        """
        steps = self.kept_steps + INTERVALS * SPACING if self.is_show else 0
        return self._desired(row, np.array((self.now + self.ahead(row) + steps) * self._dt_s))

    def targets(self, row: int) -> Array:
        """Points of a show's path for the planned knots of a motion [m]; shape (N, axes).

        A vehicle lags its motion by its dead time, so the motion leads the path by this time.
        """
        steps = self.now + self.ahead(row) + self.kept_steps + SPACING * PLANNED
        places = [self._desired(row, steps * self._dt_s + dead_s) for dead_s in self._dead_time_s]
        return np.stack([place[:, axis] for axis, place in enumerate(places)], axis=1)

    def _desired(self, row: int, times_s: Array) -> Array:
        desired = self._references(self.number_of(row))(times_s)
        return np.ascontiguousarray(desired[..., 0])  # kernels need contiguous arrays

    def resting_places(self, row: int) -> list[Array]:
        """Positions of the other vehicles at rest [m]."""
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
    """Map vehicles to the common time grid, and set PLAN_DUE and REPEAT_DUE for each.

    Args:
        now: present step on the common time grid.
        due: output: PLAN_DUE, REPEAT_DUE, both or 0; shape (n,) at least.
        moved_by: output: change of the offset from the grid [steps]; shape (n,) at least.

    Returns:
        number of vehicles whose offset has changed, and the row of a vehicle that may still fly a
        motion of another server, or -1.
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
