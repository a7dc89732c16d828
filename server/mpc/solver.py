"""Interface of solvers for the box-constrained QPs of `server.mpc.problem`."""

from typing import Protocol

from skytether.shared.law.model import Array, Flags


class SolverFailed(Exception):
    """The QP of one vehicle has no reliable solution."""

    def __init__(self, status: str, iterations: int = 0) -> None:
        super().__init__(f"{status} after {iterations} iterations")
        self.status = status
        self.iterations = iterations


class Solver(Protocol):
    """Solver of QPs with the same Hessian."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """Optimal inputs of n vehicles.

        Args:
            gradient: shape (n, axes, H).
            guess: initial guess of the inputs [m/s]; shape (n, axes, H).

        Returns:
            inputs within the bounds, shape (n, axes, H), and flags of the solved vehicles, shape
            (n,). The inputs of an unsolved vehicle are its guess.
        """
