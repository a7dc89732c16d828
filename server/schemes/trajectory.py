"""Trajectories: the vehicle is told the desired trajectory, and which one it holds is estimated.

What is sent at step k is the trajectory to be followed from there on: where the server sees ahead,
the nominal motion of the vehicle along what it sees (`server.mpc.nominal`), or what it sees
itself where the horizon is shorter than the time h below; and else the state of the target at k. It
is sent as a spline with as few uniform knots as keep within `control.spline_error_m` of it
(`shared.law.spline`); of a state that is one. The vehicle regulates itself along the spline, so all
that is known of the vehicle is its newest observation.

Which trajectory it follows is not certain: every observation acknowledges the one in force, and
those sent since may be on their way, or lost. With the share ℓ of losses and the share S(t) of
delays longer than t, both as measured, one that was sent t before an observation that does not know
of it will come with the probability

    π = (1 - ℓ) S(t) / ((1 - ℓ) S(t) + ℓ)

and from the delay bound d on it is lost (`schemes.delay_bound`). The newest that comes is the one
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

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.common import splines
from skytether.server.common.clock import Seen
from skytether.server.common.desired import Window
from skytether.server.common.scheme import Figures, Fleet, Foresight, Splines
from skytether.server.common.splines import SplineScheme
from skytether.server.mpc import exact
from skytether.server.mpc.nominal import Nominal, make_nominal, plan_nominal
from skytether.server.schemes import knots
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.delay_bound import SAMPLES, DelayBound
from skytether.server.schemes.knots import fewest_knots, spline_at
from skytether.server.schemes.sent import (
    Sent,
    first_under_way,
    judge,
    note,
    nothing_sent,
    number_of,
)
from skytether.shared.base.kernel import (
    B1,
    F1,
    F2,
    F3,
    F4,
    I1,
    inline,
    kernel,
    part,
    record,
    records,
    shared,
)
from skytether.shared.law import spline
from skytether.shared.law.model import Flags, Indices
from skytether.shared.scenario.gain import regulator
from skytether.shared.wire.protocol import KNOTS_MAX, NO_HORIZON, Observation, committed_max

ROOM = 64
"""Number of trajectories that are remembered of each vehicle: the newest that were sent."""
CHANCES = 3
"""Number of delay bounds ahead at whose ends trajectories are compared."""
SURE = 1e-3
"""Probability below which what is left of the cases is not looked at."""
RUNS_OUT = 1e-2
"""Largest probability that all trajectories are lost that are to follow one that ends."""
TINY = 1e-9
"""Smallest K_p, for weights that ask for none [1/s]."""

along, guided_to = shared(spline.along), shared(spline.guided_to)
regulated = shared(spline.regulated)
follow = shared(spline.follow)
"""The rule of flight along a spline, compiled for kernels."""


class SentTrajectory:
    """Record: how a trajectory that was sent is flown."""

    ends: int
    """Step after the last at which it is flown."""
    spacing: int
    """Steps from one knot to the next."""
    count: int
    """Number of its knots."""


TRAJECTORY = record(SentTrajectory)


class Settings(NamedTuple):
    """Constants shared by all vehicles."""

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
    plans: bool
    """Whether what is seen is planned along, and not told as it is."""


class Memory(NamedTuple):
    """State of every vehicle, and the trajectories sent to it."""

    sent: Sent
    """Which trajectories are in force, in flight or lost."""
    state: F3
    """State in the newest observation [m, m/s]; shape (capacity, axes, 2)."""
    trajectories: Annotated[NDArray[np.void], records(TRAJECTORY, 2)]
    """Trajectories in the ring; shape (capacity, ROOM)."""
    knots: F4
    """Knots of these trajectories as they are read aboard [m, m/s]; shape
    (capacity, ROOM, axes, 2 KNOTS_MAX)."""


class Guidance(SplineScheme):
    """The scheme "trajectory", and what is sent to its vehicles."""

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        terms, control, desired = fleet.terms, fleet.scenario.control, fleet.desired
        capacity, block, axes = fleet.capacity, fleet.block, terms.axes
        gain = regulator(fleet.scenario)
        # TINY: weights that ask for no gain on position would divide by 0.
        lead_s = (1.0 + gain[:, 1]) / np.maximum(gain[:, 0], TINY)
        # A plan shorter than h ends before the vehicle is near what it follows, and beyond its end
        # the spline goes straight on: measured, such plans led up to 12 m away (docs/studies.md).
        plans = desired.seen > 0 and terms.horizon * terms.dt_s >= lead_s.max()
        self._desired, self._clock = desired, fleet.clock
        self._loop_gain = np.array(terms.gain)
        self._settings = Settings(
            dt_s=terms.dt_s,
            age_max=terms.age_max,
            seen=desired.seen,
            bounds=self._loop_gain * terms.u_max,
            weight=control.state_weight[0],
            lead_s=lead_s,
            error_m=control.spline_error_m,
            plans=bool(plans),
        )
        self._memory = Memory(
            sent=nothing_sent(capacity, ROOM, terms, control, committed_max(terms)),
            state=np.zeros((capacity, axes, 2)),
            trajectories=np.zeros((capacity, ROOM), dtype=TRAJECTORY),
            knots=np.zeros((capacity, ROOM, axes, 2 * KNOTS_MAX)),
        )
        self.observed_step = self._memory.sent.observed
        self._nominal = make_nominal(terms, control, capacity if plans else 0)
        self._intended = np.zeros((block, axes, desired.seen + 1, 2))
        """Trajectories that would be sent now, from k on [m, m/s]; shape (block, axes, seen + 1,
        2)."""

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        tracker.forget(self._memory.sent, row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`; a vehicle that takes nothing holds nothing either."""
        heard = self._memory.sent.heard[row]
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        heard["in_force"], heard["since"] = observation.in_force, observation.since
        self._memory.state[row] = observation.state
        # A vehicle that takes none has dropped what it held, and drops what is under way.
        if not observation.takes:
            heard["first"], heard["in_force"] = heard["sent"], NO_HORIZON
        return True

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:  # noqa: ARG002
        """See `Scheme`: what was observed, as it is."""
        n = len(rows)
        found.estimate[:n] = found.start[:n] = self._memory.state[rows]

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in `figures`, of flying on, and the velocity of now in place of a plan.

        `planned` are the states at k of the trajectories sent last.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is filled in.
        """
        lost, unsolved = _appraise(
            self._settings,
            self._memory,
            self._clock.seen,
            self._nominal,
            self._desired.window(rows, step, found.ahead),
            rows,
            step,
            self.figures,
            self.planned,
            self._intended,
        )
        if lost:
            self.counts["horizons_lost"] += lost
        if unsolved:
            self.counts["unsolved"] += unsolved
        n = len(rows)
        found.horizons[:n, :, 0] = self._intended[:n, :, 0, 1] / self._loop_gain

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what is sent is made, and counts."""
        intended = self._intended
        _remember(self._settings, self._memory, intended, rows, step, event, found.told)


