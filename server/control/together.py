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

from all motions of all other vehicles that may be flown, with `tube_m` for how far a vehicle is
from its motion (wind, tracking, clocks); from one that was seen outside its tube, as much more as
it was. Those were apart already. So whichever of them are taken,
and whichever packets are lost, vehicles are `separation_m` apart, as long as each stays in its tube
(docs/together.md has the theorem). From zones it keeps `tube_m`. The motion in force is always a
way out: it needs no packet.

`known` has what may be flown, `motionplan` the QP, `apart` the distances, `routes` the ways around
zones, `aims` what a vehicle flies towards, and `aside` who steps aside for whom.
"""

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from operator import sub
from typing import NamedTuple, Self

import numpy as np

from skytether.server.control import apart, aside
from skytether.server.control.aims import DETOUR_S, TURN_BACK, Aims
from skytether.server.control.apart import FlownMotions, HalfPlanes
from skytether.server.control.aside import ASIDE_S, Aside
from skytether.server.control.direct import Direct
from skytether.server.control.known import Known, Sent, repeats_after
from skytether.server.control.motionplan import MotionPlan
from skytether.server.control.moves import FIGURES, Figures
from skytether.server.control.scheme import Foresight
from skytether.shared.base.chance import stream
from skytether.shared.base.kernel import B1, I1, making_kernel
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, Motion, resting
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.zones import Zones
from skytether.shared.wire.protocol import KNOTS_MAX, NO_HORIZON, Observation

LONGEST = (INTERVALS + JOIN_MAX) * SPACING
"""Steps that a motion takes at most."""
MARGIN_M = 0.03
"""Margin beyond D with which motions are planned apart: for the time between the times at which a
plan keeps D, and for the solver's tolerance [m]."""
RESTS_MPS = 0.2
"""Measured speed up to which a vehicle rests [m/s]."""
ARRIVED_M = 0.02
"""Distance from the goal at which a motion ends there [m]."""
ROUNDS = 5
"""Number of times that constraints are taken in for one of them."""
STUCK = 0.3
"""Share of the way to what is aimed at, 2 m at most, below which a plan is taken for stuck."""
DECIDES, REPEATS = 1, 2
"""Bits: it is a vehicle's turn to be decided on; it is sent a motion once more."""
BINDS_M = 1e-4
"""Distance from a half-plane up to which it holds a motion back [m]."""

SILENT = np.zeros((), dtype=FIGURES)
"""Figures of a vehicle to which nothing is sent."""
SILENT["gap"], SILENT["solved"] = 1, True


