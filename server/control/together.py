"""Motions that keep vehicles apart, whichever packets are lost.

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
from its motion (wind, tracking, clocks). Those were apart already. So whichever of them are taken,
and whichever packets are lost, vehicles are `separation_m` apart, as long as each stays in its tube
(docs/together.md has the theorem). The motion in force is always a way out: it needs no packet.

Until `join_s` a new motion is the one in force, so it joins it wherever it is taken. From there on
it is planned as a QP over the accelerations a_n between knots T apart, for n = 0 … N-1,

    min  Σ w_n |p_n - g|² + r Σ |a_n|²     v_N = 0,  |v_n + τ a_n| ≤ u,  |a_n| ≤ a_max

with g the goal, and a half-plane for each motion that may be flown and each time t,

    n(t) · (p(t) - q(t)) ≥ D     n(t) = (p̃(t) - q(t)) / |p̃(t) - q(t)|

where q is that motion and p̃ the one in force. The motion in force fulfils all of them, so there is
always a solution. A vehicle that comes no nearer to its goal aims to the right of it instead, ever
further round, and then in directions that are drawn: so those that meet pass each other.
"""

from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from skytether.server.control.dual import DualSolver
from skytether.server.control.planner import FIGURES, Figures
from skytether.server.control.scheme import Foresight
from skytether.shared.base.chance import stream
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.motion import INTERVALS, JOIN_MAX, SPACING, Motion, resting
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reference import Mission, Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.wire.protocol import KNOTS_MAX, NO_HORIZON, Observation

LONGEST = (INTERVALS + JOIN_MAX) * SPACING
"""Steps that a motion takes at most."""
SUB = 2
"""Number of times in each interval at which distances are kept."""
MARGIN_M = 0.03
"""By how much more than D motions are planned apart: between those times, and for the solver's
tolerance [m]."""
ACCELERATION_MPS2 = 0.6
"""Largest acceleration on an axis, a_max [m/s²]."""
SHARE = 0.9
"""Share of the bound of the input that a motion may use."""
SMOOTH = 0.05
"""Weight r on accelerations [s⁴]."""
LAST = 5.0
"""Weight w_N on the last position; the others are 1."""
BEGINS_M = 2.0
"""Distance from its first goal within which a vehicle is sent there to begin [m]."""
ARRIVED_M = 0.02
"""Distance from the goal at which a motion ends there [m]."""
AIM_M = 3.0
"""Distance of what is aimed at in place of the goal [m]."""
TURN, TURN_MAX, TURN_BACK = 0.5, 2.8, 0.8
"""By how much further round a vehicle aims that is stuck, how far at most before directions are
drawn, and by how much less once it moves [rad]."""
STUCK = 0.3
"""Share of the way to the goal, 2 m at most, below which a plan is taken for stuck."""


class Sent(NamedTuple):
    """A motion that was sent."""

    step: int
    """Step of its packet."""
    motion: Motion


class Known:
    """What is known of one vehicle."""

    def __init__(self) -> None:
        self.in_force: Sent | None = None
        """Motion that it flies, with its packet's step; None before the first observation."""
        self.sent: deque[Sent] = deque(maxlen=64)
        """Motions sent after that, oldest first, that may still be taken."""
        self.next: Motion | None = None
        """Motion to be sent at this step."""
        self.turned = 0.0
        """Angle by which it aims to the right of its goal [rad]."""
        self.heard = False
        """Whether an observation has come in this session."""
        self.unknown_until = -1
        """Step from which on a motion is over that another server has sent."""

    def motions(self) -> list[Motion]:
        """All that may be flown, the one to be sent at this step included."""
        flown = [self.in_force.motion] if self.in_force else []
        flown += [each.motion for each in self.sent]
        return [*flown, self.next] if self.next else flown


