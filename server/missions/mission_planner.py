"""Mission planner: motions that keep vehicles apart and out of zones, even if packets are lost.

A motion gives the position of a vehicle at all times: a spline that ends at rest, and rest after
that. A motion is sent as a trajectory with all its knots, so a vehicle that receives no further
packet flies the motion to its end and hovers there. For each vehicle the server stores every motion
that the vehicle may fly:

- the motion in force, which the newest observation acknowledges; and
- each motion sent since, as long as the vehicle may still accept its packet. The vehicle accepts a
  motion no later than `link.join_s` after its first knot, so a later observation shows reliably
  whether the vehicle has accepted the motion.

A new motion is sent only if at all times it keeps the distance

    D = separation_m + 2 tube_m

from all motions that all other vehicles may fly, at every position that the errors of their clocks
allow. `tube_m` is the largest distance of a vehicle from its motion (wind, tracking); vehicles keep
more distance from a vehicle observed outside its tube. Motions sent earlier already keep D. So
whichever packets are lost or late, and whichever motions are accepted, vehicles are `separation_m`
apart if each stays in its tube (theorem: docs/together-proof.md). The distance from zones is
`tube_m`. A vehicle can always stay on its motion in force, because this needs no packet.

`mission_state` has the motions that may be flown, `trajectory_qp` the QP, `separation` and
`half_planes` the distances, `routes` the paths around zones, `waypoints` the next target of a
vehicle, and `yielding` the choice of a vehicle that makes way for another.
"""

import math
from functools import partial
from itertools import chain
from operator import sub
from typing import Any

import numpy as np

from skytether.server.missions import yielding
from skytether.server.missions.compiled_motion import pieces_of, states
from skytether.server.missions.half_planes import HalfPlanes, half_planes
from skytether.server.missions.mission_state import LONGEST, PLAN_DUE, REPEAT_DUE, MissionState
from skytether.server.missions.possible_motions import PossibleMotion
from skytether.server.missions.separation import too_near
from skytether.server.missions.trajectory_qp import TrajectoryQP
from skytether.server.missions.vehicle_motions import VehicleMotions
from skytether.server.missions.waypoints import DETOUR_S, TURN_BACK, Waypoints
from skytether.server.missions.yielding import YIELD_S, Yielding
from skytether.server.missions.zone_clearance import comes_near
from skytether.server.planning.scheme import FIGURES, Fleet, Foresight
from skytether.server.planning.splines import SplineScheme
from skytether.shared.base.chance import stream
from skytether.shared.law.model import ALTITUDE, Array, Flags, Indices
from skytether.shared.law.motion import INTERVALS, SPACING, Motion
from skytether.shared.missions import keys
from skytether.shared.missions.derived import clearances, lands, limits, rest_scale, zones
from skytether.shared.missions.events import InZone
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.missions.mission import Guided, parse_goals
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.protocol import KNOTS_MAX, Observation, RoomMessage

RESTS_MPS = 0.2
"""Measured speed below which a vehicle counts as at rest [m/s]."""
ARRIVED_M = 0.02
"""Distance from the goal up to which the end of a motion counts as at the goal [m]."""
ROUNDS = 5
"""Largest number of QPs for a waypoint; each QP has more constraints than the last."""
STUCK = 0.3
"""Share of the distance to the waypoint, of 2 m at most, that a plan must cover; if a plan covers
less, the vehicle counts as stuck."""
TURN = 2.0 * np.pi * np.arange(32) / 32
AROUND = np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
"""Directions in which a vehicle at rest within a zone searches for a way out."""
OUT_M, OUT_STEPS = 0.1, 500
"""Distance between the positions that are tried on the way out of a zone [m], and their number."""
NEARER_M = 1e-3
"""Tolerance: distance by which a vehicle that leaves a zone may come nearer to the zone [m]."""
ZONE = "a zone"
CLOCK_POINTS = 33
"""Number of steps, within the error of a vehicle's step number, at which `_clock_m` evaluates its
motion."""
BINDS_M = 1e-4
"""Distance of a motion from a half-plane within which the half-plane counts as limiting it [m]."""

ZONES, GOALS = keys_of(keys.ZONES), keys_of(keys.GOALS)

