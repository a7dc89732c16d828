"""The wire: eight messages, each one msgpack array in one UDP datagram, sealed or plain.

    [version, type, vehicle, ...]

| type | message     | sent by | fields after `vehicle`                                     |
|------|-------------|---------|------------------------------------------------------------|
| 1    | HELLO       | client  | boot_id, terms                                             |
| 2    | WELCOME     | server  | session, boot_id, server_boot_id, server_ns, refusal,      |
|      |             |         | terms                                                      |
| 3    | OBSERVATION | client  | session, step, flown, delay, backward_us, heard, mode,     |
|      |             |         | motion, number, silence                                    |
| 4    | HORIZON     | server  | session, step, server_us, age, inputs, feedback, number,   |
|      |             |         | silence                                                    |
| 5    | HEARTBEAT   | server  | session, server_us, idle, degraded, number, silence        |
| 6    | CLOSE       | both    | session                                                    |
| 7    | TRAJECTORY  | server  | session, step, server_us, age, spacing, knots, number,     |
|      |             |         | silence                                                    |
| 8    | TIME        | client  | session, step, epoch_us, error_us                          |

With the scheme "trajectory" TRAJECTORY stands in place of HORIZON.

`docs/protocol.md` has the bytes. What the receiver knows is not sent: a state is sampled at the
begin of its step, so that the vehicle's clock is its step; a stamp is told in microseconds modulo
2^32 (71 minutes), and is the one of these times that lies nearest to what the receiver expects. A
datagram that is not exactly one of these messages is a `ProtocolError`: the peer's mistake, to be
dropped and counted by its reason, never answered.
"""

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import IntEnum
from struct import Struct
from typing import Annotated, Any, NamedTuple

import msgpack
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from skytether.shared.base.units import MICROSECOND_NS
from skytether.shared.law.heartbeat import NUMBERS
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.wire.drop import Drop, ProtocolError

# Below 0x80, so that msgpack writes it in one byte: `kind_of` and the quick decoder rely on that.
VERSION = 1
PAYLOAD_BYTES_MAX = 1200
"""Limit below which no datagram is fragmented: two fragments turn 10 % loss into 19 %."""

AXES_MAX = 3
TEXT_MAX = 32
"""Characters of a text in the terms."""
INPUTS_MAX = 270
"""Inputs of all axes in one horizon: what fits beside the other fields."""
KNOTS_MAX = 16
"""Knots in one trajectory."""
STAMPS = 2**32
"""Number of microseconds that stamps are told apart of: 71 minutes."""

LED_P = 0
"""Column of `Horizon.feedback`: position x̄ at the horizon's step [m]."""
LED_V = 1
"""Column of `Horizon.feedback`: velocity x̄ there [m/s]."""
LED = [LED_P, LED_V]
"""Columns of `Horizon.feedback`: x̄, position and velocity."""
DISTURBANCE = 2
"""Column of `Horizon.feedback`: disturbance ŵ that was reckoned with [m/s]."""
GAIN_P = 3
"""Column of `Horizon.feedback`: K on position [1/s]."""
GAIN_V = 4
"""Column of `Horizon.feedback`: K on velocity."""
FEEDBACK = 5
"""Number of columns of `Horizon.feedback`."""

NO_FEEDBACK = np.empty((0, 0), np.float32)
FLOAT_MAX = float(np.finfo(np.float32).max)
"""Largest number of a state that can be told [m, m/s]."""
NO_INPUT = np.empty(0)
"""`Observation.input` with the scheme "trajectory", where nobody reads it."""

INPUT_TOLERANCE = 1.001
"""Factor by which an input may exceed its bound (float32 rounds) before the packet is refused."""


class Refusal(IntEnum):
    """Why a server opens no session for a vehicle."""

    ACCEPTED = 0
    """The server opens a session."""
    OTHER_TERMS = 1
    """The vehicle has other terms."""
    FULL = 2
    """The server has no room."""
    TAKEN = 3
    """Another client flies under the vehicle's number."""

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


