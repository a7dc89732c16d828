"""Model and rule of flight, compiled for the server's kernels."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from skytether.shared.base.kernel import inline, record, records, shared
from skytether.shared.law import model, rule
from skytether.shared.law.model import Array, Axis, Model
from skytether.shared.law.terms import Terms

AXIS = record(Axis)
Axes = Annotated[NDArray[np.void], records(AXIS, 1)]
"""Model of each axis, for kernels; shape (axes,)."""


class AxisLaw(Axis):
    """Numpy record: model, bound and feedback of one axis. The fields of `Axis` come first."""

    bound: float
    """Bound u_max of the input [m/s]."""
    gain_p: float
    """K on position [1/s]; 0 without feedback."""
    gain_v: float
    """K on velocity; 0 without feedback."""


AXIS_LAW = record(AxisLaw)
Laws = Annotated[NDArray[np.void], records(AXIS_LAW, 1)]
"""An `AxisLaw` for each axis; shape (axes,)."""

advance = shared(model.advance)
bounded, lasting = shared(rule.bounded), shared(rule.lasting)
reference_at, step = shared(rule.reference_at), shared(rule.step)


@inline
def axis_of(record: Axis) -> Axis:
    """Model of one axis as a tuple, whose numbers stay in registers."""
    return Axis(record.a01, record.a11, record.b0, record.b1)


@inline
def axis_at(model: Axes, axis: int) -> Axis:
    return axis_of(model[axis])


def axes_of(model: Model) -> Axes:
    return np.array([tuple(axis) for axis in model.axes()], dtype=AXIS)


def laws_of(terms: Terms, gain: Array) -> Laws:
    """Model, bound and feedback of each axis; the gain K (axes, 2) is rounded as it is sent."""
    laws = np.zeros(terms.axes, dtype=AXIS_LAW)
    for name, numbers in terms.model._asdict().items():
        laws[name] = numbers
    laws["bound"] = terms.u_max
    laws["gain_p"], laws["gain_v"] = gain.T.astype("f4")
    return laws
