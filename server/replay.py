"""Committed inputs: what the vehicle has been told, and so where it is, and where it will be.

A horizon reaches the vehicle within d steps or is lost. So what it flies in the next d steps is
settled by what was sent before: these inputs are committed. They roll the newest observation on to
x̂(k+d), where planning starts, and they are the first d inputs of the next horizon: until that
arrives, and whenever within d steps it does, the vehicle flies the same.

Every observation acknowledges the horizon in force at its step. The inputs replayed from there are
those of this horizon; then, for every horizon in flight, its own from its step + d on. One that has
had d steps and was not in force is lost, and left out.

    x(i+1) = A x(i) + B (u(i) + w)        from the observation to k + d

w is what else acts on the vehicle, as an input of its own: constant wind, a wrong gain. Each
observation shows how far the velocity has come away from where the one before it, replayed, says;
the disturbance observer follows that with a time constant of `control.observer_s`.

With feedback aboard, a horizon tells the vehicle also where its inputs lead, x̄ from x̂(k) on, and
how to come back to there: it flies u(i) + K (x̄(i) - x(i)). That is replayed in the same way. What
is committed are the inputs that this comes to if nothing else happens, along x̄ from x̂(k): as K is
always the same, it makes no difference when the next horizon replaces the one before.
"""

from collections import Counter

import numpy as np
from numba import njit
from numpy.typing import NDArray

from server.clock import ClockMap
from server.delay import DelayBound
from server.mpc import stationary_gain
from server.scheme import Foresight
from shared.config import Scenario
from shared.model import Flags, Indices, Model
from shared.protocol import FEEDBACK, INPUTS_MAX, NO_HORIZON, Observation

MARGIN = 2
"""Steps on top of half a round trip, until a horizon has been acknowledged."""


