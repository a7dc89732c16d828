"""Schemes that send horizons of inputs: a predictor of vehicles, and the MPC that plans for them.

observations → x̂(k), x̂(k+d) (predictor) → U(k+d) (`mpc.hierarchical`) → d committed inputs, then
H planned ones
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from skytether.server.common.scheme import Batch, Fleet, Foresight, Head, Scheme, SentPlans
from skytether.server.mpc.hierarchical import Planner
from skytether.shared.base.kernel import I1, I2, S1, S3, kernel
from skytether.shared.law.model import Flags, Indices
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.wire.protocol import FEEDBACK, Observation, committed_max, encode_horizon

NOTHING = memoryview(b"")
"""Bytes that go with a horizon without feedback."""


class Predictor(Protocol):
    """What is known of vehicles, and predicted of them; see `Scheme`."""

    observed_step: Indices
    counts: Counter[str]

    def forget(self, row: int) -> None:
        """See `Scheme`."""

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`."""

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`."""


class InputScheme(Scheme):
    """A scheme that sends the inputs of `Foresight.horizons`."""

    properties = SchemeProperties(flown_as="predictive")

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        terms = fleet.terms
        self._packing = Packing(terms.axes, committed_max(terms) + terms.planned, terms.planned)

    def encode(self, batch: Batch, head: Callable[[int], Head]) -> Iterator[tuple[int, bytes]]:
        """See `Scheme`."""
        # Bytes of one input on all axes, and of what goes with a horizon.
        width, planned = 4 * self.terms.axes, self.terms.planned
        feedback, told = NOTHING, 0
        if self.terms.feedback:
            feedback, told = batch.found.feedback.data.cast("B"), width * FEEDBACK
        heads, inputs = self._packing.pack(batch, self.observed_step)
        begin = 0
        for i, row, k, o, d in heads:
            end = begin + width * (d + planned)
            vehicle, session, sent_us, number, silence = head(row)
            extra = feedback[i * told : (i + 1) * told]
            some, begin = inputs[begin:end], end
            yield (
                row,
                encode_horizon(vehicle, session, k, sent_us, o, some, extra, number, silence),
            )

    def sent_plans(self, batch: Batch) -> SentPlans:
        """See `Scheme`."""
        sent, found = batch.sent, batch.found
        step, ahead = batch.step[sent], found.ahead[sent]
        # Behind d committed inputs, another d of each vehicle.
        stages = ahead[:, None] + np.arange(self.terms.planned)
        inputs = np.take_along_axis(found.horizons[sent], stages[:, None], axis=2)
        return SentPlans(step, step + ahead, found.start[sent], inputs)


class HorizonScheme(InputScheme):
    """A predictor, which knows where vehicles are and what they have been told, and a planner."""

    def __init__(self, predictor: Predictor, fleet: Fleet) -> None:
        super().__init__(fleet)
        control, terms, stopwatch = fleet.scenario.control, fleet.terms, fleet.stopwatch
        self.predictor = predictor
        self.planner = Planner(
            control, terms, fleet.desired, fleet.capacity, fleet.block, stopwatch
        )
        self.observed_step, self.counts = predictor.observed_step, predictor.counts
        self.figures, self.planned = self.planner.figures, self.planner.planned

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        self.predictor.forget(row)
        self.planner.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        return self.predictor.observe(row, observation)

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`."""
        self.predictor.foresee(rows, step, found)

    def remember(self, rows: Indices, step: Indices, found: Foresight, event: Flags) -> None:
        """See `Scheme`."""
        self.predictor.remember(rows, step, found, event)

    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`."""
        self.planner.plan(rows, step, found)
        self.solve_ns = self.planner.solve_ns


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

    def pack(self, batch: Batch, observed: Indices) -> tuple[list[list[int]], memoryview]:
        """Numbers in the columns of HEAD, and bytes of the horizons one after the other.

        The bytes are valid until the next are packed.

        Args:
            batch: the vehicles; their horizons have d + H inputs on each axis.
            observed: step of the newest observation of each vehicle; shape (capacity,).
        """
        n = len(batch.sent)
        if n > len(self._heads):
            self._heads = np.empty((n, len(HEAD)), dtype=np.int64)
            self._inputs = np.empty(n * self._width, dtype=np.float32)
            self._told = self._inputs.data.cast("B")
        _pack(
            batch.found.horizons,
            batch.found.ahead,
            batch.sent,
            batch.rows,
            batch.step,
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
