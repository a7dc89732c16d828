"""Functions that are interpreted as plain Python aboard, and compiled in virtual time.

A vehicle computes only its own steps and needs no compiler; simulations fly thousands of vehicles
in one process. Both call the same functions: `shared.base.kernel.compile_all` replaces the
functions marked here by machine code, with results equal to the last bit.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])

Numbers = Annotated[NDArray[np.float64], 1]
"""One-dimensional contiguous array; the 1 is the number of dimensions, for the compiler."""
Table = Annotated[NDArray[np.float64], 2]
"""Two-dimensional contiguous array, row by row."""

COMPILABLE: list[Any] = []


def compilable(function: F) -> F:
    """Mark a function that `compile_all` may replace by machine code.

    Its parameters are ints, floats, bools, `Numbers` and `Table`, all positional and contiguous;
    the function creates no arrays, and writes its results into arrays passed to it.
    """
    call: Any = partial(function)
    COMPILABLE.append(call)
    return call
