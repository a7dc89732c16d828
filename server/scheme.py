"""What the schemes of delay compensation have in common: what is foreseen, and asked of each.

`server.replay` is "committed" and "feedback", `server.estimator` "predictive" and "none".
"""

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shared.model import Array, Flags, Indices
from shared.protocol import Observation


@dataclass(frozen=True, slots=True)
class Foresight:
    """What is known of n vehicles at their steps k, before anything is planned."""

    estimate: Array
    """x̂(k); shape (n, axes, 2)."""
    ahead: Indices
    """d: planning starts at k + d; shape (n,)."""
    start: Array
    """x̂(k+d); shape (n, axes, 2)."""
    committed: Array
    """Inputs of k … k+d-1, the first d of the last axis [m/s]; shape (n, axes, H)."""
    held: Array
    """Inputs from k+d on, if nothing more were sent [m/s]; shape (n, axes, H)."""
    disturbance: Array
    """ŵ, an input that nobody gave [m/s]; shape (n, axes)."""
    feedback: NDArray[np.float32]
    """What goes with a horizon, see `shared.protocol.Horizon`; shape (n, axes, 0 or FEEDBACK)."""

    def horizons(self, inputs: Array) -> NDArray[np.float32]:
        """What to send, from k on: the committed inputs, then planned ones from k + d on.

        Args:
            inputs: [m/s]; shape (n, axes, H).

        Returns:
            float32, d + H for each vehicle; shape (n, axes, largest d + H).
        """
        horizons: NDArray[np.float32] = _join(self.committed, self.ahead, inputs)
        return horizons

    def of(self, some: Indices) -> "Foresight":
        """Of some of the vehicles."""
        return Foresight(
            *(self.estimate[some], self.ahead[some], self.start[some]),
            *(self.committed[some], self.held[some], self.disturbance[some]),
            self.feedback[some],
        )


class Scheme(Protocol):
    """What becomes of observations and of horizons that were sent."""

    observed_step: Indices
    """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
    plans_always: bool
    """Whether it has to know what was planned at every step, sent or not."""
    counts: Counter[str]
    """What there is to tell of it."""

    def forget(self, row: int) -> None:
        """A new vehicle in this row."""

    def observe(self, row: int, observation: Observation) -> bool:
        """Keep it, unless a newer one is known (E11); whether it was kept."""

    def within_reach(self, rows: Indices, step: Indices) -> Flags:
        """Which vehicles have been observed, recently enough for an estimate; shape (n,)."""

    def foresee(self, rows: Indices, step: Indices) -> Foresight:
        """The vehicles in `rows` at their steps k, all within reach."""

    def remember(
        self,
        rows: Indices,
        step: Indices,
        foresight: Foresight,
        horizons: NDArray[np.float32],
        sent: Indices,
    ) -> None:
        """What was computed for the steps from k on, and which of it is sent.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            foresight: what it was computed from.
            horizons: [m/s], float32; shape (n, axes, largest d + H).
            sent: which of the n are sent.
        """


@njit("f4[:,:,::1](f8[:,:,::1], i8[:], f8[:,:,::1])", cache=True)
def _join(committed, ahead, inputs):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    n, axes, H = inputs.shape
    horizons = np.zeros((n, axes, H + (ahead.max() if n else 0)), dtype=np.float32)
    for i in range(n):
        d = ahead[i]
        for axis in range(axes):
            for stage in range(d):
                horizons[i, axis, stage] = committed[i, axis, stage]
            for stage in range(H):
                horizons[i, axis, d + stage] = inputs[i, axis, stage]
    return horizons
