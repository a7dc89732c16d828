"""A point that is moved while it flies: where it is, and how fast, from the moves alone.

Its velocity is told with a move, or it is the mean of those from move to move, the newer counting
more: v ← v + (1 - exp(-h / MEMORY_S)) · (Δp / h - v), with h the time between two moves. A point
whose velocity is not told and that has not been moved for REST_S rests where it was moved to.
"""

import math

import numpy as np

from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array

MEMORY_S = 0.2
"""Time constant of the mean of velocities [s], the smallest that tolerates moves wrong by 2 cm."""
REST_S = 1.0
"""Time without a move after which a point rests [s]."""


class LivePoint:
    """A point, and how it moves.

    Args:
        position: where it is at first [m]; shape (axes,).
        velocity: its velocity [m/s], or None where nobody tells it; shape (axes,).
        fastest: largest velocity along each axis that moves are taken for [m/s]; shape (axes,).
    """

    def __init__(self, position: Array, velocity: Array | None, fastest: Array) -> None:
        self._position = position
        self._told = velocity is not None
        self._velocity = np.zeros_like(position) if velocity is None else velocity
        self._fastest = fastest
        self._moved_ns: int | None = None
        """Time of its newest move, or of the first time it is asked for with a velocity told."""

    def move(self, position: Array, velocity: Array | None, now_ns: int) -> None:
        """Move the point at once.

        Args:
            position: where it is now [m]; shape (axes,).
            velocity: its velocity [m/s], or None where nobody tells it; shape (axes,).
            now_ns: time of the server [ns].
        """
        self._told = velocity is not None
        self._velocity = self._estimated(position, now_ns) if velocity is None else velocity
        self._position, self._moved_ns = position, now_ns

    def at(self, now_ns: int) -> Array:
        """State: the newest move, carried on by the velocity [m, m/s]; shape (axes, 2)."""
        if self._moved_ns is None:
            if not self._told:
                return np.stack([self._position, self._velocity], axis=-1)
            # With its velocity told, the point moves from the first time that somebody asks for it.
            self._moved_ns = now_ns
        # Never negative: a tick may be due before the move that has just come.
        since_s = max(0, now_ns - self._moved_ns) / SECOND_NS
        # Nobody has moved it for long, so that it is taken to be where it was left.
        if not self._told and since_s > REST_S:
            return np.stack([self._position, np.zeros_like(self._velocity)], axis=-1)
        return np.stack([self._position + since_s * self._velocity, self._velocity], axis=-1)

    def _estimated(self, position: Array, now_ns: int) -> Array:
        """Velocity that its moves make likely [m/s]; shape (axes,)."""
        h_s = (now_ns - self._moved_ns) / SECOND_NS if self._moved_ns is not None else math.inf
        if h_s > REST_S:
            return np.zeros_like(position)
        before = self._velocity
        if h_s > 0.0:
            share = -math.expm1(-h_s / MEMORY_S)
            before = before + share * ((position - self._position) / h_s - before)
        # Two moves a moment apart would else make a velocity that no vehicle can follow.
        velocity: Array = np.clip(before, -self._fastest, self._fastest)
        return velocity
