"""Solvers for the same QPs: each a `server.mpc.solver.Solver` for one vehicle, set up once.

The QP of an axis is given to a solver in one of two forms: condensed, in the H inputs alone, or
sparse, in inputs and states, with eq. (4) as constraints. In the sparse form the free response is
eliminated as well (its states start at zero), so that both forms share one gradient:

    minimise  Σ ½ xᵢ₊₁ᵀ Wᵢ xᵢ₊₁ + ½ ρᵢ uᵢ² + gᵢ uᵢ,   xᵢ₊₁ = A xᵢ + B uᵢ,   x₀ = 0,   |uᵢ| ≤ u_max
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from typing import Any

import daqp
import numpy as np
import osqp
from scipy import sparse
from scipy.linalg import block_diag

from skytether.server.mpc.exact import ExactSolver
from skytether.server.mpc.osqp_solver import OsqpSolver
from skytether.server.mpc.problem import Problem
from skytether.server.mpc.solver import Solver
from skytether.shared.law.model import Array, Flags

Factory = Callable[[Problem], Solver]


def by_axis(problem: Problem) -> Iterator[tuple[Array, float]]:
    """Hessian and bound [m/s] of each axis."""
    return zip(problem.hessian, problem.mpc.bounds, strict=True)


def weights(problem: Problem) -> tuple[Array, Array]:
    """Weights of the states 1 … H and of the inputs; shape (H, 2) and (H,)."""
    return problem.mpc.weights.states, problem.mpc.weights.inputs[problem.which]


@dataclass(frozen=True)
class Block:
    """QP: minimise ½ zᵀPz + qᵀz, lower ≤ Cz ≤ upper; z begins with the inputs of some axes."""

    P: sparse.csc_matrix
    C: sparse.csc_matrix
    lower: Array
    upper: Array
    axes: slice


def condensed(problem: Problem) -> list[Block]:
    """Problems in the inputs alone, one for each axis."""
    blocks = []
    for axis, (hessian, bound) in enumerate(by_axis(problem)):
        H = len(hessian)
        box, limit = sparse.eye(H, format="csc"), np.full(H, bound)
        blocks.append(Block(sparse.csc_matrix(hessian), box, -limit, limit, slice(axis, axis + 1)))
    return blocks


def joint(problem: Problem) -> list[Block]:
    """Problem of all axes in the inputs alone; its Hessian is block diagonal."""
    axes, H = problem.hessian.shape[:2]
    bound = np.repeat(problem.mpc.bounds, H)
    hessian = sparse.block_diag(list(problem.hessian), format="csc")
    return [Block(hessian, sparse.eye(axes * H, format="csc"), -bound, bound, slice(0, axes))]


def with_states(problem: Problem) -> list[Block]:
    """Problem of all axes in inputs and states."""
    axes, H = problem.hessian.shape[:2]
    A, B = problem.model.A, problem.model.B
    of_states, of_inputs = weights(problem)
    diagonal = np.concatenate([np.tile(of_inputs, axes), np.tile(of_states.ravel(), axes)])
    inputs = sparse.block_diag([sparse.kron(sparse.eye(H), B[a][:, None]) for a in range(axes)])
    before = sparse.eye(H, k=-1)
    states = sparse.block_diag([sparse.kron(before, A[a]) - sparse.eye(2 * H) for a in range(axes)])
    box = sparse.hstack([sparse.eye(axes * H), sparse.csc_matrix((axes * H, 2 * axes * H))])
    rows = sparse.vstack([sparse.hstack([inputs, states]), box], format="csc")
    zero, bound = np.zeros(2 * axes * H), np.repeat(problem.mpc.bounds, H)
    limits = np.concatenate([zero, bound])
    P = sparse.diags(diagonal, format="csc")
    return [Block(P, rows, -limits, limits, slice(0, axes))]


Form = Callable[[Problem], list[Block]]
FORMS: dict[str, Form] = {
    "condensed, by axis": condensed,
    "condensed, jointly": joint,
    "with states": with_states,
}


@dataclass(frozen=True)
class Tuning:
    """OSQP's settings at a tolerance of 1e-6; with a fixed step size it never refactorises."""

    form: str
    rho: float
    scaling: int

    def __str__(self) -> str:
        scaled = f"scaling {self.scaling}"
        return f"{self.form}, eps 1e-6, rho {self.rho:g}, {scaled}, check every 10"

    def make(self, problem: Problem) -> Solver:
        return Osqp(
            problem,
            FORMS[self.form],
            eps_abs=1e-6,
            eps_rel=1e-6,
            rho=self.rho,
            adaptive_rho=False,
            scaling=self.scaling,
            check_termination=10,
        )


