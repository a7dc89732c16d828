"""Functions of numbers and arrays that fly aboard as plain Python, and that virtual time compiles.

A vehicle takes a step every few milliseconds and needs no compiler; a laboratory flies thousands of
vehicles in one process. Both call the same functions: `shared.base.kernel.compile_all` puts machine
code into those marked here, and the numbers stay equal to the last bit.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])

Numbers = Annotated[NDArray[np.float64], 1]
"""Numbers one after the other; the 1 tells the compiler the number of dimensions."""
Table = Annotated[NDArray[np.float64], 2]
"""Numbers in rows of equal length, one row after the other in memory."""

COMPILABLE: list[Any] = []
"""All functions marked so far."""


def compilable(function: F) -> F:
    """A function that `compile_all` may put machine code into.

    Its parameters are ints, floats, bools, `Numbers` and `Table`, all by position and all
    contiguous; it makes no arrays, and writes its results into those that it is given.
    """
    call: Any = partial(function)
    COMPILABLE.append(call)
    return call
