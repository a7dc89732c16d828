"""Downlink delay compensator, eq. (12)-(13): where the vehicle is now, from where it was.

    x̂(k) = A^τ x(k-τ) + Σ_{i=1…τ} A^{i-1} B û(k-i)        τ: age of the observation in steps

û is the history (12) of the first inputs the server computed, whether sent or not (E12).
"""

import numpy as np

from shared.model import Array, Flags, Indices, Model


class Estimator:
    """Observations and inputs of up to `capacity` vehicles.

    Args:
        model: eq. (4).
        reach: largest τ that is compensated; an older observation gives no estimate.
        compensate: False for "no compensation": x̂(k) is the newest observation, as it is.
    """

    def __init__(self, model: Model, capacity: int, reach: int, *, compensate: bool) -> None:
        axes = len(model.B)
        self._reach = reach
        self._compensate = compensate
        self._powers = np.empty((axes, reach + 1, 2, 2))
        """A^τ for τ = 0 … reach."""
        self._powers[:, 0] = np.eye(2)
        for i in range(reach):
            self._powers[:, i + 1] = model.A @ self._powers[:, i]
        self._responses = np.einsum("aipq,aq->aip", self._powers[:, :-1], model.B)
        """A^{i-1} B for i = 1 … reach."""
        self.observed_step = np.full(capacity, -1, dtype=np.int64)
        """Step of the newest observation, or -1; shape (capacity,)."""
        self._state = np.zeros((capacity, axes, 2))
        self._inputs = np.zeros((capacity, axes, reach))
        """û, a ring over the steps: zero, hovering, where nothing was computed."""
        self._last_step = np.full(capacity, -1, dtype=np.int64)

    def forget(self, row: int) -> None:
        """A new vehicle in this row."""
        self.observed_step[row] = -1
        self._inputs[row] = 0.0
        self._last_step[row] = -1

    def observe(self, row: int, step: int, state: Array) -> bool:
        """Keep x(step), unless a newer one is known (E11); whether it was kept."""
        if step <= self.observed_step[row]:
            return False
        self.observed_step[row] = step
        self._state[row] = state
        return True

    def age(self, rows: Indices, step: Indices) -> Indices:
        """τ: steps between the newest observation and `step`; shape (n,)."""
        return np.maximum(step - self.observed_step[rows], 0)

    def within_reach(self, rows: Indices, step: Indices) -> Flags:
        """Which vehicles have been observed, recently enough for an estimate; shape (n,)."""
        return (self.observed_step[rows] >= 0) & (self.age(rows, step) <= self._reach)

    def estimate(self, rows: Indices, step: Indices) -> Array:
        """x̂(k) of eq. (13), for vehicles within reach; shape (n, axes, 2)."""
        observed = self._state[rows]
        if not self._compensate:
            return observed
        self._hold(rows, step)
        age = self.age(rows, step)
        i = np.arange(1, self._reach + 1)
        ring = (step[:, None] - i) % self._reach
        past = np.take_along_axis(self._inputs[rows], ring[:, None, :], axis=2)
        past = np.where((i <= age[:, None])[:, None, :], past, 0.0)
        free = np.einsum("anpq,naq->nap", self._powers[:, age], observed)
        return free + np.einsum("aip,nai->nap", self._responses, past)

    def remember(self, rows: Indices, step: Indices, inputs: Array) -> None:
        """û(k) ← u(k|k), eq. (12); inputs of shape (n, axes)."""
        self._hold(rows, step)
        self._inputs[rows, :, step % self._reach] = inputs
        self._last_step[rows] = step

    def _hold(self, rows: Indices, step: Indices) -> None:
        """Steps before this one at which nothing was computed: û is what it was before them."""
        last = self._last_step[rows]
        held = np.take_along_axis(self._inputs[rows], (last % self._reach)[:, None, None], axis=2)
        missed = np.where(last < 0, 0, np.minimum(step - 1 - last, self._reach))
        for back in range(1, int(missed.max(initial=0)) + 1):
            some = missed >= back
            self._inputs[rows[some], :, (step[some] - back) % self._reach] = held[some, :, 0]
        self._last_step[rows] = np.where(missed > 0, step - 1, last)
