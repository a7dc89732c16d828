"""Committed inputs: what the vehicle has been told, and so where it is, and where it will be.

A horizon reaches the vehicle within d steps or is lost. So what it flies in the next d steps is
settled by what was sent before: these inputs are committed. They roll the newest observation on to
x̂(k+d), where planning starts, and they are the first d inputs of the next horizon: until that
arrives, and whenever within d steps it does, the vehicle flies the same.

Every observation acknowledges the horizon in force at its step. The inputs replayed from there are
those of this horizon; then, for every horizon in flight, its own from its step + d on. One that has
had d steps and was not in force is lost, and left out.

    x(i+1) = A x(i) + B (u(i) + w)        from the observation to k + d

w is what else acts on the vehicle, as an input of its own: constant wind, a wrong gain, learned by
`server.schemes.disturbance`.

With feedback aboard, a horizon tells the vehicle also where its inputs lead, x̄ from x̂(k) on, and
how to come back to there: it flies u(i) + K (x̄(i) - x(i)). That is replayed in the same way. What
is committed are the inputs that this comes to if nothing else happens, along x̄ from x̂(k): as K is
always the same, it makes no difference when the next horizon replaces the one before.

What was sent is followed by `schemes.sent`, kept by `schemes.sent_horizons`, and flown again along
a course by `schemes.replay`; `schemes.loss_scenarios` tells what follows if horizons in flight are
lost.
"""

from collections import Counter

import numpy as np

from skytether.server.common.clock import ClockMap, Seen
from skytether.server.common.compiled import lasting, laws_of
from skytether.server.common.scheme import Fleet, Foresight
from skytether.server.mpc import exact, hierarchical
from skytether.server.schemes import horizons, sent_horizons
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.disturbance import FOLLOW_S, observe_disturbance
from skytether.server.schemes.horizons import HorizonScheme
from skytether.server.schemes.loss_scenarios import doubt
from skytether.server.schemes.observer import decay_of
from skytether.server.schemes.replay import FlownTrack, HorizonsInForce, chart, roll
from skytether.server.schemes.sent import HOVERS, first_under_way, judge, nothing_sent, number_of
from skytether.server.schemes.sent_horizons import (
    AXIS_STATE,
    LEAD,
    OBSERVATIONS,
    SENT_HORIZON,
    ReplayMemory,
    ReplaySettings,
    keep,
    remember,
    speed_of,
)
from skytether.shared.base.kernel import I1, kernel
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.gain import feedback_gain
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    GAIN_P,
    GAIN_V,
    LED_P,
    LED_V,
    NO_HORIZON,
    Observation,
    committed_max,
)


