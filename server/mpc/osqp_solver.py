"""OSQP as a solver of the QPs of `server.mpc.problem`, a reference for the exact solver.

OSQP's interface checks little: a vector of wrong length gives NaN, a NaN stays in its warm start
for ever, and reaching the iteration limit raises no exception. So inputs and results are checked
here. Each call sets its own warm start, so that the answer depends only on problem and guess.
"""

import numpy as np
import osqp
from scipy import sparse

from skytether.server.mpc.problem import Problem
from skytether.server.mpc.riccati import NEAR
from skytether.server.mpc.solver import SolverFailed
from skytether.shared.law.model import Array, Flags

ITERATIONS_MAX = 4000
TOLERANCE = 1e-9
"""Tolerance of both residuals; inputs are then accurate to about 1e-8 m/s, after 30 iterations."""
RHO_PER_CURVATURE = 2.5
"""OSQP's step size divided by the Hessian's mean curvature; chosen for few iterations."""


class OsqpSolver:
    """OSQP, set up once for each axis; later only the vectors of a problem change.

    Source: eq. (10).
    """

    def __init__(self, problem: Problem) -> None:
        self._hessian = problem.hessian
        self._u_max = problem.mpc.bounds
        self._axes = [_set_up(H, b) for H, b in zip(self._hessian, self._u_max, strict=True)]

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        inputs = guess.copy()
        solved = np.ones(len(gradient), dtype=np.bool_)
        for vehicle in range(len(gradient)):
            try:
                for axis in range(len(self._axes)):
                    inputs[vehicle, axis] = self._solve_axis(
                        axis, gradient[vehicle, axis], guess[vehicle, axis]
                    )
            except SolverFailed:
                inputs[vehicle] = guess[vehicle]
                solved[vehicle] = False
        return inputs, solved

    def _solve_axis(self, axis: int, gradient: Array, guess: Array) -> Array:
        # A NaN would stay in OSQP's warm start for all later vehicles.
        if not (np.isfinite(gradient).all() and np.isfinite(guess).all()):
            raise SolverFailed("problem not finite")
        problem, bound = self._axes[axis], self._u_max[axis]
        # Multipliers that make the guess stationary at active bounds; zero elsewhere.
        slope = self._hessian[axis] @ guess + gradient
        multipliers = np.where(np.abs(guess) >= NEAR * bound, -slope, 0.0)
        problem.update(q=gradient)
        problem.warm_start(x=guess, y=multipliers)
        result = problem.solve(raise_error=False)
        if result.info.status_val != osqp.SolverStatus.OSQP_SOLVED:
            raise SolverFailed(result.info.status, result.info.iter)
        if not np.isfinite(result.x).all():
            raise SolverFailed("answer not finite", result.info.iter)
        clipped: Array = np.clip(result.x, -bound, bound)
        return clipped


def _set_up(hessian: Array, bound: float) -> osqp.OSQP:
    H = len(hessian)
    problem = osqp.OSQP()
    problem.setup(
        P=sparse.csc_matrix(np.triu(hessian)),
        q=np.zeros(H),
        A=sparse.eye(H, format="csc"),
        l=np.full(H, -bound),
        u=np.full(H, bound),
        verbose=False,
        eps_abs=TOLERANCE,
        eps_rel=TOLERANCE,
        max_iter=ITERATIONS_MAX,
        rho=RHO_PER_CURVATURE * float(np.trace(hessian)) / H,
        # An adaptive step size would make an answer depend on the problems solved before.
        adaptive_rho=False,
        scaling=0,
        check_termination=5,
        polishing=False,
    )
    return problem
