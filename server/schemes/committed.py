"""The scheme "committed": plans start at k + d, after the inputs fixed by horizons already sent.

A horizon reaches the vehicle within d steps (the delay bound) or is lost. So the inputs of the next
d steps are fixed by the horizons already sent: these inputs are committed. The server predicts with
them from the newest observation to x̂(k+d), where planning starts, and repeats them as the first d
inputs of the next horizon. Until that horizon arrives, at any time within d steps, the vehicle
flies the same inputs.

Every observation acknowledges the horizon in force at its step. The prediction replays the inputs
of this horizon, then those of each horizon in flight, from d steps after the step it was made for.
A horizon that does not come into force by then is lost, and is not replayed.

    x(i+1) = A x(i) + B (u(i) + w)        from the observation to k + d

w is the disturbance (wind, a wrong gain) as an equivalent input, estimated by
`server.schemes.disturbance`.

With feedback aboard, a horizon also carries its reference state x̄, which starts at x̂(k), and the
vehicle flies u(i) + K (x̄(i) - x(i)). The server replays this feedback too. The committed inputs
are then the inputs of a flight along x̄ without further disturbance. K never changes, so the
time at which the next horizon replaces the present one does not matter.

`schemes.sent` tracks the horizons sent, `schemes.sent_horizons` stores them, `schemes.replay`
predicts with them, and `schemes.loss_scenarios` predicts the cases in which some are lost.
"""

from collections import Counter

import numpy as np

from skytether.server.mpc import exact, hierarchical, riccati
from skytether.server.planning.clock import ClockMap, Seen
from skytether.server.planning.compiled import lasting, laws_of
from skytether.server.planning.scheme import Fleet, Foresight, SchemeCode
from skytether.server.schemes import horizons, sent_horizons
from skytether.server.schemes import sent as tracker
from skytether.server.schemes.disturbance import FOLLOW_S, observe_disturbance
from skytether.server.schemes.feedback import feedback_gain
from skytether.server.schemes.horizons import HorizonScheme
from skytether.server.schemes.loss_scenarios import foresee_losses
from skytether.server.schemes.observer import decay_of
from skytether.server.schemes.replay import FlownTrack, HorizonSchedule, fly_schedule, make_schedule
from skytether.server.schemes.sent import (
    HOVERS,
    first_in_flight,
    nothing_sent,
    number_of,
    update_delay_and_loss,
)
from skytether.server.schemes.sent_horizons import (
    AXIS_STATE,
    OBSERVATIONS,
    REFERENCE_STATE,
    SENT_HORIZON,
    ReplayMemory,
    ReplaySettings,
    speed_of,
    store_observation,
    store_sent,
)
from skytether.shared.base.kernel import I1, kernel
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.wire.protocol import (
    DISTURBANCE,
    GAIN_P,
    GAIN_V,
    NO_HORIZON,
    REFERENCE_P,
    REFERENCE_V,
    Observation,
    ahead_max,
)