TUNINGS = [Tuning(*choice) for choice in product(FORMS, (1.0, 2.0, 3.0, 5.0), (0, 10))]


class Osqp:
    """OSQP by its own interface, warm-started from its solution of the previous step."""

    def __init__(self, problem: Problem, form: Form, **settings: Any) -> None:
        self._bound = problem.mpc.bounds[:, None]
        self._blocks = []
        for block in form(problem):
            solver, q = osqp.OSQP(), np.zeros(block.P.shape[0])
            solver.setup(
                P=sparse.triu(block.P, format="csc"),
                q=q,
                A=block.C,
                l=block.lower,
                u=block.upper,
                verbose=False,
                **settings,
            )
            self._blocks.append((solver, q, block.axes))

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        inputs, solved = np.empty_like(gradient), True
        for solver, q, axes in self._blocks:
            g = gradient[0, axes].ravel()
            q[: len(g)] = g
            solver.update(q=q)
            result = solver.solve(raise_error=False)
            solved = solved and result.info.status_val == osqp.SolverStatus.OSQP_SOLVED
            inputs[0, axes] = result.x[: len(g)].reshape(-1, gradient.shape[2])
        return np.clip(inputs, -self._bound, self._bound), np.array([solved])


class Daqp:
    """DAQP, condensed: one workspace per axis, with a warm active set."""

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
    """The solver quadprog, condensed: the Hessian is factorised once; no warm start."""

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
    """PIQP, condensed: an interior point with its default tolerances, without warm start."""

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


class QpOases:
    """qpOASES, condensed, by CasADi: a workspace per axis, which keeps its active set."""

    def __init__(self, problem: Problem) -> None:
        import casadi

        quiet: dict[str, Any] = {"print_time": False, "printLevel": "none", "error_on_fail": False}
        self._axes: list[tuple[Any, dict[str, Any]]] = []
        for hessian, bound in by_axis(problem):
            P, none = casadi.DM(hessian), casadi.Sparsity(0, len(hessian))
            solver = casadi.conic("qp", "qpoases", {"h": P.sparsity(), "a": none}, quiet)
            self._axes.append((solver, {"h": P, "lbx": -bound, "ubx": bound}))

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        inputs, solved = np.empty_like(gradient), True
        for axis, (solver, arguments) in enumerate(self._axes):
            inputs[0, axis] = np.asarray(solver(g=gradient[0, axis], **arguments)["x"])[:, 0]
            solved = solved and solver.stats()["success"]
        return inputs, np.array([solved])


