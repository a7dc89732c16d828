"""Parts of a record read from bytes, see `record`."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from skytether.shared.telemetry.record import Rows

_NUMBER = re.compile("[<|][biuf][1248]")
"""Numbers in numpy's notation: byte order, kind and size [B]."""


def columns_of(descr: Any) -> np.dtype[np.void]:
    """Columns from numpy's description as JSON: names, kinds of numbers and shapes.

    Raises:
        ValueError: the description is invalid.
    """
    try:
        fields = [(name, kind, *map(tuple, shape)) for name, kind, *shape in descr]
        # numpy would evaluate other kinds like Python code, and could raise any error.
        if not all(_NUMBER.fullmatch(kind) for _, kind, *_ in fields):
            raise ValueError("got a column of another kind, expected numbers")
        columns = np.dtype(fields)
    except TypeError as error:
        raise ValueError(str(error)) from None
    if not columns.itemsize:
        raise ValueError("the description is empty")
    return columns


def parse(part: bytes) -> Rows:
    """Rows of a part; an incomplete last row (of a killed writer) is left out.

    Raises:
        ValueError: the bytes are not a part of a record.
    """
    header, _, body = part.partition(b"\n")
    try:
        columns = columns_of(json.loads(header))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not a part of a record: {error}") from None
    return np.frombuffer(body[: len(body) - len(body) % columns.itemsize], columns)


def read(path: Path) -> Rows:
    """Rows of a part in a file; errors as in `parse`, and OSError."""
    return parse(path.read_bytes())
