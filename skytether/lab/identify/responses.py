"""Response to each velocity step: time-stamped velocities around the step, and the changes of the
input from two step durations before the step until its end.
"""

from collections.abc import Sequence

import numpy as np

from skytether.client.vehicle import Measurement
from skytether.lab.identify.fit import StepResponse
from skytether.lab.identify.steps import FlownStep
from skytether.shared.base.units import SECOND_NS

LOOKBACK = 2.0
"""Interval before a step whose inputs are included in the step's response, in step durations."""
LEAD = 0.25
"""Interval before a step whose measurements are included, in step durations. Without a dead time
only these measurements distinguish the gain from wind.
"""
SAMPLES_MIN = 10


def responses(
    inputs: Sequence[tuple[int, list[float]]],
    measured: Sequence[Measurement],
    steps: Sequence[FlownStep],
    axis: int,
) -> list[StepResponse]:
    """Responses of an axis to its steps; steps with too few measurements are left out.

    Args:
        inputs: times of changes of the input [ns], and the input of each axis from then on [m/s].
        measured: measurements, in any order.
        steps: steps of any axis.
    """
    flown_ns = np.array([time_ns for time_ns, _ in inputs], dtype=np.int64)
    flown = np.array([each[axis] for _, each in inputs])
    change = np.diff(flown, prepend=0.0)
    with_velocity = [each for each in measured if each.velocity is not None]
    stamps_ns = np.array([each.stamp_ns for each in with_velocity], dtype=np.int64)
    velocity = np.array(
        [each.velocity[axis] for each in with_velocity if each.velocity is not None]
    )
    responses_found = []
    for step in steps:
        if step.axis != axis:
            continue
        since_ns = step.began_ns - round(LOOKBACK * (step.ended_ns - step.began_ns))
        affects_step = (change != 0.0) & (flown_ns >= since_ns) & (flown_ns < step.ended_ns)
        after = (stamps_ns >= step.began_ns) & (stamps_ns < step.ended_ns)
        lead_ns = round(LEAD * (step.ended_ns - step.began_ns))
        during = (stamps_ns >= step.began_ns - lead_ns) & (stamps_ns < step.ended_ns)
        if after.sum() < SAMPLES_MIN:
            continue
        changes = np.stack(
            [(flown_ns[affects_step] - step.began_ns) / SECOND_NS, change[affects_step]], axis=1
        )
        times = (stamps_ns[during] - step.began_ns) / SECOND_NS
        responses_found.append(
            StepResponse(step.before, step.after, changes, times, velocity[during])
        )
    return responses_found
