"""Disturbance of a vehicle that flies committed inputs, learned from its observations.

Each observation shows how far the velocity has come away from where the one before it, replayed,
says; the disturbance observer (`server.schemes.observer`) follows that with a time constant of
`control.observer_s`. Vehicles report what they take their velocity for. So the observer has a
velocity of its own, which follows what is reported within FOLLOW_S: else it would learn the noise
that a filter aboard has left.
"""

from skytether.server.schemes.observer import learned
from skytether.server.schemes.replay import FlownTrack, HorizonsInForce, chart, roll
from skytether.server.schemes.sent import UNKNOWN, first_under_way, number_of
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings, speed_of
from skytether.shared.base.kernel import part

FOLLOW_S = 0.25
"""Time constant with which the disturbance observer follows the velocity that is reported [s]."""


@part
def observe_disturbance(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    trip: int,
    course: HorizonsInForce,
    track: FlownTrack,
) -> None:
    """Disturbance observer: from the observation before to the newest, where there is a new one.

    Args:
        trip: steps from that to where planning starts; a long trip makes it slower.
    """
    seen, sent = memory.seen[row], memory.sent
    heard = sent.heard[row]
    begin, end = seen.base_step, sent.observed[row]
    if end == begin:
        return
    before = number_of(sent, row, seen.base_in_force)
    after = number_of(sent, row, heard.in_force)
    # A vehicle that takes no horizon brakes by its failsafe: what it does then says nothing of
    # wind.
    by_rule = seen.takes == 1 and seen.base_takes == 1 and min(before, after) > UNKNOWN
    # Further back than `age_max` the horizons of that time may be gone from the ring.
    follows = by_rule and begin >= 0 and end - begin <= settings.age_max
    m, legs, speed = end - begin, 0, speed_of(memory.state[row].base_u)
    if follows:
        first = first_under_way(sent, row, seen.base_in_force, begin)
        legs = chart(course, sent, row, begin, before, range(first, after))
        # What came into force, and when, is known.
        while legs > 1 and course.begins[legs - 1] >= heard.since:
            legs -= 1
        if heard.since <= begin:
            course.numbers[0] = after
        elif heard.since < end:
            course.begins[legs], course.numbers[legs] = heard.since, after
            legs += 1
    for axis in range(len(settings.laws)):
        state, law, lag = memory.state[row, axis], settings.laws[axis], 0.0
        if follows:
            x = (state.base_p, state.base_v, state.base_u, speed)
            roll(settings, memory, row, axis, course, legs, end, x, track)
            # A jump of the velocity may be noise: the observer follows it with FOLLOW_S, and
            # carries the rest on as `lag`.
            off, left = state.v - track.states[m, 1], settings.follow**m
            memory.state[row, axis].w = learned(
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
    memory.seen[row].base_step, memory.seen[row].base_in_force = end, heard.in_force
    memory.seen[row].base_takes = seen.takes
