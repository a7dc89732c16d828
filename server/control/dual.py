"""Quadratic programs with few variables and many constraints, solved exactly.

    min  ½ xᵀ G x - gᵀ x     C x ≥ b,  with equality in the first rows

by the dual active-set method of Goldfarb and Idnani (1983). It begins at the minimum without
constraints and takes in the constraint that is violated most, one after the other, so its cost
follows those that matter, and not the number there are.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import F1, F2, I1, R2, kernel, part
from skytether.shared.law.model import Array

SOLVED, INFEASIBLE, ENDLESS = 0, 1, 2
"""Outcome of the solve."""
VIOLATED = 1e-9
"""Violation from which on a constraint counts."""
DEPENDENT = 1e-12
"""Square of a step's length below which a constraint depends on those in force."""
ROUNDS = 10
"""Largest number of constraints taken in, in numbers of variables."""


class DualSolver:
    """Solves problems with one Hessian.

    Args:
        hessian: G, positive definite; shape (n, n).
    """

    def __init__(self, hessian: NDArray[Any]) -> None:
        self.root = np.linalg.inv(np.linalg.cholesky(hessian))
        """Jᵀ with J Jᵀ = G⁻¹."""
        n = len(hessian)
        self._basis, self._triangle = np.zeros((n, n)), np.zeros((n, n))
        self._work = np.zeros((5, n + 1))
        self._active = np.zeros(n + 1, dtype=np.int64)

    def solve(self, linear: Array, columns: Array, least: Array, equal: int) -> Array | None:
        """The minimum x; None where there is none.

        Args:
            linear: g; shape (n,).
            columns: Cᵀ; shape (n, m).
            least: b; shape (m,).
            equal: number of constraints, the first ones, that hold with equality.
        """
        x = np.empty(len(linear))
        scratch = np.empty(len(least)), self._basis, self._triangle, self._work, self._active
        done = _solve(self.root, linear, x, columns, least, equal, *scratch)
        return x if done == SOLVED else None


# Loops run along what lies side by side in memory, so that the compiler makes SIMD of them: C and J
# are kept transposed.


@kernel
def _solve(
    root: F2,
    linear: F1,
    x: F1,
    columns: R2,
    least: F1,
    equal: int,
    slack: F1,
    J: F2,
    R: F2,
    work: F2,
    active: I1,
) -> int:
    """Fill in x; see `solved`."""
    return solved(root, linear, x, columns, least, equal, slack, J, R, work, active)


@part
def solved(
    root: F2,
    linear: F1,
    x: F1,
    columns: R2,
    least: F1,
    equal: int,
    slack: F1,
    J: F2,
    R: F2,
    work: F2,
    active: I1,
) -> int:
    """Fill in x: moved from the minimum without constraints, G⁻¹ g, to that with them.

    Args:
        root: Jᵀ of the beginning; shape (n, n).
        linear: g; shape (n,).
        x: shape (n,).
        columns, least, equal: see `DualSolver.solve`.
        slack: scratch: how far each constraint is from being violated; shape (m,).
        J: scratch: Jᵀ, its first rows those of the constraints in force; shape (n, n).
        R: scratch: upper triangle with the normals in force as Jᵀ sees them; shape (n, n).
        work: scratch; shape (5, n + 1).
        active: scratch: constraints in force; shape (n + 1,).
    """
    n, q = len(x), 0
    d, z, r, u, normal = work[0], work[1], work[2], work[3], work[4]
    _begin(root, linear, x, J)
    for _ in range(ROUNDS * n):
        # The equality that comes next, or else the constraint that is violated most.
        at = q if q < equal else _most_violated(columns, least, equal, x, slack)
        if at < 0:
            return SOLVED
        room = -least[at]
        for j in range(n):
            room += columns[j, at] * x[j]
        # An equality may be violated on either side: turned so that x always has to go along the
        # normal.
        sign = -1.0 if at < equal and room > 0.0 else 1.0
        room *= sign
        for i in range(n):
            normal[i] = sign * columns[i, at]
        price = 0.0
        while True:
            length, gain = _direction(J, R, normal, d, z, r, q)
            dual, leaves = np.inf, -1
            for i in range(q):
                # Equalities are never let go.
                if active[i] >= equal and r[i] > 0.0 and u[i] / r[i] < dual:
                    dual, leaves = u[i] / r[i], i
            # A normal that depends on those in force leaves x no way: only letting one go helps.
            primal = np.inf if length <= DEPENDENT else -room / gain
            step = min(dual, primal)
            # Neither a step nor a constraint that may leave: no x meets all of them.
            if step == np.inf:
                return INFEASIBLE
            _add(u, -step, r, q)
            price += step
            if primal < np.inf:
                _add(x, step, z, n)
                room += step * gain
            if step == primal:
                _bring_in(J, R, d, q)
                active[q], u[q] = at, price
                q += 1
                break
            _let_go(J, R, u, active, leaves, q)
            q -= 1
    return ENDLESS


@part
def _add(to: F1, factor: float, numbers: F1, count: int) -> None:
    """Add multiples of the first numbers, by a loop: numba takes a second to compile a slice."""
    for i in range(count):
        to[i] += factor * numbers[i]


@part
def _begin(root: F2, linear: F1, x: F1, J: F2) -> None:
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
def _most_violated(columns: R2, least: F1, equal: int, x: F1, slack: F1) -> int:
    """The inequality that is violated most, or -1."""
    for i in range(len(least)):
        slack[i] = -least[i]
    for j in range(len(x)):
        xj = x[j]
        for i in range(len(least)):
            slack[i] += columns[j, i] * xj
    at, worst = -1, -VIOLATED
    for i in range(equal, len(least)):
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
def _bring_in(J: F2, R: F2, d: F1, q: int) -> None:
    """Put another constraint behind the q in force; d is its normal as Jᵀ sees it."""
    for j in range(len(J) - 1, q, -1):
        _turn(d, J, j)
    for i in range(q + 1):
        R[i, q] = d[i]


@part
def _let_go(J: F2, R: F2, u: F1, active: I1, leaves: int, q: int) -> None:
    """Remove one of the q constraints in force."""
    for i in range(leaves, q - 1):
        active[i], u[i] = active[i + 1], u[i + 1]
        for j in range(q):
            R[j, i] = R[j, i + 1]
    for i in range(leaves, q - 1):
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
def _turn(d: F1, J: F2, j: int) -> None:
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
