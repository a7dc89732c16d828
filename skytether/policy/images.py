"""Images of an observation, resized and as JPEG on their way, and arrays again at the policy.

An image is an array of uint8 with three axes, of which the first or the last has length 3 and the
others at least SIDE_MIN. Its key is the path to it, as in `images/wrist` or `observation/image`.
"""

import io
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from skytether.policy.values import MADE_BYTES_MAX, ValueRefused

SIDE_MIN, SIDE_MAX = 32, 4096
JPEG, FIRST = b"__jpeg__", b"channels_first"
QUALITY = 90


def is_image(value: Any) -> bool:
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.ndim != 3:
        return False
    height, width = value.shape[1:] if _is_channels_first(value) else value.shape[:2]
    is_colour = 3 in (value.shape[0], value.shape[2])
    return is_colour and min(height, width) >= SIDE_MIN and max(height, width) <= SIDE_MAX


def _is_channels_first(image: NDArray[np.uint8]) -> bool:
    return image.shape[2] != 3


class Compressor:
    """Images of observations as they are sent.

    Args:
        side: width and height to which images are resized, with black bars that keep their ratio,
            as openpi's `resize_with_pad` does [px]; None sends them as large as they are.
        quality: quality of JPEG, 1 to 100.
        raw: keys of images that are sent as arrays.
    """

    def __init__(
        self, side: int | None = None, quality: int = QUALITY, raw: Collection[str] = ()
    ) -> None:
        self._side, self._quality, self._raw = side, quality, frozenset(raw)
        self.bytes: dict[str, int] = {}
        """Bytes of each image of the newest observation, as it is sent, by its key."""

    def __call__(self, observation: Any) -> Any:
        """The observation, with each image in place as `Unpacker` expects it."""
        self.bytes = {}
        return _mapped(observation, "", self._sent)

    def _sent(self, key: str, value: Any) -> Any:
        if not is_image(value):
            return value
        first = _is_channels_first(value)
        image = Image.fromarray(value.transpose(1, 2, 0) if first else value)
        if self._side and image.size != (self._side, self._side):
            bilinear = Image.Resampling.BILINEAR
            image = ImageOps.pad(image, (self._side, self._side), method=bilinear, color=0)
        if key in self._raw:
            array = np.asarray(image)
            self.bytes[key] = array.nbytes
            return array.transpose(2, 0, 1) if first else array
        file = io.BytesIO()
        image.save(file, "JPEG", quality=self._quality)
        self.bytes[key] = file.tell()
        return {JPEG: file.getvalue(), FIRST: first}


class Unpacker:
    """Images of one observation as they were."""

    def __init__(self) -> None:
        self._left = MADE_BYTES_MAX
        """Bytes that further images may take."""

    def __call__(self, table: dict[Any, Any]) -> Any:
        """Image of a map that `Compressor` made; any other map as it is.

        Raises:
            ValueRefused: it is no image, or all of the observation's are too large.
        """
        if JPEG not in table:
            return table
        try:
            with Image.open(io.BytesIO(table[JPEG]), formats=("JPEG",)) as image:
                width, height = image.size
                self._left -= 3 * width * height
                if self._left < 0:  # checked before memory is taken for it
                    raise ValueRefused(f"got images of more than {MADE_BYTES_MAX} B")
                array = np.asarray(image.convert("RGB"))
        except (OSError, TypeError, SyntaxError, Image.DecompressionBombError) as error:
            raise ValueRefused(f"no image: {error}") from None
        return np.ascontiguousarray(array.transpose(2, 0, 1)) if table.get(FIRST) else array


def _mapped(value: Any, key: str, change: Callable[[str, Any], Any]) -> Any:
    """Value with each array in it changed, given the path of keys to it."""
    if isinstance(value, dict):
        inner = f"{key}/" if key else ""
        return {name: _mapped(each, f"{inner}{name}", change) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_mapped(each, f"{key}/{i}", change) for i, each in enumerate(value)]
    return change(key, value)
