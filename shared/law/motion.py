"""Motions of vehicles on a mission: position of a vehicle at every time.

A motion has a knot at every SPACING-th step of the vehicle. The acceleration is constant between
two knots, and the vehicle rests from the last knot on. A motion is sent as a trajectory with the
same knots (`shared.law.spline`): the cubic between two knots equals the motion.
"""

from typing import Annotated, NamedTuple

import numpy as np

from skytether.shared.law.model import Array

SPACING = 10
INTERVALS = 12
JOIN_MAX = 3
"""Largest number of intervals that a new motion copies from the motion in force."""
SAMPLES = 4
"""Number of straight pieces that approximate an interval of a motion."""
INPUT_SHARE = 0.9
"""Share of the input bound that a motion may use."""
MARGIN_M = 0.03
"""Smallest margin of a plan [m], see `Clearances`."""


Knots = Annotated[Array, 2]
"""Values at the knots; shape (knots, axes). The 2 tells kernels the number of dimensions."""


def speed_bounds(u_max: Array, gain: Array, speed_mps: float) -> Array:
    """Largest speed of a motion on each axis [m/s]; shape (axes,).

    Args:
        u_max: bound of the input [m/s]; shape (axes,).
        gain: steady velocity over input; shape (axes,).
        speed_mps: largest speed over all axes [m/s]; 0: limited by the input bound only.
    """
    most: Array = INPUT_SHARE * u_max * gain
    # One bound per axis keeps constraints linear, but allows `speed_mps` only on the diagonal.
    return np.minimum(most, speed_mps / np.sqrt(len(most))) if speed_mps else most


class Motion(NamedTuple):
    """Position of a vehicle at every time; times are counted in the vehicle's own steps."""

    first: int
    """Step of the first knot, a multiple of SPACING."""
    position: Knots
    velocity: Knots
    """Velocity of each knot, 0 at the last [m/s]; shape (knots, axes)."""

    @property
    def last(self) -> int:
        """Step of the last knot; the vehicle rests from there on."""
        return self.first + (len(self.position) - 1) * SPACING

    def at(self, steps: Array, dt_s: float) -> tuple[Array, Array]:
        """Positions [m] and velocities [m/s] at given steps, which may be fractional.

        Before the first knot, the values are those of the first knot.

        Args:
            steps: shape (n,).
            dt_s: length of a step [s].

        Returns:
            two arrays of shape (n, axes).
        """
        knots = len(self.position)
        along = np.clip((steps - self.first) / SPACING, 0.0, knots - 1)
        knot = np.minimum(along.astype(np.int64), max(knots - 2, 0))
        t_s = ((along - knot) * SPACING * dt_s)[:, None]
        v0, v1 = self.velocity[knot], self.velocity[np.minimum(knot + 1, knots - 1)]
        acceleration = (v1 - v0) / (SPACING * dt_s)
        return (
            self.position[knot] + t_s * v0 + 0.5 * t_s * t_s * acceleration,
            v0 + t_s * acceleration,
        )


class Clearances(NamedTuple):
    """Distances that motions of a mission keep [m]."""

    apart_m: float
    """Distance that motions keep from each other: the required separation plus both tubes."""
    tube_m: float
    """Distance that motions keep from zones: the largest distance of a vehicle from its motion."""
    bend_m: float
    """Largest distance of a motion from the straight pieces that approximate it, see SAMPLES."""

    @property
    def margin_m(self) -> float:
        """Distance that a plan keeps in addition to the other clearances [m]. It covers the times
        between the checked times, and the solver's tolerance.
        """
        return max(MARGIN_M, 2.0 * self.bend_m + 0.02)

    @property
    def planned_apart_m(self) -> float:
        return self.apart_m + self.margin_m

    @property
    def planned_clear_m(self) -> float:
        return self.tube_m + self.margin_m


def bend_m(acceleration_mps2: float, dt_s: float) -> float:
    """Largest distance between a motion and the straight pieces that approximate it [m], given the
    motion's largest acceleration; see SAMPLES.
    """
    return acceleration_mps2 * (SPACING / SAMPLES * dt_s) ** 2 / 8.0


def resting(step: int, position: Array) -> Motion:
    at = np.array([position], dtype=np.float64)
    return Motion(step // SPACING * SPACING, at, np.zeros_like(at))
