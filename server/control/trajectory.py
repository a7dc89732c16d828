"""Trajectories: the vehicle is told the desired trajectory, and which one it holds is estimated.

No plan is made. What is sent at step k is the desired trajectory from there on, as far as the
server sees ahead, as a spline with as few uniform knots as keep within `control.spline_error_m` of
it (`shared.law.spline`); where the server sees nothing ahead that is one knot, the state of the
target at k. An inner knot has the mean velocity about it: that of the knot alone would make the
input of a target that moves at random swing. The vehicle regulates itself along the spline, so all
that is known of the vehicle is its newest observation.

Which trajectory it follows is not certain: every observation acknowledges the one in force, and
those sent since may be on their way, or lost. With the share ℓ of losses and the share S(t) of
delays longer than t, both as measured, one that was sent t before an observation that does not know
of it will come with the probability

    π = (1 - ℓ) S(t) / ((1 - ℓ) S(t) + ℓ)

and from the delay bound d on it is lost (`server.control.delay`). The newest that comes is the one
that is followed. So the expected gap is

    E[ Q_p Σ (Δp + h Δv)² ]          Δp, Δv: trajectory followed - the one known now

over the axes and these cases, with the weight Q_p on the position [1/m²] and h = (1 + K_v) / K_p,
the time by which the regulator itself weighs the two: K_p (Δp + h Δv) is by how much the input
would be another. It is the mean of that at k + d, when a packet of now is in force at the latest,
k + 2 d, when it is known whether it came, and k + 3 d, when one that is sent then would be: looking
at k + d alone, a trajectory that ends is replaced too late if a packet is lost. Where nothing has
come into force the vehicle hovers where it was observed.

This is the scheme "trajectory", and stands in place of its planner.
"""

from collections import Counter
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.control import delay
from skytether.server.control.clock import ClockMap, Seen, half_trip_ns, shortest_ns
from skytether.server.control.committed import LEARNED, LOSS, MARGIN
from skytether.server.control.delay import SAMPLES, DelayBound, acknowledge, at_least, begin
from skytether.server.control.desired import Desired, Window
from skytether.server.control.planner import FIGURES, Figures
from skytether.server.control.scheme import Foresight, Splines
from skytether.shared.base.kernel import (
    B1,
    F1,
    F2,
    F3,
    F4,
    I1,
    S2,
    inline,
    kernel,
    part,
    record,
    records,
    shared,
)
from skytether.shared.law import spline
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import KNOTS_MAX, NO_HORIZON, Observation, committed_max

ROOM = 64
"""Number of trajectories that are remembered of each vehicle: the newest that were sent."""
CHANCES = 3
"""Number of delay bounds ahead at whose ends trajectories are compared."""
SURE = 1e-3
"""Probability below which what is left of the cases is not looked at."""
TINY = 1e-9
"""Smallest K_p, for weights that ask for none [1/s]."""
INTERVALS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, KNOTS_MAX - 1])
"""Numbers of intervals between knots that are tried, fewest first."""

spline_at, along = shared(spline.spline_at), shared(spline.along)
shared(spline.guided), shared(spline.guided_to)
follow = shared(spline.follow)
"""The rule of flight along a spline, compiled for kernels."""


class Followed:
    """Record: what is known of one vehicle."""

    in_force: int
    """Step that the trajectory in force at its newest observation was made for, or NO_HORIZON."""
    since: int
    """First step flown with it."""
    acknowledged: int
    """Step that the trajectory last seen to have come into force was made for, or NO_HORIZON."""
    judged: int
    """Step up to which trajectories were seen in force, lost or overtaken."""
    sent: int
    """Number of trajectories sent so far."""
    first: int
    """Number of the first that may be held: those before were dropped aboard."""
    loss: float
    """Share of trajectories that were lost lately, ℓ."""


class Sent:
    """Record: a trajectory that was sent."""

    step: int
    """Step k of its first knot."""
    due: int
    """Step at which it is in force, or lost."""
    ends: int
    """Step after the last at which it is flown."""
    spacing: int
    """Steps from one knot to the next."""
    count: int
    """Number of its knots."""


VEHICLE, SENT = record(Followed), record(Sent)


