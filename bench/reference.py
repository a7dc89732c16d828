"""Reference solutions of QPs, found by another solver and then proved to be optimal.

DAQP finds the inputs that are at a bound. With these fixed, a dense Cholesky factorisation gives
the other inputs, and the optimality conditions are checked: every free input within the box, and no
multiplier of the wrong sign.
"""

import daqp
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from skytether.shared.law.model import Array

AT_BOUND = 1e-7
"""Distance from a bound within which an input is assumed to be at the bound [m/s]."""
ROUNDS_MAX = 10
"""Largest number of corrections of the assumed set of inputs at a bound."""
ROUNDING = 1e-11
"""Rounding error of a multiplier relative to the gradient, and of an input to its bound."""


class NoReference(Exception):
    """No solution was found that could be proved optimal."""


class Reference:
    """Exact inputs of box-constrained QPs with one Hessian (H, H) and bound [m/s]."""

    def __init__(self, hessian: Array, bound: float) -> None:
        self._hessian, self._bound = hessian, bound
        H = len(hessian)
        box = np.full(H, bound)
        self._model = daqp.Model()
        self._model.setup(hessian, np.zeros(H), np.zeros((0, H)), box, -box)

    def solve(self, gradient: Array) -> Array:
        """Optimal inputs, exact to rounding [m/s]; gradient of shape (H,).

        Raises:
            NoReference: no solution could be proved.
        """
        self._model.update(f=gradient)
        first, *_ = self._model.solve()
        near = self._bound - AT_BOUND
        side = np.where(first >= near, 1.0, np.where(first <= -near, -1.0, 0.0))
        for _ in range(ROUNDS_MAX):
            inputs = self._polish(side, gradient)
            slope = self._hessian @ inputs + gradient
            small = ROUNDING * (1.0 + np.abs(gradient).max())
            outside = np.abs(inputs) > self._bound * (1.0 + ROUNDING)
            inward = side * slope > small
            if not (outside | inward).any():
                return np.clip(inputs, -self._bound, self._bound)
            side = np.where(outside, np.sign(inputs), np.where(inward, 0.0, side))
        raise NoReference

    def _polish(self, side: Array, gradient: Array) -> Array:
        """Optimal inputs when the inputs that are at a bound are fixed there; shape (H,)."""
        inputs, free = side * self._bound, side == 0.0
        if free.any():
            toward = -gradient[free] - self._hessian[np.ix_(free, ~free)] @ inputs[~free]
            factor = cho_factor(self._hessian[np.ix_(free, free)])
            inputs[free] = cho_solve(factor, toward)
        return inputs
