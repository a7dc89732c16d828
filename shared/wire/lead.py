"""LEAD, the message about the server that leads a vehicle, and the leadership number in plans.

`protocol` has the type number of LEAD and imports this module when needed, like `path_proof`.
HORIZON and TRAJECTORY to a vehicle with two servers have one more field at the end:

    leadership  leadership number for which the plan was made, see `Lead`; 0 is not sent
"""

from typing import NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from skytether.shared.law.limits import Limits
from skytether.shared.law.terms import Terms
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import (
    FLAG,
    U16,
    U31,
    U32,
    Horizon,
    Message,
    OrNone,
    Trajectory,
    add,
    checked,
    decode,
    is_plain,
    kind_of,
    knots_in,
    number_of,
    unpacked,
)

PLANS = {number_of(plan): len(plan._fields) + 3 for plan in (Horizon, Trajectory)}
"""Number of elements of an encoded plan with a leadership number, by the type of the plan."""


class Lead(NamedTuple):
    """LEAD: names the server that leads a vehicle. The server answers with the same leadership
    number, and with the largest number that any vehicle of its mission has sent.
    """

    vehicle: int
    session: int
    number: int
    """Leadership number. It only rises; the vehicle does not fly plans with another number."""
    leads: int
    """1 if the server of this session leads the vehicle, else 0."""
    largest: int = 0
    """Largest leadership number that the server has received; 0 from a vehicle."""
    step: int = 0
    """In a vehicle's LEAD, the step k at which it was sent; in a server's LEAD, the step of the
    vehicle's newest LEAD. A server leaves the next three fields empty."""
    in_force: int | None = None
    """Step for which the motion in force was made; None if no motion is in force."""
    spacing: int = 0
    """Steps from one knot of the motion in force to the next."""
    knots: NDArray[np.float32] | bytes = b""
    """Position [m] and velocity [m/s] of each knot; shape (axes, knots, 2)."""
    limits: Limits | None = None
    """Limits of the server's motions; None from a vehicle, or without a mission."""
    changes: int = 0
    """Number of changes of `limits` since the server started."""


def with_leadership(number: int, plan: bytes) -> bytes:
    """Encoded plan with the leadership number as last field, or without it if `number` is 0."""
    if not number:
        return plan
    return bytes([plan[0] + 1]) + plan[1:] + msgpack.packb(number)  # the array has one more element


def decode_led(payload: bytes, terms: Terms) -> tuple[Message, int]:
    """Message in a datagram, and the leadership number of a plan; 0 for all other messages.

    Raises:
        ProtocolError: the datagram is not one of our messages.
    """
    if (kind := kind_of(payload)) not in PLANS:
        return decode(payload, terms), 0
    fields = unpacked(payload)
    if len(fields) != PLANS[kind]:
        return checked(fields, terms), 0
    *plain, number = fields
    if type(number) is not int or number not in U32:
        raise ProtocolError(Drop.FIELD)
    return checked(tuple(plain), terms), number


def _limits(value: object, ours: Terms) -> Limits | None:  # noqa: ARG001
    if value is None:
        return None
    if type(value) is not tuple or tuple(map(type, value)) != (float, float, float, str):
        raise ProtocolError(Drop.FIELD)
    if not all(map(is_plain, value)):
        raise ProtocolError(Drop.FIELD)
    return Limits._make(value)


def _knots_or_none(value: object, ours: Terms) -> NDArray[np.float32]:
    return knots_in(value, ours) if value != b"" else np.empty((ours.axes, 0, 2), np.float32)


add(
    10,
    Lead,
    (
        *(U16, U32, U32, FLAG, U32, U31, OrNone(U31), U16),
        *(_knots_or_none, _limits, U31),
    ),
)