NO_HORIZON = -1
"""`Observation.in_force` while no horizon has arrived yet."""


class Hello(NamedTuple):
    """Request of a vehicle for a session."""

    vehicle: int
    boot_id: int
    terms: Terms


class Welcome(NamedTuple):
    """Answer to HELLO: a session, or why there is none."""

    vehicle: int
    session: int
    """Number of the session, 0 where there is none."""
    boot_id: int
    """The vehicle's own, echoed: an answer to another life of the vehicle is not for this one."""
    server_boot_id: int
    server_ns: int
    refusal: int
    """Why there is none, one of `Refusal`."""
    terms: Terms


class Mode(IntEnum):
    """Mode of a vehicle, see `client.failsafe`."""

    INIT = 0
    """Vehicle without a session."""
    SYNC = 1
    """Vehicle whose link is not good for long enough yet."""
    READY = 2
    """Vehicle that waits for a horizon, and to be armed."""
    TRACK = 3
    """Vehicle that flies a horizon."""
    COAST = 4
    """Vehicle that flies on along a horizon for want of a newer one."""
    BRAKE = 5
    """Vehicle that takes the input that it flew last to zero."""
    HOVER = 6
    """Vehicle that stands still."""
    LAND = 7
    """Vehicle that descends, and stays down."""
    FAULT = 8
    """Vehicle with a fault aboard: stands still, and flies nothing more."""
    MANUAL = 9
    """Vehicle that a pilot or nobody flies: nothing is sent to its autopilot."""
    RETURN = 10
    """Vehicle that its autopilot flies home, and lands there."""

    def __str__(self) -> str:
        return self.name.lower()


class Observation(NamedTuple):
    """The vehicle's state at the start of one step, and what it does from there on.

    A further field stands last here, and its check last in the row of `_TYPES`.
    """

    vehicle: int
    session: int
    step: int
    """Step k at whose begin the state was sampled, on the vehicle's grid."""
    in_force: int
    """Step that the horizon in force was made for, or NO_HORIZON."""
    since: int
    """First step that was flown with that horizon."""
    backward_us: int
    """Stamp: when the newest packet of the server came, by the time since the vehicle's step 0,
    less the server's clock when it was sent."""
    heard: int
    """Number of packets of the server that have come, modulo NUMBERS."""
    mode: int
    """Mode of the vehicle, one of `Mode`."""
    takes: int
    """1 if a horizon that comes now would be flown, else 0."""
    state: Array
    """Position [m] and velocity [m/s]; shape (axes, 2). It is told as float32."""
    input: Array
    """Desired velocity that is flown from `step` on [m/s]; shape (axes,), or NO_INPUT with the
    scheme "trajectory". It is told as float32."""
    number: int = 0
    """Number of packets that the vehicle has sent in the session before, modulo NUMBERS."""
    silence: int = 0
    """Longest silence that the vehicle asks of the server [half steps]; 0 for none."""


class Horizon(NamedTuple):
    """The control horizon U(k) of eq. (8), after the committed inputs where there are any."""

    vehicle: int
    session: int
    step: int
    """Step k of the first input, on the vehicle's grid."""
    server_us: int
    """Stamp: the server's clock when it was sent."""
    age: int
    """Steps from the newest observation that the server had to `step`."""
    inputs: NDArray[np.float32]
    """Desired velocity [m/s]; shape (axes, d + H), d committed ones first, 0 … `committed_max`."""
    feedback: NDArray[np.float32] = NO_FEEDBACK
    """Parameters of the feedback aboard, in the columns LED_P … GAIN_V; shape (axes, FEEDBACK), or
    (axes, 0) where the inputs are to be flown as they are."""
    number: int = 0
    """Number of packets that the server has sent in the session before, modulo NUMBERS."""
    silence: int = 0
    """Longest silence that the server asks of the vehicle [half steps]; 0 for none."""


