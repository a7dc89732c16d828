"""Predictions for the cases in which horizons in flight are lost.

In case j exactly the newest j + 1 horizons are lost; the last case also covers more losses.
Losses are assumed independent, with the loss rate of recent horizons.
"""

from skytether.server.planning.scheme import Foresight
from skytether.server.schemes.replay import (
    FlownTrack,
    HorizonSchedule,
    fly_schedule,
    make_schedule,
)
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings, speed_of
from skytether.shared.base.kernel import part


@part
def foresee_losses(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    i: int,
    k: int,
    in_force: int,
    in_flight: range,
    schedule: HorizonSchedule,
    track: FlownTrack,
    foresight: Foresight,
) -> None:
    """Fill in `loss_probability`, `start_if_lost` and `inputs_if_lost` of vehicle i of a block.

    Args:
        in_force: number of the horizon in force at the vehicle's newest observation.
        in_flight: numbers of the horizons in flight.
        schedule, track: scratch memory.
    """
    observed, share, speed = memory.sent.observed[row], 1.0, speed_of(memory.state[row].u)
    start, loss = k + foresight.ahead[i] - observed, memory.sent.delivery[row].loss
    cases = foresight.loss_probability.shape[1]
    for j in range(cases):
        foresight.loss_probability[i, j] = 0.0
        left = len(in_flight) - j - 1
        if left < 0:
            continue
        share *= loss
        # The last case covers all cases with at least this many losses.
        last = left == 0 or j + 1 == cases
        foresight.loss_probability[i, j] = share if last else share * (1.0 - loss)
        arriving = range(in_flight.start, in_flight.start + left)
        legs = make_schedule(schedule, memory.sent, row, observed, in_force, arriving)
        for axis in range(len(settings.laws)):
            state = memory.state[row, axis]
            x = (state.p, state.v, state.u, speed)
            end = observed + start + settings.H
            fly_schedule(settings, memory, row, axis, schedule, legs, end, x, track)
            for n in range(2):
                foresight.start_if_lost[i, j, axis, n] = track.states[max(start, 0), n]
            for n in range(settings.H):
                at = start + n
                foresight.inputs_if_lost[i, j, axis, n] = track.commands[at] if at >= 0 else 0.0
