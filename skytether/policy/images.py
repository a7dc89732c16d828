"""Images of observations: resized and JPEG-compressed at the robot end, decoded at the policy end.

An image is an array of uint8 with three axes. The first or the last axis has length 3, the others
SIDE_MIN to SIDE_MAX. An image's key is its path in the observation, as in `images/wrist`.
"""

import io
from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.policy.values import MADE_BYTES_MAX, ValueRefused
from skytether.shared.base import extras

with extras.named("policy"):
    from PIL import Image, ImageOps

SIDE_MIN, SIDE_MAX = 32, 4096
JPEG, FIRST = b"__jpeg__", b"channels_first"
QUALITY = 90
VALUES_MAX = 256
"""Largest number of elements of a list or an array whose elements are shown."""


def is_image(value: Any) -> bool:
    """Whether a value is compressed as an image, see the module."""
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.ndim != 3:
        return False
    height, width = value.shape[1:] if _is_channels_first(value) else value.shape[:2]
    is_colour = 3 in (value.shape[0], value.shape[2])
    return is_colour and min(height, width) >= SIDE_MIN and max(height, width) <= SIDE_MAX


def _is_channels_first(image: NDArray[np.uint8]) -> bool:
    return image.shape[2] != 3


class Compressor:
    """Compression of the images of observations.

    Args:
        side: width and height to which images are resized, padded with black to keep the aspect
            ratio, as in openpi's `resize_with_pad` [px]; None: images are not resized.
        quality: JPEG quality, 1 to 100.
        raw: keys of images that are sent as arrays, without JPEG compression.
    """

    def __init__(
        self, side: int | None = None, quality: int = QUALITY, raw: Collection[str] = ()
    ) -> None:
        self._side, self._quality, self._raw = side, quality, frozenset(raw)
        self.bytes: dict[str, int] = {}
        """Compressed size of each image of the newest observation, by key [B]."""

    def __call__(self, observation: Any) -> Any:
        """Observation with each image replaced by the map that `Unpacker` decodes."""
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
    """Decoder of the images of one observation."""

    def __init__(self) -> None:
        self._left = MADE_BYTES_MAX
        """Remaining memory for further images [B]."""

    def __call__(self, table: dict[Any, Any]) -> Any:
        """Decode a map of `Compressor` into an image; other maps are returned unchanged.

        Raises:
            ValueRefused: the JPEG data are invalid, or the images of the observation together
                exceed MADE_BYTES_MAX.
        """
        if JPEG not in table:
            return table
        try:
            with Image.open(io.BytesIO(table[JPEG]), formats=("JPEG",)) as image:
                width, height = image.size
                self._left -= 3 * width * height
                if self._left < 0:  # checked before memory is allocated
                    raise ValueRefused(f"got images of more than {MADE_BYTES_MAX} B")
                array = np.asarray(image.convert("RGB"))
        except (OSError, TypeError, SyntaxError, Image.DecompressionBombError) as error:
            raise ValueRefused(f"invalid JPEG image: {error}") from None
        return np.ascontiguousarray(array.transpose(2, 0, 1)) if table.get(FIRST) else array


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and values of a nested value; a compressed image and a large list are one value each."""
    if isinstance(value, dict) and not isinstance(value.get(JPEG), bytes):
        for name, each in value.items():
            yield from leaves(each, f"{key}/{name}" if key else str(name))
    elif isinstance(value, list) and len(value) <= VALUES_MAX and not _is_pixels(value):
        for i, each in enumerate(value):
            yield from leaves(each, f"{key}/{i}")
    else:
        yield key, value


def _mapped(value: Any, key: str, change: Callable[[str, Any], Any]) -> Any:
    """Copy of a nested value in which `change(key, leaf)` replaces each leaf."""
    if isinstance(value, dict):
        inner = f"{key}/" if key else ""
        return {name: _mapped(each, f"{inner}{name}", change) for name, each in value.items()}
    if isinstance(value, list) and not _is_pixels(value):
        return [_mapped(each, f"{key}/{i}", change) for i, each in enumerate(value)]
    return change(key, value)


def _is_pixels(value: list[Any]) -> bool:
    """Whether a list is rows of pixels, which would take a second to copy."""
    row = value[0] if value else None
    pixel = row[0] if isinstance(row, list) and row else None
    return isinstance(pixel, list)
