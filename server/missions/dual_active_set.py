"""Quadratic programs with few variables and many constraints, solve_qp exactly.

    min  ½ xᵀ G x - gᵀ x     C x ≥ b,  with equality in the first rows

by the dual active-set method of Goldfarb and Idnani (1983). It begins at the minimum without
constraints and takes in the constraint that is violated most, one after the other, so its cost
follows those that matter, and not the number there are.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F1, F2, I1, R2, kernel, part
from skytether.shared.law.model import Array

SOLVED, INFEASIBLE, TOO_MANY_ROUNDS = 0, 1, 2
"""Outcome of the solve."""
VIOLATED = 1e-9
"""Violation from which on a constraint counts."""
DEPENDENT = 1e-12
"""Square of a step's length below which a constraint depends on those in force."""
ROUNDS = 10
"""Largest number of constraints taken in, in numbers of variables."""


class Workspace(NamedTuple):
    """Scratch for problems of n variables and m constraints."""

    slack: F1
    """How far each constraint is from being violated; shape (m,)."""
    J: F2
    """Jᵀ, its first rows those of the constraints in force; shape (n, n)."""
    R: F2
    """Upper triangle with the normals in force as Jᵀ sees them; shape (n, n)."""
    work: F2
    """Shape (5, n + 1)."""
    active: I1
    """Constraints in force; shape (n + 1,)."""


def workspace(n: int, m: int) -> Workspace:
    """Scratch for problems of n variables and m constraints."""
    J, R = np.zeros((2, n, n))
    return Workspace(np.zeros(m), J, R, np.zeros((5, n + 1)), np.zeros(n + 1, dtype=np.int64))


class DualActiveSet:
    """Solver of problems with one Hessian.

    Args:
        hessian: G, positive definite; shape (n, n).
    """

    def __init__(self, hessian: NDArray[Any]) -> None:
        self.root = np.linalg.inv(np.linalg.cholesky(hessian))
        """Jᵀ with J Jᵀ = G⁻¹."""
        self._scratch = workspace(len(hessian), 0)

    def solve(self, linear: Array, columns: Array, bounds: Array, equal: int) -> Array | None:
        """The minimum x; None where there is none.

        Args:
            linear: g; shape (n,).
            columns: Cᵀ; shape (n, m).
            bounds: b; shape (m,).
            equal: number of constraints, the first ones, that hold with equality.
        """
        x, scratch = np.empty(len(linear)), self._scratch._replace(slack=np.empty(len(bounds)))
        outcome = _solve(self.root, linear, x, columns, bounds, equal, scratch)
        return x if outcome == SOLVED else None


# Loops run along what lies side by side in memory, so that the compiler makes SIMD of them: C and J
# are kept transposed.


@kernel
def _solve(
    root: F2, linear: F1, x: F1, columns: R2, bounds: F1, equal: int, scratch: Workspace
) -> int:
    """Fill in x; see `solve_qp`."""
    return solve_qp(root, linear, x, columns, bounds, equal, scratch)


@part
def solve_qp(
    root: F2, linear: F1, x: F1, columns: R2, bounds: F1, equal: int, scratch: Workspace
) -> int:
    """Fill in x: moved from the minimum without constraints, G⁻¹ g, to that with them.

    Args:
        root: Jᵀ of the beginning; shape (n, n).
        linear: g; shape (n,).
        x: shape (n,).
        columns, bounds, equal: see `DualActiveSet.solve`.
        scratch: see `workspace`.
    """
    slack, J, R, work, active = scratch
    n, q = len(x), 0
    d, z, r, u, normal = work[0], work[1], work[2], work[3], work[4]
    _start_unconstrained(root, linear, x, J)
    for _ in range(ROUNDS * n):
        # The equality that comes next, or else the constraint that is violated most.
        at = q if q < equal else _most_violated(columns, bounds, equal, x, slack)
        if at < 0:
            return SOLVED
        margin = -bounds[at]
        for j in range(n):
            margin += columns[j, at] * x[j]
        # An equality may be violated on either side: turned so that x always has to go along the
        # normal.
        sign = -1.0 if at < equal and margin > 0.0 else 1.0
        margin *= sign
        for i in range(n):
            normal[i] = sign * columns[i, at]
        multiplier = 0.0
        while True:
            length, gain = _direction(J, R, normal, d, z, r, q)
            dual, dropped = np.inf, -1
            for i in range(q):
                # Equalities are never let go.
                if active[i] >= equal and r[i] > 0.0 and u[i] / r[i] < dual:
                    dual, dropped = u[i] / r[i], i
            # A normal that depends on those in force dropped x no way: only letting one go helps.
            primal = np.inf if length <= DEPENDENT else -margin / gain
            step = min(dual, primal)
            # Neither a step nor a constraint that may leave: no x meets all of them.
            if step == np.inf:
                return INFEASIBLE
            _add_scaled(u, -step, r, q)
            multiplier += step
            if primal < np.inf:
                _add_scaled(x, step, z, n)
                margin += step * gain
            if step == primal:
                _add_constraint(J, R, d, q)
                active[q], u[q] = at, multiplier
                q += 1
                break
            _drop_constraint(J, R, u, active, dropped, q)
            q -= 1
    return TOO_MANY_ROUNDS


