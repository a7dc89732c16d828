"""Model of the vehicle: a first-order velocity loop per axis, eq. (1)-(4).

Per axis the state is x = [p, v] (position [m], velocity [m/s]) and the input u the desired velocity
[m/s]; v follows g u, with the gain g and the time constant tau; for the dead time see
`shared.law.dead_time`. The axes are not coupled, so the model of the whole vehicle is one 2 x 2
system per axis, and the same code serves 2-D and 3-D:

    p(k+1) = p(k) + a01 v(k) + b0 u(k)          A = [[1, a01],   B = [b0,
    v(k+1) =        a11 v(k) + b1 u(k)               [0, a11]]        b1]

`advance` is the only implementation of eq. (4). Its arguments are the numbers of one axis or the
arrays of all axes. It is compiled into every kernel that predicts a state.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
"""Rows of vehicles or step indices, one per vehicle; shape (n,)."""
Flags = NDArray[np.bool_]
"""Flag of each vehicle; shape (n,)."""
ALTITUDE = 2
"""Index of the vertical axis, if there is one."""


class Axis(NamedTuple):
    """Coefficients of the discretised model, eq. (4), on one axis."""

    a01: float
    """Change of position in a step for each m/s of velocity [s]."""
    a11: float
    """Factor of the velocity in a step."""
    b0: float
    """Change of position in a step for each m/s of input [s]."""
    b1: float
    """Change of velocity in a step for each m/s of input."""


class Model(NamedTuple):
    """Coefficients of the discretised model, eq. (4), on every axis as in `Axis`; each of shape
    (axes,).
    """

    a01: Array
    a11: Array
    b0: Array
    b1: Array

    def axes(self) -> list[Axis]:
        # Python's floats, because numpy takes twice as long for the few axes of a vehicle.
        columns = [field.tolist() for field in self]
        return [Axis(*numbers) for numbers in zip(*columns, strict=True)]

    def step(self, x: Array, u: Array | float) -> Array:
        """State one step later; x of shape (..., axes, 2), u of shape (..., axes)."""
        return np.stack(advance(self, x[..., 0], x[..., 1], u), -1)

    def roll(self, x: Array, inputs: Array) -> Array:
        """States under successive inputs, starting with x; shape (n + 1, axes, 2).

        Args:
            x: initial state; shape (axes, 2).
            inputs: one per step [m/s]; shape (axes, n).
        """
        states = []
        for axis, (p, v), along in zip(self.axes(), x.tolist(), inputs.tolist(), strict=True):
            of_axis = [(p, v)]
            for u in along:
                p, v = advance(axis, p, v, u)  # noqa: PLW2901 - predicted step by step
                of_axis.append((p, v))
            states.append(of_axis)
        return np.array(states).swapaxes(0, 1)

    @property
    def A(self) -> Array:  # noqa: N802 - the paper's letter
        """Matrix A of the discretised model; shape (axes, 2, 2).

        Source: eq. (4).
        """
        one, zero = np.ones_like(self.a01), np.zeros_like(self.a01)
        return np.stack([np.stack([one, self.a01], -1), np.stack([zero, self.a11], -1)], -2)

    @property
    def B(self) -> Array:  # noqa: N802 - the paper's letter
        """Matrix B of the discretised model; shape (axes, 2).

        Source: eq. (4).
        """
        return np.stack([self.b0, self.b1], -1)


def advance(axis: Any, p: Any, v: Any, u: Any) -> tuple[Any, Any]:
    """Position and velocity one step later, x(k+1) = A x(k) + B u(k).

    Args:
        axis: an `Axis` and numbers, or a `Model` and arrays whose last axis is the spatial one.
        p, v, u: position [m], velocity and input [m/s].

    Source: eq. (4).
    """
    # The order of these operations matters: client and compiled kernels must agree to the last bit.
    return p + axis.a01 * v + axis.b0 * u, axis.a11 * v + axis.b1 * u


def discretise(
    tau_s: Array | Sequence[float], dt_s: float, gain: Array | Sequence[float] | float = 1.0
) -> Model:
    """Exact zero-order hold of the continuous model: the matrix exponential in closed form.

    Args:
        tau_s: time constant of each axis [s]; shape (axes,).
        dt_s: length of a step [s].
        gain: g, steady velocity over desired velocity, of each axis or of all.

    Source: eqs. (1), (2), (3).
    """
    tau, g = np.asarray(tau_s, dtype=np.float64), np.asarray(gain, dtype=np.float64)
    # 1 - exp(-dt/tau), without cancellation if tau is long.
    settled = -np.expm1(-dt_s / tau)
    B = g * (dt_s - tau * settled), g * settled
    return Model(tau * settled, np.exp(-dt_s / tau), *B)


def white_acceleration(tau_s: Array, dt_s: float) -> Array:
    """Square root L of a step's covariance under white acceleration, L Lᵀ = ∫ e^{As} G Gᵀ e^{Aᵀs}.

    With G = [0, 1], e^{As}G = [τ(1 - e^{-s/τ}), e^{-s/τ}] is integrated over [0, Δt].

    Args:
        tau_s: time constants [s]; shape (axes,).
        dt_s: length of a step [s].

    Returns:
        shape (axes, 2, 2).
    """
    tau = np.asarray(tau_s, dtype=np.float64)
    # expm1 keeps the digits that 1 - exp(-x) loses if a step is much shorter than τ.
    one = -tau * np.expm1(-dt_s / tau)  # ∫ e^{-s/τ}
    two = -0.5 * tau * np.expm1(-2.0 * dt_s / tau)  # ∫ e^{-2s/τ}
    positions = tau**2 * (dt_s - 2.0 * one + two)
    both = tau * (one - two)
    covariance = np.stack([np.stack([positions, both], -1), np.stack([both, two], -1)], -2)
    root: Array = np.linalg.cholesky(covariance).astype(np.float64)
    return root
