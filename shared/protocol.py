"""The wire: five messages, each one msgpack array in one UDP datagram.

    [version, type, vehicle, ...]

| type | message     | sent by | fields after `vehicle`                                        |
|------|-------------|---------|---------------------------------------------------------------|
| 1    | HELLO       | client  | boot_id, terms                                                |
| 2    | WELCOME     | server  | session, boot_id, server_boot_id, server_ns, terms            |
| 3    | OBSERVATION | client  | session, step, stamp_ns, in_force, server_ns, received_ns, state |
| 4    | HORIZON     | server  | session, step, server_ns, observed_ns, inputs                 |
| 5    | HEARTBEAT   | server  | session, server_ns                                            |

`docs/protocol.md` has the bytes. Stamps are integer nanoseconds of one host's monotonic clock.
Those that control uses are the client's; `server_ns` is the server's own, which the client only
echoes. A datagram that is not exactly one of these messages is a `ProtocolError`: the peer's
mistake, to be dropped and counted by its reason, never answered.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

VERSION = 1
PAYLOAD_BYTES_MAX = 1200
"""So that no datagram is ever fragmented: two fragments turn 10 % loss into 19 %."""

AXES_MAX = 3
INPUTS_MAX = 288
"""Inputs of all axes in one horizon: what fits beside the other fields."""

INPUT_TOLERANCE = 1.001
"""How far over its bound an input may be (float32 rounds) before the packet is refused."""

NO_HORIZON = -1
"""`Observation.in_force` while no horizon has arrived yet."""


class ProtocolError(Exception):
    """The peer sent something that is no message of ours. `reason` is one of a small fixed set."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Terms(NamedTuple):
    """What both ends must agree on before a flight."""

    dt_ns: int
    horizon: int
    axes: int
    tau_s: tuple[float, ...]
    """Time constant of the model (2)-(3) per axis [s]."""
    u_max: tuple[float, ...]
    """Bound (6) of the input per axis [m/s]."""

    def against(self, other: "Terms") -> str:
        """Where they differ, for the operator of either end."""
        return ", ".join(
            f"{name} {mine} against {theirs}"
            for name, mine, theirs in zip(self._fields, self, other, strict=True)
            if mine != theirs
        )


class Hello(NamedTuple):
    """A vehicle asks for a session."""

    vehicle: int
    boot_id: int
    terms: Terms


class Welcome(NamedTuple):
    """The server opens it; with other terms than the vehicle's it says which, and opens none."""

    vehicle: int
    session: int
    boot_id: int
    """The vehicle's own, echoed: an answer to another life of the vehicle is not for this one."""
    server_boot_id: int
    server_ns: int
    terms: Terms


class Observation(NamedTuple):
    """The vehicle's state at the start of one step."""

    vehicle: int
    session: int
    step: int
    stamp_ns: int
    """When the state was sampled [client clock]."""
    in_force: int
    """Step that the horizon in force was made for, or NO_HORIZON."""
    server_ns: int
    """Newest `server_ns` seen, echoed,"""
    received_ns: int
    """and when it came [client clock]."""
    state: NDArray[np.float64]
    """Position [m] and velocity [m/s]; shape (axes, 2)."""


class Horizon(NamedTuple):
    """The control horizon U(k) of eq. (8)."""

    vehicle: int
    session: int
    step: int
    """k: the step of the first input, on the vehicle's grid."""
    server_ns: int
    observed_ns: int
    """Stamp of the observation it was computed from, echoed [client clock]."""
    inputs: NDArray[np.float32]
    """Desired velocity [m/s]; shape (axes, H)."""


class Heartbeat(NamedTuple):
    """The server lives and has nothing else to say."""

    vehicle: int
    session: int
    server_ns: int


Message = Hello | Welcome | Observation | Horizon | Heartbeat

_Check = Callable[[object, Terms], object]


def _integer(low: int, high: int) -> _Check:
    def check(value: object, _: Terms) -> int:
        # `type`, not `isinstance`: True is no integer on this wire.
        if type(value) is not int or not low <= value <= high:
            raise ProtocolError("field")
        return value

    return check


