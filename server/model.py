"""Eq. (4) and the rule of flight, compiled: the functions of `shared`, for the server's kernels."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from shared import model, rule
from shared.kernel import inline, record, records
from shared.model import Model

AXIS_FIELDS = [(name, "f8") for name in Model._fields]
AXIS = record(*AXIS_FIELDS)
"""One `shared.model.Axis`."""
Axes = Annotated[NDArray[np.void], records(AXIS, 1)]
"""A model as kernels take it; shape (axes,)."""

advance = inline(model.advance)
stage_at, entry, bounded = inline(rule.stage_at), inline(rule.entry), inline(rule.bounded)
led_back, flown = inline(rule.led_back), inline(rule.flown)


def axes_of(model: Model) -> Axes:
    """A model as kernels take it; shape (axes,)."""
    return np.array([tuple(axis) for axis in model.axes()], dtype=AXIS)