@part
def _add_scaled(to: F1, factor: float, numbers: F1, count: int) -> None:
    """Add multiples of the first numbers, by a loop: numba takes a second to compile a slice."""
    for i in range(count):
        to[i] += factor * numbers[i]


@part
def _start_unconstrained(root: F2, linear: F1, x: F1, J: F2) -> None:
    """Fill in J, and x with the minimum of the QP without its constraints, J Jᵀ g."""
    for i in range(len(x)):
        x[i] = 0.0
        for j in range(len(x)):
            J[i, j] = root[i, j]
    for i in range(len(x)):
        along = 0.0
        for j in range(len(x)):
            along += root[i, j] * linear[j]
        for j in range(len(x)):
            x[j] += along * root[i, j]


@part
def _most_violated(columns: R2, bounds: F1, equal: int, x: F1, slack: F1) -> int:
    """The inequality that is violated most, or -1."""
    for i in range(len(bounds)):
        slack[i] = -bounds[i]
    for j in range(len(x)):
        xj = x[j]
        for i in range(len(bounds)):
            slack[i] += columns[j, i] * xj
    at, worst = -1, -VIOLATED
    for i in range(equal, len(bounds)):
        if slack[i] < worst:
            at, worst = i, slack[i]
    return at


@part
def _direction(J: F2, R: F2, normal: F1, d: F1, z: F1, r: F1, q: int) -> tuple[float, float]:
    """Fill in the step of x, z, and of the multipliers, r, that a constraint asks for.

    Returns:
        the square of the length of z, and by how much the constraint gains along it.
    """
    n, length, gain = len(J), 0.0, 0.0
    for j in range(n):
        z[j] = 0.0
        d[j] = 0.0
        for i in range(n):
            d[j] += J[j, i] * normal[i]
    for j in range(q, n):
        for i in range(n):
            z[i] += d[j] * J[j, i]
    for i in range(n):
        length += z[i] * z[i]
        gain += z[i] * normal[i]
    for i in range(q - 1, -1, -1):
        r[i] = d[i]
        for j in range(i + 1, q):
            r[i] -= R[i, j] * r[j]
        r[i] /= R[i, i]
    return length, gain


@part
def _add_constraint(J: F2, R: F2, d: F1, q: int) -> None:
    """Put another constraint behind the q in force; d is its normal as Jᵀ sees it."""
    for j in range(len(J) - 1, q, -1):
        _rotate(d, J, j)
    for i in range(q + 1):
        R[i, q] = d[i]


@part
def _drop_constraint(J: F2, R: F2, u: F1, active: I1, dropped: int, q: int) -> None:
    """Remove one of the q constraints in force."""
    for i in range(dropped, q - 1):
        active[i], u[i] = active[i + 1], u[i + 1]
        for j in range(q):
            R[j, i] = R[j, i + 1]
    for i in range(dropped, q - 1):
        # Givens rotations make R a triangle again after the column that left.
        one, other = R[i, i], R[i + 1, i]
        size = np.hypot(one, other)
        if size == 0.0:
            continue
        c, s = one / size, other / size
        for j in range(i, q - 1):
            one, other = R[i, j], R[i + 1, j]
            R[i, j], R[i + 1, j] = c * one + s * other, c * other - s * one
        for j in range(len(J)):
            one, other = J[i, j], J[i + 1, j]
            J[i, j], J[i + 1, j] = c * one + s * other, c * other - s * one


@part
def _rotate(d: F1, J: F2, j: int) -> None:
    """Turn rows j - 1 and j so that d[j] becomes 0."""
    one, other = d[j - 1], d[j]
    size = np.hypot(one, other)
    if other == 0.0:
        return
    c, s = one / size, other / size
    d[j - 1], d[j] = size, 0.0
    for i in range(len(J)):
        one, other = J[j - 1, i], J[j, i]
        J[j - 1, i], J[j, i] = c * one + s * other, c * other - s * one