def _floats(value: object, *, count: int) -> tuple[float, ...]:
    if type(value) is not tuple or len(value) != count:
        raise ProtocolError("field")
    for number in value:
        if type(number) is not float or not 0.0 < number < math.inf:
            raise ProtocolError("field")
    return value


def _terms(value: object, ours: Terms) -> Terms:
    """The peer's terms: they may differ from ours, but must make sense."""
    if type(value) is not tuple or len(value) != len(Terms._fields):
        raise ProtocolError("field")
    dt_ns, horizon, axes, tau_s, u_max = value
    count = _AXES(axes, ours)
    assert isinstance(count, int)
    _STAMP(dt_ns, ours)
    _HORIZON(horizon, ours)
    return Terms(dt_ns, horizon, axes, _floats(tau_s, count=count), _floats(u_max, count=count))


def _finite_array(value: object, dtype: str, shape: tuple[int, int]) -> NDArray[np.floating]:
    if type(value) is not bytes or len(value) != shape[0] * shape[1] * np.dtype(dtype).itemsize:
        raise ProtocolError("shape")
    array = np.frombuffer(value, dtype).reshape(shape)
    if not np.isfinite(array).all():
        raise ProtocolError("not finite")
    return array


def _state(value: object, ours: Terms) -> NDArray[np.floating]:
    return _finite_array(value, "<f8", (ours.axes, 2))


def _inputs(value: object, ours: Terms) -> NDArray[np.floating]:
    inputs = _finite_array(value, "<f4", (ours.axes, ours.horizon))
    if (np.abs(inputs).max(axis=1) > np.multiply(ours.u_max, INPUT_TOLERANCE)).any():
        raise ProtocolError("input out of range")
    return inputs


_U16 = _integer(0, 2**16 - 1)
_U32 = _integer(0, 2**32 - 1)
_U64 = _integer(0, 2**64 - 1)
_STAMP = _integer(0, 2**63 - 1)
_STEP = _integer(0, 2**40)
_STEP_OR_NONE = _integer(NO_HORIZON, 2**40)
_AXES = _integer(1, AXES_MAX)
_HORIZON = _integer(1, INPUTS_MAX)

_TYPES: tuple[tuple[type[Message], tuple[_Check, ...]], ...] = (
    (Hello, (_U16, _U64, _terms)),
    (Welcome, (_U16, _U32, _U64, _U64, _STAMP, _terms)),
    (Observation, (_U16, _U32, _STEP, _STAMP, _STEP_OR_NONE, _STAMP, _STAMP, _state)),
    (Horizon, (_U16, _U32, _STEP, _STAMP, _STAMP, _inputs)),
    (Heartbeat, (_U16, _U32, _STAMP)),
)
"""Message of each type number (from 1) and the check of each of its fields."""

_NUMBERS = {message: number for number, (message, _) in enumerate(_TYPES, start=1)}


def encode(message: Message) -> bytes:
    """The datagram of a message; arrays travel as little-endian bytes."""
    body = [field.tobytes() if isinstance(field, np.ndarray) else field for field in message]
    payload: bytes = msgpack.packb([VERSION, _NUMBERS[type(message)], *body])
    assert len(payload) <= PAYLOAD_BYTES_MAX
    return payload


def decode(payload: bytes, terms: Terms) -> Message:
    """The message in a datagram, every field checked against our own terms.

    Raises:
        ProtocolError: it is none of ours.
    """
    if len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError("too long")
    try:
        fields = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError("not msgpack") from error
    if type(fields) is not tuple or len(fields) < 2:
        raise ProtocolError("not a message")
    version, number, *body = fields
    if type(version) is not int or version != VERSION:
        raise ProtocolError("version")
    if type(number) is not int or not 1 <= number <= len(_TYPES):
        raise ProtocolError("type")
    message, checks = _TYPES[number - 1]
    if len(body) != len(checks):
        raise ProtocolError("not a message")
    checked = (check(value, terms) for check, value in zip(checks, body, strict=True))
    return message(*checked)  # type: ignore[arg-type]