make = Guidance
KERNELS = (knots, splines, exact)
"""See `server.schemes.table`."""


@inline
def _ahead(settings: Settings, intended: F2, stage: int) -> tuple[float, float]:
    """State of a trajectory at a stage on one axis, position [m] and velocity [m/s].

    Args:
        intended: states from k on [m, m/s]; shape (seen + 1, 2).
    """
    # Behind what is seen the trajectory goes straight on, as the spline will.
    last = min(stage, settings.seen)
    v = intended[last, 1]
    return intended[last, 0] + (stage - last) * settings.dt_s * v, v


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
    trajectory = memory.trajectories[row, slot]
    knots = memory.knots[row, slot, axis, : 2 * trajectory.count]
    since = step - memory.sent.plans[row, slot].step
    return spline_at(knots, trajectory.spacing, settings.dt_s, since)


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
            # Laplace's rule below, (later + 1) / (known + 1): without samples the share is 1, and
            # never quite 0.
            later += bound.samples[row, slot] > since
        left *= (later + 1) / (known + 1)
    return left / (left + loss)


@part
def _gap(
    settings: Settings, memory: Memory, intended: F3, row: int, number: int, k: int, d: int
) -> tuple[float, float]:
    """Mean of Q_p Σ (Δp + h Δv)² of a trajectory that may be followed, and |Δp| at k + d [m].

    Args:
        intended: what would be sent now, from k on [m, m/s]; shape (axes, seen + 1, 2).
        number: of the trajectory; negative for none.
    """
    gap, away = 0.0, 0.0
    for stage in range(d, CHANCES * d + 1, d):
        for axis in range(len(settings.bounds)):
            p, v = _ahead(settings, intended[axis], stage)
            led_p, led_v = _followed(settings, memory, row, number, axis, k + stage)
            off = led_p - p + settings.lead_s[axis] * (led_v - v)
            gap += off * off / CHANCES
            if stage == d:
                away += (led_p - p) ** 2
    return settings.weight * gap, np.sqrt(away)