class Trajectory(NamedTuple):
    """The desired trajectory from a step on, as a spline, see `shared.law.spline`."""

    vehicle: int
    session: int
    step: int
    """Step k of the first knot, on the vehicle's grid."""
    server_us: int
    """Stamp: the server's clock when it was sent."""
    age: int
    """Steps from the newest observation that the server had to `step`."""
    spacing: int
    """Steps from one knot to the next."""
    knots: NDArray[np.float32]
    """Position [m] and velocity [m/s] of each knot; shape (axes, knots, 2)."""
    number: int = 0
    """Number of packets that the server has sent in the session before, modulo NUMBERS."""
    silence: int = 0
    """Longest silence that the server asks of the vehicle [half steps]; 0 for none."""


class Idle(IntEnum):
    """Why the server makes no plan for a vehicle."""

    PLANS = 0
    """Plans are made, and the trigger has sent what was worth sending."""
    OBSERVATION = 1
    """The newest observation is older than `link.age_max_s`, or would be before a plan began."""
    DELAY = 2
    """The delay to the vehicle is longer than a horizon has room for."""
    UNSOLVED = 3
    """The solver has found no plan."""

    def __str__(self) -> str:
        return IDLE_TEXTS[self]


IDLE_TEXTS = {
    Idle.PLANS: "no newer horizon has come",
    Idle.OBSERVATION: "its newest observation at the server is older than link.age_max_s",
    Idle.DELAY: "the delay to it is longer than a horizon has room for",
    Idle.UNSOLVED: "the solver has found none",
}


class Heartbeat(NamedTuple):
    """Sign of life of a server that has nothing else to say."""

    vehicle: int
    session: int
    server_us: int
    """Stamp: the server's clock when it was sent."""
    idle: int
    """Why no plan is made for the vehicle, one of `Idle`."""
    degraded: int
    """1 if the server sleeps through more of its ticks than it may, else 0."""
    number: int = 0
    """Number of packets that the server has sent in the session before, modulo NUMBERS."""
    silence: int = 0
    """Longest silence that the server asks of the vehicle [half steps]; 0 for none."""


class Close(NamedTuple):
    """Announcement that the sender ends; sent `CLOSES` times."""

    vehicle: int
    session: int


class Time(NamedTuple):
    """Time of day at which a vehicle's step 0 began; sent where the vehicle's host knows it."""

    vehicle: int
    session: int
    step: int
    """Step k in which it is told, on the vehicle's grid."""
    epoch_us: int
    """Stamp: the time since 1970 at which step 0 began."""
    error_us: int
    """Largest error of that [µs]."""


# With a tenth of all packets lost, all three are lost once in a thousand times.
CLOSES = 3
"""Number of times that CLOSE is said, for some of them may be lost."""


def stamp_us(time_ns: int) -> int:
    """Stamp of a time, or of a difference of two clocks: whole microseconds modulo STAMPS."""
    # Python's % is never negative, so a negative difference of two clocks has a stamp as well.
    return time_ns // MICROSECOND_NS % STAMPS


def stamped_ns(stamp: int, near_ns: int) -> int:
    """Time that a stamp tells [ns]: of all that have the stamp the one nearest to `near_ns`.

    It is the right one, but for its part of a microsecond, where that is known to half an hour.
    """
    near = near_ns // MICROSECOND_NS
    half = STAMPS // 2
    # Signed distance of the stamp from what is expected, from -half to half - 1.
    return (near + (stamp - near + half) % STAMPS - half) * MICROSECOND_NS


Message = Hello | Welcome | Observation | Horizon | Heartbeat | Close | Trajectory | Time


class _OrNone(NamedTuple):
    """Check of a field that may be empty, and is else one of these integers."""

    integers: range


_Check = range | _OrNone | Callable[[object, Terms], object]
"""The integers a field may be, or what makes the field of the bytes that were sent, or refuses
them."""


