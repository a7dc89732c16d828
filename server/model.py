"""Eq. (4) and the rule of flight, compiled: the functions of `shared`, for the server's kernels."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from shared import model, rule
from shared.kernel import inline, record, records
from shared.model import Axis, Model

AXIS_FIELDS = [(name, "f8") for name in Model._fields]
AXIS = record(*AXIS_FIELDS)
"""One `shared.model.Axis`."""
Axes = Annotated[NDArray[np.void], records(AXIS, 1)]
"""A model as kernels take it; shape (axes,)."""

advance = inline(model.advance)
entry, bounded, lasting = inline(rule.entry), inline(rule.bounded), inline(rule.lasting)
remaining, leading = inline(rule.remaining), inline(rule.leading)
led_back, flown = inline(rule.led_back), inline(rule.flown)


@inline
def axis_at(model: Axes, axis: int) -> Axis:
    """Eq. (4) on one axis, in numbers of its own that stay in registers."""
    at = model[axis]
    return Axis(at.a01, at.a11, at.b0, at.b1)


def axes_of(model: Model) -> Axes:
    """A model as kernels take it; shape (axes,)."""
    return np.array([tuple(axis) for axis in model.axes()], dtype=AXIS)
