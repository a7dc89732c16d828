"""Downlink delay compensator, eq. (12)-(13): where the vehicle is now, from where it was.

    x̂(k) = A^τ x(k-τ) + Σ_{i=1…τ} A^{i-1} B û(k-i)        τ: age of the observation in steps

û is the history (12) of the first inputs the server computed, whether sent or not (E12). The sum is
not formed: one step of (4) after the other says the same.

This is the scheme "predictive", and "none", which takes the newest observation for the present.
`server.replay` is the other.
"""

from collections import Counter

import numpy as np

from server.model import Axes, advance, axes_of
from server.scheme import Foresight
from shared.kernel import F3, I1, S3, kernel
from shared.model import Flags, Indices, Model
from shared.protocol import Observation


class Estimator:
    """The paper's `Scheme`: observations and inputs of up to `capacity` vehicles.

    Args:
        model: eq. (4).
        reach: largest τ that is compensated.
        compensate: False for "no compensation": x̂(k) is the newest observation, as it is.
    """

    def __init__(self, model: Model, capacity: int, reach: int, *, compensate: bool) -> None:
        axes = len(model.b0)
        self.counts: Counter[str] = Counter()
        self._model = axes_of(model)
        self._compensate = compensate
        self.observed_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest observation, or -1; shape (capacity,)."""
        self._state = np.zeros((capacity, axes, 2))
        self._inputs = np.zeros((capacity, axes, reach))
        """Input history û, a ring over the steps; 0, hovering, where nothing was computed [m/s]."""
        self._last_step = np.full(capacity, -1, dtype=np.int64)
        """Step whose û was computed last, or -1; shape (capacity,)."""

    def forget(self, row: int) -> None:
        """See `Scheme`."""
        self.observed_step[row] = -1
        self._inputs[row] = 0.0
        self._last_step[row] = -1

    def observe(self, row: int, observation: Observation) -> bool:
        """See `Scheme`."""
        if observation.step <= self.observed_step[row]:
            return False
        self.observed_step[row] = observation.step
        self._state[row] = observation.state
        return True

    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """See `Scheme`: planning starts at k, from x̂(k) of eq. (13)."""
        _fly_on(
            self._model,
            self._state,
            self.observed_step,
            self._inputs,
            self._last_step,
            self._compensate,
            rows,
            step,
            found.estimate,
            found.start,
        )

    def remember(
        self,
        rows: Indices,
        step: Indices,
        found: Foresight,
        event: Flags,  # noqa: ARG002 - whether sent or not (E12)
    ) -> None:
        """Take û(k) ← u(k|k), eq. (12).

        Steps before at which nothing was computed flew on with the input of before them.
        """
        _write_down(self._inputs, self._last_step, rows, step, found.horizons)


@kernel
def _fly_on(
    model: Axes,
    state: F3,
    observed_step: I1,
    inputs: F3,
    last_step: I1,
    compensate: bool,
    rows: I1,
    steps: I1,
    estimate: F3,
    start: F3,
) -> None:
    """Fill in x̂(k), eq. (13), as `estimate` and `start`; see `Estimator` for the shapes."""
    reach = inputs.shape[2]
    for i in range(len(rows)):
        row = rows[i]
        for axis in range(len(model)):
            p, v = state[row, axis, 0], state[row, axis, 1]
            if compensate:
                for step in range(observed_step[row], steps[i]):
                    u = inputs[row, axis, min(step, last_step[row]) % reach]
                    p, v = advance(model[axis], p, v, u)
            estimate[i, axis, 0], estimate[i, axis, 1] = p, v
            start[i, axis, 0], start[i, axis, 1] = p, v


@kernel
def _write_down(inputs: F3, last_step: I1, rows: I1, steps: I1, horizons: S3) -> None:
    """Put the first input of each horizon into the history `inputs`, see `Estimator.remember`."""
    reach = inputs.shape[2]
    for i in range(len(rows)):
        row, step, last = rows[i], steps[i], last_step[rows[i]]
        if last >= 0:
            for axis in range(horizons.shape[1]):
                held = inputs[row, axis, last % reach]
                for missed in range(max(last + 1, step - reach + 1), step):
                    inputs[row, axis, missed % reach] = held
        for axis in range(horizons.shape[1]):
            inputs[row, axis, step % reach] = horizons[i, axis, 0]
        last_step[row] = step
