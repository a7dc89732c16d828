"""Desired trajectories x_d(t): position and velocity at any time (E6 in docs/paper.md: the paper
has positions only).

A reference is a function from time since the epoch [s; any shape] to the desired state
[m, m/s; that shape + (axes, 2)], in the world frame with the third axis up.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from skytether.shared.law.model import Array

FAR_M = 1e6
"""Largest coordinate of a trajectory [m]."""
NORTH_MAX = 85.0
"""Largest latitude of an origin [degrees]."""
FAST_MPS = 1e6
"""Largest velocity along an axis of a trajectory made from points [m/s]."""
SAMPLED_S = np.concatenate([0.2347 * np.arange(512), np.geomspace(121.0, 86_400.0, 64)])
"""Times at which a plug-in's trajectory is checked before a flight [s]: dense for two minutes, then
increasingly sparse up to a day. They are not round numbers, because many trajectories have corners
at round times."""

Reference = Callable[[NDArray[Any]], Array]


class OfFleet(ABC):
    """Desired trajectories of several vehicles. An object is the `Reference` of one of them."""

    @property
    @abstractmethod
    def vehicles(self) -> tuple[int, ...]:
        """Numbers of the vehicles."""

    @abstractmethod
    def __call__(self, t: NDArray[Any]) -> Array:
        """See `Reference`."""

    @abstractmethod
    def of(self, vehicle: int) -> Self:
        """Copy that is the reference of another vehicle."""

    @abstractmethod
    def allocated(self) -> Self:
        """Copy in which the goals are newly allocated to the vehicles."""


def planar(
    x: Callable[[Array], tuple[Array, Array]],
    y: Callable[[Array], tuple[Array, Array]],
    axes: int,
    altitude_m: float,
) -> Reference:
    """Planar curve at constant altitude. `x` and `y` are functions of time that return position and
    velocity.
    """

    def sample(t: Array) -> Array:
        t = np.asarray(t, dtype=np.float64)
        state = np.zeros((*t.shape, axes, 2))
        for axis, curve in zip(range(axes), (x, y), strict=False):
            state[..., axis, 0], state[..., axis, 1] = curve(t)
        if axes == 3:
            state[..., 2, 0] = altitude_m
        return state

    return sample


def reflected(free: Any, bound: float) -> tuple[Any, Any]:
    """Coordinate reflected at walls at ±bound, and its direction: 1, or -1 if reversed.

    Args:
        free: coordinate without walls; number or array.
    """
    crossed = np.floor((free + bound) / (2.0 * bound))
    way = 1.0 - 2.0 * (crossed % 2.0)
    return way * (free - 2.0 * bound * crossed), way


def sampled(reference: Reference, axes: int) -> bytes:
    """States of a trajectory at SAMPLED_S, rounded to mm and mm/s to be equal on every computer.

    Raises:
        ValueError: the states have a wrong type or shape, or are too large or not finite.
    """
    for times in (np.zeros(()), SAMPLED_S):
        states, shape = np.asarray(reference(times)), (*times.shape, axes, 2)
        if states.shape != shape or states.dtype.kind != "f":
            got = f"{states.dtype.name} of shape {states.shape}"
            raise ValueError(f"got {got} at {times.size} times, expected floats of shape {shape}")
        if not (np.abs(states) <= [FAR_M, FAST_MPS]).all():  # NaN is refused, too
            raise ValueError(f"expected at most {FAR_M:g} m from the origin, and {FAST_MPS:g} m/s")
    return np.rint(1000.0 * states).astype(np.int64).tobytes()