def _checked(values: list[object], checks: tuple[_Check, ...], terms: Terms) -> list[object]:
    """Values, one for each check, each as its check returns it."""
    for i, check in enumerate(checks):
        if type(check) is range:
            # `type`, not `isinstance`: True is no integer on this wire.
            if type(values[i]) is not int or values[i] not in check:
                raise ProtocolError(Drop.FIELD)
        elif isinstance(check, _OrNone):
            if values[i] is not None:
                _checked(values[i : i + 1], (check.integers,), terms)
        else:
            values[i] = check(values[i], terms)
    return values


def _terms(value: object, ours: Terms) -> Terms:
    """The peer's terms: they may differ from ours, but must be of the same kind."""
    if type(value) is not tuple or len(value) != len(ours):
        raise ProtocolError(Drop.FIELD)
    for theirs, our in zip(value, ours, strict=True):
        # Exact types: True would pass for 1, and 1 for 1.0.
        if type(theirs) is not type(our) or not _is_plain(theirs):
            raise ProtocolError(Drop.FIELD)
    return Terms._make(value)


def _is_plain(value: object) -> bool:
    """Whether a term is a finite number, a short text, yes or no, or a number for each axis."""
    match value:
        case float():
            return math.isfinite(value)
        case tuple():
            numbers = all(type(number) is float and math.isfinite(number) for number in value)
            return len(value) <= AXES_MAX and numbers
        case str():
            return len(value) <= TEXT_MAX
    return True


def _motion(value: object, ours: Terms) -> tuple[Array, Array]:
    """State and input of an observation; the input is NO_INPUT where nobody reads it."""
    axes = ours.axes
    told = _FLOATS[axes * (2 if ours.splines else 3)]
    if type(value) is not bytes or len(value) != told.size:
        raise ProtocolError(Drop.SHAPE)
    # Struct takes 0.2 µs for six numbers, np.frombuffer and tolist 0.7 µs.
    numbers = told.unpack(value)
    # Numbers that were float32 have a finite sum, unless one of them is not finite.
    if not math.isfinite(sum(numbers)):
        raise ProtocolError(Drop.NOT_FINITE)
    # zip with `strict` takes twice as long as this. Along splines there are no inputs.
    for axis, u in enumerate(numbers[2 * axes :]):
        if abs(u) > ours.u_max[axis] * INPUT_TOLERANCE:
            raise ProtocolError(Drop.INPUT_OUT_OF_RANGE)
    motion = np.array(numbers)
    return motion[: 2 * axes].reshape(axes, 2), motion[2 * axes :]


def _inputs(value: object, ours: Terms) -> NDArray[np.float32]:
    if ours.splines:
        raise ProtocolError(Drop.TYPE)
    most = ours.horizon + committed_max(ours)
    inputs = _array(value, _FLOAT32, ours.axes, (ours.horizon, most))
    largest = np.abs(inputs).max(axis=1).tolist()  # NaN where there is one
    if not all(map(math.isfinite, largest)):
        raise ProtocolError(Drop.NOT_FINITE)
    for most, bound in zip(largest, ours.u_max, strict=True):
        if most > bound * INPUT_TOLERANCE:
            raise ProtocolError(Drop.INPUT_OUT_OF_RANGE)
    return inputs


def _feedback(value: object, ours: Terms) -> NDArray[np.float32]:
    feedback = _array(value, _FLOAT32, ours.axes, (0, FEEDBACK))
    if feedback.shape[1] not in (0, FEEDBACK):
        raise ProtocolError(Drop.SHAPE)
    if not all(map(math.isfinite, feedback.ravel().tolist())):
        raise ProtocolError(Drop.NOT_FINITE)
    return feedback


