"""Motions that keep vehicles apart, and out of zones, whichever packets are lost.

A motion is where a vehicle is at every time: a spline that ends at rest, and rest from there on. It
is sent as a trajectory whose knots are all of it, so a vehicle that hears nothing more flies it to
its end and hovers there. For each vehicle the server keeps every motion that may be flown:

- the one in force at its newest observation, which acknowledges it; and
- each that was sent since, as long as a packet may still be taken. Aboard a trajectory is taken no
  later than `link.join_s` after its first knot, so an observation made later says for certain
  whether it was.

A new motion is sent only if at every time it keeps the distance

    D = separation_m + 2 tube_m

from all that all other vehicles may fly, wherever on these motions they may be by what is known of
their clocks, with `tube_m` for how far a vehicle is from its motion (wind, tracking); from one that
was seen outside its tube, as much more as it was. Those were apart already. So whichever of them
are taken, and whichever packets are lost or late, vehicles are `separation_m` apart, as long as
each stays in its tube (docs/together.md has the theorem). From zones it keeps `tube_m`. The motion
in force is always a way out: it needs no packet.

`roster` has what may be flown, `motionplan` the QP, `apart` the distances, `routes` the ways around
zones, `aims` what a vehicle flies towards, and `aside` who steps aside for whom.
"""

import math
from functools import partial
from operator import sub
from typing import NamedTuple

import numpy as np

from skytether.server.control import apart, aside
from skytether.server.control.aims import DETOUR_S, TURN_BACK, Aims
from skytether.server.control.apart import HalfPlanes
from skytether.server.control.aside import ASIDE_S, Aside
from skytether.server.control.clear import touches
from skytether.server.control.direct import Direct
from skytether.server.control.known import Known
from skytether.server.control.motionplan import MotionPlan
from skytether.server.control.moves import FIGURES, Figures
from skytether.server.control.roster import DECIDES, REPEATS, Roster
from skytether.server.control.scheme import Foresight
from skytether.shared.base.chance import stream
from skytether.shared.law.model import ALTITUDE, Array, Flags, Indices
from skytether.shared.law.motion import SPACING, Motion
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.zones import Zones
from skytether.shared.wire.protocol import KNOTS_MAX, Observation

RESTS_MPS = 0.2
"""Measured speed up to which a vehicle rests [m/s]."""
ARRIVED_M = 0.02
"""Distance from the goal at which a motion ends there [m]."""
ROUNDS = 5
"""Number of times that constraints are taken in for one of them."""
STUCK = 0.3
"""Share of the way to what is aimed at, 2 m at most, below which a plan is taken for stuck."""
TURN = 2.0 * np.pi * np.arange(32) / 32
AROUND = np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
"""Directions in which a vehicle that rests within a zone looks for a way out."""
OUT_M, OUT_STEPS = 0.1, 500
"""Distance from one place that is looked at to the next [m], and number of these."""
NEARER_M = 1e-3
"""Distance by which it may come nearer to the zone that it leaves [m]."""
ZONE = "a zone"
"""Reason why a vehicle waits that a zone holds back."""
CLOCK_POINTS = 33
"""Number of steps that a vehicle may be at for which it is told how far it may be elsewhere."""
BINDS_M = 1e-4
"""Distance from a half-plane up to which it holds a motion back [m]."""

SILENT = np.zeros((), dtype=FIGURES)
"""Figures of a vehicle to which nothing is sent."""
SILENT["gap"], SILENT["solved"] = 1, True


class Straight(NamedTuple):
    """Vehicle that may fly straight to its goal."""

    row: int
    known: Known
    k: int
    """Present step of the vehicle."""
    goal: Array
    """Shape (axes,) [m]."""