class Together:
    """The scheme "trajectory" for missions: motions that keep apart.

    Args:
        scenario: `control.separation_m` and `tube_m`, and the seed of directions that are drawn.
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
        self.observed_step: Indices = np.full(capacity, -1, dtype=np.int64)
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        self.planned = np.zeros((block, terms.axes, 2))
        self._state = np.zeros((capacity, terms.axes, 2))
        self._rows = [Known() for _ in range(capacity)]
        self._references, self._number_of = references, number_of
        mission = scenario.make_reference()
        self._vehicles = len(mission.vehicles) if isinstance(mission, Mission) else 0
        """Number of vehicles on the mission."""
        self._met: set[int] = set()
        """Numbers of those that were at rest where the mission begins."""
        control = scenario.control
        self._apart_m = control.separation_m + 2.0 * control.tube_m
        self._tube_m, self._dt_s = control.tube_m, terms.dt_s
        self._join = terms.join
        self._lead = -(-self._join // SPACING) * SPACING
        """Steps after the first knot from which on a motion differs from the one in force."""
        self._again = terms.age_max // 3
        """Steps after which a motion is sent again, before it is too old to be flown."""
        self._plan = Plan(terms)
        self._rng = stream(scenario.seed, "together")
        self._now, self._ahead = 0, dict[int, int]()
        """Step of a vehicle on no grid of its own, and how far ahead of it each row's is."""

    def forget(self, row: int) -> None:
        """See `Scheme`; motions stay, for the vehicle goes on with them."""
        self.observed_step[row] = -1
        self._rows[row].heard = False

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        if observation.step <= self.observed_step[row]:
            return False
        k = observation.step
        self.observed_step[row] = k
        self._state[row] = observation.state
        known = self._rows[row]
        if observation.in_force == NO_HORIZON:
            # It hovers, or comes to rest, where it is: nothing else was ever taken, or all ended.
            known.in_force = Sent(-1, resting(k, self._place(row, observation.state[:, 0])))
            if not observation.takes:
                known.sent.clear()
        elif known.in_force is None or known.in_force.step != observation.in_force:
            found = next((each for each in known.sent if each.step == observation.in_force), None)
            if found is None:  # of another server, or of a vehicle that was in this row before
                known.unknown_until = observation.in_force + LONGEST
                found = Sent(observation.in_force, resting(k, observation.state[:, 0]))
            known.in_force = found
        if k <= known.unknown_until:
            known.in_force = Sent(known.in_force.step, resting(k, observation.state[:, 0]))
        newest, motion = known.in_force
        p, _ = motion.at(np.array([float(k)]), self._dt_s)
        is_within = bool(np.linalg.norm(p[0] - observation.state[:, 0]) <= self._tube_m)
        if is_within and newest >= 0:
            self._met.add(self._number_of(row))
        elif not is_within and self._number_of(row) in self._met:
            self.counts["left_tube"] += 1
        while known.sent and (known.sent[0].step <= newest or known.sent[0].step + self._join < k):
            gone = known.sent.popleft()
            self.counts["horizons_lost"] += gone.step > newest
        known.heard = True
        return True

    def _place(self, row: int, observed: Array) -> Array:
        """Where a vehicle without a motion rests: where the mission begins, unless it has begun."""
        number = self._number_of(row)
        if number in self._met:
            return observed
        first: Array = self._references(number)(np.zeros(()))[:, 0]
        return first if np.linalg.norm(first - observed) < BEGINS_M else observed

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """Plan for vehicles whose step is a multiple of SPACING."""
        figures = self.figures
        steps = dict(zip(rows.tolist(), step.tolist(), strict=True))
        self._meet(steps)
        figures["row"][: len(rows)], figures["step"][: len(rows)] = rows, step
        figures["start"][: len(rows)], figures["gap"][: len(rows)] = step, 1
        figures["solved"], figures["fresh"] = True, False
        for name in ("state_gap", "expected_gap", "cost_gap", "deviation_m"):
            figures[name] = 0.0
        for i, (row, k) in enumerate(steps.items()):
            known = self._rows[row]
            if known.in_force is not None and known.heard and k % SPACING == 0:
                self._decide(row, known, k)
            at = known.in_force.motion if known.in_force else resting(k, self._state[row, :, 0])
            p, v = at.at(np.array([float(k)]), self._dt_s)
            self.planned[i, :, 0], self.planned[i, :, 1] = p[0], v[0]
            if known.next is not None:
                figures["expected_gap"][i] = 1e9

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; the knots of what is sent."""
        for i in event.nonzero()[0].tolist():
            known, k = self._rows[int(rows[i])], int(step[i])
            motion = known.next
            if motion is None:
                assert known.in_force is not None
                motion = known.in_force.motion
            count = min(max((motion.last - k) // SPACING, 0) + 1, KNOTS_MAX)
            p, v = motion.at(k + SPACING * np.arange(count, dtype=np.float64), self._dt_s)
            knots = np.stack([p, v], axis=-1).transpose(1, 0, 2).reshape(p.shape[1], -1)
            found.told.knots[i, :, : 2 * count] = knots
            found.told.number[i], found.told.spacing[i] = count, SPACING
            known.sent.append(Sent(k, motion))

    def _meet(self, steps: dict[int, int]) -> None:
        """Take note of how far ahead of the others the steps of vehicles are."""
        known = [k - self._ahead[row] for row, k in steps.items() if row in self._ahead]
        self._now = int(np.median(known)) if known else self._now + 1
        self._ahead |= {row: k - self._now for row, k in steps.items()}
        for row in steps:
            self._rows[row].next = None

    # -- what is decided ---------------------------------------------------------------------------

    def _decide(self, row: int, known: Known, k: int) -> None:
        """Find the motion to be sent to a vehicle now, if any."""
        base = known.in_force
        assert base is not None
        if known.sent:
            return  # whether that was taken is not known yet
        if base.step < 0:
            known.next = base.motion  # it has none: first of all the place where it hovers
            return
        if k - base.step > self._again:
            known.next = base.motion  # or it would end aboard, and the vehicle drift
            return
        if len(self._met) < self._vehicles:
            return  # the mission begins once all are where it begins
        if any(each.heard and self._is_unknown(row, each) for row, each in enumerate(self._rows)):
            return
        sample = self._references(self._number_of(row))
        goal = sample(np.array(k * self._dt_s))[:, 0]
        if np.abs(base.motion.position[-1] - goal).max() < ARRIVED_M:
            known.turned = 0.0
            return
        others = self._others(row, k)
        found = self._toward(base.motion, known, k, goal, others)
        if found is None:
            self.counts["unsolved"] += 1
        elif self._is_apart(found, k, others):
            known.next = found
        else:
            self.counts["refused"] += 1

    def _is_unknown(self, row: int, known: Known) -> bool:
        """Whether a vehicle still flies a motion that this server does not know."""
        return self.observed_step[row] <= known.unknown_until

    def _others(self, row: int, k: int) -> list[tuple[Motion, int]]:
        """Motions of others that may be flown, and by how many steps they are ahead."""
        found = []
        for other, known in enumerate(self._rows):
            if other == row or known.in_force is None:
                continue
            theirs = self._now + self._ahead.get(other, 0)
            found += [(each, theirs - k) for each in known.motions()]
        return found

    def _toward(
        self, base: Motion, known: Known, k: int, goal: Array, others: list[tuple[Motion, int]]
    ) -> Motion | None:
        """A motion from the one in force towards a goal; None where no solution is found."""
        dt_s, plan = self._dt_s, self._plan
        due = k + self._lead
        (p0,), (v0,) = base.at(np.array([float(due)]), dt_s)
        times = due + plan.times * SPACING
        held, _ = base.at(times, dt_s)
        normals, offsets, places = [], [], []
        for motion, shift in others:
            q, _ = motion.at(times + shift, dt_s)
            off = held - q
            away = np.linalg.norm(off, axis=1)
            near = np.flatnonzero(away < self._apart_m + MARGIN_M + plan.reach_m)
            if not len(near):
                continue
            n = off[near] / away[near, None]
            least = np.minimum(self._apart_m + MARGIN_M, away[near] - 1e-4)
            places.append(near)
            normals.append(n)
            offsets.append(least + np.einsum("ij,ij->i", n, q[near]))
        aim = goal
        way = goal - p0
        far = float(np.linalg.norm(way))
        if known.turned and far > 1e-9:
            c, s = np.cos(-known.turned), np.sin(-known.turned)
            ahead = way[:2] / max(float(np.linalg.norm(way[:2])), 1e-9)
            aim = p0.copy()
            aim[:2] += min(far, AIM_M) * np.array(
                [c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]]
            )
        planes = (
            (np.concatenate(places), np.concatenate(normals), np.concatenate(offsets))
            if places
            else None
        )
        solved = plan.solve(p0, v0, aim, planes)
        if solved is None:
            return None
        p, v = solved
        moved = float(np.linalg.norm(p[-1] - p0))
        if moved < STUCK * min(far, 2.0):
            known.turned += TURN
            if known.turned > TURN_MAX:
                known.turned = float(self._rng.uniform(0.3, TURN_MAX))
        else:
            known.turned = max(0.0, known.turned - TURN_BACK)
        before = np.arange(k, due, SPACING, dtype=np.float64)
        kept_p, kept_v = base.at(before, dt_s)
        return Motion(k, np.concatenate([kept_p, p]), np.concatenate([kept_v, v]))

    def _is_apart(self, motion: Motion, k: int, others: list[tuple[Motion, int]]) -> bool:
        """Whether a motion keeps its distance from all others, for ever."""
        for other, shift in others:
            last = max(motion.last, other.last - shift)
            steps = np.arange(k, last + SPACING, SPACING / (2 * SUB))
            p, _ = motion.at(steps, self._dt_s)
            q, _ = other.at(steps + shift, self._dt_s)
            if np.linalg.norm(p - q, axis=1).min() < self._apart_m:
                return False
        return True


Planes = tuple[Indices, Array, Array]
"""Times, by index; normals; and least values of normal · position [m]."""


class Plan:
    """The QP of one motion."""

    def __init__(self, terms: Terms) -> None:
        n, axes = INTERVALS, terms.axes
        T = SPACING * terms.dt_s
        tau_s, gain = np.array(terms.tau_s), np.array(terms.gain)
        most = SHARE * np.array(terms.u_max) * gain
        place = np.arange(n)
        self._to_velocity = T * np.tril(np.ones((n, n)))
        self._to_position = _positions(np.arange(1.0, n + 1.0), place, T)
        self.times: Array = np.arange(n * SUB + 1) / SUB
        """Times at which distances are kept, in intervals from where the plan begins."""
        self._to_sample = _positions(self.times, place, T)
        self._weights = np.ones(n)
        self._weights[-1] = LAST
        hessian = self._to_position.T @ (self._weights[:, None] * self._to_position)
        self._solver = DualSolver(np.kron(np.eye(axes), hessian + SMOOTH * np.eye(n)))
        # The input at the end of each interval, and at its begin: v ± within what it can do.
        ends = [self._to_velocity + tau_s[x] * np.eye(n) for x in range(axes)]
        before = np.vstack([np.zeros(n), self._to_velocity[:-1]])
        begins = [before + tau_s[x] * np.eye(n) for x in range(axes)]
        both = np.vstack([np.eye(n * axes), _blocks(ends), _blocks(begins)])
        self._fixed = np.vstack([_blocks([self._to_velocity[-1:]] * axes), both, -both])
        self._most, self._axes, self._T = most, axes, T
        passed_s = self.times * T
        along_m = np.minimum(ACCELERATION_MPS2 * passed_s**2, 2.0 * most.max() * passed_s)
        self.reach_m = np.sqrt(axes) * along_m
        """How far apart two motions from one state may be at those times [m]."""

    def solve(
        self, p0: Array, v0: Array, goal: Array, planes: Planes | None
    ) -> tuple[Array, Array] | None:
        """Positions and velocities of the knots from a state on, that state first; None of none.

        Args:
            p0, v0: where it begins [m, m/s]; shape (axes,).
            goal: where it shall be [m]; shape (axes,).
            planes: see there.
        """
        n, axes, T = INTERVALS, self._axes, self._T
        free = p0 + np.arange(1, n + 1)[:, None] * T * v0
        linear = (self._to_position.T @ (self._weights[:, None] * (free - goal))).T.ravel()
        a = np.full(n * axes, ACCELERATION_MPS2)
        most, v = np.repeat(self._most, n), np.repeat(v0, n)
        low = [-v0, -a, -most - v, -most - v, -a, v - most, v - most]
        rows = [self._fixed]
        if planes is not None:
            at, normal, least = planes
            rows.append(
                np.concatenate([normal[:, [x]] * self._to_sample[at] for x in range(axes)], axis=1)
            )
            drifting = p0 + self.times[at][:, None] * T * v0
            low.append(least - np.einsum("ij,ij->i", normal, drifting))
        x = self._solver.solve(-linear, np.vstack(rows), np.concatenate(low), axes)
        if x is None:
            return None
        found = x.reshape(axes, n).T
        velocity = np.vstack([v0, v0 + self._to_velocity @ found])
        velocity[-1] = 0.0
        # Positions of what is flown: that velocity, whatever the solver's tolerance has left.
        steps = 0.5 * T * (velocity[1:] + velocity[:-1])
        position = np.vstack([p0, p0 + np.cumsum(steps, axis=0)])
        return position, velocity


def _positions(times: Array, place: Indices, T: float) -> Array:
    """Position by accelerations of intervals at times, in intervals [s²]; shape (times, n)."""
    into = np.clip(times[:, None] - place, 0.0, None)
    inside = np.minimum(into, 1.0)
    moved: Array = T * T * (0.5 * inside**2 + inside * (into - inside))
    return moved


def _blocks(parts: list[Array]) -> Array:
    """Matrix with these along its diagonal."""
    rows, columns = (sum(each.shape[axis] for each in parts) for axis in (0, 1))
    whole, row, column = np.zeros((rows, columns)), 0, 0
    for each in parts:
        whole[row : row + len(each), column : column + each.shape[1]] = each
        row, column = row + len(each), column + each.shape[1]
    return whole
