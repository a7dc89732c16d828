"""Exact solution of quadratic programs with few variables and many constraints.

    min  ½ xᵀ G x - gᵀ x     C x ≥ b,  with equality in the first rows

by the dual active-set method of Goldfarb and Idnani (1983). It starts at the unconstrained minimum
and adds the most violated constraint, one after another, so its cost depends on the constraints
that matter, not on their number.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F1, F2, I1, R2, kernel, part
from skytether.shared.law.model import Array

SOLVED, INFEASIBLE, TOO_MANY_ROUNDS = 0, 1, 2
"""Result of the solver."""
VIOLATED = 1e-9
"""Violation above which a constraint counts as violated."""
DEPENDENT = 1e-12
"""Squared length of a step below which a constraint depends on the active ones."""
ROUNDS = 10
"""Largest number of constraints added, as a multiple of the number of variables."""


class DualWorkspace(NamedTuple):
    """Scratch arrays for problems with n variables and m constraints."""

    slack: F1
    """Slack of each constraint, negative if it is violated; shape (m,)."""
    J: F2
    """Jᵀ, its first rows those of the active constraints; shape (n, n)."""
    R: F2
    """Upper triangle: active normals transformed by Jᵀ; shape (n, n)."""
    work: F2
    """Scratch array; shape (5, n + 1)."""
    active: I1
    """Active constraints; shape (n + 1,)."""


def workspace(n: int, m: int) -> DualWorkspace:
    J, R = np.zeros((2, n, n))
    return DualWorkspace(np.zeros(m), J, R, np.zeros((5, n + 1)), np.zeros(n + 1, dtype=np.int64))


class DualActiveSet:
    """Solver of problems with the same Hessian G, positive definite; shape (n, n)."""

    def __init__(self, hessian: NDArray[Any]) -> None:
        self.root = np.linalg.inv(np.linalg.cholesky(hessian))
        """Jᵀ with J Jᵀ = G⁻¹."""
        self._scratch = workspace(len(hessian), 0)

    def solve(self, linear: Array, columns: Array, bounds: Array, equal: int) -> Array | None:
        """Minimum x; None if infeasible, or not found.

        Args:
            linear: g; shape (n,).
            columns: Cᵀ; shape (n, m).
            bounds: b; shape (m,).
            equal: number of equality constraints, which come first.
        """
        x, scratch = np.empty(len(linear)), self._scratch._replace(slack=np.empty(len(bounds)))
        outcome = _solve(self.root, linear, x, columns, bounds, equal, scratch)
        return x if outcome == SOLVED else None


# Inner loops run along contiguous memory, so that the compiler uses SIMD: C and J are stored
# transposed.


@kernel
def _solve(
    root: F2, linear: F1, x: F1, columns: R2, bounds: F1, equal: int, scratch: DualWorkspace
) -> int:
    return solve_qp(root, linear, x, columns, bounds, equal, scratch)


@part
def solve_qp(
    root: F2, linear: F1, x: F1, columns: R2, bounds: F1, equal: int, scratch: DualWorkspace
) -> int:
    """Move x from the unconstrained minimum G⁻¹ g to the constrained one.

    Args:
        root: initial Jᵀ; shape (n, n).
        linear: g; shape (n,).
        x: output; shape (n,).
        columns, bounds, equal: see `DualActiveSet.solve`.

    Returns:
        SOLVED, INFEASIBLE or TOO_MANY_ROUNDS.
    """
    slack, J, R, work, active = scratch
    n, q = len(x), 0
    d, z, r, u, normal = work[0], work[1], work[2], work[3], work[4]
    _start_unconstrained(root, linear, x, J)
    for _ in range(ROUNDS * n):
        # Next equality, or else the most violated inequality.
        at = q if q < equal else _most_violated(columns, bounds, equal, x, slack)
        if at < 0:
            return SOLVED
        margin = -bounds[at]
        for j in range(n):
            margin += columns[j, at] * x[j]
        # An equality may be violated on either side: its sign is chosen so that x has to move along
        # the normal.
        sign = -1.0 if at < equal and margin > 0.0 else 1.0
        margin *= sign
        for i in range(n):
            normal[i] = sign * columns[i, at]
        multiplier = 0.0
        while True:
            length, gain = _direction(J, R, normal, d, z, r, q)
            dual, dropped = np.inf, -1
            for i in range(q):
                # Equalities are never dropped.
                if active[i] >= equal and r[i] > 0.0 and u[i] / r[i] < dual:
                    dual, dropped = u[i] / r[i], i
            # If the normal depends on the active ones, x cannot move: only dropping one helps.
            primal = np.inf if length <= DEPENDENT else -margin / gain
            step = min(dual, primal)
            # No step is possible and no constraint can be dropped: the problem is infeasible.
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
    """Loop in place of a slice, which takes numba a second to compile."""
    for i in range(count):
        to[i] += factor * numbers[i]


@part
def _start_unconstrained(root: F2, linear: F1, x: F1, J: F2) -> None:
    """Fill in J, and x with the unconstrained minimum J Jᵀ g."""
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
    """Fill in the steps of x (z) and of the multipliers (r) for a constraint.

    Returns:
        squared length of z, and the constraint's gain along it.
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
    """Add a constraint to the q active ones; d is its normal transformed by Jᵀ."""
    for j in range(len(J) - 1, q, -1):
        _rotate(d, J, j)
    for i in range(q + 1):
        R[i, q] = d[i]


@part
def _drop_constraint(J: F2, R: F2, u: F1, active: I1, dropped: int, q: int) -> None:
    for i in range(dropped, q - 1):
        active[i], u[i] = active[i + 1], u[i + 1]
        for j in range(q):
            R[j, i] = R[j, i + 1]
    for i in range(dropped, q - 1):
        # Givens rotations make R triangular again without the dropped column.
        upper, lower = R[i, i], R[i + 1, i]
        size = np.hypot(upper, lower)
        if size == 0.0:
            continue
        c, s = upper / size, lower / size
        for j in range(i, q - 1):
            upper, lower = R[i, j], R[i + 1, j]
            R[i, j], R[i + 1, j] = c * upper + s * lower, c * lower - s * upper
        for j in range(len(J)):
            upper, lower = J[i, j], J[i + 1, j]
            J[i, j], J[i + 1, j] = c * upper + s * lower, c * lower - s * upper


@part
def _rotate(d: F1, J: F2, j: int) -> None:
    """Rotate rows j - 1 and j so that d[j] becomes 0."""
    upper, lower = d[j - 1], d[j]
    size = np.hypot(upper, lower)
    if lower == 0.0:
        return
    c, s = upper / size, lower / size
    d[j - 1], d[j] = size, 0.0
    for i in range(len(J)):
        upper, lower = J[j - 1, i], J[j, i]
        J[j - 1, i], J[j, i] = c * upper + s * lower, c * lower - s * upper
