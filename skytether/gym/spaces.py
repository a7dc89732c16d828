"""Actions as rows of arrays, and observations with their size, for any of Gymnasium's spaces.

The row of an action is an array of the space's shape and dtype. For a Dict or Tuple space it is a
record with a field for each part; the fields of a Tuple are "0", "1" and so on. So in every space,
rows for successive steps are one array that can be sliced, stacked, compared and copied.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from numpy.typing import NDArray

from skytether.shared.base.errors import ConfigError

Space = gymnasium.Space[Any]
NUMBER_BYTES = 8
"""Size of a number outside an array [B]."""


def _parts(space: Space) -> Mapping[str, Space]:
    """Parts of a Dict or a Tuple by name."""
    if isinstance(space, Dict):
        return space.spaces
    assert isinstance(space, Tuple)
    return {str(number): part for number, part in enumerate(space.spaces)}


def no_rows(space: Space, name: str = "action space") -> NDArray[Any]:
    """Empty array of the dtype and row shape of a space's actions; shape (0, *row).

    Raises:
        ConfigError: actions of the space cannot be rows.
    """
    match space:
        case Dict() | Tuple():
            if not _parts(space) or not all(key and isinstance(key, str) for key in _parts(space)):
                raise ConfigError(f"env: got the {name} {space}, expected parts with names")
            every = {key: no_rows(part, f"{name}, {key}") for key, part in _parts(space).items()}
            fields = [(key, rows.dtype, rows.shape[1:]) for key, rows in every.items()]
            return np.zeros(0, fields)
        case Text():
            return np.zeros(0, f"U{space.max_length}")
        case Box() | Discrete() | MultiBinary() | MultiDiscrete():
            return np.zeros((0, *(space.shape or ())), space.dtype)
    expected = "Box, Discrete, MultiBinary, MultiDiscrete or Text, alone or within Dict or Tuple"
    raise ConfigError(f"env: got the {name} {space}, expected {expected}")


def to_rows(space: Space, given: Any, name: str) -> NDArray[Any]:
    """Rows of one action, or of actions for successive steps, as a copy; shape (n, *row).

    Args:
        given: action of the space, or actions with one more axis in front.

    Raises:
        ValueError: the action has a wrong shape, or a number outside the space.
    """
    if isinstance(space, Dict | Tuple):
        every = {
            key: to_rows(part, each, f"{name}, {key}")
            for key, part, each in _given(space, given, name)
        }
        count = len(next(iter(every.values()), ()))
        made = np.zeros(count, no_rows(space).dtype)
        for key, rows in every.items():
            if len(rows) != count:
                raise ValueError(f"{name}, {key}: got {len(rows)} rows, expected {count}")
            made[key] = rows
        return made
    like = no_rows(space)
    try:
        array = np.asarray(given)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    shape = like.shape[1:]
    rows = array[None] if array.shape == shape else array
    if rows.shape[1:] != shape or not rows.ndim:
        wanted = ", ".join(["n", *map(str, shape)])
        raise ValueError(f"{name}: got the shape {array.shape}, expected {shape} or ({wanted})")
    if isinstance(space, Text):
        for text in rows:
            if text not in space:
                raise ValueError(f"{name}: got {str(text)!r}, expected one of {space}")
        return rows.astype(like.dtype)
    return _cast(space, rows, name)


def _given(space: Space, given: Any, name: str) -> list[tuple[str, Space, Any]]:
    """Name, space and value of each part of an action or observation of a Dict or Tuple space."""
    parts = _parts(space)
    fields = getattr(getattr(given, "dtype", None), "names", None)
    if isinstance(space, Tuple) and isinstance(given, tuple | list):
        got: list[Any] = [str(number) for number in range(len(given))]
        by_key: Any = dict(zip(got, given, strict=True))
    elif isinstance(given, Mapping) or fields:
        got, by_key = list(fields or given), given
    else:
        kind = "dict" if isinstance(space, Dict) else "tuple"
        raise ValueError(f"{name}: got {type(given).__name__}, expected a {kind} of {list(parts)}")
    if set(got) != set(parts):
        raise ValueError(f"{name}: got the parts {got}, expected {list(parts)}")
    return [(key, part, by_key[key]) for key, part in parts.items()]


def _cast(space: Space, array: NDArray[Any], name: str) -> NDArray[Any]:
    """Copy of numbers in the dtype of their space; raises ValueError if a value would change."""
    dtype = np.dtype(space.dtype)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name}: got {array.dtype}, expected numbers")
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            made = array.astype(dtype)
        if not np.isfinite(made).all():
            wrong = array[~np.isfinite(made)][0]
            raise ValueError(f"{name}: got {wrong}, expected finite numbers of {dtype}")
        return made
    low, high = _bounds(space, dtype)
    # A cast would turn a uint8 of 300 into 44, and an index of 1.5 into 1.
    right = (array >= low) & (array <= high) & (array == np.floor(array))
    if not right.all():
        wrong, low, high = (
            np.broadcast_to(each, array.shape)[~right][0] for each in (array, low, high)
        )
        raise ValueError(f"{name}: got {wrong}, expected whole numbers from {low} to {high}")
    return array.astype(dtype)


def _bounds(space: Space, dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Smallest and largest whole number of a space, or of each of its elements."""
    match space:
        case Discrete():
            return space.start, space.start + space.n - 1
        case MultiDiscrete():
            return space.start, space.start + space.nvec - 1
    if isinstance(space, MultiBinary) or dtype.kind == "b":
        return 0, 1
    return np.iinfo(dtype).min, np.iinfo(dtype).max