class Replay:
    """The committed `Scheme`: observations of, and horizons sent to, up to `capacity` vehicles.

    Args:
        model: eq. (4).
        reach: an observation more steps old than this gives no estimate.
        clock: knows half of the smallest round trip, which is a first guess at the delay bound.
    """

    def __init__(
        self, scenario: Scenario, model: Model, capacity: int, reach: int, clock: ClockMap
    ) -> None:
        control, vehicle, axes = scenario.control, scenario.vehicle, len(model.B)
        H = self._H = control.horizon
        self.plans_always = False
        self.counts: Counter[str] = Counter()
        self._reach = reach
        brake_mps2 = vehicle.brake_mps2 if vehicle.exhausted == "brake" else 0.0
        self._feeds_back = control.scheme == "feedback"
        gain = stationary_gain(model, control) if self._feeds_back else np.zeros((axes, 2))
        self._gain = gain.astype(np.float32)
        bounds = (scenario.u_max, brake_mps2 * control.dt)
        self._flies = (model.A, model.B, *bounds, self._gain.astype(np.float64))
        """A and B, and what `client.compensator` makes of a horizon."""
        observer_s = control.observer_s
        self._observer_decay = float(np.exp(-control.dt / observer_s)) if observer_s else 1.0
        given = control.delay_bound
        fixed_s = None if given == "auto" else given
        most = min(H, INPUTS_MAX // axes - H)
        self._delay_bound = DelayBound(capacity, control.dt, most, fixed_s)
        self._dt_ns = scenario.dt_ns
        self._clock = clock
        self._begun = np.zeros(capacity, dtype=np.bool_)
        self.observed_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest observation, or -1; shape (capacity,)."""
        self._state = np.zeros((capacity, axes, 2))
        self._in_force = np.full(capacity, NO_HORIZON, dtype=np.int64)
        self._since = np.zeros(capacity, dtype=np.int64)
        self._seen = (self._state, self.observed_step, self._in_force, self._since)
        """The newest observation."""
        self._acknowledged = np.full(capacity, NO_HORIZON, dtype=np.int64)
        """The horizon that was last seen to have come into force."""
        room = reach + H
        self._stamps = np.zeros((capacity, room), dtype=np.int64)
        self._horizons = np.zeros((capacity, room, axes, 2 * H), dtype=np.float32)
        self._lengths = np.zeros((capacity, room), dtype=np.int64)
        self._sent = np.zeros(capacity, dtype=np.int64)
        self._origins = np.zeros((capacity, room, axes, 3), dtype=np.float32)
        self._told = (self._stamps, self._horizons, self._lengths, self._origins, self._sent)
        """Horizons that were sent, a ring: step, inputs, how many, and x̂ and ŵ that they start
        from; and how many horizons so far."""
        self._base_step = np.full(capacity, -1, dtype=np.int64)
        base_state = np.zeros((capacity, axes, 2))
        base_in_force = np.full(capacity, NO_HORIZON, dtype=np.int64)
        self._base = (base_state, self._base_step, base_in_force)
        """The observation before, from which the disturbance observer starts; step -1 for none."""
        self._disturbance = np.zeros((capacity, axes))
        self._judged = np.zeros(capacity, dtype=np.int64)
        """Horizons of up to this step have been seen in force, or lost, or overtaken."""

    def forget(self, row: int) -> None:
        """A new vehicle in this row."""
        self.observed_step[row] = self._base_step[row] = -1
        self._disturbance[row] = 0.0
        self._acknowledged[row] = NO_HORIZON
        self._sent[row] = self._judged[row] = 0
        self._begun[row] = False
        self._delay_bound.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        self._state[row] = observation.state
        self._in_force[row], self._since[row] = observation.in_force, observation.since
        return True

    def within_reach(self, rows: Indices, step: Indices) -> Flags:
        """See `Scheme`."""
        observed = self.observed_step[rows]
        return (observed >= 0) & (step - observed <= self._reach)

    def foresee(self, rows: Indices, step: Indices) -> Foresight:
        """See `Scheme`: planning starts at k + d."""
        self._listen(rows)
        ahead = self._delay_bound.steps(rows)
        estimate, start, committed, held, lost = _replay(
            *(self._flies, self._told, self._seen, self._judged, self._disturbance),
            *(rows, step, ahead, self._H),
        )
        self.counts["horizons lost"] += lost
        disturbance = self._disturbance[rows]
        feedback = np.empty((*disturbance.shape, FEEDBACK * self._feeds_back), dtype=np.float32)
        if self._feeds_back:
            feedback[..., :2], feedback[..., 2] = estimate, disturbance
            feedback[..., 3:] = self._gain
        return Foresight(estimate, ahead, start, committed, held, disturbance, feedback)

    def remember(
        self,
        rows: Indices,
        step: Indices,
        foresight: Foresight,
        horizons: NDArray[np.float32],
        sent: Indices,
    ) -> None:
        """See `Scheme`; only what was sent counts."""
        rows = rows[sent]
        slot = self._sent[rows] % self._stamps.shape[1]
        self._stamps[rows, slot] = step[sent]
        self._lengths[rows, slot] = foresight.ahead[sent] + self._H
        self._horizons[rows, slot, :, : horizons.shape[2]] = horizons[sent]
        if self._feeds_back:
            self._origins[rows, slot] = foresight.feedback[sent, :, :3]
        self._sent[rows] += 1

    def _listen(self, rows: Indices) -> None:
        """What observations have come with since the last time: delays, and a disturbance."""
        begin = rows[~self._begun[rows]]
        if len(begin):
            self._begun[begin] = True
            half_trip = -(-self._clock.bound_ns(begin) // self._dt_ns)
            self._delay_bound.begin(begin, half_trip + MARGIN)
        in_force = self._in_force[rows]
        told = rows[(in_force != self._acknowledged[rows]) & (self._sent[rows] > 0)]
        if len(told):
            oldest = np.maximum(self._sent[told] - self._stamps.shape[1], 0)
            ours = self._stamps[told, oldest % self._stamps.shape[1]] <= self._in_force[told]
            known = told[ours]
            self._delay_bound.acknowledged(known, self._since[known] - self._in_force[known])
            self._acknowledged[told] = self._in_force[told]
        if self._observer_decay < 1.0:
            _observe_disturbance(
                *(self._flies, self._told, self._seen, self._base, self._disturbance),
                *(rows, self._delay_bound.steps(rows), self._reach, self._observer_decay),
            )


FLIES = "Tuple((f8[:,:,::1], f8[:,::1], f8[::1], f8, f8[:,::1]))"
TOLD = "Tuple((i8[:,::1], f4[:,:,:,::1], i8[:,::1], f4[:,:,:,::1], i8[::1]))"
SEEN = "Tuple((f8[:,:,::1], i8[::1], i8[::1], i8[::1]))"
"""Of the kernels: `Replay._flies`, `_told` and `_seen`."""
HOVERS, UNKNOWN = -1, -2
"""In place of the number of a horizon: none yet; one that was sent in an earlier life of ours."""
NEVER = 2**62
"""A step."""


@njit("i8(i8[:,::1], i8[::1], i8, i8)", cache=True)
def _number(stamps, sent, row, stamp):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """Of the horizon made for step `stamp`, counted from 0 in the order of sending."""
    if stamp < 0:
        return HOVERS
    room = stamps.shape[1]
    for number in range(sent[row] - 1, max(sent[row] - room, 0) - 1, -1):
        if stamps[row, number % room] <= stamp:
            return number if stamps[row, number % room] == stamp else UNKNOWN
    return UNKNOWN


@njit("i8(i8[:,::1], i8[::1], i8, i8)", cache=True)
def _first_after(stamps, sent, row, stamp):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """Number of the first horizon made for a step after `stamp`."""
    room = stamps.shape[1]
    number = sent[row]
    while number > max(sent[row] - room, 0) and stamps[row, (number - 1) % room] > stamp:
        number -= 1
    return number


@njit("UniTuple(f8, 2)(f8[:,:,::1], f8[:,::1], i8, f8, f8, f8)", cache=True)
def _roll(A, B, axis, p, v, u):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """Eq. (4)."""
    return (
        A[axis, 0, 0] * p + A[axis, 0, 1] * v + B[axis, 0] * u,
        A[axis, 1, 0] * p + A[axis, 1, 1] * v + B[axis, 1] * u,
    )


@njit(f"f8({TOLD}, {FLIES}, i8, i8, i8, i8)", cache=True)
def _input(told, flies, row, slot, axis, stage):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """The input of a stage of a horizon, as far as the vehicle will go."""
    most = flies[2][axis]
    return min(max(float(told[1][row, slot, axis, stage]), -most), most)


@njit(f"Tuple((i8, i8, i8, f8))({TOLD}, {FLIES}, i8, i8)", cache=True)
def _take(told, flies, row, number):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """A horizon: where it is in the ring, its step, its last stage, and the speed it ends with."""
    if number < 0:
        return number, 0, 0, 0.0
    stamps, horizons, lengths, _, _ = told
    slot, squares = number % stamps.shape[1], 0.0
    end = lengths[row, slot] - 1
    for axis in range(horizons.shape[2]):
        squares += _input(told, flies, row, slot, axis, end) ** 2
    return slot, stamps[row, slot], end, np.sqrt(squares)


@njit(f"i8({TOLD}, i8, i8, i8)", cache=True)
def _due(told, row, number, d):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """The step from which a horizon in flight is counted on."""
    stamps, _, _, _, sent = told
    return stamps[row, number % stamps.shape[1]] + d if number < sent[row] else NEVER


# `_lead` and `_command` are called side by side: one that calls the other is not inlined any more,
# and a replay then takes two and a half times as long.


@njit(
    f"UniTuple(f8, 2)({TOLD}, {FLIES}, i8, Tuple((i8, i8, i8, f8)), i8, i8, i8, f8, f8)", cache=True
)
def _lead(told, flies, row, taken, axis, begin, end, p, v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """x̄ of a horizon at step `end`: from p, v at `begin`, or from where it starts if that is -1.

    After its last step there is no feedback any more, and x̄ stays what it is.
    """
    slot, stamp, last, _ = taken
    if slot < 0:
        return p, v
    origins = told[3]
    if begin < 0:
        begin = stamp
        p, v = float(origins[row, slot, axis, 0]), float(origins[row, slot, axis, 1])
    w = float(origins[row, slot, axis, 2])
    for step in range(max(begin, stamp), min(end, stamp + last)):
        u = _input(told, flies, row, slot, axis, step - stamp) + w
        p, v = _roll(flies[0], flies[1], axis, p, v, u)
    return p, v


@njit(
    f"f8({TOLD}, {FLIES}, i8, Tuple((i8, i8, i8, f8)), i8, i8, f8, f8, f8, f8)",
    cache=True,
    error_model="numpy",
)
def _command(told, flies, row, taken, axis, step, p, v, p_led, v_led):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """What `client.compensator` flies at a step with a horizon, from the state p, v; led is x̄."""
    slot, stamp, end, speed = taken
    if slot == HOVERS:
        return 0.0
    if slot == UNKNOWN:
        return v  # as good a guess as any: it flies on
    _, _, u_max, brake, gain = flies
    stage = step - stamp
    u = _input(told, flies, row, slot, axis, min(max(stage, 0), end))
    if 0 <= stage <= end:
        u += gain[axis, 0] * (p_led - p) + gain[axis, 1] * (v_led - v)
        return min(max(u, -u_max[axis]), u_max[axis])
    if stage < 0 or brake == 0.0:
        return u
    return u * (max(0.0, speed - (stage - end) * brake) / speed) if speed > 0.0 else 0.0


@njit(
    f"Tuple((f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], i8))({FLIES}, {TOLD}, {SEEN},"
    "i8[::1], f8[:,::1], i8[:], i8[:], i8[:], i8)",
    cache=True,
    error_model="numpy",
)
def _replay(flies, told, seen, judged, disturbance, rows, steps, ahead, H):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """See `Replay.foresee`: x̂(k), x̂(k+d), committed and held inputs, and newly lost horizons."""
    A, B, _, _, gain = flies
    stamps, _, _, _, sent = told
    state, observed_step, in_force, _ = seen
    n, axes, room = len(rows), len(A), stamps.shape[1]
    estimate, start = np.empty((n, axes, 2)), np.empty((n, axes, 2))
    committed, held = np.zeros((n, axes, H)), np.zeros((n, axes, H))
    lost, feeds_back = 0, gain.any()
    for i in range(n):
        row, k, d = rows[i], steps[i], ahead[i]
        observed = observed_step[row]
        # Those that had d steps and are not in force have been overtaken, or are lost.
        flown = _number(stamps, sent, row, in_force[row])
        first = _first_after(stamps, sent, row, max(in_force[row], observed - d))
        for number in range(_first_after(stamps, sent, row, in_force[row]), first):
            lost += stamps[row, number % room] > judged[row]
        judged[row] = max(judged[row], observed - d)
        for axis in range(axes):
            p, v = state[row, axis, 0], state[row, axis, 1]
            taken, following = _take(told, flies, row, flown), first
            due, led, p_led, v_led = _due(told, row, following, d), -1, 0.0, 0.0
            # An observation from ahead of k, where clocks disagree, is taken as it is.
            estimate[i, axis, 0], estimate[i, axis, 1] = p, v
            start[i, axis, 0], start[i, axis, 1] = p, v
            for step in range(observed, k + d + H):
                while due <= step:
                    taken, following, led = _take(told, flies, row, following), following + 1, -1
                    due = _due(told, row, following, d)
                if feeds_back:
                    p_led, v_led = _lead(told, flies, row, taken, axis, led, step, p_led, v_led)
                    led = step
                if step == k:
                    estimate[i, axis, 0], estimate[i, axis, 1] = p, v
                if step == k + d:
                    start[i, axis, 0], start[i, axis, 1] = p, v
                u = _command(told, flies, row, taken, axis, step, p, v, p_led, v_led)
                if step < k + d:
                    if step >= k:
                        committed[i, axis, step - k] = u
                else:
                    held[i, axis, step - k - d] = u
                p, v = _roll(A, B, axis, p, v, u + disturbance[row, axis])
    return estimate, start, committed, held, lost


@njit(
    f"({FLIES}, {TOLD}, {SEEN}, Tuple((f8[:,:,::1], i8[::1], i8[::1])), f8[:,::1], i8[:], i8[:],"
    "i8, f8)",
    cache=True,
    error_model="numpy",
)
def _observe_disturbance(flies, told, seen, base, disturbance, rows, ahead, reach, decay):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    """Disturbance observer: from the observation before to the newest, where there is a new one."""
    A, B, u_max, _, gain = flies
    stamps, _, _, _, sent = told
    state, observed_step, in_force, since = seen
    base_state, base_step, base_in_force = base
    axes, feeds_back = len(A), gain.any()
    for i in range(len(rows)):
        row, d = rows[i], ahead[i]
        begin, end = base_step[row], observed_step[row]
        if end == begin:
            continue
        before = _number(stamps, sent, row, base_in_force[row])
        after = _number(stamps, sent, row, in_force[row])
        known = min(before, after) > UNKNOWN and begin >= 0 and end - begin <= reach
        for axis in range(axes):
            p, v, number = base_state[row, axis, 0], base_state[row, axis, 1], before
            taken = _take(told, flies, row, number)
            following = _first_after(stamps, sent, row, max(base_in_force[row], begin - d))
            due, led, p_led, v_led = _due(told, row, following, d), -1, 0.0, 0.0
            for step in range(begin, end if known else begin):
                was = number
                while due <= step and following < after:
                    number, following = following, following + 1
                    due = _due(told, row, following, d)
                if step >= since[row]:
                    number = after
                if number != was:
                    taken, led = _take(told, flies, row, number), -1
                if feeds_back:
                    p_led, v_led = _lead(told, flies, row, taken, axis, led, step, p_led, v_led)
                    led = step
                u = _command(told, flies, row, taken, axis, step, p, v, p_led, v_led)
                p, v = _roll(A, B, axis, p, v, u + disturbance[row, axis])
            if known:
                # A change of w changes the velocity after m steps by 1 - a^m of it.
                m = end - begin
                off = (state[row, axis, 1] - v) / (1.0 - A[axis, 1, 1] ** m)
                w = disturbance[row, axis] + (1.0 - decay**m) * off
                disturbance[row, axis] = min(max(w, -u_max[axis]), u_max[axis])
            base_state[row, axis] = state[row, axis]
        base_step[row], base_in_force[row] = end, in_force[row]