class Hpipm:
    """HPIPM, a Riccati interior-point solver, by CasADi: all axes in one problem."""

    def __init__(self, problem: Problem) -> None:
        import casadi

        axes, H = problem.hessian.shape[:2]
        of_states, of_inputs = weights(problem)
        width = 3 * axes  # in each stage: the states of all axes, then their inputs
        columns, states = H * width + 2 * axes, 2 * axes
        rows, diagonal = np.zeros((H * states, columns)), np.zeros(columns)
        A, B = problem.model.A, problem.model.B
        step = np.hstack([block_diag(*A), block_diag(*B[:, :, None]), -np.eye(states)])
        limit = np.full(columns, np.inf)
        limit[:states] = 0.0
        for i in range(H):
            at, then = i * width + states, (i + 1) * width
            rows[i * states : (i + 1) * states, i * width : then + states] = step
            diagonal[at:then], limit[at:then] = of_inputs[i], problem.mpc.bounds
            diagonal[then : then + states] = np.tile(of_states[i], axes)
        P, C = casadi.DM(sparse.diags(diagonal, format="csc")), casadi.DM(sparse.csc_matrix(rows))
        options = {"N": H, "nx": [states] * (H + 1), "nu": [axes] * H + [0], "ng": [0] * (H + 1)}
        # With CasADi's default 1e8 for "no bound" HPIPM does not converge.
        options |= {"inf": 1e3, "hpipm": {"mode": "speed"}}
        options |= {"print_time": False, "error_on_fail": False}
        self._solver = casadi.conic("qp", "hpipm", {"h": P.sparsity(), "a": C.sparsity()}, options)
        self._g = np.zeros(columns)
        self._given: dict[str, Any] = {
            "h": P,
            "a": C,
            "lba": 0.0,
            "uba": 0.0,
            "lbx": -limit,
            "ubx": limit,
        }
        # Positions of the inputs in the solution; shape (axes, H).
        self._inputs = np.arange(H) * width + states + np.arange(axes)[:, None]

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        self._g[self._inputs] = gradient[0]
        answer = np.asarray(self._solver(g=self._g, **self._given)["x"])
        return answer[self._inputs, 0][None], np.array([self._solver.stats()["success"]])


class Ipopt:
    """IPOPT by CasADi, with states: the usual way to write an MPC in Python."""

    def __init__(self, problem: Problem) -> None:
        import casadi

        (block,) = with_states(problem)
        columns, H = block.P.shape[0], problem.hessian.shape[1]
        inputs = problem.mpc.bounds.size * H
        z, g = casadi.SX.sym("z", columns), casadi.SX.sym("g", inputs)
        P, C = casadi.DM(block.P), casadi.DM(block.C[: columns - inputs])
        cost = 0.5 * casadi.bilin(P, z, z) + casadi.dot(g, z[:inputs])
        quiet: dict[str, Any] = {"print_time": False, "error_on_fail": True}
        quiet |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8}
        program = {"x": z, "p": g, "f": cost, "g": casadi.mtimes(C, z)}
        self._solver = casadi.nlpsol("mpc", "ipopt", program, quiet)
        limit = np.full(columns, np.inf)
        limit[:inputs] = np.repeat(problem.mpc.bounds, H)
        self._given: dict[str, Any] = {"lbx": -limit, "ubx": limit, "lbg": 0.0, "ubg": 0.0}
        self._z = np.zeros(columns)

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        self._z[: guess.size] = guess.ravel()
        answer = self._solver(x0=self._z, p=gradient.ravel(), **self._given)
        self._z = np.asarray(answer["x"])[:, 0]
        return self._z[: guess.size].copy().reshape(gradient.shape), np.array([True])


class EmptySolver:
    """Solver that does nothing, to measure the cost of the measurement itself."""

    def __init__(self, problem: Problem) -> None:  # noqa: ARG002 - interface of `Solver`
        self._solved = np.array([True])

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:  # noqa: ARG002
        return guess, self._solved


OURS = "Riccati (ours)"
TUNED = "OSQP, tuned"
NOTHING = "nothing"


def contestants(tuned: Tuning) -> dict[str, Factory]:
    """Installed contestants, by name."""
    extra: dict[str, tuple[str, Factory]] = {
        "quadprog": ("quadprog", Quadprog),
        "PIQP": ("piqp", Piqp),
        "qpOASES": ("casadi", QpOases),
        "HPIPM": ("casadi", Hpipm),
        "IPOPT": ("casadi", Ipopt),
    }
    return {
        OURS: ExactSolver,
        NOTHING: EmptySolver,
        TUNED: tuned.make,
        "OSQP, defaults": lambda problem: Osqp(problem, joint),
        "OSQP, eps 1e-9": OsqpSolver,
        "DAQP": Daqp,
        **{name: make for name, (package, make) in extra.items() if find_spec(package)},
    }