class Replay:
    """The committed `Scheme`: observations of, and horizons sent to, up to `capacity` vehicles.

    Args:
        terms: the rule of flight.
        control: `observer_s` and `delay_bound`.
        gain: K of feedback aboard, 0 without; shape (axes, 2).
        clock: knows half of the smallest round trip, which is a first guess at the delay bound.
    """

    def __init__(
        self, terms: Terms, control: ControlConfig, gain: Array, capacity: int, clock: ClockMap
    ) -> None:
        axes, H, most = terms.axes, terms.horizon, committed_max(terms)
        self.counts: Counter[str] = Counter()
        self._settings = ReplaySettings(
            laws=laws_of(terms, gain),
            H=H,
            age_max=terms.age_max,
            dt_ns=terms.dt_ns,
            brake=terms.brake,
            decay=decay_of(terms, control),
            follow=float(np.exp(-terms.dt_s / FOLLOW_S)),
            feeds_back=terms.feedback,
        )
        # One horizon a step at most, and none is flown for longer than `age_max`.
        ring = terms.age_max + H
        self._memory = ReplayMemory(
            sent=nothing_sent(capacity, ring, terms, control, most),
            seen=np.zeros(capacity, dtype=OBSERVATIONS),
            state=np.zeros((capacity, axes), dtype=AXIS_STATE),
            horizons=np.zeros((capacity, ring), dtype=SENT_HORIZON),
            inputs=np.zeros((capacity, ring, axes, most + H), dtype=np.float32),
            led=np.zeros((capacity, ring, axes), dtype=LEAD),
        )
        # From the oldest observation that counts to the end of a plan that is made from it.
        longest = terms.age_max + most + H + 1
        self._course = HorizonsInForce(
            np.empty(ring + 2, dtype=np.int64), np.empty(ring + 2, dtype=np.int64)
        )
        self._track = FlownTrack(np.empty(longest), np.empty((longest, 2)))
        self._clock = clock
        self.observed_step: Indices = self._memory.sent.observed
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        tracker.forget(self._memory.sent, row)
        self._memory.seen[row] = (-1, NO_HORIZON, 1, 1)
        self._memory.state["w"][row] = 0.0

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        told = observation
        return keep(
            self._memory,
            row,
            told.step,
            told.in_force,
            told.since,
            told.takes,
            told.state,
            told.input,
        )

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`: planning starts at k + d."""
        lost = _foresee(
            self._settings,
            self._memory,
            self._clock.seen,
            self._course,
            self._track,
            rows,
            step,
            found,
        )
        if lost:
            self.counts["horizons_lost"] += lost

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`; only what was sent counts."""
        remember(self._settings, self._memory, rows, step, found, event)


def make(fleet: Fleet) -> HorizonScheme:
    """The scheme "committed"."""
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return HorizonScheme(Replay(fleet.terms, control, gain, fleet.capacity, fleet.clock), fleet)


KERNELS = (sent_horizons, horizons, hierarchical, exact)
"""See `server.schemes.table`."""


@kernel
def _foresee(
    settings: ReplaySettings,
    memory: ReplayMemory,
    clock: Seen,
    course: HorizonsInForce,
    track: FlownTrack,
    rows: I1,
    steps: I1,
    found: Foresight,
) -> int:
    """Fill in what is foreseen of vehicles at their steps k; the number of horizons newly lost.

    Both `course` and `track` are scratch.
    """
    axes, H, sent, lost = len(settings.laws), settings.H, memory.sent, 0
    for i in range(len(rows)):
        row, k, bound = rows[i], steps[i], sent.bound.steps
        heard, observed = sent.heard[row], sent.observed[row]
        age = k - observed
        assert age <= settings.age_max  # the controller's promise; the track has no more room
        # A bound so large that no plan could be flown is forgotten: nothing would be sent, and
        # nothing that was sent could show that the delay is smaller by now.
        if bound[row] > age and age + bound[row] > settings.age_max:
            bound[row], sent.bound.seen[row] = 0, 0
        lost += judge(sent, clock, row)
        d = bound[row]
        if settings.decay < 1.0:
            observe_disturbance(settings, memory, row, age + d, course, track)
        # A vehicle that takes no horizons stands still, whatever is under way to it.
        flying, under_way = HOVERS, range(0)
        if memory.seen[row].takes == 1:
            flying = number_of(sent, row, heard.in_force)
            under_way = range(first_under_way(sent, row, heard.in_force, observed), heard.sent)
        legs = chart(course, sent, row, observed, flying, under_way)
        found.ahead[i], speed = d, speed_of(memory.state[row].u)
        found.flown[i] = max(0, lasting(d + H, k, observed, settings.age_max) - d)
        for axis in range(axes):
            state, law = memory.state[row, axis], settings.laws[axis]
            x = (state.p, state.v, state.u, speed)
            roll(settings, memory, row, axis, course, legs, k + d + H, x, track)
            # An observation from ahead of k, where clocks disagree, is taken as it is.
            now, then = k - observed, k + d - observed
            for j in range(2):
                found.estimate[i, axis, j] = track.states[max(now, 0), j]
                found.start[i, axis, j] = track.states[max(then, 0), j]
            for j in range(d):
                found.committed[i, axis, j] = track.commands[now + j] if now + j >= 0 else 0.0
            for j in range(H):
                found.held[i, axis, j] = track.commands[then + j] if then + j >= 0 else 0.0
            found.disturbance[i, axis] = state.w
            if settings.feeds_back:
                feedback = found.feedback[i, axis]
                feedback[LED_P] = found.estimate[i, axis, 0]
                feedback[LED_V] = found.estimate[i, axis, 1]
                feedback[DISTURBANCE] = state.w
                feedback[GAIN_P], feedback[GAIN_V] = law.gain_p, law.gain_v
        doubt(settings, memory, row, i, k, flying, under_way, course, track, found)
    return lost
