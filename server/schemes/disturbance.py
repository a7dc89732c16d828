"""Disturbance observer of the scheme "committed".

From each observation to the next, the flown horizons are replayed. The difference between the
replayed and the observed velocity drives the disturbance observer (`server.schemes.observer`), with
the time constant `control.observer_s`. Observed velocities are noisy, so they are low-pass filtered
with the time constant FOLLOW_S; otherwise the noise would enter the estimate.
"""

from skytether.server.schemes.observer import updated_disturbance
from skytether.server.schemes.replay import (
    FlownTrack,
    HorizonSchedule,
    fly_schedule,
    make_schedule,
)
from skytether.server.schemes.sent import UNKNOWN, first_in_flight, number_of
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings, speed_of
from skytether.shared.base.kernel import part

FOLLOW_S = 0.25
"""Time constant of the observer's low-pass filter on the observed velocity [s]."""


@part
def observe_disturbance(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    trip: int,
    schedule: HorizonSchedule,
    track: FlownTrack,
) -> None:
    """Update the disturbance at an observation, slower if many (`trip`) steps before planning."""
    seen, sent = memory.seen[row], memory.sent
    delivery = sent.delivery[row]
    begin, end = seen.base_step, sent.observed[row]
    if end == begin:
        return
    before = number_of(sent, row, seen.base_in_force)
    after = number_of(sent, row, delivery.in_force)
    # A vehicle that accepts no horizons brakes by its failsafe, whose inputs are unknown to the
    # server.
    inputs_known = seen.takes == 1 and seen.base_takes == 1 and min(before, after) > UNKNOWN
    # Horizons older than `age_max` may have been overwritten in the ring.
    replayable = inputs_known and begin >= 0 and end - begin <= settings.age_max
    m, legs, speed = end - begin, 0, speed_of(memory.state[row].base_u)
    if replayable:
        first = first_in_flight(sent, row, seen.base_in_force, begin)
        legs = make_schedule(schedule, sent, row, begin, before, range(first, after))
        # The newest observation reports the horizon in force, and the step from which it was flown.
        while legs > 1 and schedule.begins[legs - 1] >= delivery.since:
            legs -= 1
        if delivery.since <= begin:
            schedule.numbers[0] = after
        elif delivery.since < end:
            schedule.begins[legs], schedule.numbers[legs] = delivery.since, after
            legs += 1
    for axis in range(len(settings.laws)):
        state, law, lag = memory.state[row, axis], settings.laws[axis], 0.0
        if replayable:
            x = (state.base_p, state.base_v, state.base_u, speed)
            fly_schedule(settings, memory, row, axis, schedule, legs, end, x, track)
            # Low-pass filter: `lag` is the part of the velocity difference not yet in its output.
            off, left = state.v - track.states[m, 1], settings.follow**m
            memory.state[row, axis].w = updated_disturbance(
                state.w,
                (1.0 - left) * off,
                m,
                law.a11,
                settings.decay,
                trip * settings.dt_ns,
                law.bound,
            )
            lag = left * off
        memory.state[row, axis].base_p, memory.state[row, axis].base_v = state.p, state.v - lag
        memory.state[row, axis].base_u = state.u
    memory.seen[row].base_step, memory.seen[row].base_in_force = end, delivery.in_force
    memory.seen[row].base_takes = seen.takes
