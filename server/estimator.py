"""Downlink delay compensator, eq. (12)-(13): where the vehicle is now, from where it was.

    x̂(k) = A^τ x(k-τ) + Σ_{i=1…τ} A^{i-1} B û(k-i)        τ: age of the observation in steps

û is the history (12) of the first inputs the server computed, whether sent or not (E12). The sum is
not formed: one step of (4) after the other says the same.

This is the scheme "predictive", and "none", which takes the newest observation for the present.
`server.replay` is the other.
"""

from collections import Counter

import numpy as np
from numba import njit
from numpy.typing import NDArray

from server.scheme import Foresight
from shared.model import Array, Flags, Indices, Model
from shared.protocol import Observation


class Estimator:
    """The paper's `Scheme`: observations and inputs of up to `capacity` vehicles.

    Args:
        model: eq. (4).
        reach: largest τ that is compensated; an older observation gives no estimate.
        compensate: False for "no compensation": x̂(k) is the newest observation, as it is.
    """

    def __init__(self, model: Model, capacity: int, reach: int, *, compensate: bool) -> None:
        axes = len(model.B)
        self.plans_always = True
        self.counts: Counter[str] = Counter()
        self._model = model
        self._reach = reach
        self._compensate = compensate
        self.observed_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest observation, or -1; shape (capacity,)."""
        self._state = np.zeros((capacity, axes, 2))
        self._inputs = np.zeros((capacity, axes, reach))
        """û, a ring over the steps: zero, hovering, where nothing was computed."""
        self._last_step = np.full(capacity, -1, dtype=np.int64)
        """The step whose û was computed last, or -1."""
        self._nothing = np.zeros((capacity, axes, 0))
        self._no_feedback = np.zeros((capacity, axes, 0), dtype=np.float32)

    def forget(self, row: int) -> None:
        """A new vehicle in this row."""
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

    def age(self, rows: Indices, step: Indices) -> Indices:
        """τ: steps between the newest observation and `step`; shape (n,)."""
        return np.maximum(step - self.observed_step[rows], 0)

    def within_reach(self, rows: Indices, step: Indices) -> Flags:
        """See `Scheme`."""
        return (self.observed_step[rows] >= 0) & (self.age(rows, step) <= self._reach)

    def estimate(self, rows: Indices, step: Indices) -> Array:
        """x̂(k) of eq. (13), for vehicles within reach; shape (n, axes, 2)."""
        if not self._compensate:
            return self._state[rows]
        estimate: Array = _fly_on(
            *(self._model.A, self._model.B, self._state, self.observed_step),
            *(self._inputs, self._last_step, rows, step),
        )
        return estimate

    def foresee(self, rows: Indices, step: Indices) -> Foresight:
        """See `Scheme`: planning starts at k, from x̂(k)."""
        estimate, n = self.estimate(rows, step), len(rows)
        nothing, here = self._nothing[:n], np.zeros(n, dtype=np.int64)
        calm = np.zeros(estimate.shape[:2])
        aboard = self._no_feedback[:n]
        return Foresight(estimate, here, estimate, nothing, nothing, calm, aboard)

    def remember(
        self,
        rows: Indices,
        step: Indices,
        foresight: Foresight,  # noqa: ARG002 - the first input is all that (12) asks for
        horizons: NDArray[np.float32],
        sent: Indices,  # noqa: ARG002
    ) -> None:
        """û(k) ← u(k|k), eq. (12), whether sent or not (E12).

        Steps before at which nothing was computed flew on with the input of before them.
        """
        _write_down(self._inputs, self._last_step, rows, step, horizons)


@njit(
    "f8[:,:,::1](f8[:,:,::1], f8[:,::1], f8[:,:,::1], i8[::1], f8[:,:,::1], i8[::1], i8[:], i8[:])",
    cache=True,
    error_model="numpy",
)
def _fly_on(A, B, state, observed_step, inputs, last_step, rows, steps):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    n, axes, reach = len(rows), len(A), inputs.shape[2]
    estimate = np.empty((n, axes, 2))
    for i in range(n):
        row = rows[i]
        for axis in range(axes):
            p, v = state[row, axis, 0], state[row, axis, 1]
            for step in range(observed_step[row], steps[i]):
                u = inputs[row, axis, min(step, last_step[row]) % reach]
                p, v = (
                    A[axis, 0, 0] * p + A[axis, 0, 1] * v + B[axis, 0] * u,
                    A[axis, 1, 0] * p + A[axis, 1, 1] * v + B[axis, 1] * u,
                )
            estimate[i, axis, 0], estimate[i, axis, 1] = p, v
    return estimate


@njit("(f8[:,:,::1], i8[::1], i8[:], i8[:], f4[:,:,:])", cache=True)
def _write_down(inputs, last_step, rows, steps, new):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    reach = inputs.shape[2]
    for i in range(len(rows)):
        row, step, last = rows[i], steps[i], last_step[rows[i]]
        if last >= 0:
            for axis in range(new.shape[1]):
                held = inputs[row, axis, last % reach]
                for missed in range(max(last + 1, step - reach + 1), step):
                    inputs[row, axis, missed % reach] = held
        for axis in range(new.shape[1]):
            inputs[row, axis, step % reach] = new[i, axis, 0]
        last_step[row] = step