SILENT = np.zeros((), dtype=FIGURES)
"""Figures of a vehicle to which no packet is sent."""
SILENT["gap"], SILENT["solved"] = 1, True


class MissionPlanner(SplineScheme):
    """Scheme "trajectory" for missions: motions that keep apart."""

    changeable = ZONES | GOALS
    keeps_rows = True

    def __init__(self, fleet: Fleet, state: MissionState) -> None:
        super().__init__(fleet)
        scenario, terms = fleet.scenario, fleet.terms
        self.figures = np.repeat(SILENT, fleet.block)
        self._state = state
        self.counts, self.events = state.counts, state.events
        self.observed_step = state.observed_step
        mission = scenario.section(MissionConfig)
        self.limits = limits(scenario)
        self._references = fleet.references
        apart = self._clearances = clearances(scenario)
        self._dt_s = terms.dt_s
        self._resend_after = terms.age_max // 3
        """Age at which a motion is sent again, so that it never is too old to be flown [steps]."""
        self._qp = TrajectoryQP(terms, mission.acceleration_mps2, mission.speed_mps)
        self._zones, self._lands = zones(scenario), lands(scenario)
        self._waypoints = Waypoints(
            self._zones,
            apart.tube_m,
            apart.planned_apart_m,
            round(DETOUR_S / terms.dt_s),
            stream(scenario.seed, "together"),
        )
        self._leaves = False
        """Whether the server is about to end, and plans no further motion."""
        self._repeating: list[VehicleMotions] = []
        """Vehicles whose latest motion is repeated at this step."""
        self._scale = state.possible.metric.scale.copy()
        self._scale[ALTITUDE:] = rest_scale(scenario)
        """Factor on each coordinate in distances between vehicles at rest; shape (axes,)."""

    def fleet_figures(self) -> dict[str, Any]:
        """Largest values of the quantities that the theorem bounds (docs/together-proof.md), each
        divided by its bound.
        """
        return {"margins": dict(self._state.margins)}

    def forget(self, row: int) -> None:
        self._state.forget(row)

    def restart(self, row: int) -> bool:
        return self._state.restart(row)

    def follow(self, row: int, lead: RoomMessage | None) -> None:
        assert lead is None or isinstance(lead, Lead)
        self._state.follow(row, lead)

    def observe(self, row: int, observation: Observation) -> bool:
        return self._state.observe(row, observation)

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:  # noqa: ARG002
        n = len(rows)
        foresight.estimate[:n] = foresight.start[:n] = self._state.state[rows]

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:  # noqa: ARG002
        """Plan for each vehicle every SPACING steps; the vehicles take turns."""
        figures, n = self.figures, len(rows)
        self._state.align(rows, step)
        figures["expected_gap"][:n] = 0.0
        figures["row"][:n], figures["step"][:n], figures["start"][:n] = rows, step, step
        # Vehicles are planned in the order of rows: each plan accounts for the motions decided
        # earlier.
        for vehicle in self._repeating:
            vehicle.repeat = None
        self._repeating.clear()
        due = self._state.due[:n].nonzero()[0].tolist()
        for i in due:
            row, k = int(rows[i]), int(step[i])
            vehicle = self._state.vehicles[row]
            if self._state.due[i] & REPEAT_DUE:
                vehicle.repeat = vehicle.repeat_at(k)
                self._repeating.append(vehicle)
            if self._state.due[i] & PLAN_DUE and self._may_plan(row, vehicle, k):
                self._plan_to_goal(row, vehicle, k)
        for i in due:
            vehicle = self._state.vehicles[int(rows[i])]
            # A figure above any threshold, because every motion found has to be sent.
            if vehicle.next or vehicle.repeat:
                figures["expected_gap"][i] = 1e9
            if vehicle.next:
                self._state.decided.add(int(rows[i]))
        self.planned[:n] = self._state.state[rows]

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        for i in event.nonzero()[0].tolist():
            vehicle, k = self._state.vehicles[int(rows[i])], int(step[i])
            if vehicle.repeat:
                k, motion = vehicle.repeat
            elif vehicle.next:
                motion = vehicle.next
            else:
                assert vehicle.in_force is not None
                motion = vehicle.in_force.motion
            count = min(max((motion.last - k) // SPACING, 0) + 1, KNOTS_MAX)
            p, v = motion.at(k + SPACING * np.arange(count, dtype=np.float64), self._dt_s)
            knots = np.stack([p, v], axis=-1).transpose(1, 0, 2).reshape(p.shape[1], -1)
            foresight.splines.knots[i, :, : 2 * count] = knots
            foresight.splines.number[i], foresight.splines.spacing[i] = count, SPACING
            foresight.splines.age[i] = int(step[i]) - k
            if not vehicle.repeat:
                self._state.note_sent(int(rows[i]), k, motion)

    # -- zones -------------------------------------------------------------------------------------

    def change(self, scenario: Scenario, keys: frozenset[str]) -> None:
        if keys & GOALS and isinstance(self._references, Guided):
            goals = scenario.section(MissionConfig).goals
            self._references.goals = parse_goals(goals, scenario.model.axes)
        if keys & ZONES:
            self._zones, self.limits = zones(scenario), limits(scenario)
            self._waypoints.change_zones(self._zones)
            for vehicle in self._state.vehicles.values():
                vehicle.goal = None  # resets closed positions and progress: they fit the old zones

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        """Reason why the keys cannot be changed now, such as a zone in the way of a vehicle."""
        objection = self._objection(zones(scenario)) if keys & ZONES else ""
        return f"mission.zones: got {objection}; nothing was changed" if objection else ""

    def _objection(self, zones: Zones) -> str:
        """Reason why these zones are refused; empty if they are accepted.

        A server that leads no vehicle accepts all zones, because the leader knows all motions and
        checks the zones.
        """
        if self.is_standby:
            return ""
        if zones and (number := self._state.unknown()) is not None:
            return f"zones before it is known where vehicle {number} is"
        for row, vehicle in self._state.vehicles.items():
            clearance_m = (
                self._clearances.tube_m
                + self._clearances.bend_m
                + max(vehicle.outside_m, self._state.brakes_m(vehicle))
            )
            for motion in vehicle.motions():
                # k: earliest possible step of the vehicle. Before its first knot a motion is at
                # rest, so no earlier step matters, even with an unbounded clock error.
                late = max(self._state.error(row).late, 0.0)
                step = self._state.now + self._state.ahead(row)
                k = math.floor(max(step - late, motion.first))
                points, _ = motion.at(pieces_of(k, motion.last), self._dt_s)
                if comes_near(zones, points, clearance_m):
                    zone = zones.in_the_way(points, clearance_m)
                    left_s = max(motion.last - k, 0) * self._dt_s
                    hovers = "hovers in or above" if self._lands else "hovers in"
                    does = f"may fly into for {left_s:.1f} s more" if left_s else hovers
                    number = self._state.number_of(row)
                    return f"{zone}, which vehicle {number} {does}, tube included"
        return ""

    @property
    def is_standby(self) -> bool:
        """Whether another server leads all vehicles from which packets have arrived."""
        return self._state.led_vehicles.is_standby

    def leave(self) -> int:
        self._leaves = True
        return LONGEST

    def rests(self, row: int) -> bool:
        return self._state.rests(row)

    def vehicle_figures(self, row: int) -> dict[str, Any]:
        clock_m = self._clock_m(row)
        waits = self._state.vehicles[row].waits_for if row in self._state.vehicles else ""
        figures = {"clock_m": clock_m and round(clock_m, 3), "waits": waits or None}
        return {name: value for name, value in figures.items() if value is not None}

    def _clock_m(self, row: int) -> float | None:
        """Largest shift of a vehicle along its motion by its clock error [m]; None if unknown.

        Other vehicles keep this additional distance along the vehicle's path.
        """
        vehicle, error = self._state.vehicles.get(row), self._state.error(row)
        if vehicle is None or vehicle.in_force is None:
            return None
        motion, k = vehicle.in_force.motion, self._state.now + self._state.ahead(row)
        steps = np.linspace(k - error.late, k + error.early, CLOCK_POINTS)
        steps = np.append(steps, float(k))
        position, _ = motion.at(steps.clip(motion.first, motion.last), self._dt_s)
        return float(np.linalg.norm(position - position[-1], axis=1).max())

    # -- decisions ---------------------------------------------------------------------------------

    def _may_plan(self, row: int, vehicle: VehicleMotions, k: int) -> bool:
        """Whether a motion may be planned at step k. If not, `waits_for` is set to the reason, or
        the motion in force is sent again.
        """
        in_force = vehicle.in_force
        assert in_force is not None
        vehicle.waits_for = self._own_wait(row, vehicle)
        if vehicle.waits_for:
            return False
        # A vehicle without a motion first gets its hovering position as a motion. The motion in
        # force is sent again before it is too old to be flown, or the vehicle would drift.
        if in_force.step < 0 or k - in_force.step > self._resend_after:
            vehicle.next = in_force.motion
            return False
        vehicle.waits_for = self._common_wait()
        return not vehicle.waits_for

    def _own_wait(self, row: int, vehicle: VehicleMotions) -> str:
        """Reason why this vehicle may not get a motion yet, in words; empty if it may."""
        if self._leaves:
            return "another server: this one ends"
        if row in self._state.restarted:
            return "its restarted client"
        if self._state.led_vehicles.awaits(row):
            return "its first observation"
        if vehicle.sent:
            return "an acknowledgement"  # the motion in force is unknown
        has_motion = vehicle.in_force is not None and vehicle.in_force.step >= 0
        return "" if has_motion or vehicle.speed_mps <= RESTS_MPS else "coming to rest"

    def _common_wait(self) -> str:
        """Reason why no motion is planned for any vehicle, in words; empty if there is none."""
        if (missing := self._state.led_vehicles.missing) is not None:
            return f"vehicle {self._state.number_of(missing)} to follow this server"
        if self._state.absent:
            return f"vehicle {min(self._state.absent)} to begin"
        if self._state.foreign is not None:
            number = self._state.number_of(self._state.foreign)
            return f"vehicle {number}, of another server's motion"
        return ""

    def _plan_to_goal(self, row: int, vehicle: VehicleMotions, k: int) -> None:
        assert vehicle.in_force is not None
        home = self._state.goal(row)
        yields = vehicle.yielding
        if yields and (self._state.now > yields.until or not self._has_to_pass(yields, home)):
            vehicle.yielding = None
        goal = vehicle.yielding.place if vehicle.yielding else home
        place = vehicle.in_force.motion.position[-1]
        if (out := self._way_out(row, vehicle, place)) is not None:
            self._state.update_possible()
            self._plan_motion(row, vehicle, k, out)
            return
        has_path = self._state.is_show and vehicle.yielding is None
        targets = self._state.targets(row) if has_path else None
        is_there = max(map(abs, map(sub, place.tolist(), goal.tolist()))) < ARRIVED_M
        if is_there and (targets is None or np.abs(targets - place).max() < ARRIVED_M):
            vehicle.turned_rad = 0.0
            if vehicle.yielding:
                asker = self._state.number_of(vehicle.yielding.asker)
                vehicle.waits_for = f"vehicle {asker} to pass"
            return
        self._state.update_possible()
        way = self._way(row, goal) if self._zones else (place, goal)
        is_stuck = vehicle.is_stuck(k, goal, sum(map(math.dist, way[:-1], way[1:])))
        asked = is_stuck and self._ask_to_yield(row, np.array(way))
        self._plan_motion(row, vehicle, k, goal, targets)
        if is_stuck:
            is_blocked = vehicle.zone_blocks and not asked
            if is_blocked and self._waypoints.close_way(vehicle, k, place, goal):
                self.counts["closed"] += 1
            vehicle.zone_blocks = False

    def _way_out(self, row: int, vehicle: VehicleMotions, place: Array) -> Array | None:
        """Nearest position clear of zones [m], if a vehicle rests within a zone; else None.

        No motion leads into a zone, so the vehicle has been there since the server started.
        """
        clearance_m = self._clearances.tube_m
        if not self._zones or self._zones.clearance(place[None]).min() >= clearance_m:
            vehicle.in_zone = False
            return None
        if not vehicle.in_zone:
            vehicle.in_zone = True
            zone = self._zones.in_the_way(place[None], clearance_m)
            self.events.append(InZone(vehicle=self._state.number_of(row), zone=zone))
        around = np.zeros((len(AROUND), len(place)))
        around[:, :2] = AROUND
        for far_m in np.arange(1, OUT_STEPS) * OUT_M:
            places: Array = place + far_m * around
            clear_m = self._zones.clearance(places).min(axis=1)
            best = int(clear_m.argmax())
            if clear_m[best] >= self._clearances.planned_clear_m:
                way_out: Array = places[best]
                return way_out
        return None

    def _plan_motion(
        self, row: int, vehicle: VehicleMotions, k: int, goal: Array, path: Array | None = None
    ) -> None:
        vehicle.next = self._motion_toward(row, vehicle, k, goal, path)
        self.counts["stuck"] += vehicle.next is None

    def _way(self, row: int, goal: Array) -> Array:
        in_force = self._state.vehicles[row].in_force
        assert in_force is not None
        place = in_force.motion.position[-1]
        return np.concatenate([place[None], self._waypoints.routes.way(place, goal)])

    def _has_to_pass(self, yields: Yielding, home: Array) -> bool:
        """Whether the vehicle that asked another to yield still has to pass the other's goal."""
        path = self._way(yields.asker, self._state.goal(yields.asker)) * self._scale
        (away_m,) = yielding.distance_from_way(home[None] * self._scale, path)
        return bool(away_m < self._clearances.planned_apart_m)

    def _ask_to_yield(self, row: int, way: Array) -> bool:
        """Make the first vehicle that rests at its goal on a path yield; False if none can."""
        keep_m = self._clearances.planned_apart_m
        rest_ends, homes = list[tuple[int, Array]](), list[int]()
        for other, each in self._state.vehicles.items():
            if other == row or each.in_force is None or not self._state.rows.aligned[other]:
                continue
            motions = each.motions()
            rest_ends += [(other, motion.position[-1]) for motion in motions]
            rests = each.in_force.step >= 0 and len(motions) == 1 and each.yielding is None
            left_m = motions[0].position[-1] - self._state.goal(other)
            if rests and np.abs(left_m).max() < ARRIVED_M:
                homes.append(other)
        places = np.array([self._state.goal(other) for other in homes]).reshape(-1, way.shape[1])
        first = yielding.first_on(way * self._scale, places * self._scale, keep_m)
        if first is None:
            return False
        asked, others = homes[first], [end for other, end in rest_ends if other != homes[first]]
        free = yielding.place_to_yield(
            places[first],
            way,
            np.array([way[0], *others]),
            keep_m,
            self._scale,
            self._zones,
            self._waypoints.routes,
            self._clearances.planned_clear_m,
        )
        if free is not None:
            self.counts["asides"] += 1
            until = self._state.now + round(YIELD_S / self._dt_s)
            self._state.vehicles[asked].yielding = Yielding(free, row, until)
        return free is not None

    def _motion_toward(
        self, row: int, vehicle: VehicleMotions, k: int, goal: Array, path: Array | None
    ) -> Motion | None:
        """New motion, which continues the motion in force along a path, or towards a goal if there
        is no free path; None if no motion is found.

        The new motion is added to the possible motions, so that the next vehicle's plan accounts
        for it. Constraints are added only after a solution violates them: most paths are free and
        straight.
        """
        assert vehicle.in_force is not None
        qp, base = self._qp, vehicle.in_force.motion
        due = k + self._state.kept_steps
        kept_knots = states(base, k, self._state.kept_steps // SPACING + 1, self._dt_s)
        p0 = kept_knots[0][-1]
        planes, violated = None, np.zeros(self._state.possible.count + 1, dtype=np.bool_)
        rests = partial(self._state.resting_places, row)
        waypoints = self._waypoints.candidates(vehicle, k, p0, goal, rests)
        targets_of = (np.tile(waypoint, (INTERVALS, 1)) for waypoint in waypoints)
        for targets in targets_of if path is None else chain([path], targets_of):
            for _ in range(ROUNDS):
                constraints = planes.from_some(violated) if planes else None
                solved = qp.solve(*kept_knots, targets, constraints)
                if solved is None:
                    self.counts["unsolved"] += 1
                    return None
                motion = Motion(k, *solved)
                planned = self._state.possible_motion(row, motion)
                conflicts = self._conflicts(row, motion, planned)
                if not (conflicts > violated).any():
                    break
                violated |= conflicts
                planes = planes or self._half_planes(row, base, due)
            # If the plan hardly moves the vehicle, another waypoint is tried.
            moved_m, far_m = math.dist(motion.position[-1], p0), math.dist(targets[-1], p0)
            if moved_m >= STUCK * min(far_m, 2.0) and not conflicts.any():
                vehicle.waits_for, vehicle.turned_rad = "", max(0.0, vehicle.turned_rad - TURN_BACK)
                self._state.possible.add(row, planned, vehicle.outside_m)
                return motion
            if constraints:
                vehicle.waits_for = vehicle.waits_for or self._limiting_constraint(
                    solved, constraints
                )
                vehicle.zone_blocks |= vehicle.waits_for == ZONE
            self.counts["refused"] += bool(conflicts.any())
        return None

    def _half_planes(self, row: int, base: Motion, due: int) -> HalfPlanes:
        qp, ahead = self._qp, self._state.rows.ahead[row]
        times = due + qp.times * SPACING
        in_force, _ = base.at(times, self._dt_s)
        planes = half_planes(
            times - ahead,
            in_force,
            qp.reach_m,
            row,
            self._state.lands(row),
            self._state.possible,
            self._clearances.planned_apart_m + self._state.vehicles[row].outside_m,
            self._state.error(row),
        )
        if not self._zones:
            return planes
        near = self._zones.planes(in_force, qp.reach_m + self._clearances.planned_clear_m)
        # A vehicle that is too near to a zone already may stay, but not come nearer.
        bound = np.minimum(self._clearances.planned_clear_m, near.away_m - 1e-4)
        bound += np.einsum("ij,ij->i", near.normal, near.border)
        return HalfPlanes(
            np.concatenate([planes.time, near.at]),
            np.concatenate([planes.normal, near.normal]),
            np.concatenate([planes.bound, bound]),
            np.concatenate([planes.other, np.full(len(near.at), self._state.possible.count)]),
        )

    def _limiting_constraint(self, solved: tuple[Array, Array], planes: HalfPlanes) -> str:
        """Name of the vehicle or zone that limits a motion most; empty if nothing limits it."""
        position = self._qp.at_times(*solved)
        spare_m = np.einsum("ij,ij->i", planes.normal, position[planes.time]) - planes.bound
        binding = planes.other[spare_m < BINDS_M]
        if not len(binding):
            return ""
        index, often = np.unique(binding, return_counts=True)
        most = int(index[often.argmax()])
        if most == self._state.possible.count:
            return ZONE
        return f"vehicle {self._state.number_of(int(self._state.possible.rows[most]))}"

    def _conflicts(self, row: int, motion: Motion, planned: PossibleMotion) -> Flags:
        """Flags of the motions that `motion` comes too near to; the last flag is for zones.
        `planned`: the same motion in steps of the common time grid.
        """
        vehicle = self._state.vehicles[row]
        assert vehicle.in_force is not None
        conflicts = too_near(
            planned,
            self._state.in_common(row, vehicle.in_force.motion),
            planned.motion.first,
            row,
            self._state.possible,
            self._clearances.apart_m + vehicle.outside_m,
        )
        if self._zones:
            points, _ = motion.at(pieces_of(motion.first, motion.last), self._dt_s)
            conflicts[-1] = self._enters_zone(points)
        return conflicts

    def _enters_zone(self, points: Array) -> bool:
        """Whether a polyline comes too near to a zone. A polyline may lead away from a zone that is
        too near at its start.
        """
        clearance_m = self._clearances.tube_m + self._clearances.bend_m
        if not comes_near(self._zones, points, clearance_m):
            return False
        away_m = self._zones.clearance(points)
        is_clear = away_m[0] >= clearance_m
        if is_clear.all():
            return True
        others = [zone for zone, clear in zip(self._zones.zones, is_clear, strict=True) if clear]
        if others and comes_near(Zones(others), points, clearance_m):
            return True
        left_m = away_m[:, ~is_clear]
        so_far = np.minimum(np.maximum.accumulate(left_m, axis=0), clearance_m)
        return bool((left_m < so_far - NEARER_M).any())
