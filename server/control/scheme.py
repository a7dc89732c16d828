"""Interface of the schemes of delay compensation, and the predictions that they share.

`server.control.committed` is "committed", `server.control.predictive` "predictive" and "none",
`server.control.trajectory` "trajectory".
"""

from collections import Counter
from typing import NamedTuple, Protocol

import numpy as np

from skytether.shared.base.kernel import F2, F3, F4, I1, S1, S3, kernel
from skytether.shared.law.model import Flags, Indices
from skytether.shared.wire.protocol import FEEDBACK, KNOTS_MAX, Observation


class Splines(NamedTuple):
    """Trajectories that are sent in place of horizons; no vehicles with the other schemes."""

    knots: S3
    """Position [m] and velocity [m/s] of one knot after the other; shape
    (block, axes, 2 KNOTS_MAX)."""
    number: I1
    """Number of knots; shape (block,)."""
    spacing: I1
    """Steps from one knot to the next; shape (block,)."""
    back: I1
    """Number of steps since the one it was made for: 0, unless it is sent once more; shape
    (block,)."""


class Foresight(NamedTuple):
    """Predictions for vehicles at their steps k before planning, and the horizons sent after it.

    It is written anew for every block of vehicles; those of a block come first in each array.
    """

    estimate: F3
    """Estimate x̂(k) [m, m/s]; shape (block, axes, 2)."""
    ahead: I1
    """Delay bound d: planning starts at k + d; shape (block,)."""
    start: F3
    """Estimate x̂(k+d), where planning starts [m, m/s]; shape (block, axes, 2)."""
    committed: F3
    """Inputs of k … k+d-1, the first d of the last axis [m/s]; shape (block, axes, most), with
    the largest d there may be."""
    held: F3
    """Inputs from k+d on, if nothing more were sent [m/s]; shape (block, axes, H)."""
    doubt: F2
    """Probability that the newest 1, 2, … of the horizons in flight are lost, and no older one;
    shape (block, doubts), with no doubts where no trigger asks for them."""
    doubted_start: F4
    """State at k+d in each of these cases [m, m/s]; shape (block, doubts, axes, 2)."""
    doubted: F4
    """Inputs from k+d on in each of these cases, if nothing more were sent [m/s]; shape
    (block, doubts, axes, H)."""
    flown: I1
    """Number of the inputs planned from k+d on that a vehicle flies, before they are too old;
    shape (block,)."""
    disturbance: F2
    """Disturbance ŵ, an input that nobody gave [m/s]; shape (block, axes)."""
    horizons: S3
    """What may be sent, from k on: d committed inputs, then H planned ones [m/s]; shape
    (block, axes, most + H)."""
    feedback: S3
    """What goes with a horizon, see `wire.protocol.Horizon`; shape (block, axes, FEEDBACK)."""
    told: Splines
    """Trajectories that are sent, with the scheme "trajectory"."""


DOUBTS = 4
"""Number of horizons in flight whose loss is reckoned with."""


def foresight(
    block: int, axes: int, H: int, most: int, doubts: int = 0, *, splines: bool = False
) -> Foresight:
    """Room for a block of vehicles, whose delay bounds are at most `most`."""
    states, told = (block, axes, 2), block if splines else 0
    return Foresight(
        estimate=np.zeros(states),
        ahead=np.zeros(block, dtype=np.int64),
        start=np.zeros(states),
        committed=np.zeros((block, axes, most)),
        held=np.zeros((block, axes, H)),
        doubt=np.zeros((block, doubts)),
        doubted_start=np.zeros((block, doubts, axes, 2)),
        doubted=np.zeros((block, doubts, axes, H)),
        flown=np.full(block, H),
        disturbance=np.zeros((block, axes)),
        horizons=np.zeros((block, axes, most + H), dtype=np.float32),
        feedback=np.zeros((block, axes, FEEDBACK), dtype=np.float32),
        told=Splines(
            knots=np.zeros((told, axes, 2 * KNOTS_MAX), dtype=np.float32),
            number=np.ones(told, dtype=np.int64),
            spacing=np.ones(told, dtype=np.int64),
            back=np.zeros(told, dtype=np.int64),
        ),
    )


def in_a_row(found: Foresight, sent: Indices) -> memoryview:
    """Bytes of the horizons of some vehicles of a block, one after the other, as they are sent.

    Args:
        sent: which vehicles, by index; their horizons have d + H inputs on each axis; shape (n,).
    """
    _, axes, most = found.horizons.shape
    # One array for all horizons of a block, of which the packets take slices without copying.
    packed = np.empty(len(sent) * axes * most, dtype=np.float32)
    _pack(found.horizons, found.ahead, sent, found.held.shape[2], packed)
    return packed.data.cast("B")


@kernel
def _pack(horizons: S3, ahead: I1, sent: I1, H: int, packed: S1) -> None:
    """Fill in `in_a_row` as numbers; shape of `packed`: as many as there can be."""
    at = 0
    for i in sent:
        for axis in range(horizons.shape[1]):
            for stage in range(ahead[i] + H):
                packed[at] = horizons[i, axis, stage]
                at += 1


class Scheme(Protocol):
    """Counts of observations and of horizons sent, by what became of them."""

    observed_step: Indices
    """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
    counts: Counter[str]
    """Events that the scheme counted, by name."""

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row."""

    def observe(self, row: int, observation: Observation) -> bool:
        """Keep an observation, unless a newer one is known (E11); whether it was kept."""

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in all but the horizons, for vehicles that were observed recently enough.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is filled in.
        """

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """Take note of what was computed for the steps from k on, and which of it is sent.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what was foreseen, and the horizons.
            event: which vehicles are sent theirs; shape (n,).
        """
