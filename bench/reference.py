"""Reference solutions of QPs, found by other solvers and then proved to be optimal.

quadprog (or, if it is not installed, bounded least squares of scipy) finds the inputs that are at a
bound. With these fixed, a dense Cholesky factorisation gives the other inputs, and the optimality
conditions are checked: every free input within the box, and no multiplier of the wrong sign.
"""

from importlib.util import find_spec

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import lsq_linear

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
        self._root = np.linalg.cholesky(hessian).T
        self._factor = np.linalg.inv(self._root)
        H = len(hessian)
        self._rows, self._limits = np.hstack([np.eye(H), -np.eye(H)]), np.full(2 * H, -bound)

    def solve(self, gradient: Array) -> Array:
        """Optimal inputs, exact to rounding [m/s]; gradient of shape (H,).

        Raises:
            NoReference: no solution could be proved.
        """
        first = self._first(gradient)
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

    def _first(self, gradient: Array) -> Array:
        if find_spec("quadprog"):
            import quadprog

            arguments = (self._factor, -gradient, self._rows, self._limits, 0, True)
            return quadprog.solve_qp(*arguments)[0]
        aim = -np.linalg.solve(self._root.T, gradient)
        return lsq_linear(self._root, aim, (-self._bound, self._bound), "bvls", tol=1e-15).x

    def _polish(self, side: Array, gradient: Array) -> Array:
        """Optimal inputs when the inputs that are at a bound are fixed there; shape (H,)."""
        inputs, free = side * self._bound, side == 0.0
        if free.any():
            toward = -gradient[free] - self._hessian[np.ix_(free, ~free)] @ inputs[~free]
            factor = cho_factor(self._hessian[np.ix_(free, free)])
            inputs[free] = cho_solve(factor, toward)
        return inputs
