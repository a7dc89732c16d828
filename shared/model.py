"""The UAV as a first-order velocity loop per axis, eq. (1)-(4).

Per axis the state is x = [p, v] (position [m], velocity [m/s]) and the input u the desired velocity
[m/s]; v follows u with the time constant tau. The axes do not couple, so the model of the whole
vehicle is one 2 x 2 system an axis, and the same code flies in 2-D and 3-D.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
"""Rows of vehicles or step indices, one per vehicle; shape (n,)."""
Flags = NDArray[np.bool_]
"""One yes or no per vehicle; shape (n,)."""


@dataclass(frozen=True, slots=True)
class Model:
    """x(k+1) = A x(k) + B u(k), eq. (4), for every axis."""

    A: Array
    """shape (axes, 2, 2)"""
    B: Array
    """shape (axes, 2)"""

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u) of eq. (4): x of shape (..., axes, 2), u of shape (..., axes)."""
        return np.einsum("aij,...aj->...ai", self.A, x) + self.B * u[..., None]

    def roll_out(self, x: Array, inputs: Array) -> Array:
        """States at the stages of a horizon, the first of them x.

        Args:
            x: shape (axes, 2).
            inputs: shape (stages, axes).

        Returns:
            shape (stages, axes, 2).
        """
        # Plain numbers: numpy costs more than it saves on so few.
        states = np.empty((len(inputs), *x.shape))
        for axis, (A, B) in enumerate(zip(self.A.tolist(), self.B.tolist(), strict=True)):
            (p, v), along = x[axis].tolist(), []
            for u in inputs[:, axis].tolist():
                along.append((p, v))
                p, v = A[0][0] * p + A[0][1] * v + B[0] * u, A[1][0] * p + A[1][1] * v + B[1] * u
            states[:, axis] = along
        return states


def discretise(tau_s: Array, dt_s: float) -> Model:
    """Exact zero-order hold of eq. (1)-(3): the matrix exponential in closed form.

    Args:
        tau_s: time constant of each axis [s]; shape (axes,).
        dt_s: length of a step [s].
    """
    tau = np.asarray(tau_s, dtype=np.float64)
    decay = np.exp(-dt_s / tau)
    # 1 - exp(-dt/tau), without cancellation where tau is long.
    settled = -np.expm1(-dt_s / tau)
    one, zero = np.ones_like(tau), np.zeros_like(tau)
    A = np.stack([np.stack([one, tau * settled], -1), np.stack([zero, decay], -1)], -2)
    B = np.stack([dt_s - tau * settled, settled], -1)
    return Model(A, B)
