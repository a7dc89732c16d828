"""The scheme "trajectory": sends the desired trajectory as a spline, which the vehicle follows.

At step k the server sends the trajectory to follow from k on:

- the nominal motion of the vehicle along the known desired trajectory (`server.mpc.nominal`);
- the known desired trajectory itself, if the horizon is shorter than the time h below;
- the target's present state, if the server knows nothing ahead;
- the plan of a plug-in's planner along the desired trajectory, extrapolated where unknown
  (`server.mpc.plugin_planners`).

The trajectory is sent as a spline with the fewest uniform knots that keep its error within
`control.spline_error_m` (`shared.law.spline`); a single state is one knot. A regulator aboard
follows the spline, so the newest observation serves as the server's estimate.

The server is not certain which trajectory the vehicle follows: an observation acknowledges the
trajectory in force, and later trajectories may be in flight or lost. With the loss rate ℓ and the
share S(t) of delays longer than t, a trajectory sent a time t before an observation that does not
acknowledge it will still arrive with the probability

    π = (1 - ℓ) S(t) / ((1 - ℓ) S(t) + ℓ)

and is lost once it is older than the delay bound d (`schemes.delay_bound`). The vehicle follows the
newest trajectory that arrives. So the expected gap is

    E[ Q_p Σ (Δp + h Δv)² ]          Δp, Δv: trajectory followed - trajectory that would be sent now

summed over the axes, with the expectation over these cases, the weight Q_p on the position [1/m²]
and h = (1 + K_v) / K_p, with which the regulator weighs velocity: K_p (Δp + h Δv) is the change of
its input. The gap is averaged over the steps k + d, when a packet sent now is in force at the
latest; k + 2 d, when the server knows whether it arrived; and k + 3 d, when a packet sent then
would be in force. When only the step k + d was used, an ending trajectory was replaced too late if
a packet was lost. A vehicle that has received no trajectory hovers at its observed position.
"""

