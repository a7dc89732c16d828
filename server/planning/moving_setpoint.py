"""A point that an operator moves in flight: its position and velocity, computed from the moves.

The point's velocity is given with a move, or is an exponential average over the moves: v ← v + (1 -
exp(-h / MEMORY_S)) · (Δp / h - v), with h the time between two moves. A point without a given
velocity that has not been moved for REST_S is at rest.
"""

import math

import numpy as np

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario

MEMORY_S = 0.2
"""Time constant of the mean velocity [s], just long enough to smooth errors of 2 cm in moves."""
REST_S = 1.0
"""Time without a move after which a point is at rest [s]."""


class LivePoint:
    """A point that an operator moves; `fastest` limits the velocity estimated from moves [m/s]."""

    def __init__(self, position: Array, velocity: Array | None, fastest: Array) -> None:
        self._position = position
        self._has_velocity = velocity is not None
        self._velocity = np.zeros_like(position) if velocity is None else velocity
        self._fastest = fastest
        self._moved_ns: int | None = None
        """Time of the newest move, or of the first call of `at` if a velocity is given."""

    def move(self, position: Array, velocity: Array | None, now_ns: int) -> None:
        self._has_velocity = velocity is not None
        self._velocity = self._estimated(position, now_ns) if velocity is None else velocity
        self._position, self._moved_ns = position, now_ns

    def at(self, now_ns: int) -> Array:
        """State of the point: its newest move, extrapolated [m, m/s]; shape (axes, 2)."""
        if self._moved_ns is None:
            if not self._has_velocity:
                return np.stack([self._position, self._velocity], axis=-1)
            # With a given velocity the point moves from the first call on.
            self._moved_ns = now_ns
        # The time is at least 0, because a tick may be due before a move that has just arrived.
        since_s = max(0, now_ns - self._moved_ns) / SECOND_NS
        if not self._has_velocity and since_s > REST_S:
            return np.stack([self._position, np.zeros_like(self._velocity)], axis=-1)
        return np.stack([self._position + since_s * self._velocity, self._velocity], axis=-1)

    def _estimated(self, position: Array, now_ns: int) -> Array:
        h_s = (now_ns - self._moved_ns) / SECOND_NS if self._moved_ns is not None else math.inf
        if h_s > REST_S:
            return np.zeros_like(position)
        before = self._velocity
        if h_s > 0.0:
            share = -math.expm1(-h_s / MEMORY_S)
            before = before + share * ((position - self._position) / h_s - before)
        # Two moves within a short time could give a velocity that no vehicle can follow.
        velocity: Array = np.clip(before, -self._fastest, self._fastest)
        return velocity


def live_point(scenario: Scenario) -> LivePoint:
    velocity = scenario.reference.velocity_mps
    start = scenario.unallocated_reference()(np.zeros(()))[:, 0]
    return LivePoint(start, np.array(velocity) if velocity else None, scenario.u_max)