class Settings(NamedTuple):
    """What is the same for all vehicles."""

    dt_ns: int
    """Length of a step [ns]."""
    dt_s: float
    """Length of a step [s]."""
    age_max: int
    """Largest age of an observation that counts [steps]."""
    seen: int
    """Steps that the server sees ahead, H at most."""
    bounds: F1
    """Largest velocity on each axis [m/s]; shape (axes,)."""
    weight: float
    """Weight Q_p on the position [1/m²]."""
    lead_s: F1
    """Time h of each axis [s]; shape (axes,)."""
    error_m: float
    """Largest distance of a spline from what is seen on an axis, if its knots suffice [m]."""


class Memory(NamedTuple):
    """What is known of every vehicle, and what it was sent."""

    observed: I1
    """Step of the newest observation, or -1; shape (capacity,)."""
    vehicles: Annotated[NDArray[np.void], records(VEHICLE, 1)]
    """Shape (capacity,)."""
    state: F3
    """State in the newest observation [m, m/s]; shape (capacity, axes, 2)."""
    sent: Annotated[NDArray[np.void], records(SENT, 2)]
    """Trajectories that were sent, a ring; shape (capacity, ROOM)."""
    knots: F4
    """Their knots as they are read aboard [m, m/s]; shape (capacity, ROOM, axes, 2 KNOTS_MAX)."""