from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.mpc import riccati
from skytether.server.mpc.nominal import Nominal, make_nominal, plan_nominal
from skytether.server.planning import splines
from skytether.server.planning.clock import Seen
from skytether.server.planning.desired import Window
from skytether.server.planning.scheme import Figures, Fleet, Foresight, SchemeCode, Splines
from skytether.server.planning.splines import SplineScheme
from skytether.server.schemes import knots
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.delay_bound import SAMPLES, DelayBound
from skytether.server.schemes.knots import fewest_knots, spline_at
from skytether.server.schemes.sent import (
    Sent,
    add_plan,
    first_in_flight,
    nothing_sent,
    number_of,
    update_delay_and_loss,
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
from skytether.shared.scenario.registry import MPC, load
from skytether.shared.wire.protocol import KNOTS_MAX, NO_HORIZON, Observation, ahead_max

if TYPE_CHECKING:
    from skytether.server.mpc.plugin_planners import PluginPlanners

RING = 64
"""Number of sent trajectories that are stored for each vehicle."""
COMPARED = 3
"""Number of steps at which trajectories are compared: k + d, k + 2 d, k + 3 d."""
IGNORED = 1e-3
"""Total probability of the cases that the expected gap ignores."""
RUNS_OUT = 1e-2
"""Probability of losing all trajectories in flight, above which an ending plan is replaced."""
TINY = 1e-9
"""Lower limit of K_p in h [1/s]; avoids a division by 0 with weights that give K_p = 0."""

along, guided_to = shared(spline.along), shared(spline.guided_to)
regulated = shared(spline.regulated)
follow = shared(spline.follow)


class SentTrajectory:
    """Numpy record: a trajectory that was sent, without its knots."""

    ends: int
    """First step at which the trajectory is too old to be flown."""
    spacing: int
    count: int


TRAJECTORY = record(SentTrajectory)


class Settings(NamedTuple):
    """Constants shared by all vehicles."""

    dt_s: float
    age_max: int
    """Largest age of an observation that is used [steps]."""
    seen: int
    """Number of steps for which the desired trajectory is known ahead, at most H; H with a
    plug-in's planner."""
    bounds: F1
    """Largest velocity on each axis [m/s]; shape (axes,)."""
    weight: float
    """Weight Q_p on the position [1/m²]."""
    lead_s: F1
    """Time h, by which velocity errors are weighed against position errors [s]; shape (axes,)."""
    error_m: float
    """Largest error of a spline if KNOTS_MAX knots suffice [m]: `control.spline_error_m`."""
    plans: bool
    """Whether the nominal motion is sent instead of the desired trajectory itself."""


class Memory(NamedTuple):
    """Newest observation of every vehicle, and the trajectories sent to it."""

    sent: Sent
    state: F3
    """State in the newest observation [m, m/s]; shape (capacity, axes, 2)."""
    trajectories: Annotated[NDArray[np.void], records(TRAJECTORY, 2)]
    """Trajectories in the ring; shape (capacity, RING)."""
    knots: F4
    """Knots of `trajectories`, rounded as they are sent [m, m/s]; shape (capacity, RING, axes, 2
    KNOTS_MAX)."""


class Guidance(SplineScheme):
    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        terms, control, desired = fleet.terms, fleet.scenario.control, fleet.desired
        capacity, block, axes = fleet.capacity, fleet.block, terms.axes
        gain = regulator(fleet.scenario)
        lead_s = (1.0 + gain[:, 1]) / np.maximum(gain[:, 0], TINY)
        # A plan shorter than h ends before the vehicle is near the trajectory, and then its spline
        # is extrapolated as a straight line: measured errors reached 12 m.
        plans = desired.seen > 0 and terms.horizon * terms.dt_s >= lead_s.max()
        self._own: PluginPlanners | None = None
        if control.planner != MPC:
            planners = load("skytether.server.mpc.plugin_planners", "control.planner")
            self._own = planners.PluginPlanners(fleet, states=True)
        seen = terms.horizon if self._own else desired.seen
        self._desired, self._clock, self._stopwatch = desired, fleet.clock, fleet.stopwatch
        self._loop_gain = np.array(terms.gain)
        self._settings = Settings(
            dt_s=terms.dt_s,
            age_max=terms.age_max,
            seen=seen,
            bounds=self._loop_gain * terms.u_max,
            weight=control.state_weight[0],
            lead_s=lead_s,
            error_m=control.spline_error_m,
            plans=bool(plans),
        )
        self._memory = Memory(
            sent=nothing_sent(capacity, RING, terms, control, ahead_max(terms)),
            state=np.zeros((capacity, axes, 2)),
            trajectories=np.zeros((capacity, RING), dtype=TRAJECTORY),
            knots=np.zeros((capacity, RING, axes, 2 * KNOTS_MAX)),
        )
        self.observed_step = self._memory.sent.observed
        self._nominal = make_nominal(terms, control, capacity if plans else 0)
        self._intended = np.zeros((block, axes, seen + 1, 2))
        """Trajectory that would be sent now [m, m/s]; shape (block, axes, seen + 1, 2)."""

    def forget(self, row: int) -> None:
        tracker.forget(self._memory.sent, row)
        if self._own:
            self._own.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        delivery = self._memory.sent.delivery[row]
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        delivery["in_force"], delivery["since"] = observation.in_force, observation.since
        self._memory.state[row] = observation.state
        # A vehicle that accepts no trajectories has dropped all received trajectories, and will
        # drop the trajectories in flight.
        if not observation.takes:
            delivery["first"], delivery["in_force"] = delivery["sent"], NO_HORIZON
        return True

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:  # noqa: ARG002
        """Fill in the estimates, which are the newest observations."""
        n = len(rows)
        foresight.estimate[:n] = foresight.start[:n] = self._memory.state[rows]

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Make the trajectories that would be sent now, and fill in `figures` and `planned`.

        `planned` has the states at k of the trajectories sent last. The first column of `horizons`
        is the velocity at k, as an input.
        """
        settings, memory, intended = self._settings, self._memory, self._intended
        figures, clock = self.figures, self._clock.seen
        lost = _begin(settings, memory, clock, rows, step, figures, self.planned, intended)
        unsolved = 0
        if self._own:
            self._plan_own(self._own, rows, step, foresight)
        else:
            window = self._desired.window(rows, step, foresight.ahead)
            unsolved = _intend(settings, self._nominal, window, rows, step, intended)
        _appraise(settings, memory, rows, step, figures, intended)
        if lost:
            self.counts["horizons_lost"] += lost
        if unsolved:
            self.counts["unsolved"] += unsolved
        n = len(rows)
        foresight.horizons[:n, :, 0] = self._intended[:n, :, 0, 1] / self._loop_gain
        took_ns = self._stopwatch.lap("plan")
        self.solve_ns = took_ns if self._stopwatch.runs else -1

    def _plan_own(
        self, own: "PluginPlanners", rows: Indices, step: Indices, foresight: Foresight
    ) -> None:
        """Fill in the plans of plug-ins' planners; a vehicle without a plan gets the desired
        trajectory, which is not sent.
        """
        n, intended, model = len(rows), self._intended, self.terms.model
        desired = self._desired.states(rows, step, foresight.ahead)
        plans = own.plan(rows, step, intended[:n, :, 0], desired)
        for i, plan in enumerate(plans):
            if plan is None:
                intended[i] = desired[i]
            else:
                states = model.roll(intended[i, :, 0], plan) if plan.ndim == 2 else plan
                intended[i] = states.swapaxes(0, 1)
        self.figures["solved"][:n] = [plan is not None for plan in plans]

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        """Fit and store splines for the vehicles whose trajectory is sent."""
        intended = self._intended
        _fit_and_store(self._settings, self._memory, intended, rows, step, event, foresight.splines)


CODE = SchemeCode(Guidance, lambda _: (knots, splines, riccati))


@inline
def _ahead(settings: Settings, intended: F2, stage: int) -> tuple[float, float]:
    """State at a stage after k of the trajectory that would be sent now [m, m/s]."""
    # After its end the trajectory is extrapolated as a straight line, like its spline.
    last = min(stage, settings.seen)
    v = intended[last, 1]
    return intended[last, 0] + (stage - last) * settings.dt_s * v, v


@inline
def _followed(
    settings: Settings, memory: Memory, row: int, number: int, axis: int, step: int
) -> tuple[float, float]:
    """State of a sent trajectory at a step [m, m/s]; with a negative number the vehicle hovers."""
    if number < 0:
        return memory.state[row, axis, 0], 0.0
    slot = number % RING
    trajectory = memory.trajectories[row, slot]
    knots = memory.knots[row, slot, axis, : 2 * trajectory.count]
    since = step - memory.sent.plans[row, slot].step
    return spline_at(knots, trajectory.spacing, settings.dt_s, since)


@part
def _arrives(bound: DelayBound, row: int, loss: float, since: int) -> float:
    """Probability π that a packet sent `since` steps before the observation will still arrive."""
    left = 1.0 - loss
    if since > 0:
        count, later = min(bound.seen[row], SAMPLES), 0
        for slot in range(count):
            later += bound.samples[row, slot] > since
        # Laplace's rule adds 1: the share is 1 without samples, and never 0.
        left *= (later + 1) / (count + 1)
    return left / (left + loss)


@part
def _gap(
    settings: Settings, memory: Memory, intended: F3, row: int, number: int, k: int, d: int
) -> tuple[float, float]:
    """Mean of Q_p Σ (Δp + h Δv)² if the vehicle follows a sent trajectory, and |Δp| at k + d [m].

    Args:
        intended: trajectory that would be sent now [m, m/s]; shape (axes, seen + 1, 2).
        number: number of the sent trajectory; negative if the vehicle hovers without one.
        d: delay bound [steps].
    """
    gap, squares = 0.0, 0.0
    for stage in range(d, COMPARED * d + 1, d):
        for axis in range(len(settings.bounds)):
            p, v = _ahead(settings, intended[axis], stage)
            sent_p, sent_v = _followed(settings, memory, row, number, axis, k + stage)
            off = sent_p - p + settings.lead_s[axis] * (sent_v - v)
            gap += off * off / COMPARED
            if stage == d:
                squares += (sent_p - p) ** 2
    return settings.weight * gap, np.sqrt(squares)


@part
def _intend_one(
    settings: Settings, nominal: Nominal, row: int, k: int, desired: F3, intended: F3
) -> bool:
    """Fill in the trajectory that would be sent now; False if the nominal MPC finds no plan.

    Args:
        desired: desired trajectory from k on [m, m/s]; shape (axes, seen + 1 or more, 2).
        intended: output; its first stage, the state at k, is input to the nominal MPC [m, m/s];
            shape (axes, seen + 1, 2).
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
def _intend(
    settings: Settings, nominal: Nominal, window: Window, rows: I1, steps: I1, intended: F4
) -> int:
    """Fill in the trajectories that would be sent now; returns the number of unsolved plans."""
    unsolved, axes = 0, len(settings.bounds)
    for i in range(len(rows)):
        desired = window.states[window.place[i], :axes, window.first[i] :]
        if not _intend_one(settings, nominal, rows[i], steps[i], desired, intended[i]):
            unsolved += 1
    return unsolved


@inline
def _newest(sent: Sent, row: int, first: int) -> int:
    """Number of the newest trajectory in flight, else of the trajectory in force, or negative."""
    delivery = sent.delivery[row]
    if first < delivery.sent:
        return delivery.sent - 1
    return number_of(sent, row, delivery.in_force)


@kernel
def _begin(
    settings: Settings,
    memory: Memory,
    clock: Seen,
    rows: I1,
    steps: I1,
    figures: Figures,
    planned: F3,
    intended: F4,
) -> int:
    """Fill in the start of the trajectories that would be sent now, in `planned` and `intended`,
    and `fresh` in `figures`; return the number of newly lost trajectories.
    """
    sent, lost, axes = memory.sent, 0, len(settings.bounds)
    for i in range(len(rows)):
        row, k, plan = rows[i], steps[i], figures[i]
        lost += update_delay_and_loss(sent, clock, row)
        delivery, d, observed = sent.delivery[row], sent.bound.steps[row], sent.observed[row]
        in_force, ends = number_of(sent, row, delivery.in_force), -1
        if in_force >= 0:
            ends = memory.trajectories[row, in_force % RING].ends
        first = first_in_flight(sent, row, delivery.in_force, observed)
        for number in range(first, delivery.sent):
            ends = max(ends, memory.trajectories[row, number % RING].ends)
        plan.row, plan.step, plan.start, plan.gap, plan.solved = row, k, k, 1, True
        # `fresh` only if a new trajectory could be flown at k + d; otherwise a trajectory would be
        # sent at every step.
        plan.fresh = ends <= k + d <= observed + settings.age_max
        newest = _newest(sent, row, first)
        for axis in range(axes):
            p, v = memory.state[row, axis, 0], memory.state[row, axis, 1]
            if not plan.fresh:
                p, v = _followed(settings, memory, row, newest, axis, k)
            intended[i, axis, 0, 0], intended[i, axis, 0, 1] = p, v
            planned[i, axis, 0], planned[i, axis, 1] = p, v
    return lost


@kernel
def _appraise(
    settings: Settings, memory: Memory, rows: I1, steps: I1, figures: Figures, intended: F4
) -> None:
    """Fill in the gaps between trajectories sent before and trajectories that would be sent now."""
    sent = memory.sent
    for i in range(len(rows)):
        row, k, plan = rows[i], steps[i], figures[i]
        delivery, d, observed = sent.delivery[row], sent.bound.steps[row], sent.observed[row]
        in_force, in_force_ends = number_of(sent, row, delivery.in_force), np.inf
        if in_force >= 0:
            in_force_ends = memory.trajectories[row, in_force % RING].ends
        first = first_in_flight(sent, row, delivery.in_force, observed)
        share, expected = 1.0, 0.0
        for number in range(delivery.sent - 1, first - 1, -1):
            if share <= IGNORED:
                break
            since = observed - sent.plans[row, number % RING].step
            arrives = _arrives(sent.bound, row, delivery.loss, since)
            gap, _ = _gap(settings, memory, intended[i], row, number, k, d)
            expected += share * arrives * gap
            share *= 1.0 - arrives
        if share > IGNORED:
            gap, _ = _gap(settings, memory, intended[i], row, in_force, k, d)
            expected += share * gap
        plan.state_gap, plan.expected_gap = 0.0, expected
        plan.cost_gap, plan.deviation_m = 0.0, 0.0
        if not plan.fresh:
            newest = _newest(sent, row, first)
            plan.cost_gap, plan.deviation_m = _gap(settings, memory, intended[i], row, newest, k, d)
        # If the trajectory in force ends soon and all trajectories in flight may be lost, a new
        # trajectory is sent, so that the vehicle does not brake.
        soon = in_force_ends <= k + COMPARED * d <= observed + settings.age_max
        plan.fresh |= soon and share > RUNS_OUT


@kernel
def _fit_and_store(
    settings: Settings,
    memory: Memory,
    intended: F4,
    rows: I1,
    steps: I1,
    event: B1,
    splines: Splines,
) -> None:
    for i in range(len(rows)):
        if not event[i]:
            continue
        row, dt_s = rows[i], settings.dt_s
        count, spacing = fewest_knots(intended[i], dt_s, settings.error_m, splines.knots[i])
        splines.number[i], splines.spacing[i] = count, spacing
        slot = add_plan(memory.sent, row, steps[i], memory.sent.bound.steps[row])
        trajectory = memory.trajectories[row, slot]
        trajectory.ends = memory.sent.observed[row] + settings.age_max + 1
        trajectory.spacing, trajectory.count = spacing, count
        for axis in range(len(settings.bounds)):
            for number in range(2 * count):
                memory.knots[row, slot, axis, number] = splines.knots[i, axis, number]
