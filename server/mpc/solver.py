"""Solver of the box-constrained QPs of `server.mpc.problem`: a batch of them in, inputs out."""

from typing import Protocol

from skytether.shared.law.model import Array, Flags

NEAR = 1.0 - 1e-6
"""Share of its bound at which a guessed input counts as at the bound: guesses were float32."""


class SolverFailed(Exception):
    """The QP of one vehicle has no trustworthy answer."""

    def __init__(self, status: str, iterations: int = 0) -> None:
        super().__init__(f"{status} after {iterations} iterations")
        self.status = status
        self.iterations = iterations


class Solver(Protocol):
    """Solves QPs of one Hessian."""

    def solve(self, gradient: Array, guess: Array) -> tuple[Array, Flags]:
        """The optimal inputs of n vehicles.

        Args:
            gradient: shape (n, axes, H).
            guess: inputs expected to be near [m/s]; shape (n, axes, H).

        Returns:
            inputs within the bounds, shape (n, axes, H), and which vehicles were solved,
            shape (n,). The inputs of a vehicle that was not are its guess.
        """
