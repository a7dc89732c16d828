"""Confidence intervals of the laboratory's figures, at 95 %.

A mean over independent flights has a Student's t interval. Any other statistic of a sample of
flights (a ratio of means, a rate of growth) has a jackknife interval, computed from the changes of
the statistic when one flight is left out. The fit of `identify` has a robust least-squares
interval, see `lab.identify.fit`.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import special

from skytether.shared.law.model import Array

Estimate = tuple[float | None, float | None]
"""Mean, and half-width of its 95 % interval; None with too few values."""


def students(freedom: int) -> float:
    """Half-width of a 95 % interval in standard errors, for a number of degrees of freedom."""
    # scipy.stats gives the same number, but takes a second to import in each worker.
    return float(special.stdtrit(freedom, 0.975))


def interval(values: Sequence[float]) -> Estimate:
    """Mean of some values, and half-width of its 95 % interval (Student's t).

    The mean is None without values, the interval with fewer than two values.
    """
    if not values:
        return None, None
    mean, n = float(np.mean(values)), len(values)
    if n < 2:
        return mean, None
    return mean, students(n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n)


def jackknife(statistic: Callable[[Array], float], sample: Array) -> tuple[float, float]:
    """Statistic of a sample, and half-width of its 95 % interval (jackknife, Student's t).

    `sample` has a row for each flight, which is independent of the others, and at least two rows.
    """
    n = len(sample)
    others = np.array([statistic(np.delete(sample, row, axis=0)) for row in range(n)])
    return statistic(sample), students(n - 1) * math.sqrt((n - 1) * others.var())
