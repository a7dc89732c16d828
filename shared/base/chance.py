"""Named random streams: the same seed and names give the same numbers in any process."""

import zlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Independent random generator for one purpose, as in `stream(3, "uplink", "delay", flow)`."""
    # The number of names comes first, because SeedSequence treats [1, 2] and [1, 2, 0] alike.
    numbers = [zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names]
    return np.random.Generator(
        np.random.Philox(np.random.SeedSequence([seed, len(numbers), *numbers]))
    )
