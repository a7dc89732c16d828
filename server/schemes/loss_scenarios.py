"""Doubt of committed inputs: what becomes of a vehicle where horizons in flight are lost.

Case j is that the newest j + 1 of them are lost, and no more. A horizon is lost with the share that
was lost lately, each by itself; the last case stands for all in which more are lost.
"""

from skytether.server.common.scheme import Foresight
from skytether.server.schemes.replay import FlownTrack, HorizonsInForce, chart, roll
from skytether.server.schemes.sent_horizons import ReplayMemory, ReplaySettings, speed_of
from skytether.shared.base.kernel import part


@part
def doubt(
    settings: ReplaySettings,
    memory: ReplayMemory,
    row: int,
    i: int,
    k: int,
    flying: int,
    under_way: range,
    course: HorizonsInForce,
    track: FlownTrack,
    found: Foresight,
) -> None:
    """Fill in what becomes of vehicle `i` of a block where the newest horizons in flight are lost.

    Args:
        flying: number of the horizon in force at its newest observation.
        under_way: numbers of those in flight.
    """
    observed, share, speed = memory.sent.observed[row], 1.0, speed_of(memory.state[row].u)
    then, loss = k + found.ahead[i] - observed, memory.sent.heard[row].loss
    for j in range(found.doubt.shape[1]):
        found.doubt[i, j] = 0.0
        left = len(under_way) - j - 1
        if left < 0:
            continue
        share *= loss
        # Where more may be lost than are reckoned with, or none is left, this case stands for all.
        last = left == 0 or j + 1 == found.doubt.shape[1]
        found.doubt[i, j] = share if last else share * (1.0 - loss)
        some = range(under_way.start, under_way.start + left)
        legs = chart(course, memory.sent, row, observed, flying, some)
        for axis in range(len(settings.laws)):
            state = memory.state[row, axis]
            x = (state.p, state.v, state.u, speed)
            roll(settings, memory, row, axis, course, legs, observed + then + settings.H, x, track)
            for n in range(2):
                found.doubted_start[i, j, axis, n] = track.states[max(then, 0), n]
            for n in range(settings.H):
                found.doubted[i, j, axis, n] = track.commands[then + n] if then + n >= 0 else 0.0