@part
def _intend(
    settings: Settings, nominal: Nominal, row: int, k: int, desired: F3, intended: F3
) -> bool:
    """Fill in the trajectory that would be sent now; False where no plan is found.

    Args:
        desired: states from k on [m, m/s]; shape (axes, seen + 1 or more, 2).
        intended: what is filled in; where the server sees ahead, its first stage is where the
            vehicle is led at k [m, m/s]; shape (axes, seen + 1, 2).
    """
    if settings.plans and plan_nominal(nominal, row, k, desired, intended):
        return True
    for axis in range(len(intended)):
        bound = settings.bounds[axis]
        for stage in range(settings.seen + 1):
            v = desired[axis, stage, 1]
            intended[axis, stage, 0] = desired[axis, stage, 0]
            intended[axis, stage, 1] = max(-bound, min(v, bound))
    return not settings.plans


@kernel
def _appraise(
    settings: Settings,
    memory: Memory,
    clock: Seen,
    nominal: Nominal,
    window: Window,
    rows: I1,
    steps: I1,
    figures: Figures,
    planned: F3,
    intended: F4,
) -> tuple[int, int]:
    """Fill in what `Guidance.plan` says.

    Returns:
        how many trajectories are newly known to be lost, and how many plans were not found.
    """
    sent, lost, unsolved, axes = memory.sent, 0, 0, len(settings.bounds)
    for i in range(len(rows)):
        row, k, plan = rows[i], steps[i], figures[i]
        lost += judge(sent, clock, row)
        heard, d, observed = sent.heard[row], sent.bound.steps[row], sent.observed[row]
        flown = number_of(sent, row, heard.in_force)
        newest, ends, held = flown, -1, np.inf
        if flown >= 0:
            held = ends = memory.trajectories[row, flown % ROOM].ends
        first_in_flight = first_under_way(sent, row, heard.in_force, observed)
        for number in range(first_in_flight, heard.sent):
            newest, ends = number, max(ends, memory.trajectories[row, number % ROOM].ends)
        # Only if the new one would be young enough: otherwise one would be sent at each step.
        plan.fresh = ends <= k + d <= observed + settings.age_max
        for axis in range(axes):
            p, v = memory.state[row, axis, 0], memory.state[row, axis, 1]
            if not plan.fresh:
                p, v = _followed(settings, memory, row, newest, axis, k)
            intended[i, axis, 0, 0], intended[i, axis, 0, 1] = p, v
            planned[i, axis, 0], planned[i, axis, 1] = p, v
        place = window.place[i]
        desired = window.states[place, :axes, window.first[i] :]
        if not _intend(settings, nominal, row, k, desired, intended[i]):
            unsolved += 1
        share, expected = 1.0, 0.0
        for number in range(heard.sent - 1, first_in_flight - 1, -1):
            if share <= SURE:
                break
            since = observed - sent.plans[row, number % ROOM].step
            comes = _arrives(sent.bound, row, heard.loss, since)
            gap, _ = _gap(settings, memory, intended[i], row, number, k, d)
            expected += share * comes * gap
            share *= 1.0 - comes
        if share > SURE:
            gap, _ = _gap(settings, memory, intended[i], row, flown, k, d)
            expected += share * gap
        plan.row, plan.step, plan.start, plan.gap = row, k, k, 1
        plan.solved = True
        plan.state_gap, plan.expected_gap = 0.0, expected
        plan.cost_gap, plan.deviation_m = 0.0, 0.0
        if not plan.fresh:
            plan.cost_gap, plan.deviation_m = _gap(settings, memory, intended[i], row, newest, k, d)
        # What is held ends soon, and all that was sent since may be lost: the vehicle would brake.
        soon = held <= k + CHANCES * d <= observed + settings.age_max
        plan.fresh |= soon and share > RUNS_OUT
    return lost, unsolved


@kernel
def _remember(
    settings: Settings,
    memory: Memory,
    intended: F4,
    rows: I1,
    steps: I1,
    event: B1,
    told: Splines,
) -> None:
    """Make and write down the trajectories that are sent, see `Guidance.remember`."""
    for i in range(len(rows)):
        if not event[i]:
            continue
        row, dt_s = rows[i], settings.dt_s
        count, spacing = fewest_knots(intended[i], dt_s, settings.error_m, told.knots[i])
        told.number[i], told.spacing[i] = count, spacing
        slot = note(memory.sent, row, steps[i], memory.sent.bound.steps[row])
        trajectory = memory.trajectories[row, slot]
        trajectory.ends = memory.sent.observed[row] + settings.age_max + 1
        trajectory.spacing, trajectory.count = spacing, count
        for axis in range(len(settings.bounds)):
            for number in range(2 * count):
                memory.knots[row, slot, axis, number] = told.knots[i, axis, number]