def _knots(value: object, ours: Terms) -> NDArray[np.float32]:
    if not ours.splines:
        raise ProtocolError(Drop.TYPE)
    numbers = _array(value, _FLOAT32, ours.axes, (2, 2 * KNOTS_MAX))
    if numbers.shape[1] % 2:
        raise ProtocolError(Drop.SHAPE)
    if not all(map(math.isfinite, numbers.ravel().tolist())):
        raise ProtocolError(Drop.NOT_FINITE)
    return numbers.reshape(ours.axes, -1, 2)


def committed_max(terms: Terms) -> int:
    """Largest number of committed steps that a horizon has room for beside its plan; 1 or more."""
    return max(1, min(INPUTS_MAX // terms.axes - terms.horizon, terms.age_max))


def _array(value: object, dtype: np.dtype[Any], axes: int, counts: tuple[int, int]) -> NDArray[Any]:
    """Array of `axes` rows, with at least and at most so many numbers each."""
    if type(value) is not bytes:
        raise ProtocolError(Drop.SHAPE)
    count, rest = divmod(len(value), axes * dtype.itemsize)
    if rest or not counts[0] <= count <= counts[1]:
        raise ProtocolError(Drop.SHAPE)
    # A read-only view of the datagram's own bytes: nothing is copied.
    return np.ndarray((axes, count), dtype, value)


_FLOAT32 = np.dtype("<f4")
_FLOATS = {count: Struct(f"<{count}f") for count in range(1, 3 * AXES_MAX + 1)}
_FLAG = range(2)
_U16 = range(2**16)
_U32 = range(2**32)
_U64 = range(2**64)
_CLOCK = range(2**63)
_STAMP = range(STAMPS)
_NUMBER = range(NUMBERS)
# Negative where the server's clock was set and its clock map lags: the step then lies before the
# observation.
_AGE = range(-(2**15), 2**32)
_SPACING = range(1, 2**16)

_TYPES: tuple[tuple[type[Message], tuple[_Check, ...]], ...] = (
    (Hello, (_U16, _U64, _terms)),
    (Welcome, (_U16, _U32, _U64, _U64, _CLOCK, range(len(Refusal)), _terms)),
    (
        Observation,
        (
            *(_U16, _U32, _U32, _AGE, _OrNone(_AGE), _STAMP, _NUMBER),
            *(range(2 * len(Mode)), _motion, _NUMBER, _U16),
        ),
    ),
    (Horizon, (_U16, _U32, _U32, _STAMP, _AGE, _inputs, _feedback, _NUMBER, _U16)),
    (Heartbeat, (_U16, _U32, _STAMP, range(len(Idle)), _FLAG, _NUMBER, _U16)),
    (Close, (_U16, _U32)),
    (Trajectory, (_U16, _U32, _U32, _STAMP, _AGE, _SPACING, _knots, _NUMBER, _U16)),
    (Time, (_U16, _U32, _U32, _STAMP, _U32)),
)
"""Message of each type number (from 1) and the check of each of its fields on the wire."""

_OBSERVATION = 3
"""Type number of the message that a server hears most."""
_FIELDS = _TYPES[_OBSERVATION - 1][1]


def _kind(check: _Check) -> Any:
    """Type of a field on the wire, as msgspec checks it."""
    if isinstance(check, _OrNone):
        return _kind(check.integers) | None
    return Annotated[int, Meta(ge=check[0], le=check[-1])] if isinstance(check, range) else bytes


_QUICK = msgspec.msgpack.Decoder(tuple[int, int, *map(_kind, _FIELDS)])  # type: ignore[misc]
"""Decoder of an observation that checks types and ranges at once. A packet that it refuses is read
again field by field, which finds the reason."""
_MADE = [(i, check) for i, check in enumerate(_FIELDS) if callable(check)]
"""Fields of it that are made of bytes, by their place behind version and type."""
# 0x90 + n is msgpack's header of an array of n < 16 elements.
_QUICK_START = bytes([0x90 | (2 + len(_FIELDS)), VERSION, _OBSERVATION])

_NUMBERS = {message: number for number, (message, _) in enumerate(_TYPES, start=1)}
# One packer for all messages: packb, which makes one for each, takes three times as long.
_PACKER = msgpack.Packer(default=np.ndarray.tobytes)


def _told(said: Observation) -> list[object]:
    """Fields of an observation on the wire."""
    vehicle, session, step, made_for, since, backward_us, heard, mode, takes, state, u, *rest = said
    numbers = state.ravel().tolist() + u.tolist()
    return [
        # Steps are told as differences and mode and `takes` in one number: a byte each as a rule,
        # where the numbers themselves took up to five.
        VERSION,
        _OBSERVATION,
        vehicle,
        session,
        step,
        step - since,
        None if made_for == NO_HORIZON else since - made_for,
        backward_us,
        heard,
        2 * mode + takes,
        _FLOATS[len(numbers)].pack(*numbers),
        *rest,
    ]


def _observation(told: Iterable[Any]) -> Observation:
    """Observation of its fields on the wire, each of which has been checked."""
    vehicle, session, step, flown, delay, backward_us, heard, does, (state, u), *rest = told
    since = step - flown
    in_force = NO_HORIZON if delay is None else since - delay
    # Differences may lead below step 0 though each of them is within its range.
    if since < 0 or (delay is not None and in_force < 0):
        raise ProtocolError(Drop.FIELD)
    mode, takes = divmod(does, 2)
    return Observation._make(
        (vehicle, session, step, in_force, since, backward_us, heard, mode, takes, state, u, *rest)
    )


def encode(message: Message) -> bytes:
    """The datagram of a message; arrays travel as little-endian bytes."""
    if type(message) is Observation:
        payload: bytes = _PACKER.pack(_told(message))
    else:
        payload = _PACKER.pack([VERSION, _NUMBERS[type(message)], *message])
    assert len(payload) <= PAYLOAD_BYTES_MAX
    return payload


def encode_horizon(
    vehicle: int,
    session: int,
    step: int,
    server_us: int,
    age: int,
    inputs: memoryview,
    feedback: memoryview,
    number: int,
    silence: int,
) -> bytes:
    """Datagram of a `Horizon` whose arrays are bytes already, for a server that sends many."""
    told = (vehicle, session, step, server_us, age, inputs, feedback, number, silence)
    payload: bytes = _PACKER.pack((VERSION, _NUMBERS[Horizon], *told))
    assert len(payload) <= PAYLOAD_BYTES_MAX
    return payload


def kind_of(payload: bytes) -> int | None:
    """Type number of a message, from its first bytes; None of one that is none of ours.

    Array, version and type must be in msgpack's shortest form, so that it is what it looks like.
    """
    head = payload[:3]
    if len(head) < 3 or head[0] & 0xF0 != 0x90 or max(head[1:]) >= 0x80:
        return None
    return head[2]


def decode(payload: bytes, terms: Terms) -> Message:
    """The message in a datagram, every field checked against our own terms.

    Raises:
        ProtocolError: it is none of ours.
    """
    # The first check of all: nothing is parsed of a packet that is too long.
    if len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(Drop.TOO_LONG)
    if payload.startswith(_QUICK_START):
        with suppress(msgspec.DecodeError):
            told = list(_QUICK.decode(payload)[2:])
            for i, made_of in _MADE:
                told[i] = made_of(told[i], terms)
            return _observation(told)
    try:
        # No message has a map or an extension, so that none is ever built of a stranger's bytes.
        fields = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError(Drop.NOT_MSGPACK) from error
    if type(fields) is not tuple or len(fields) < 2:
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    version, number, *body = fields
    if type(version) is not int or version != VERSION:
        raise ProtocolError(Drop.VERSION)
    if type(number) is not int or not 1 <= number <= len(_TYPES):
        raise ProtocolError(Drop.TYPE)
    message, checks = _TYPES[number - 1]
    if len(body) != len(checks):
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    fields = _checked(body, checks, terms)
    return _observation(fields) if message is Observation else message._make(fields)
