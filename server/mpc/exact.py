"""Exact solver of the QPs of `mpc`: an active-set method with a Riccati recursion per iteration.

If the method of `server.mpc.riccati` does not converge, DAQP, a dual active-set method, solves the
QP. DAQP's answer is used only if it meets the optimality conditions.

For a single vehicle DAQP would suffice: 24 µs in place of 10 in a hot loop, the same in a paced
loop. For many vehicles the Riccati method is faster, because it solves their QPs side by side: a
vehicle takes 0.9 to 1.7 µs with 64 vehicles and 0.8 to 1.8 µs with 1000. DAQP, called for one
vehicle after the other, takes 13 to 17 and 21 to 29 µs (axes 2, H = 50; one run at commit df76e24).
"""

import daqp
import numpy as np

from skytether.server.mpc.problem import MPC, WIDTH, Problem, column, set_previous, simd_batch
from skytether.server.mpc.riccati import RiccatiWorkspace, active_sets, workspace
from skytether.server.mpc.solver import SolverFailed
from skytether.shared.base.kernel import B1, F3, kernel
from skytether.shared.law.model import Array, Flags

SNAP = 1e-12
"""Distance from a bound up to which an input of DAQP is moved onto the bound [m/s]."""
RESIDUAL_MAX = 1e-7
"""Largest residual of the optimality conditions of DAQP's answer, relative to the gradient."""


@kernel
def _solve(
    mpc: MPC, which: int, work: RiccatiWorkspace, gradient: F3, guess: F3, inputs: F3, settled: B1
) -> None:
    """Fill in the inputs of n vehicles (n, axes, H), and flags of solved problems (axes n,)."""
    alone, together, n = simd_batch(work.memory), simd_batch(work.together), len(gradient)
    for axis in range(len(mpc.model)):
        first = 0
        while first < n:
            simd = together if n - first >= WIDTH else alone
            L, at = len(simd.p), axis * n + first
            for lane in range(L):
                set_previous(guess[first + lane, axis], 0, False, simd, lane)
                for stage in range(gradient.shape[2]):
                    simd.gradient[stage, lane] = gradient[first + lane, axis, stage]
            active_sets(mpc, axis, which, simd, work.free, settled[at : at + L])
            for lane in range(L):
                column(simd.inputs, lane, inputs[first + lane, axis])
            first += L


class ExactSolver:
    """Exact `server.mpc.solver.Solver`: apart from rounding, answers do not depend on guesses.

    Source: eq. (10).
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.work = workspace(problem.mpc)
        self.fallbacks = 0
        """Number of problems solved by DAQP."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        inputs = np.empty_like(gradient)
        n, axes, _ = gradient.shape
        settled = np.ones((axes, n), dtype=np.bool_)
        mpc, which = self._problem.mpc, self._problem.which
        _solve(mpc, which, self.work, gradient, guess, inputs, settled.reshape(-1))
        solved: Flags = np.all(np.isfinite(gradient), axis=(1, 2))
        for vehicle, axis in np.argwhere(~settled.T & solved[:, None]):
            self.fallbacks += 1
            try:
                inputs[vehicle, axis] = self._dual(int(axis), gradient[vehicle, axis])
            except SolverFailed:
                solved[vehicle] = False
        inputs[~solved] = guess[~solved]
        return inputs, solved

    def _dual(self, axis: int, gradient: Array) -> Array:
        problem = self._problem
        hessian = problem.hessian[axis]
        bound = np.full(len(gradient), problem.mpc.bounds[axis])
        # No general constraints, so that DAQP uses its faster method for simple bounds.
        nothing = np.zeros((0, len(gradient)))
        answer, _, status, info = daqp.solve(
            hessian, gradient, nothing, bound, -bound, primal_tol=1e-12, dual_tol=1e-12
        )
        # DAQP may return an input that misses its bound by a rounding error.
        answer = np.where(np.abs(answer) > bound - SNAP, np.copysign(bound, answer), answer)
        inputs: Array = np.clip(answer, -bound, bound)
        slope = hessian @ inputs + gradient
        # Optimality: the slope is zero inside the bounds, and does not point inwards at a bound.
        slope = np.where(np.abs(inputs) >= bound, np.maximum(np.sign(inputs) * slope, 0.0), slope)
        if not np.abs(slope).max() <= RESIDUAL_MAX * (1.0 + np.abs(gradient).max()):
            raise SolverFailed(f"DAQP status {status}", info["iterations"])
        return inputs
