"""Normal random numbers for a simulated vehicle's wind and noise, drawn in blocks of many steps.

The numbers are the same as if drawn step by step: numpy fills an array one number after another.
"""

import numpy as np

from skytether.shared.law.model import Array

BLOCK = 256


class Normals:
    """Normal random numbers of a stream, step by step.

    Args:
        rng: stream to draw from; nothing else may draw from it before `give_back`.
        shape: shape of the numbers of a step.
    """

    def __init__(self, rng: np.random.Generator, shape: tuple[int, ...]) -> None:
        self._rng, self._shape = rng, shape
        self._before = rng.bit_generator.state
        self._block = np.empty((0, *shape))
        self._used = 0

    def next(self) -> Array:
        if self._used == len(self._block):
            self._before = self._rng.bit_generator.state
            self._block = self._rng.standard_normal((BLOCK, *self._shape))
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]

    def give_back(self) -> None:
        """Rewind the stream to its state after the used numbers."""
        if self._used < len(self._block):
            self._rng.bit_generator.state = self._before
            self._rng.standard_normal((self._used, *self._shape))
        self._block, self._used = self._block[:0], 0
