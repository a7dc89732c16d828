"""Interface of the schemes of delay compensation, and the predictions that they share.

`server.schemes.committed` is "committed", `server.schemes.predictive` "predictive" and "none",
`server.schemes.trajectory` "trajectory".
"""

from collections import Counter
from typing import Annotated, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F2, F3, F4, I1, I2, S1, S3, kernel, record, records
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
    """Inputs that may be sent, from k on: d committed inputs, then H planned ones [m/s]; shape
    (block, axes, most + H)."""
    feedback: S3
    """Feedback columns of a horizon, see `wire.protocol.Horizon`; shape (block, axes, FEEDBACK)."""
    told: Splines
    """Trajectories that are sent, with the scheme "trajectory"."""


class PlanFigures:
    """Record: what is known of a vehicle once its plan is made; a cost is that of eq. (9)."""

    row: int
    """Row of the vehicle."""
    step: int
    """Step k."""
    start: int
    """Step k + d, where planning starts."""
    gap: int
    """Steps since planning started before."""
    state_gap: float
    """V(k) of eq. (16): square of how far x̂ is from x_p, weighted by P [cost]."""
    cost_gap: float
    """Cost of flying on with what was sent above that of the plan [cost]."""
    expected_gap: float
    """Mean of that cost where packets in flight may be lost [cost]."""
    deviation_m: float
    """Largest distance between what was sent and the generator's plan before [m]; 0 where fresh."""
    fresh: bool
    """Whether it is at its first step, or behind a gap that no plan reached over."""
    solved: bool
    """Whether the plan is new and right, so that it may be sent."""


FIGURES = record(PlanFigures)
Figures = Annotated[NDArray[np.void], records(FIGURES, 1)]
"""Shape (n,)."""


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


class Packing:
    """Packs the horizons that are sent, of one block of vehicles after the other.

    Args:
        axes: number of axes.
        most: largest number of inputs of a horizon on each axis.
        planned: number of these that are planned, H; d more are committed.
    """

    def __init__(self, axes: int, most: int, planned: int) -> None:
        self._width, self._planned = axes * most, planned
        self._heads = np.empty((0, len(HEAD)), dtype=np.int64)
        self._inputs = np.empty(0, dtype=np.float32)
        self._told = self._inputs.data.cast("B")

    def pack(
        self, found: Foresight, sent: Indices, rows: Indices, step: Indices, observed: Indices
    ) -> tuple[list[list[int]], memoryview]:
        """Numbers in the columns of HEAD, and bytes of the horizons one after the other.

        The bytes are valid until the next are packed.

        Args:
            found: has the horizons, of d + H inputs on each axis.
            sent: which vehicles of the block, by index; shape (n,).
            rows: the vehicles of the block.
            step: k of each.
            observed: step of the newest observation of each vehicle; shape (capacity,).
        """
        n = len(sent)
        if n > len(self._heads):
            self._heads = np.empty((n, len(HEAD)), dtype=np.int64)
            self._inputs = np.empty(n * self._width, dtype=np.float32)
            self._told = self._inputs.data.cast("B")
        _pack(
            found.horizons,
            found.ahead,
            sent,
            rows,
            step,
            observed,
            self._planned,
            self._heads,
            self._inputs,
        )
        return self._heads[:n].tolist(), self._told


HEAD = ("index", "row", "step", "age", "ahead")
"""Columns that `Packing` tells of a horizon: place of its vehicle in the block, and row; step k;
age of the observation [steps]; delay bound d."""


@kernel
def _pack(
    horizons: S3,
    ahead: I1,
    sent: I1,
    rows: I1,
    steps: I1,
    observed: I1,
    H: int,
    heads: I2,
    packed: S1,
) -> None:
    """Fill in what `Packing.pack` returns, as numbers; there is room for all there can be."""
    at = 0
    for n in range(len(sent)):
        i = sent[n]
        heads[n, 0], heads[n, 1], heads[n, 2] = i, rows[i], steps[i]
        heads[n, 3], heads[n, 4] = steps[i] - observed[rows[i]], ahead[i]
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
