"""Solvers for the same QPs: each a `server.mpc.solver.Solver` for one vehicle, set up once.

All get the QPs condensed, in the inputs alone: minimise ½ uᵀHu + gᵀu, |uᵢ| ≤ u_max.
"""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import daqp
import numpy as np
import osqp
from scipy import sparse

from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import Problem
from skytether.server.mpc.solver import Solver
from skytether.shared.law.model import Array, Flags

Factory = Callable[[Problem], Solver]


def by_axis(problem: Problem) -> Iterator[tuple[Array, float]]:
    """Hessian and bound [m/s] of each axis."""
    return zip(problem.hessian, problem.mpc.bounds, strict=True)


RHO = {"smooth": 2.0, "saturated": 3.0}
"""Fastest step size of OSQP in each of the flights of `bench.solvers`."""


def tuned(flight: str) -> Factory:
    """OSQP with a tolerance of 1e-6 and the fastest of 24 tunings (commit 95d9b3a). With a fixed
    step size it never refactorises.
    """
    settings = {"eps_abs": 1e-6, "eps_rel": 1e-6, "rho": RHO[flight], "adaptive_rho": False}
    return lambda problem: Osqp(problem, scaling=0, check_termination=10, **settings)


class Osqp:
    """OSQP by its own interface, all axes in one problem, warm-started from its solution of the
    previous step.
    """

    def __init__(self, problem: Problem, **settings: Any) -> None:
        axes, H = problem.hessian.shape[:2]
        bound = np.repeat(problem.mpc.bounds, H)
        hessian = sparse.block_diag(list(problem.hessian), format="csc")
        self._bound, self._solver = problem.mpc.bounds[:, None], osqp.OSQP()
        self._solver.setup(
            P=sparse.triu(hessian, format="csc"),
            q=np.zeros(axes * H),
            A=sparse.eye(axes * H, format="csc"),
            l=-bound,
            u=bound,
            verbose=False,
            **settings,
        )

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        self._solver.update(q=gradient.ravel())
        result = self._solver.solve(raise_error=False)
        solved = result.info.status_val == osqp.SolverStatus.OSQP_SOLVED
        inputs = np.clip(result.x.reshape(gradient.shape), -self._bound, self._bound)
        return inputs, np.array([solved])


class Daqp:
    """DAQP: one workspace per axis, with a warm active set."""

    def __init__(self, problem: Problem) -> None:
        self._models = []
        for hessian, bound in by_axis(problem):
            H = len(hessian)
            model, box = daqp.Model(), np.full(H, bound)
            model.setup(hessian, np.zeros(H), np.zeros((0, H)), box, -box)
            self._models.append(model)

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        inputs, solved = np.empty_like(gradient), True
        for axis, model in enumerate(self._models):
            model.update(f=gradient[0, axis])
            inputs[0, axis], _, flag, _ = model.solve()
            solved = solved and flag > 0
        return inputs, np.array([solved])


class Quadprog:
    """The solver quadprog: the Hessian is factorised once; no warm start."""

    def __init__(self, problem: Problem) -> None:
        import quadprog

        self._solve = quadprog.solve_qp
        H = problem.hessian.shape[1]
        # quadprog needs the inverse of the upper factor R of the Hessian RᵀR.
        self._factors = [np.linalg.inv(np.linalg.cholesky(h).T) for h in problem.hessian]
        self._rows = np.hstack([np.eye(H), -np.eye(H)])
        self._limits = [np.full(2 * H, -bound) for bound in problem.mpc.bounds]

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        inputs = np.empty_like(gradient)
        for axis, (factor, limits) in enumerate(zip(self._factors, self._limits, strict=True)):
            g = gradient[0, axis]
            inputs[0, axis] = self._solve(factor, -g, self._rows, limits, 0, True)[0]
        return inputs, np.array([True])


class Piqp:
    """PIQP: an interior point with its default tolerances, without warm start."""

    def __init__(self, problem: Problem) -> None:
        import piqp

        self._solved = piqp.PIQP_SOLVED
        self._solvers = []
        for hessian, bound in by_axis(problem):
            solver, box = piqp.DenseSolver(), np.full(len(hessian), bound)
            solver.settings.compute_timings = False
            solver.setup(hessian, np.zeros(len(hessian)), x_l=-box, x_u=box)
            self._solvers.append(solver)

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        inputs, solved = np.empty_like(gradient), True
        for axis, solver in enumerate(self._solvers):
            solver.update(c=gradient[0, axis])
            solved = solver.solve() == self._solved and solved
            inputs[0, axis] = solver.result.x
        return inputs, np.array([solved])


class EmptySolver:
    """Solver that does nothing, to measure the cost of the measurement itself."""

    def __init__(self, problem: Problem) -> None:  # noqa: ARG002 - interface of `Solver`
        self._solved = np.array([True])

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        return guess, self._solved


OURS = "Riccati (ours)"
TUNED = "OSQP, tuned"
NOTHING = "nothing"


def contestants(flight: str) -> dict[str, Factory]:
    """Installed contestants, by name; OSQP is tuned for a flight of `bench.solvers`."""
    extra: dict[str, tuple[str, Factory]] = {
        "quadprog": ("quadprog", Quadprog),
        "PIQP": ("piqp", Piqp),
    }
    return {
        OURS: ExactSolver,
        NOTHING: EmptySolver,
        TUNED: tuned(flight),
        "OSQP, defaults": Osqp,
        "OSQP, eps 1e-9": OsqpSolver,
        "DAQP": Daqp,
        **{name: make for name, (package, make) in extra.items() if find_spec(package)},
    }