class VehicleRows(NamedTuple):
    """Numbers of all rows; each of shape (capacity,)."""

    ahead: I1
    """Steps by which the vehicle is ahead of one on no grid of its own."""
    met: B1
    """Whether that is known."""
    heard: B1
    """Whether an observation has come in this session."""
    number: I1
    """Number of the vehicle that was observed last."""
    observed_step: I1
    """Step of its newest observation; -1 before any."""
    unknown_until: I1
    """Step from which on a motion is over that another server has sent."""
    sent_step: I1
    """Step of the motion that was sent last and is not acknowledged."""
    repeats_for: I1
    """Steps after that up to which it is sent once more, see `Known.repeats`."""

    @classmethod
    def of(cls, capacity: int) -> Self:
        """Numbers of rows of which nothing is known."""
        ahead, number, sent_step, repeats_for = np.zeros((4, capacity), dtype=np.int64)
        met, heard = np.zeros((2, capacity), dtype=np.bool_)
        observed_step, unknown_until = np.full((2, capacity), -1, dtype=np.int64)
        return cls(ahead, met, heard, number, observed_step, unknown_until, sent_step, repeats_for)


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
        capacity: number of vehicles there can be.
        block: number of vehicles that are decided on at a time.
        references: where each vehicle wants to be, by its number.
        number_of: number of the vehicle in a row.
    """

    solve_ns = -1

    def __init__(
        self,
        scenario: Scenario,
        terms: Terms,
        capacity: int,
        block: int,
        references: Callable[[int], Reference],
        number_of: Callable[[int], int],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.left: list[tuple[int, float]] = []
        """Vehicles that have left their tube since this was emptied, and how far outside they were
        [m]."""
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        self.planned = np.zeros((block, terms.axes, 2))
        self._state = np.zeros((capacity, terms.axes, 2))
        self._rows: dict[int, Known] = {}
        """State of the vehicles, by row."""
        self._references, self._number_of = references, number_of
        goals = scenario.make_reference()
        self._absent = set(goals.vehicles) if isinstance(goals, Mission) else set[int]()
        """Numbers of vehicles on the mission that were not yet at rest where it begins."""
        mission = scenario.mission
        self._apart_m = mission.separation_m + 2.0 * mission.tube_m
        self._scale = np.ones(terms.axes)
        """Factors of the coordinates before distances of vehicles are taken; shape (axes,)."""
        self._scale[2:] = mission.height_scale
        bend_m = apart.bend_m(float(np.sqrt(terms.axes)) * mission.acceleration_mps2, terms.dt_s)
        self._tube_m, self._bend_m, self._dt_s = mission.tube_m, bend_m, terms.dt_s
        self._join = terms.join
        self._lead = -(-self._join // SPACING) * SPACING
        """Steps after the first knot from which on a motion differs from the one in force."""
        self._again = terms.age_max // 3
        """Steps after which a motion is sent again, before it is too old to be flown."""
        self._tau_s, self._braking = max(terms.tau_s), 2.0 * terms.brake_mps2
        """Time constant and deceleration with which it comes to rest without a motion [s, m/s²]."""
        self._plan = MotionPlan(terms, mission.acceleration_mps2, mission.speed_mps)
        self._zones = scenario.zones
        self._aims = Aims(
            self._zones,
            self._tube_m,
            self._apart_m + MARGIN_M,
            round(DETOUR_S / terms.dt_s),
            stream(scenario.seed, "together"),
        )
        self._now = 0
        """Step of a vehicle on no grid of its own."""
        self._vehicles = VehicleRows.of(capacity)
        """Numbers of all rows."""
        self.observed_step: Indices = self._vehicles.observed_step
        self._repeating: list[Known] = []
        """Vehicles that are sent a motion once more at this step."""
        self._looks, self._found, self._places = np.zeros((3, block), dtype=np.int64)
        """Scratch of `_meet`: what is to be done for each vehicle, DECIDES and REPEATS; steps by
        which it is ahead; and the step of each that is known to be on the grid."""
        self._flown = FlownMotions(self._scale, terms.dt_s)
        """All motions that may be flown, but for those of rows in `_changed`."""
        kept, keep_m = self._lead // SPACING + 1, self._apart_m + 2.0 * bend_m
        self._direct = Direct(self._plan, self._flown, kept, keep_m, STUCK)
        self._changed: set[int] = set()
        """Rows to gather anew: their motions that may be flown have changed, or the distance kept
        from these, or their place on the grid."""
        self._decided: set[int] = set()
        """Rows of the vehicles that have a motion to be sent at their newest step."""
        self._foreign: int | None = None
        """Row of a vehicle that may still fly a motion of another server; None of none."""

    def forget(self, row: int) -> None:
        """See `Scheme`; motions stay, for the vehicle goes on with them."""
        self.observed_step[row] = -1
        self._vehicles.heard[row] = False

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        if observation.step <= self.observed_step[row]:
            return False
        k = observation.step
        self.observed_step[row] = k
        self._state[row] = observation.state
        known = self._rows.setdefault(row, Known())
        self._vehicles.number[row] = self._number_of(row)
        if observation.in_force == NO_HORIZON:
            # It hovers, or comes to rest, where it is: nothing else was ever taken, or all ended.
            known.in_force = Sent(-1, resting(k, self._place(row, observation.state[:, 0])))
            if not observation.takes:
                known.sent.clear()
        elif known.in_force is None or known.in_force.step != observation.in_force:
            found = next((each for each in known.sent if each.step == observation.in_force), None)
            if found is None:  # of another server, or of a vehicle that was in this row before
                self._vehicles.unknown_until[row] = observation.in_force + LONGEST
                found = Sent(observation.in_force, resting(k, observation.state[:, 0]))
            known.in_force = found
        if k <= self._vehicles.unknown_until[row]:
            known.in_force = Sent(known.in_force.step, resting(k, observation.state[:, 0]))
        newest, motion = known.in_force
        self._measure(row, known, motion.at(np.array([float(k)]), self._dt_s)[0][0])
        while known.sent and (known.sent[0].step <= newest or known.sent[0].step + self._join < k):
            gone = known.sent.popleft()
            self.counts["horizons_lost"] += gone.step > newest
            known.learn(gone.step == newest and k <= observation.since + 1)
        self._vehicles.heard[row] = True
        self._note(row, known)
        return True

    def _note(self, row: int, known: Known) -> None:
        """Mark a row whose motions that may be flown, or be sent again, have changed."""
        self._changed.add(row)
        known.again = None
        self._vehicles.sent_step[row], self._vehicles.repeats_for[row] = known.repeats

    def _measure(self, row: int, known: Known, expected: Array) -> None:
        """Take note of how far a vehicle may be from where its motion has it."""
        number, state = self._number_of(row), self._state[row]
        assert known.in_force is not None
        off_m = float(np.linalg.norm(expected - state[:, 0])) - self._tube_m
        known.speed_mps = float(np.linalg.norm(state[:, 1]))
        if known.in_force.step < 0:  # it brakes, and rests further on than where it was seen
            off_m = max(off_m, known.speed_mps * (self._tau_s + known.speed_mps / self._braking))
        elif off_m <= 0.0:
            self._absent.discard(number)
        elif number not in self._absent:
            self.counts["left_tube"] += 1
            if not known.off_m:
                self.left.append((number, off_m))
        known.off_m = 0.0 if number in self._absent else max(off_m, 0.0)

    def _place(self, row: int, observed: Array) -> Array:
        """Resting place of a vehicle without a motion: where it begins its mission, or is."""
        number = self._number_of(row)
        if number not in self._absent:
            return observed
        first: Array = self._references(number)(np.zeros(()))[:, 0]
        return first if np.linalg.norm(first - observed) < self._tube_m else observed

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """Plan for vehicles every SPACING steps, not all at the same."""
        figures, n = self.figures, len(rows)
        self._meet(rows, step)
        figures[:n] = SILENT
        figures["row"][:n], figures["step"][:n], figures["start"][:n] = rows, step, step
        # By their numbers, so that vehicles take turns: a plan reckons with the motions decided
        # before it.
        for each in self._repeating:
            each.again = None
        self._repeating.clear()
        straight: list[Straight] = []
        looked_at = self._looks[:n].nonzero()[0].tolist()
        for i in looked_at:
            row, k = int(rows[i]), int(step[i])
            known = self._rows[row]
            if self._looks[i] & REPEATS:
                known.again = known.owed(k)
                self._repeating.append(known)
            if self._looks[i] & DECIDES:
                self._decide(row, known, k, straight)
        self._fly_straight(straight)
        for i in looked_at:
            known = self._rows[int(rows[i])]
            # A figure above any threshold: a motion that was found has to be sent.
            if known.next or known.again:
                figures["expected_gap"][i] = 1e9
            if known.next:
                self._decided.add(int(rows[i]))
        self.planned[:n] = self._state[rows]

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; the knots of what is sent."""
        for i in event.nonzero()[0].tolist():
            known, k = self._rows[int(rows[i])], int(step[i])
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
                known.sent.append(Sent(k, motion))
                self._note(int(rows[i]), known)

    # -- zones -------------------------------------------------------------------------------------

    def change_zones(self, zones: Zones) -> None:
        """Keep out of other zones from now on, to which `objection` has nothing to say."""
        self._zones = zones
        self._aims.change_zones(zones)

    def objection(self, zones: Zones) -> str:
        """Why there cannot be these zones: where a vehicle may fly into one; empty: there can."""
        for number in sorted(self._absent):
            first = self._references(number)(np.zeros(1))[:, :, 0]
            if zone := zones.in_the_way(first, self._tube_m):
                return f"{zone}, in which vehicle {number} is to begin, tube included"
        for row, known in self._rows.items():
            for motion in known.motions():
                k = self._now + int(self._vehicles.ahead[row])
                points, _ = motion.at(apart.pieces_of(k, motion.last), self._dt_s)
                if zone := zones.in_the_way(points, self._tube_m + self._bend_m):
                    left_s = max(motion.last - k, 0) * self._dt_s
                    does = f"may fly into for {left_s:.1f} s more" if left_s else "hovers in"
                    return f"{zone}, which vehicle {self._number_of(row)} {does}, tube included"
        return ""

    def waits(self, row: int) -> str:
        """Reason why a vehicle waits; empty if it does not."""
        return self._rows[row].waits if row in self._rows else ""

    # -- what is decided ---------------------------------------------------------------------------

    def _meet(self, rows: Indices, step: Indices) -> None:
        """Bring the steps of all vehicles onto one grid; nothing is to be sent yet."""
        n = len(rows)
        self._now, moved, foreign = _meet(
            rows, step, self._now, self._vehicles, self._looks, self._found, self._places
        )
        if moved:
            self._changed.update(rows[self._found[:n] != 0].tolist())
        if self._decided:
            for row in self._decided.intersection(rows.tolist()):
                self._rows[row].next = None
                self._changed.add(row)
                self._decided.remove(row)
        self._foreign = None if foreign < 0 else foreign

    def _gather(self) -> None:
        """Bring all motions that may be flown side by side, those that are others since then."""
        for row in self._changed & self._rows.keys():
            each = self._rows[row]
            # All that may be flown, also those whose acknowledgement is still under way.
            self._flown.replace(row, each.motions(), int(self._vehicles.ahead[row]), each.off_m)
        self._changed.clear()

    def _decide(self, row: int, known: Known, k: int, straight: list[Straight]) -> None:
        """Find the motion to be sent to a vehicle now, if any.

        Args:
            row, known: the vehicle.
            k: its step.
            straight: takes the vehicles that may fly straight, to be planned for together.
        """
        known.waits = ""
        if self._plans(known, k):
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
        if self._absent:
            known.waits = f"vehicle {min(self._absent)} to begin"
            return False
        if self._foreign is not None:
            known.waits = f"vehicle {self._number_of(self._foreign)}, of another server's motion"
            return False
        return True

    def _fly_on(self, row: int, known: Known, k: int, straight: list[Straight]) -> None:
        """Find a motion to a vehicle's goal, or to where it steps aside; see `_decide`."""
        assert known.in_force is not None
        home = self._goal(row)
        if known.aside and (self._now > known.aside.until or not self._to_pass(known.aside, home)):
            known.aside = None
        goal = known.aside.place if known.aside else home
        place = known.in_force.motion.position[-1]
        if max(map(abs, map(sub, place.tolist(), goal.tolist()))) < ARRIVED_M:
            known.turned = 0.0
            if known.aside:
                known.waits = f"vehicle {self._number_of(known.aside.asker)} to pass"
            return
        self._gather()
        way = self._way(row, goal) if self._zones else np.array([place, goal])
        is_stuck = known.is_stuck(k, goal, sum(map(math.dist, way[:-1], way[1:])))
        roams = known.turned or known.aside or (known.detour and k < known.detour_until)
        if not (is_stuck or roams or self._zones):
            straight.append(Straight(row, known, k, goal))
            return
        # A plan reckons with all that were decided before it.
        self._fly_straight(straight)
        if is_stuck:
            self._ask(row, way)
        self._find(row, known, k, goal)

    def _fly_straight(self, straight: list[Straight]) -> None:
        """Find motions of vehicles that may fly straight, one after the other; none are left."""
        while straight:
            rows, steps = np.array([(each.row, each.k) for each in straight]).T.copy()
            goals = np.array([each.goal for each in straight])
            found = self._direct.motions(rows, steps, self._vehicles.ahead[rows], goals)
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
            self._flown.add(row, known.next, int(self._vehicles.ahead[row]), known.off_m)

    def _goal(self, row: int) -> Array:
        """Goal of a vehicle at the present step [m]; shape (axes,)."""
        k = self._now + int(self._vehicles.ahead[row])
        wanted = self._references(self._number_of(row))(np.array(k * self._dt_s))
        return np.ascontiguousarray(wanted[:, 0])  # kernels reckon with that

    def _way(self, row: int, goal: Array) -> Array:
        """Way around zones to a goal from where a vehicle comes to rest, that place first [m]."""
        known = self._rows[row].in_force
        assert known is not None
        place = known.motion.position[-1]
        return np.concatenate([place[None], self._aims.routes.way(place, goal)])

    def _to_pass(self, left: Aside, home: Array) -> bool:
        """Whether a vehicle has yet to pass the place that one has left for it."""
        way = self._way(left.asker, self._goal(left.asker)) * self._scale
        return bool(aside.off_way(home[None] * self._scale, way)[0] < self._apart_m + MARGIN_M)

    def _ask(self, row: int, way: Array) -> None:
        """Ask the first vehicle that rests at its goal in another vehicle's way to step aside."""
        keep_m, ends, homes = self._apart_m + MARGIN_M, list[tuple[int, Array]](), list[int]()
        for other, each in self._rows.items():
            if other == row or each.in_force is None or not self._vehicles.met[other]:
                continue
            flown = each.motions()
            ends += [(other, motion.position[-1]) for motion in flown]
            rests = each.in_force.step >= 0 and len(flown) == 1 and each.aside is None
            if rests and np.abs(flown[0].position[-1] - self._goal(other)).max() < ARRIVED_M:
                homes.append(other)
        places = np.array([self._goal(other) for other in homes]).reshape(-1, way.shape[1])
        first = aside.first_on(way * self._scale, places * self._scale, keep_m)
        if first is None:
            return
        asked, others = homes[first], [end for other, end in ends if other != homes[first]]
        free = aside.place(
            places[first],
            way,
            np.array([way[0], *others]),
            keep_m,
            self._scale,
            self._zones,
            self._aims.routes,
            self._tube_m + MARGIN_M,
        )
        if free is not None:
            self.counts["asides"] += 1
            until = self._now + round(ASIDE_S / self._dt_s)
            self._rows[asked].aside = Aside(free, row, until)

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
        planes, taken = None, np.zeros(self._flown.count + 1, dtype=np.bool_)
        for aim in self._aims.of(known, k, p0, goal, partial(self._rests, row)):
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
            self.counts["refused"] += bool(hit.any())
        return None

    def _rests(self, row: int) -> list[Array]:
        """Resting places of all vehicles but one [m]."""
        found = []
        for other, each in self._rows.items():
            motions, now = each.motions(), self._now + self._vehicles.ahead[other]
            if other != row and motions and all(motion.last <= now for motion in motions):
                found.append(motions[0].position[-1])
        return found

    def _planes(self, row: int, base: Motion, due: int) -> HalfPlanes:
        """Half-planes of the others' motions, and behind them those of zones."""
        plan, ahead = self._plan, self._vehicles.ahead[row]
        times = due + plan.times * SPACING
        held, _ = base.at(times, self._dt_s)
        found = apart.half_planes(
            times - ahead,
            held,
            plan.reach_m,
            row,
            self._flown,
            self._apart_m + MARGIN_M + self._rows[row].off_m,
        )
        if not self._zones:
            return found
        near = self._zones.planes(held, plan.reach_m + self._tube_m + MARGIN_M)
        # A vehicle that is nearer to a zone already need only come no nearer.
        least = np.minimum(self._tube_m + MARGIN_M, near.away_m - 1e-4)
        least += np.einsum("ij,ij->i", near.normal, near.border)
        return HalfPlanes(
            np.concatenate([found.at, near.at]),
            np.concatenate([found.normal, near.normal]),
            np.concatenate([found.least, least]),
            np.concatenate([found.of, np.full(len(near.at), self._flown.count)]),
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
        if most == self._flown.count:
            return "a zone"
        return f"vehicle {self._number_of(int(self._flown.of[most]))}"

    def _hit(self, row: int, motion: Motion, k: int) -> Flags:
        """Which motions of others one comes too near to, ever, and last whether it does a zone."""
        known, ahead = self._rows[row], int(self._vehicles.ahead[row])
        assert known.in_force is not None
        common, base = (
            each._replace(first=each.first - ahead) for each in (motion, known.in_force.motion)
        )
        keep_m = self._apart_m + 2.0 * self._bend_m + known.off_m
        hit = apart.too_near(common, base, k - ahead, row, self._flown, keep_m)
        if self._zones:
            points, _ = motion.at(apart.pieces_of(k, motion.last), self._dt_s)
            hit[-1] = (self._zones.along(points) < self._tube_m + self._bend_m).any()
        return hit


@making_kernel
def _meet(
    rows: I1,
    step: I1,
    now: int,
    vehicles: VehicleRows,
    looks: I1,
    found: I1,
    places: I1,
) -> tuple[int, int, int]:
    """Bring vehicles onto one grid, and find what is to be done for each.

    Args:
        rows, step: the vehicles, and the step of each; shape (n,).
        now: step on the grid before, of a vehicle on no grid of its own.
        vehicles: numbers of all rows.
        looks: output: DECIDES, REPEATS, both or 0; shape (n,) at least.
        found: output: change of the place on the grid [steps]; shape (n,) at least.
        places: scratch; shape (n,) at least.

    Returns:
        the step on the grid now, the number of vehicles whose place on it has changed, and the row
        of a vehicle that may still fly a motion of another server, or -1.
    """
    known, moved, foreign = 0, 0, -1
    for i in range(len(rows)):
        row = rows[i]
        if vehicles.met[row]:
            places[known] = step[i] - vehicles.ahead[row]
            known += 1
    # The median, for one vehicle that begins anew must not move the grid of all others.
    now = np.sort(places[:known])[known // 2] if known else now + 1
    for i in range(len(rows)):
        row = rows[i]
        found[i] = step[i] - now - vehicles.ahead[row]
        moved += found[i] != 0
        vehicles.ahead[row], vehicles.met[row] = step[i] - now, True
        looks[i] = 0
        if vehicles.heard[row] and (step[i] - vehicles.number[row]) % SPACING == 0:
            looks[i] |= DECIDES
        if repeats_after(step[i] - vehicles.sent_step[row], vehicles.repeats_for[row]):
            looks[i] |= REPEATS
    for row in range(len(vehicles.heard)):
        if (
            foreign < 0
            and vehicles.heard[row]
            and vehicles.observed_step[row] <= vehicles.unknown_until[row]
        ):
            foreign = row
    return now, moved, foreign