def to_action(space: Space, row: Any) -> Any:
    """Action of a space, from a row of an array of actions."""
    if isinstance(space, Dict | Tuple):
        made = {key: to_action(part, row[key]) for key, part in _parts(space).items()}
        return made if isinstance(space, Dict) else tuple(made.values())
    return str(row) if isinstance(space, Text) else row


def idle_of(space: Space) -> Any:
    """Action of zeros, or the action in the space that is closest to zeros."""
    if isinstance(space, Dict | Tuple):
        made = {key: idle_of(part) for key, part in _parts(space).items()}
        return made if isinstance(space, Dict) else tuple(made.values())
    if isinstance(space, Text):
        return min(space.character_set, default="") * space.min_length
    zeros = np.zeros_like(no_rows(space), shape=space.shape)
    if isinstance(space, Box):
        return np.clip(zeros, space.low, space.high)
    return np.clip(zeros, *_bounds(space, zeros.dtype))


def observed(space: Space, given: Any, name: str = "observation") -> Any:
    """Copy of an observation, with arrays of the dtype of their space.

    Raises:
        ValueError: an array has another shape, or integers that do not fit its dtype.
    """
    if isinstance(space, Dict | Tuple):
        made = {
            key: observed(part, each, f"{name}, {key}")
            for key, part, each in _given(space, given, name)
        }
        return made if isinstance(space, Dict) else tuple(made.values())
    if not isinstance(space, Box | Discrete | MultiBinary | MultiDiscrete):
        return deepcopy(given)
    array = np.asarray(given)
    if array.shape != space.shape:
        raise ValueError(f"{name}: got the shape {array.shape}, expected {space.shape}")
    dtype = np.dtype(space.dtype)
    if array.dtype != dtype and dtype.kind in "biu":
        array = _cast(space, array, name)
    copied = np.array(array, dtype)
    return copied[()] if isinstance(space, Discrete) else copied


def size_of(observation: Any) -> int:
    """Size of the arrays, texts and numbers of an observation [B]."""
    match observation:
        case np.ndarray() | np.generic():
            return int(observation.nbytes)
        case str():
            return len(observation.encode())
        case Mapping():
            return sum(map(size_of, observation.values()))
        case tuple() | list():
            return sum(map(size_of, observation))
        case int() | float() | None:
            return NUMBER_BYTES
    raise ValueError(
        f"observation: got {type(observation).__name__}, expected arrays, numbers, text, "
        "or dicts and tuples of them"
    )
