"""Values of parameters in MAVLink messages: floats, even if the parameter is an integer.

ArduPilot converts an integer to a float; PX4 sends the integer's bits as those of a float
(`MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST`, `…_BYTEWISE`).
"""

import math
import struct

from skytether.mavlink.dialect import dialect

FLOAT = int(dialect.MAV_PARAM_TYPE_REAL32)
INTEGER = int(dialect.MAV_PARAM_TYPE_INT32)
INTEGERS = frozenset(
    {
        int(dialect.MAV_PARAM_TYPE_UINT8),
        int(dialect.MAV_PARAM_TYPE_INT8),
        int(dialect.MAV_PARAM_TYPE_UINT16),
        int(dialect.MAV_PARAM_TYPE_INT16),
        int(dialect.MAV_PARAM_TYPE_UINT32),
        INTEGER,
    }
)
"""Types of parameters that are integers of at most four bytes."""


def type_of(value: float) -> int:
    return INTEGER if isinstance(value, int) else FLOAT


def to_wire(value: float, *, bytewise: bool) -> float:
    """Float by which a MAVLink message represents a parameter's value.

    Args:
        value: an int for a parameter of type INTEGER.
        bytewise: whether the integer's bits are sent, as PX4 does.
    """
    if bytewise and isinstance(value, int):
        bits: float = struct.unpack("<f", struct.pack("<i", value))[0]
        return bits
    return float(value)


def from_wire(value: float, kind: int, *, bytewise: bool) -> float | None:
    """Value of a received parameter, an int for integer types; None if it is invalid."""
    if kind not in INTEGERS:
        return value if kind == FLOAT and math.isfinite(value) else None
    if bytewise:
        return int(struct.unpack("<i", struct.pack("<f", value))[0])
    return round(value) if math.isfinite(value) else None
