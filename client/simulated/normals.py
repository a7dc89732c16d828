"""Normal numbers of a simulated vehicle's wind and noise, drawn for many steps at a time.

Drawn step by step they are the same: numpy fills an array with one number after the other.
"""

import numpy as np

from skytether.shared.law.model import Array

BLOCK = 256
"""Steps for which numbers are drawn at a time."""


class Normals:
    """Normal numbers of a stream, step by step.

    Args:
        rng: stream that they are drawn from; nothing else may draw from it before `give_back`.
        shape: shape of the numbers of a step.
    """

    def __init__(self, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        self._rng, self._shape = rng, shape
        self._before = rng.bit_generator.state
        """State of the stream before the block was drawn."""
        self._block = np.empty((0, *shape))
        self._used = 0
        """Number of steps of the block that have passed."""

    def next(self) -> Array:
        """Numbers of the next step, of the shape given."""
        if self._used == len(self._block):
            self._before = self._rng.bit_generator.state
            self._block = self._rng.standard_normal((BLOCK, *self._shape))
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]

    def give_back(self) -> None:
        """Rewind the stream to just behind the numbers of the steps that were taken."""
        if self._used < len(self._block):
            self._rng.bit_generator.state = self._before
            self._rng.standard_normal((self._used, *self._shape))
        self._block, self._used = self._block[:0], 0
