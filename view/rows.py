"""Rows of the record as plain columns: a number each, with axis and unit in its name.

They are what a recording and an exported table hold. A row lies in memory as before, only the names
are others: so it comes back to the last bit.
"""

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any

import numpy as np

from shared.record import Rows

AXES = "xyz"
"""Names of the axes."""
SHORT = {"inputs": "input"}
"""Names of columns of velocities that have another one here."""
NOT_FINITE = "not_finite"
"""Key of a message for the columns that JSON has no numbers for."""
NAN = np.float64(np.nan)
"""What is meant where a message has no value."""


def plain(columns: np.dtype[np.void]) -> np.dtype[np.void]:
    """Plain columns in place of those of the record, at the same places in memory.

    A state, of shape (axes, 2), becomes `position_x_m`, `velocity_x_mps` and so on, with its name
    before it unless it is `state`. Velocities, of shape (axes,), or (axes, steps) of the inputs of
    a plan, become `input_x_mps` and so on.

    Raises:
        ValueError: a column is none of these, and no number.
    """
    fields: list[Any] = []
    for name in columns.names or ():
        kind = columns[name]
        axes, *rest = kind.shape or (0,)
        if not kind.shape:
            fields.append((name, kind))
        elif axes <= len(AXES) and (not rest or name == "inputs"):
            shape = [tuple(rest)] if rest else []
            fields += [
                (f"{SHORT.get(name, name)}_{axis}_mps", kind.base, *shape) for axis in AXES[:axes]
            ]
        elif axes <= len(AXES) and rest == [2]:
            before = "" if name == "state" else f"{name}_"
            for axis in AXES[:axes]:
                fields.append((f"{before}position_{axis}_m", kind.base))
                fields.append((f"{before}velocity_{axis}_mps", kind.base))
        else:
            raise ValueError(f"column {name}: got shape {kind.shape}, expected that of a state")
    flat = np.dtype(fields)
    if flat.itemsize != columns.itemsize:
        raise ValueError(f"got rows of {columns.itemsize} B, expected {flat.itemsize} B")
    return flat


class Table:
    """Rows of a part as messages, and back.

    A message has a key for each plain column. A number that is not finite is none in JSON: NaN is
    left out, and what else there is stands in the list NOT_FINITE, as "column=bytes in memory".

    Args:
        columns: columns of the rows.

    Raises:
        ValueError: see `plain`.
    """

    def __init__(self, columns: np.dtype[np.void]) -> None:
        self.columns = columns
        """Columns of the rows."""
        self.plain = plain(columns)
        """Plain columns."""
        self.names: tuple[str, ...] = self.plain.names or ()
        """Names of the plain columns."""
        kinds = {name: self.plain[name] for name in self.names if self.plain[name].base.kind == "f"}
        self._numbers = [name for name, kind in kinds.items() if not kind.shape]
        self._lists = [name for name, kind in kinds.items() if kind.shape]

    def schema(self) -> dict[str, Any]:
        """JSON schema of a message."""
        properties: dict[str, Any] = {}
        for name in self.names:
            kind = {"b": "boolean", "f": "number"}.get(self.plain[name].base.kind, "integer")
            several = self.plain[name].shape
            properties[name] = (
                {"type": "array", "items": {"type": kind}} if several else {"type": kind}
            )
        properties[NOT_FINITE] = {"type": "array", "items": {"type": "string"}}
        return {"type": "object", "properties": properties}

    def messages(self, rows: Rows) -> list[dict[str, Any]]:
        """A message for each row."""
        flat = np.ascontiguousarray(rows).view(self.plain)
        values = [flat[name].tolist() for name in self.names]
        messages = [dict(zip(self.names, each, strict=True)) for each in zip(*values, strict=True)]
        for i, message in enumerate(messages):
            odd = [name for name in self._numbers if not isfinite(message[name])]
            odd += [name for name in self._lists if not all(map(isfinite, message[name]))]
            for name in odd:
                del message[name]
                bits = flat[name][i].tobytes()
                if bits != NAN.astype(self.plain[name].base).tobytes():
                    message.setdefault(NOT_FINITE, []).append(f"{name}={bits.hex()}")
        return messages

    def rows(self, messages: Iterable[Mapping[str, Any]]) -> Rows:
        """The rows that messages were made of.

        Raises:
            ValueError: these are no messages of such rows.
        """
        given = list(messages)
        lists = {name: np.full(self.plain[name].shape, NAN) for name in self._lists}
        absent = dict.fromkeys(self._numbers, NAN) | lists
        names = [(name, absent.get(name)) for name in self.names]
        try:
            values = [tuple(each.get(name, default) for name, default in names) for each in given]
            flat = np.array(values, self.plain)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"a row is none: {error}") from None
        for i, message in enumerate(given):
            for each in message.get(NOT_FINITE, ()):
                name, _, bits = each.partition("=")
                kind = self.plain[name] if name in absent else None
                if kind is None or len(bits) != 2 * kind.itemsize:
                    raise ValueError(f"a row has {each[:40]!r} for a number")
                flat[name][i] = np.frombuffer(bytes.fromhex(bits), kind)[0]
        return flat.view(self.columns)