class Together:
    """The scheme "trajectory" for missions: motions that keep apart.

    Args:
        scenario: what is asked for, as `mission` says it, and the seed of directions.
        terms: the rule of flight.
        block: number of vehicles that are decided on at a time.
        roster: vehicles, and the motions that each may fly.
    """

    solve_ns = -1

    def __init__(self, scenario: Scenario, terms: Terms, block: int, roster: Roster) -> None:
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        self.planned = np.zeros((block, terms.axes, 2))
        self._roster = roster
        self.counts, self.left = roster.counts, roster.left
        self.inside: list[tuple[int, str]] = []
        """Vehicles that were found at rest within a zone since this was emptied, and its name."""
        self.observed_step = roster.observed_step
        mission = scenario.mission
        clear = self._clear = scenario.clearances
        self._dt_s = terms.dt_s
        self._lead = -(-terms.join // SPACING) * SPACING
        """Steps after the first knot from which on a motion differs from the one in force."""
        self._again = terms.age_max // 3
        """Steps after which a motion is sent again, before it is too old to be flown."""
        self._plan = MotionPlan(terms, mission.acceleration_mps2, mission.speed_mps)
        self._zones, self._lands = scenario.zones, scenario.lands
        self._aims = Aims(
            self._zones,
            clear.tube_m,
            clear.planned_apart_m,
            round(DETOUR_S / terms.dt_s),
            stream(scenario.seed, "together"),
        )
        self._repeating: list[Known] = []
        """Vehicles that are sent a motion once more at this step."""
        kept = self._lead // SPACING + 1
        self._scale = roster.flown.scale.copy()
        self._scale[ALTITUDE:] = scenario.rest_scale
        """Factors of the coordinates before distances of vehicles at rest are taken; shape
        (axes,)."""
        self._direct = Direct(self._plan, roster.flown, kept, clear.apart_m, STUCK)

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        self._roster.forget(row)

    def restart(self, row: int) -> bool:
        """Take note that the client of a vehicle has begun anew; whether that is news."""
        return self._roster.restart(row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        return self._roster.observe(row, observation)

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._roster.state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """Plan for vehicles every SPACING steps, not all at the same."""
        figures, n = self.figures, len(rows)
        self._roster.meet(rows, step)
        figures[:n] = SILENT
        figures["row"][:n], figures["step"][:n], figures["start"][:n] = rows, step, step
        # By their numbers, so that vehicles take turns: a plan reckons with the motions decided
        # before it.
        for each in self._repeating:
            each.again = None
        self._repeating.clear()
        straight: list[Straight] = []
        looked_at = self._roster.looks[:n].nonzero()[0].tolist()
        for i in looked_at:
            row, k = int(rows[i]), int(step[i])
            known = self._roster.known[row]
            if self._roster.looks[i] & REPEATS:
                known.again = known.owed(k)
                self._repeating.append(known)
            if self._roster.looks[i] & DECIDES:
                self._decide(row, known, k, straight)
        self._fly_straight(straight)
        for i in looked_at:
            known = self._roster.known[int(rows[i])]
            # A figure above any threshold: a motion that was found has to be sent.
            if known.next or known.again:
                figures["expected_gap"][i] = 1e9
            if known.next:
                self._roster.decided.add(int(rows[i]))
        self.planned[:n] = self._roster.state[rows]

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; the knots of what is sent."""
        for i in event.nonzero()[0].tolist():
            known, k = self._roster.known[int(rows[i])], int(step[i])
            if known.again:
                k, motion = known.again
            elif known.next:
                motion = known.next
            else:
                assert known.in_force is not None
                motion = known.in_force.motion
            count = min(max((motion.last - k) // SPACING, 0) + 1, KNOTS_MAX)
            p, v = motion.at(k + SPACING * np.arange(count, dtype=np.float64), self._dt_s)
            knots = np.stack([p, v], axis=-1).transpose(1, 0, 2).reshape(p.shape[1], -1)
            found.told.knots[i, :, : 2 * count] = knots
            found.told.number[i], found.told.spacing[i] = count, SPACING
            found.told.back[i] = int(step[i]) - k
            if not known.again:
                self._roster.sent(int(rows[i]), k, motion)

    # -- zones -------------------------------------------------------------------------------------

    def change_zones(self, zones: Zones) -> None:
        """Keep out of other zones from now on, to which `objection` has nothing to say."""
        self._zones = zones
        self._aims.change_zones(zones)
        for known in self._roster.known.values():
            known.goal = None  # what was found out about ways to it holds no more

    def objection(self, zones: Zones) -> str:
        """Why there cannot be these zones: where a vehicle may fly into one, or is not known to
        keep out; empty: there can.
        """
        if zones and (number := self._roster.unknown()) is not None:
            return f"zones before it is known where vehicle {number} is"
        for row, known in self._roster.known.items():
            room_m = self._clear.tube_m + self._clear.bend_m + self._roster.brakes_m(known)
            for motion in known.motions():
                # The earliest step that the vehicle may be at.
                k = self._roster.now + self._roster.ahead(row)
                k -= max(math.ceil(self._roster.error(row).late), 0)
                points, _ = motion.at(apart.pieces_of(k, motion.last), self._dt_s)
                if touches(zones, points, room_m):
                    zone = zones.in_the_way(points, room_m)
                    left_s = max(motion.last - k, 0) * self._dt_s
                    hovers = "hovers in or above" if self._lands else "hovers in"
                    does = f"may fly into for {left_s:.1f} s more" if left_s else hovers
                    number = self._roster.number_of(row)
                    return f"{zone}, which vehicle {number} {does}, tube included"
        return ""

    def waits(self, row: int) -> str:
        """Reason why a vehicle waits; empty if it does not."""
        return self._roster.known[row].waits if row in self._roster.known else ""

    def clock_m(self, row: int) -> float | None:
        """Distance by which a vehicle may now be elsewhere on its motion than where its step is
        counted [m]; None of none.

        Others keep as much further away from it, along its way.
        """
        known, error = self._roster.known.get(row), self._roster.error(row)
        if known is None or known.in_force is None:
            return None
        motion, k = known.in_force.motion, self._roster.now + self._roster.ahead(row)
        steps = np.linspace(k - error.late, k + error.early, CLOCK_POINTS)
        steps = np.append(steps, float(k))
        position, _ = motion.at(steps.clip(motion.first, motion.last), self._dt_s)
        return float(np.linalg.norm(position - position[-1], axis=1).max())

    # -- what is decided ---------------------------------------------------------------------------

    def _decide(self, row: int, known: Known, k: int, straight: list[Straight]) -> None:
        """Find the motion to be sent to a vehicle now, if any.

        Args:
            row, known: the vehicle.
            k: its step.
            straight: takes the vehicles that may fly straight, to be planned for together.
        """
        known.waits = ""
        if row in self._roster.restarted:
            known.waits = "its client, which has begun anew"
        elif self._plans(known, k):
            self._fly_on(row, known, k, straight)

    def _plans(self, known: Known, k: int) -> bool:
        """Whether a vehicle may be given another motion; what it waits for, if not."""
        base = known.in_force
        assert base is not None
        if known.sent:
            # Whether that was taken is not known yet.
            known.waits = "an acknowledgement"
            return False
        if base.step < 0:
            if known.speed_mps > RESTS_MPS:
                known.waits = "coming to rest"
            else:
                known.next = base.motion  # it has none: first of all the place where it hovers
            return False
        if k - base.step > self._again:
            known.next = base.motion  # or it would end aboard, and the vehicle drift
            return False
        if self._roster.absent:
            known.waits = f"vehicle {min(self._roster.absent)} to begin"
            return False
        if self._roster.foreign is not None:
            number = self._roster.number_of(self._roster.foreign)
            known.waits = f"vehicle {number}, of another server's motion"
            return False
        return True

    def _fly_on(self, row: int, known: Known, k: int, straight: list[Straight]) -> None:
        """Find a motion to a vehicle's goal, or to where it steps aside; see `_decide`."""
        assert known.in_force is not None
        home = self._roster.goal(row)
        left = known.aside
        if left and (self._roster.now > left.until or not self._to_pass(left, home)):
            known.aside = None
        goal = known.aside.place if known.aside else home
        place = known.in_force.motion.position[-1]
        if (out := self._way_out(row, known, place)) is not None:
            self._roster.gather()
            self._find(row, known, k, out)
            return
        if max(map(abs, map(sub, place.tolist(), goal.tolist()))) < ARRIVED_M:
            known.turned = 0.0
            if known.aside:
                known.waits = f"vehicle {self._roster.number_of(known.aside.asker)} to pass"
            return
        self._roster.gather()
        way = self._way(row, goal) if self._zones else np.array([place, goal])
        is_stuck = known.is_stuck(k, goal, sum(map(math.dist, way[:-1], way[1:])))
        roams = known.turned or known.aside or (known.detour and k < known.detour_until)
        if not (is_stuck or roams or self._zones):
            straight.append(Straight(row, known, k, goal))
            return
        # A plan reckons with all that were decided before it.
        self._fly_straight(straight)
        asked = is_stuck and self._ask(row, way)
        self._find(row, known, k, goal)
        if is_stuck:
            if known.barred and not asked and self._aims.close(known, k, place, goal):
                self.counts["closed"] += 1
            known.barred = False

    def _way_out(self, row: int, known: Known, place: Array) -> Array | None:
        """Nearest place clear of zones, for a vehicle that rests within one [m]; None of one that
        is clear.

        No motion leads there: it was there when the server began, which knew of no zone before.
        """
        room_m = self._clear.tube_m
        if not self._zones or self._zones.clearance(place[None]).min() >= room_m:
            known.in_zone = False
            return None
        if not known.in_zone:
            known.in_zone = True
            zone = self._zones.in_the_way(place[None], room_m)
            self.inside.append((self._roster.number_of(row), zone))
        around = np.zeros((len(AROUND), len(place)))
        around[:, :2] = AROUND
        for far_m in np.arange(1, OUT_STEPS) * OUT_M:
            found: Array = place + far_m * around
            clear_m = self._zones.clearance(found).min(axis=1)
            best = int(clear_m.argmax())
            if clear_m[best] >= self._clear.planned_clear_m:
                there: Array = found[best]
                return there
        return None

    def _fly_straight(self, straight: list[Straight]) -> None:
        """Find motions of vehicles that may fly straight, one after the other; none are left."""
        while straight:
            rows, steps = np.array([(each.row, each.k) for each in straight]).T.copy()
            goals = np.array([each.goal for each in straight])
            found = self._direct.motions(rows, steps, self._roster.rows.ahead[rows], goals)
            for (_, known, _, _), motion in zip(straight, found, strict=False):
                known.next, known.waits = motion, ""
            del straight[: len(found)]
            if straight:  # the way of the first that is left is not straight
                self._find(*straight.pop(0))

    def _find(self, row: int, known: Known, k: int, goal: Array) -> None:
        """Find a motion towards a goal, around others that are in the way."""
        known.next = self._toward(row, known, k, goal)
        if known.next is None:
            self.counts["stuck"] += 1
        else:
            ahead, lands = self._roster.ahead(row), self._roster.lands(row)
            error = self._roster.error(row)
            self._roster.flown.add(row, known.next, ahead, lands, known.off_m, error)

    def _way(self, row: int, goal: Array) -> Array:
        """Way around zones to a goal from where a vehicle comes to rest, that place first [m]."""
        known = self._roster.known[row].in_force
        assert known is not None
        place = known.motion.position[-1]
        return np.concatenate([place[None], self._aims.routes.way(place, goal)])

    def _to_pass(self, left: Aside, home: Array) -> bool:
        """Whether a vehicle has yet to pass the place that one has left for it."""
        way = self._way(left.asker, self._roster.goal(left.asker)) * self._scale
        return bool(aside.off_way(home[None] * self._scale, way)[0] < self._clear.planned_apart_m)

    def _ask(self, row: int, way: Array) -> bool:
        """Ask the first vehicle that rests at its goal in another vehicle's way to step aside;
        whether it does.
        """
        keep_m, ends, homes = self._clear.planned_apart_m, list[tuple[int, Array]](), list[int]()
        for other, each in self._roster.known.items():
            if other == row or each.in_force is None or not self._roster.rows.met[other]:
                continue
            flown = each.motions()
            ends += [(other, motion.position[-1]) for motion in flown]
            rests = each.in_force.step >= 0 and len(flown) == 1 and each.aside is None
            if rests and np.abs(flown[0].position[-1] - self._roster.goal(other)).max() < ARRIVED_M:
                homes.append(other)
        places = np.array([self._roster.goal(other) for other in homes]).reshape(-1, way.shape[1])
        first = aside.first_on(way * self._scale, places * self._scale, keep_m)
        if first is None:
            return False
        asked, others = homes[first], [end for other, end in ends if other != homes[first]]
        free = aside.place(
            places[first],
            way,
            np.array([way[0], *others]),
            keep_m,
            self._scale,
            self._zones,
            self._aims.routes,
            self._clear.planned_clear_m,
        )
        if free is not None:
            self.counts["asides"] += 1
            until = self._roster.now + round(ASIDE_S / self._dt_s)
            self._roster.known[asked].aside = Aside(free, row, until)
        return free is not None

    def _toward(self, row: int, known: Known, k: int, goal: Array) -> Motion | None:
        """A motion from the one in force towards a goal, apart from all; None where none is found.

        Of the constraints only those are taken in that a solution without them has violated: mostly
        nothing is near, and the way is straight.
        """
        assert known.in_force is not None
        dt_s, plan, base = self._dt_s, self._plan, known.in_force.motion
        due = k + self._lead
        kept = apart.states(base, k, self._lead // SPACING + 1, dt_s)
        p0 = kept[0][-1]
        planes, taken = None, np.zeros(self._roster.flown.count + 1, dtype=np.bool_)
        for aim in self._aims.of(known, k, p0, goal, partial(self._roster.rests, row)):
            for _ in range(ROUNDS):
                held = planes.of_some(taken) if planes else None
                solved = plan.solve(*kept, aim, held)
                if solved is None:
                    self.counts["unsolved"] += 1
                    return None
                motion = Motion(k, *solved)
                hit = self._hit(row, motion, k)
                if not (hit & ~taken).any():
                    break
                taken |= hit
                planes = planes or self._planes(row, base, due)
            # A plan that hardly moves is taken for stuck, and another aim is tried.
            moved_m, far_m = math.dist(motion.position[-1], p0), math.dist(aim, p0)
            if moved_m >= STUCK * min(far_m, 2.0) and not hit.any():
                known.waits, known.turned = "", max(0.0, known.turned - TURN_BACK)
                return motion
            if held:
                known.waits = known.waits or self._blocker(solved, held)
                known.barred |= known.waits == ZONE
            self.counts["refused"] += bool(hit.any())
        return None

    def _planes(self, row: int, base: Motion, due: int) -> HalfPlanes:
        """Half-planes of the others' motions, and behind them those of zones."""
        plan, ahead = self._plan, self._roster.rows.ahead[row]
        times = due + plan.times * SPACING
        held, _ = base.at(times, self._dt_s)
        found = apart.half_planes(
            times - ahead,
            held,
            plan.reach_m,
            row,
            self._roster.lands(row),
            self._roster.flown,
            self._clear.planned_apart_m + self._roster.known[row].off_m,
            self._roster.error(row),
        )
        if not self._zones:
            return found
        near = self._zones.planes(held, plan.reach_m + self._clear.planned_clear_m)
        # A vehicle that is nearer to a zone already need only come no nearer.
        least = np.minimum(self._clear.planned_clear_m, near.away_m - 1e-4)
        least += np.einsum("ij,ij->i", near.normal, near.border)
        return HalfPlanes(
            np.concatenate([found.at, near.at]),
            np.concatenate([found.normal, near.normal]),
            np.concatenate([found.least, least]),
            np.concatenate([found.of, np.full(len(near.at), self._roster.flown.count)]),
        )

    def _blocker(self, solved: tuple[Array, Array], planes: HalfPlanes) -> str:
        """Constraint that holds a motion back most, in words."""
        position = self._plan.at_times(*solved)
        room = np.einsum("ij,ij->i", planes.normal, position[planes.at]) - planes.least
        binding = planes.of[room < BINDS_M]
        if not len(binding):
            return ""
        index, often = np.unique(binding, return_counts=True)
        most = int(index[often.argmax()])
        if most == self._roster.flown.count:
            return ZONE
        return f"vehicle {self._roster.number_of(int(self._roster.flown.of[most]))}"

    def _hit(self, row: int, motion: Motion, k: int) -> Flags:
        """Which motions of others one comes too near to, ever, and last whether it does a zone."""
        known, ahead = self._roster.known[row], self._roster.ahead(row)
        assert known.in_force is not None
        common, base = (
            each._replace(first=each.first - ahead) for each in (motion, known.in_force.motion)
        )
        keep_m = self._clear.apart_m + known.off_m
        lands, flown = self._roster.lands(row), self._roster.flown
        error = self._roster.error(row)
        hit = apart.too_near(common, base, k - ahead, row, lands, flown, keep_m, error)
        if self._zones:
            points, _ = motion.at(apart.pieces_of(k, motion.last), self._dt_s)
            hit[-1] = self._meets_zone(points)
        return hit

    def _meets_zone(self, points: Array) -> bool:
        """Whether a way through points comes too near to a zone; from one that it begins in, or is
        too near to already, it may only come out.
        """
        room_m = self._clear.tube_m + self._clear.bend_m
        if not touches(self._zones, points, room_m):
            return False
        away_m = self._zones.clearance(points)
        is_clear = away_m[0] >= room_m
        if is_clear.all():
            return True
        others = [zone for zone, clear in zip(self._zones.zones, is_clear, strict=True) if clear]
        if others and touches(Zones(others), points, room_m):
            return True
        left = away_m[:, ~is_clear]
        so_far = np.minimum(np.maximum.accumulate(left, axis=0), room_m)
        return bool((left < so_far - NEARER_M).any())
