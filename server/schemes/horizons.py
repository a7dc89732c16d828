"""Schemes that send horizons of inputs: a predictor, the hierarchical MPC, and the encoding.

observations → x̂(k), x̂(k+d) (predictor) → U(k+d) (`mpc.hierarchical`)
             → horizon: d committed inputs, then H planned inputs
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from skytether.server.mpc.hierarchical import Planner
from skytether.server.mpc.plugin_planners import InputPlanner
from skytether.server.planning.clock import UNSEEN
from skytether.server.planning.scheme import Batch, Fleet, Foresight, Header, Scheme, SentPlans
from skytether.shared.base.kernel import I1, I2, S1, S3, kernel
from skytether.shared.law.model import Flags, Indices
from skytether.shared.law.terms import COMMITTING, INDEXED, Terms
from skytether.shared.scenario.registry import MPC
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.wire.protocol import FEEDBACK, Observation, ahead_max, encode_horizon

NO_FEEDBACK = memoryview(b"")
"""Encoded feedback of a horizon without feedback aboard."""


def uplink_max_ns(terms: Terms) -> int:
    """Longest uplink delay at which a horizon can still be flown [ns]."""
    if terms.scheme not in INDEXED:
        return UNSEEN  # the vehicle flies the first input whenever a horizon arrives
    return (ahead_max(terms) if terms.scheme in COMMITTING else terms.horizon) * terms.dt_ns


class Predictor(Protocol):
    """The part of a `Scheme` that stores observations and predicts states."""

    observed_step: Indices
    counts: Counter[str]

    def forget(self, row: int) -> None:
        """Delete the data of the vehicle in a row."""

    def observe(self, row: int, observation: Observation) -> bool:
        """Store an observation unless a newer one is stored; return whether it was stored."""

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Fill in the predictions of a `Foresight`, without its plans."""

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        """Store the new plans; `event`: flags of the vehicles whose plan is sent, shape (n,)."""


class InputScheme(Scheme):
    """A scheme that sends the inputs of `Foresight.horizons`."""

    properties = SchemeProperties(flown_as="predictive")

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        terms = fleet.terms
        self.uplink_max_ns = uplink_max_ns(terms)
        self._packing = Packing(terms.axes, ahead_max(terms) + terms.planned, terms.planned)

    def encode(self, batch: Batch, header: Callable[[int], Header]) -> Iterator[tuple[int, bytes]]:
        # Number of bytes of one input on all axes.
        width, planned = 4 * self.terms.axes, self.terms.planned
        feedback, feedback_bytes = NO_FEEDBACK, 0
        if self.terms.feedback:
            feedback = batch.foresight.feedback.data.cast("B")
            feedback_bytes = width * FEEDBACK
        numbers, inputs = self._packing.pack(batch, self.observed_step)
        begin = 0
        for i, row, k, age, d in numbers:
            end = begin + width * (d + planned)
            vehicle, session, sent_us, number, silence = header(row)
            extra = feedback[i * feedback_bytes : (i + 1) * feedback_bytes]
            own, begin = inputs[begin:end], end
            yield (
                row,
                encode_horizon(vehicle, session, k, sent_us, age, own, extra, number, silence),
            )

    def sent_plans(self, batch: Batch) -> SentPlans:
        sent, foresight = batch.sent, batch.foresight
        step, ahead = batch.step[sent], foresight.ahead[sent]
        # The planned inputs follow d committed inputs; d differs between vehicles.
        stages = ahead[:, None] + np.arange(self.terms.planned)
        inputs = np.take_along_axis(foresight.horizons[sent], stages[:, None], axis=2)
        return SentPlans(step, step + ahead, foresight.start[sent], inputs)


class HorizonScheme(InputScheme):
    """A scheme made of a predictor and the hierarchical MPC."""

    def __init__(self, predictor: Predictor, fleet: Fleet) -> None:
        super().__init__(fleet)
        control, terms, stopwatch = fleet.scenario.control, fleet.terms, fleet.stopwatch
        self.predictor = predictor
        self.planner = (
            Planner(control, terms, fleet.desired, fleet.capacity, fleet.block, stopwatch)
            if control.planner == MPC
            else InputPlanner(fleet)
        )
        self.observed_step, self.counts = predictor.observed_step, predictor.counts
        self.figures, self.planned = self.planner.figures, self.planner.planned

    def forget(self, row: int) -> None:
        self.predictor.forget(row)
        self.planner.forget(row)

    def observe(self, row: int, observation: Observation) -> bool:
        return self.predictor.observe(row, observation)

    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        self.predictor.foresee(rows, step, foresight)

    def remember(self, rows: Indices, step: Indices, foresight: Foresight, event: Flags) -> None:
        self.predictor.remember(rows, step, foresight, event)
        self.planner.remember(rows, event)

    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        self.planner.plan(rows, step, foresight)
        self.solve_ns = self.planner.solve_ns


class Packing:
    """Packs the horizons of a block of vehicles into one buffer, for encoding.

    Args:
        most: largest number of inputs of a horizon on each axis.
        planned: number of planned inputs H; the inputs before them are committed.
    """

    def __init__(self, axes: int, most: int, planned: int) -> None:
        self._width, self._planned = axes * most, planned
        self._numbers = np.empty((0, len(COLUMNS)), dtype=np.int64)
        self._inputs = np.empty(0, dtype=np.float32)
        self._bytes = self._inputs.data.cast("B")

    def pack(self, batch: Batch, observed: Indices) -> tuple[list[list[int]], memoryview]:
        """Pack the horizons to be sent.

        Args:
            observed: step of the newest observation of each vehicle; shape (capacity,).

        Returns:
            a row of COLUMNS for each horizon, and the bytes of all horizons, concatenated, with d +
            H inputs on each axis of each horizon. The bytes are valid until the next call.
        """
        n = len(batch.sent)
        if n > len(self._numbers):
            self._numbers = np.empty((n, len(COLUMNS)), dtype=np.int64)
            self._inputs = np.empty(n * self._width, dtype=np.float32)
            self._bytes = self._inputs.data.cast("B")
        _pack(
            batch.foresight.horizons,
            batch.foresight.ahead,
            batch.sent,
            batch.rows,
            batch.step,
            observed,
            self._planned,
            self._numbers,
            self._inputs,
        )
        return self._numbers[:n].tolist(), self._bytes


COLUMNS = ("index", "row", "step", "age", "ahead")
"""Columns of `Packing.pack`: index of the vehicle in the block; its row; step k; age of the newest
observation [steps]; delay bound d."""


@kernel
def _pack(
    horizons: S3,
    ahead: I1,
    sent: I1,
    rows: I1,
    steps: I1,
    observed: I1,
    H: int,
    numbers: I2,
    packed: S1,
) -> None:
    at = 0
    for n in range(len(sent)):
        i = sent[n]
        numbers[n, 0], numbers[n, 1], numbers[n, 2] = i, rows[i], steps[i]
        numbers[n, 3], numbers[n, 4] = steps[i] - observed[rows[i]], ahead[i]
        for axis in range(horizons.shape[1]):
            for stage in range(ahead[i] + H):
                packed[at] = horizons[i, axis, stage]
                at += 1