class Replay:
    """Predictor of the scheme "committed": replays sent horizons from the newest observation.

    Args:
        gain: gain K of the feedback aboard, 0 without feedback; shape (axes, 2).
        clock: clock map; half of the smallest round trip is the first value of the delay bound.
    """

    def __init__(
        self, terms: Terms, control: ControlConfig, gain: Array, capacity: int, clock: ClockMap
    ) -> None:
        axes, H, most = terms.axes, terms.horizon, ahead_max(terms)
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
        # At most one horizon is sent per step, and none is flown longer than `age_max`.
        ring = terms.age_max + H
        self._memory = ReplayMemory(
            sent=nothing_sent(capacity, ring, terms, control, most),
            seen=np.zeros(capacity, dtype=OBSERVATIONS),
            state=np.zeros((capacity, axes), dtype=AXIS_STATE),
            horizons=np.zeros((capacity, ring), dtype=SENT_HORIZON),
            inputs=np.zeros((capacity, ring, axes, most + H), dtype=np.float32),
            reference=np.zeros((capacity, ring, axes), dtype=REFERENCE_STATE),
        )
        # Number of steps from the oldest usable observation to the end of the plan made from it.
        longest = terms.age_max + most + H + 1
        self._schedule = HorizonSchedule(
            np.empty(ring + 2, dtype=np.int64), np.empty(ring + 2, dtype=np.int64)
        )
        self._track = FlownTrack(np.empty(longest), np.empty((longest, 2)))
        self._clock = clock
        self.observed_step: Indices = self._memory.sent.observed
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        for row in range(capacity):
            self.forget(row)

    def forget(self, row: int) -> None:
        tracker.forget(self._memory.sent, row)
        self._memory.seen[row] = (-1, NO_HORIZON, 1, 1)
        self._memory.state["w"][row] = 0.0

    def observe(self, row: int, observation: Observation) -> bool:
        return store_observation(
            self._memory,
            row,
            observation.step,
            observation.in_force,
            observation.since,
            observation.takes,
            observation.state,
            observation.input,
        )

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Predict x̂(k) and x̂(k+d); planning starts at step k + d."""
        lost = _foresee(
            self._settings,
            self._memory,
            self._clock.seen,
            self._schedule,
            self._track,
            rows,
            step,
            foresight,
        )
        if lost:
            self.counts["horizons_lost"] += lost

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        store_sent(self._settings, self._memory, rows, step, foresight, event)


def make(fleet: Fleet) -> HorizonScheme:
    control, gain = fleet.scenario.control, feedback_gain(fleet.scenario)
    return HorizonScheme(Replay(fleet.terms, control, gain, fleet.capacity, fleet.clock), fleet)


CODE = SchemeCode(make, lambda _: (sent_horizons, horizons, hierarchical, exact, riccati))


@kernel
def _foresee(
    settings: ReplaySettings,
    memory: ReplayMemory,
    clock: Seen,
    schedule: HorizonSchedule,
    track: FlownTrack,
    rows: I1,
    steps: I1,
    foresight: Foresight,
) -> int:
    """Fill in the predictions at the steps k; return the number of newly lost horizons."""
    axes, H, sent, lost = len(settings.laws), settings.H, memory.sent, 0
    for i in range(len(rows)):
        row, k, bound = rows[i], steps[i], sent.bound.steps
        delivery, observed = sent.delivery[row], sent.observed[row]
        age = k - observed  # at most age_max: the controller ensures it
        # With a bound too large for any plan, nothing would be sent, and no acknowledgement could
        # show that the delay has become smaller. So the bound is reset.
        if bound[row] > age and age + bound[row] > settings.age_max:
            bound[row], sent.bound.seen[row] = 0, 0
        lost += update_delay_and_loss(sent, clock, row)
        d = bound[row]
        if settings.decay < 1.0:
            observe_disturbance(settings, memory, row, age + d, schedule, track)
        # A vehicle that accepts no horizons hovers, even if horizons are in flight to it.
        in_force, in_flight = HOVERS, range(0)
        if memory.seen[row].takes == 1:
            in_force = number_of(sent, row, delivery.in_force)
            in_flight = range(
                first_in_flight(sent, row, delivery.in_force, observed), delivery.sent
            )
        legs = make_schedule(schedule, sent, row, observed, in_force, in_flight)
        foresight.ahead[i], speed = d, speed_of(memory.state[row].u)
        foresight.usable[i] = max(0, lasting(d + H, k, observed, settings.age_max) - d)
        for axis in range(axes):
            state, law = memory.state[row, axis], settings.laws[axis]
            x = (state.p, state.v, state.u, speed)
            fly_schedule(settings, memory, row, axis, schedule, legs, k + d + H, x, track)
            # With a wrong clock offset the observation may be later than k, and is used unchanged.
            now, start = k - observed, k + d - observed
            for j in range(2):
                foresight.estimate[i, axis, j] = track.states[max(now, 0), j]
                foresight.start[i, axis, j] = track.states[max(start, 0), j]
            for j in range(d):
                foresight.committed[i, axis, j] = track.commands[now + j] if now + j >= 0 else 0.0
            for j in range(H):
                foresight.held[i, axis, j] = track.commands[start + j] if start + j >= 0 else 0.0
            foresight.disturbance[i, axis] = state.w
            if settings.feeds_back:
                feedback = foresight.feedback[i, axis]
                feedback[REFERENCE_P] = foresight.estimate[i, axis, 0]
                feedback[REFERENCE_V] = foresight.estimate[i, axis, 1]
                feedback[DISTURBANCE] = state.w
                feedback[GAIN_P], feedback[GAIN_V] = law.gain_p, law.gain_v
        foresee_losses(settings, memory, row, i, k, in_force, in_flight, schedule, track, foresight)
    return lost