class Guidance:
    """The `Scheme` "trajectory" for up to `capacity` vehicles, and what is sent to them.

    Args:
        terms: the rule of flight.
        control: weights and `delay_bound`.
        gain: K of the regulator aboard; shape (axes, 2).
        desired: what the server knows of the desired trajectories.
        clock: knows half of the smallest round trip, which is a first guess at the delay bound.
        block: number of vehicles that are decided on at a time.
    """

    solve_ns = -1
    """See `server.control.planner.Planner`: there is nothing to solve."""

    def __init__(
        self,
        terms: Terms,
        control: ControlConfig,
        gain: Array,
        desired: Desired,
        clock: ClockMap,
        capacity: int,
        block: int,
    ) -> None:
        axes, given = terms.axes, control.delay_bound
        self.counts: Counter[str] = Counter()
        self._desired, self._clock = desired, clock
        self._loop_gain = np.array(terms.gain)
        self._settings = Settings(
            dt_ns=terms.dt_ns,
            dt_s=terms.dt_s,
            age_max=terms.age_max,
            seen=desired.seen,
            bounds=self._loop_gain * terms.u_max,
            weight=control.state_weight[0],
            lead_s=(1.0 + gain[:, 1]) / np.maximum(gain[:, 0], TINY),
            error_m=control.spline_error_m,
        )
        self._memory = Memory(
            observed=np.full(capacity, -1, dtype=np.int64),
            vehicles=np.zeros(capacity, dtype=VEHICLE),
            state=np.zeros((capacity, axes, 2)),
            sent=np.zeros((capacity, ROOM), dtype=SENT),
            knots=np.zeros((capacity, ROOM, axes, 2 * KNOTS_MAX)),
        )
        fixed_s = None if given == "auto" else given
        self.delay_bound = delay.delay_bound(capacity, terms.dt_s, committed_max(terms), fixed_s)
        self.observed_step: Indices = self._memory.observed
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        self.figures: Figures = np.zeros(block, dtype=FIGURES)
        """What flying on would cost; those of a block come first."""
        self.planned = np.zeros((block, axes, 2))
        """States at k of the trajectories sent last [m, m/s]; shape (block, axes, 2)."""
        self._now = np.zeros((block, axes, 2))
        """Desired states at k, with velocities within the bounds [m, m/s]."""
        self._window: Window | None = None
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        self._memory.observed[row] = -1
        self._memory.vehicles[row] = (NO_HORIZON, 0, NO_HORIZON, -1, 0, 0, LOSS)
        delay.forget(self.delay_bound, row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`; a vehicle that takes nothing holds nothing either."""
        known = self._memory.vehicles[row]
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        known["in_force"], known["since"] = observation.in_force, observation.since
        self._memory.state[row] = observation.state
        if not observation.takes:
            known["first"], known["in_force"] = known["sent"], NO_HORIZON
        return True

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._memory.state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in `figures` and `planned`, and the desired state of now in place of a plan.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is filled in.
        """
        self._window = self._desired.window(rows, step, found.ahead)
        lost = _appraise(
            self._settings,
            self._memory,
            self.delay_bound,
            self._clock.seen,
            self._window,
            rows,
            step,
            self.figures,
            self.planned,
            self._now,
        )
        if lost:
            self.counts["horizons_lost"] += lost
        n = len(rows)
        found.horizons[:n, :, 0] = self._now[:n, :, 1] / self._loop_gain

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what is sent is made, and counts."""
        window, bound = self._window, self.delay_bound
        assert window is not None
        _remember(self._settings, self._memory, bound, window, rows, step, event, found.told)


@inline
def _known(settings: Settings, desired: F2, stage: int, axis: int) -> tuple[float, float]:
    """Desired state at a stage on one axis as it would be told, position [m] and velocity [m/s].

    Args:
        desired: states from k on [m, m/s]; shape (stages, 2).
    """
    last, bound = min(stage, settings.seen), settings.bounds[axis]
    v = max(-bound, min(desired[last, 1], bound))
    return desired[last, 0] + (stage - last) * settings.dt_s * v, v


@inline
def _followed(
    settings: Settings, memory: Memory, row: int, number: int, axis: int, step: int
) -> tuple[float, float]:
    """State of a trajectory that was sent at a step on one axis [m, m/s]; of none, where it hovers.

    Args:
        number: of the trajectory; negative for none.
    """
    if number < 0:
        return memory.state[row, axis, 0], 0.0
    slot = number % ROOM
    sent = memory.sent[row, slot]
    knots = memory.knots[row, slot, axis, : 2 * sent.count]
    return spline_at(knots, sent.spacing, settings.dt_s, step - sent.step)


@part
def _listen(
    settings: Settings, memory: Memory, bound: DelayBound, clock: Seen, row: int
) -> tuple[int, int]:
    """Take what the newest observation says of delays and losses.

    Returns:
        number of the trajectory in force there, or -1 where that is none, or unknown; and how many
        are newly known to be lost.
    """
    dt_ns, known, observed = settings.dt_ns, memory.vehicles[row], memory.observed[row]
    if bound.steps[row] == 0:
        begin(bound, row, -(-half_trip_ns(clock, row) // dt_ns) + MARGIN)
    at_least(bound, row, -(-shortest_ns(clock, row) // dt_ns))
    oldest = max(known.first, known.sent - ROOM)
    flown, lost = -1, 0
    for number in range(known.sent - 1, oldest - 1, -1):
        sent = memory.sent[row, number % ROOM]
        if sent.step == known.in_force:
            flown = number
        if sent.step <= known.in_force:
            break
        if known.judged < sent.due <= observed:
            lost += 1
            memory.vehicles[row].loss += LEARNED * (1.0 - memory.vehicles[row].loss)
    memory.vehicles[row].judged = observed
    if flown >= 0 and known.in_force != known.acknowledged:
        memory.vehicles[row].loss -= LEARNED * memory.vehicles[row].loss
        acknowledge(bound, row, known.since - known.in_force)
        memory.vehicles[row].acknowledged = known.in_force
    return flown, lost


@part
def _arrives(bound: DelayBound, row: int, loss: float, since: int) -> float:
    """Probability that a packet comes, of which an observation so many steps later knows nothing.

    Args:
        loss: share of packets that are lost.
        since: steps from sending to the observation; negative if that was made before.
    """
    left = 1.0 - loss
    if since > 0:
        known, later = min(bound.seen[row], SAMPLES), 0
        for slot in range(known):
            later += bound.samples[row, slot] > since
        left *= (later + 1) / (known + 1)
    return left / (left + loss)


@part
def _gap(
    settings: Settings, memory: Memory, desired: F3, row: int, number: int, k: int, d: int
) -> tuple[float, float]:
    """Mean of Q_p Σ (Δp + h Δv)² of a trajectory that may be followed, and |Δp| at k + d [m].

    Args:
        desired: what is known now, from k on [m, m/s]; shape (axes, stages, 2).
        number: of the trajectory; negative for none.
    """
    gap, away = 0.0, 0.0
    for stage in range(d, CHANCES * d + 1, d):
        for axis in range(len(settings.bounds)):
            p, v = _known(settings, desired[axis], stage, axis)
            led_p, led_v = _followed(settings, memory, row, number, axis, k + stage)
            off = led_p - p + settings.lead_s[axis] * (led_v - v)
            gap += off * off / CHANCES
            if stage == d:
                away += (led_p - p) ** 2
    return settings.weight * gap, np.sqrt(away)


@kernel
def _appraise(
    settings: Settings,
    memory: Memory,
    bound: DelayBound,
    clock: Seen,
    window: Window,
    rows: I1,
    steps: I1,
    figures: Figures,
    planned: F3,
    now: F3,
) -> int:
    """Fill in figures, see `Guidance.plan`; the number of trajectories newly known to be lost."""
    lost, axes = 0, len(settings.bounds)
    for i in range(len(rows)):
        row, k, plan = rows[i], steps[i], figures[i]
        flown, newly = _listen(settings, memory, bound, clock, row)
        lost += newly
        known, d, observed = memory.vehicles[row], bound.steps[row], memory.observed[row]
        place, first = window.place[i], window.first[i]
        desired = window.states[place, :axes, first : first + settings.seen + 1]
        newest, share, expected, ends = flown, 1.0, 0.0, -1
        if flown >= 0:
            ends = memory.sent[row, flown % ROOM].ends
        oldest = max(known.first, known.sent - ROOM, flown + 1)
        for number in range(known.sent - 1, oldest - 1, -1):
            sent = memory.sent[row, number % ROOM]
            if sent.step <= known.in_force or sent.due <= observed:
                break
            newest, ends = max(newest, number), max(ends, sent.ends)
            if share > SURE:
                comes = _arrives(bound, row, known.loss, observed - sent.step)
                gap, _ = _gap(settings, memory, desired, row, number, k, d)
                expected += share * comes * gap
                share *= 1.0 - comes
        if share > SURE:
            gap, _ = _gap(settings, memory, desired, row, flown, k, d)
            expected += share * gap
        plan.row, plan.step, plan.start, plan.gap = row, k, k, 1
        plan.fresh, plan.solved = ends <= k + d, True
        plan.state_gap, plan.expected_gap = 0.0, expected
        plan.cost_gap, plan.deviation_m = 0.0, 0.0
        if not plan.fresh:
            plan.cost_gap, plan.deviation_m = _gap(settings, memory, desired, row, newest, k, d)
        for axis in range(axes):
            p, v = _known(settings, desired[axis], 0, axis)
            now[i, axis, 0], now[i, axis, 1] = p, v
            if newest >= 0:
                p, v = _followed(settings, memory, row, newest, axis, k)
            planned[i, axis, 0], planned[i, axis, 1] = p, v
    return lost


@part
def _fit(settings: Settings, desired: F3, knots: S2) -> tuple[int, int]:
    """Fill in the fewest knots that keep near enough to what is seen, or else as many as fit.

    Args:
        desired: states from k on [m, m/s]; shape (axes, stages, 2).
        knots: what is filled in [m, m/s]; shape (axes, 2 KNOTS_MAX).

    Returns:
        number of knots, and steps from one to the next.
    """
    count, spacing, seen = 1, 1, settings.seen
    for intervals in INTERVALS:
        if intervals > seen:
            break
        count, spacing, away = intervals + 1, max(seen // max(intervals, 1), 1), 0.0
        for axis in range(len(knots)):
            bound = settings.bounds[axis]
            for knot in range(count):
                at, near = knot * spacing, spacing // 2
                p, v = desired[axis, at, 0], desired[axis, at, 1]
                if near > 0 and 0 < knot < count - 1:
                    way = desired[axis, at + near, 0] - desired[axis, at - near, 0]
                    v = way / (2 * near * settings.dt_s)
                knots[axis, 2 * knot] = p
                knots[axis, 2 * knot + 1] = max(-bound, min(v, bound))
            some = knots[axis, : 2 * count]
            for stage in range(seen + 1):
                p, _ = spline_at(some, spacing, settings.dt_s, stage)
                away = max(away, abs(p - desired[axis, stage, 0]))
        if away <= settings.error_m:
            break
    return count, spacing


@kernel
def _remember(
    settings: Settings,
    memory: Memory,
    bound: DelayBound,
    window: Window,
    rows: I1,
    steps: I1,
    event: B1,
    told: Splines,
) -> None:
    """Make and write down the trajectories that are sent, see `Guidance.remember`."""
    for i in range(len(rows)):
        if not event[i]:
            continue
        row, place, first = rows[i], window.place[i], window.first[i]
        axes = len(settings.bounds)
        desired = window.states[place, :axes, first : first + settings.seen + 1]
        count, spacing = _fit(settings, desired, told.knots[i])
        told.number[i], told.spacing[i] = count, spacing
        slot = memory.vehicles[row].sent % ROOM
        memory.vehicles[row].sent += 1
        sent = memory.sent[row, slot]
        sent.step, sent.due = steps[i], steps[i] + bound.steps[row]
        sent.ends = memory.observed[row] + settings.age_max + 1
        sent.spacing, sent.count = spacing, count
        for axis in range(axes):
            for n in range(2 * count):
                memory.knots[row, slot, axis, n] = told.knots[i, axis, n]
