"""Serialization of observations and actions in openpi's format: msgpack with numpy arrays.

An array is a map with the byte-string keys `__ndarray__`, `data`, `dtype` and `shape`; a numpy
scalar is a map with `__npgeneric__`, `data` and `dtype`. Only numbers, booleans and texts are
accepted as elements: nothing is unpickled, and the shape of an array must match the size of its
data.
"""

import re
from collections.abc import Callable
from math import prod
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

ARRAY, GENERIC = b"__ndarray__", b"__npgeneric__"
BYTES_MAX = 4_000_000
"""Largest serialized value that is sent [B]; 20 MB of raw images would take 16 s at 10 Mbit/s."""
MADE_BYTES_MAX = 64_000_000
"""Largest serialized value before compression, and largest sum of its decompressed images [B]."""
AXES_MAX = 8
_DTYPE = re.compile(r"[<>|=]?([biuf][1248]|[US][1-9]\d{0,5})")


class ValueRefused(ValueError):
    """Invalid or too large value; the message gives the reason in one line."""


def pack(value: Any) -> bytes:
    """Serialize a value.

    Raises:
        ValueRefused: the value contains other types than numbers, text, bytes, lists, maps and
            arrays, or is nested too deeply.
    """
    try:
        packed: bytes = msgpack.packb(value, default=_described)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueRefused(str(error)) from None
    return packed


def unpack(
    data: bytes, hook: Callable[[dict[Any, Any]], Any] | None = None, most: int = BYTES_MAX
) -> Any:
    """Deserialize a value; its arrays are read-only views of `data`.

    Args:
        hook: called with each map that is not an array; returns the value that replaces the map.
        most: largest allowed size of `data` [B].

    Raises:
        ValueRefused: `data` is too large or invalid, or `hook` refuses a map.
    """
    if len(data) > most:
        raise ValueRefused(f"got {len(data)} B, expected at most {most}")

    def made(table: dict[Any, Any]) -> Any:
        if ARRAY in table:
            return _array(table)
        if GENERIC in table:
            return _dtype(table.get(b"dtype")).type(table.get(b"data"))
        return hook(table) if hook else table

    try:
        return msgpack.unpackb(data, object_hook=made)
    except ValueRefused:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ValueRefused(f"invalid msgpack: {error}") from None


def _described(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and not _DTYPE.fullmatch(value.dtype.str):
        raise ValueRefused(f"got an array of {value.dtype}, expected numbers or texts")
    if isinstance(value, np.ndarray):
        return {
            ARRAY: True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {GENERIC: True, b"data": value.item(), b"dtype": value.dtype.str}
    raise ValueRefused(f"got a {type(value).__name__}, expected numbers, text, lists, maps, arrays")


def _dtype(given: Any) -> "np.dtype[Any]":
    if not isinstance(given, str) or not _DTYPE.fullmatch(given):
        raise ValueRefused(f"got an array of {given!r:.40}, expected numbers or texts")
    return np.dtype(given)


def _array(table: dict[Any, Any]) -> NDArray[Any]:
    dtype, data, shape = _dtype(table.get(b"dtype")), table.get(b"data"), table.get(b"shape")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) > AXES_MAX:
        raise ValueRefused("got an array without data or shape")
    if not all(type(each) is int and each >= 0 for each in shape):
        raise ValueRefused(f"got an array of shape {shape!r:.40}")
    if prod(shape) * dtype.itemsize != len(data):
        raise ValueRefused(f"got {len(data)} B for an array of shape {shape!r:.40} of {dtype}")
    return np.ndarray(shape, dtype, data)
