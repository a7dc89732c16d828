"""The wire: ten messages, each one msgpack array in one UDP datagram, sealed or plain.

    [version, type, vehicle, ...]

Each message is a class below; `docs/protocol.md` describes its bytes. With the scheme
"trajectory", TRAJECTORY replaces HORIZON. Fields of several messages:

    server_us   time stamp: the server's clock when the packet was sent
    age         steps from the server's newest observation to `step`
    number      number of packets that the sender sent earlier in the session, modulo NUMBERS
    silence     longest silence that the sender allows the other end [half steps]; 0 for no bound

A state is sampled at the start of its step, so the step number is also the state's time stamp.
Other time stamps are in microseconds modulo 2^32 (71 minutes); the receiver adds the multiple of
2^32 that is nearest to the expected time. A datagram that is not exactly one of these messages is
an error of the peer (`ProtocolError`). It is dropped, counted by reason, and never answered.
"""

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import IntEnum
from importlib import import_module
from struct import Struct
from typing import Annotated, Any, NamedTuple, Protocol

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

# Below 0x80, so that msgpack writes the version as one byte, as `kind_of` and `_QUICK` require.
VERSION = 1
PAYLOAD_BYTES_MAX = 1200
"""Size up to which no datagram is fragmented [B]. Two fragments would turn 10 % loss into 19 %."""

AXES_MAX = 3
TEXT_MAX = 32
INPUTS_MAX = 270
"""Largest number of inputs of all axes in one horizon, limited by the packet size."""
KNOTS_MAX = 16
STAMPS = 2**32
"""Modulus of time stamps [µs]; 2^32 µs are 71 minutes."""

REFERENCE_P, REFERENCE_V, DISTURBANCE, GAIN_P, GAIN_V = range(5)
"""Columns of `Horizon.feedback`: position [m] and velocity [m/s] of x̄ at the horizon's step, the
disturbance ŵ that the inputs compensate [m/s], and K on position [1/s] and on velocity."""
REFERENCE = [REFERENCE_P, REFERENCE_V]
FEEDBACK = 5

NO_FEEDBACK = np.empty((0, 0), np.float32)
FLOAT_MAX = float(np.finfo(np.float32).max)
"""Largest number that fits in a state on the wire [m, m/s]."""
NO_INPUT = np.empty(0)
"""Value of `Observation.input` with the scheme "trajectory", which does not use the input."""

INPUT_TOLERANCE = 1.001
"""Factor by which an input may exceed its bound before the packet is refused, because of float32
rounding."""


class Refusal(IntEnum):
    ACCEPTED = 0
    OTHER_TERMS = 1
    FULL = 2
    TAKEN = 3

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


NO_HORIZON = -1
"""Value of `Observation.in_force` before the first horizon has arrived."""


class Hello(NamedTuple):
    vehicle: int
    boot_id: int
    terms: Terms


class Welcome(NamedTuple):
    """Answer to HELLO: a session, or the reason for a refusal."""

    vehicle: int
    session: int
    """Number of the session; 0 for a refusal."""
    boot_id: int
    """Boot id from the HELLO; a client drops answers to an earlier run of itself."""
    server_boot_id: int
    server_ns: int
    refusal: int
    """Reason for the refusal, one of `Refusal`."""
    terms: Terms


class Mode(IntEnum):
    """Mode of a vehicle, see `client.failsafe`."""

    INIT = 0
    SYNC = 1
    """Waits until the link has been good for long enough."""
    READY = 2
    """Waits for a horizon, and to be armed."""
    TRACK = 3
    COAST = 4
    """Continues along a horizon without receiving a newer one."""
    BRAKE = 5
    """Brakes to a stop from the last input."""
    HOVER = 6
    """At rest, holding the position."""
    LAND = 7
    """Descends, and stays on the ground."""
    FAULT = 8
    """Has a fault: holds the position, and ignores horizons."""
    MANUAL = 9
    """A pilot flies, or nobody does: nothing is sent to the autopilot."""
    RETURN = 10
    """The autopilot flies the vehicle home and lands it."""

    def __str__(self) -> str:
        return self.name.lower()


class Observation(NamedTuple):
    """The vehicle's state at the start of a step, and the input flown from this step on."""

    vehicle: int
    session: int
    step: int
    """Step k at whose start the state was sampled, by the vehicle's count."""
    in_force: int
    """Step for which the horizon in force was made, or NO_HORIZON."""
    since: int
    """First step that was flown with the horizon in force."""
    backward_us: int
    """Time stamp: time from the vehicle's step 0 to the arrival of the server's newest packet,
    minus the server's clock when this packet was sent."""
    heard: int
    """Number of packets of the server that have arrived, modulo NUMBERS."""
    mode: int
    takes: int
    """1 if the vehicle accepts plans now, else 0."""
    state: Array
    """Position [m] and velocity [m/s]; shape (axes, 2). Sent as float32."""
    input: Array
    """Desired velocity that is flown from `step` on [m/s]; shape (axes,), or NO_INPUT with the
    scheme "trajectory". Sent as float32."""
    number: int = 0
    silence: int = 0
    unsaved: int = 0
    """1 if the client's state cannot be saved, so that a restarted client could not continue the
    flight; else 0."""


class Horizon(NamedTuple):
    """Control horizon U(k) of eq. (8), preceded by the committed inputs if there are any."""

    vehicle: int
    session: int
    step: int
    """Step k of the first input, by the vehicle's count."""
    server_us: int
    age: int
    inputs: NDArray[np.float32]
    """Desired velocity [m/s]; shape (axes, d + H). The first d (0 to `ahead_max`) inputs are
    committed."""
    feedback: NDArray[np.float32] = NO_FEEDBACK
    """Parameters of the feedback aboard, in the columns REFERENCE_P … GAIN_V; shape (axes,
    FEEDBACK), or (axes, 0) without feedback."""
    number: int = 0
    silence: int = 0


class Trajectory(NamedTuple):
    """The desired trajectory from a step on, as a spline, see `shared.law.spline`."""

    vehicle: int
    session: int
    step: int
    """Step k of the first knot, by the vehicle's count."""
    server_us: int
    age: int
    spacing: int
    knots: NDArray[np.float32]
    """Position [m] and velocity [m/s] of each knot; shape (axes, knots, 2)."""
    number: int = 0
    silence: int = 0


class Idle(IntEnum):
    """Reason why the server sends no plan. PLANS: it plans, and the trigger may send the plan."""

    def __new__(cls, number: int, text: str = "") -> "Idle":
        made = int.__new__(cls, number)
        made._value_, made.text = number, text
        return made

    text: str

    PLANS = 0, "no newer horizon has arrived"
    # The observation is too old, or would be too old when a plan starts.
    OBSERVATION = 1, "its newest observation at the server is older than link.age_max_s"
    DELAY = 2, "the delay to it is longer than a horizon can cover"
    UNSOLVED = 3, "the solver has found no plan"
    OTHER_SERVER = 4, "another server leads it"

    def __str__(self) -> str:
        return self.text


class Heartbeat(NamedTuple):
    vehicle: int
    session: int
    server_us: int
    idle: int
    degraded: int
    """1 if the server misses too many ticks, else 0."""
    number: int = 0
    silence: int = 0


class Close(NamedTuple):
    """Announcement that the sender ends; sent `CLOSES` times, because packets may be lost."""

    vehicle: int
    session: int


class Time(NamedTuple):
    """Time of day at which a vehicle's step 0 began; sent if the vehicle's host knows the time."""

    vehicle: int
    session: int
    step: int
    """Step k in which the message is sent, by the vehicle's count."""
    epoch_us: int
    """Time stamp: the time since 1970 at which step 0 began."""
    error_us: int
    """Largest error of `epoch_us` [µs]."""


# With 10 % loss, all three packets are lost in one of a thousand cases.
CLOSES = 3


def stamp_us(time_ns: int) -> int:
    """Time stamp of a time, or of a difference of two clocks: whole microseconds modulo STAMPS."""
    # Python's % is never negative, so negative differences of clocks have stamps, too.
    return time_ns // MICROSECOND_NS % STAMPS


def stamped_ns(stamp: int, near_ns: int) -> int:
    """Time with a given stamp that is nearest to `near_ns` [ns].

    The result is exact to a microsecond if the error of `near_ns` is less than half an hour.
    """
    near = near_ns // MICROSECOND_NS
    half = STAMPS // 2
    # Signed distance of the stamp from the expected stamp, from -half to half - 1.
    return (near + (stamp - near + half) % STAMPS - half) * MICROSECOND_NS


class RoomMessage(Protocol):
    """Message of an optional package, see `add`: a `NamedTuple` that begins with these fields."""

    @property
    def vehicle(self) -> int: ...

    @property
    def session(self) -> int: ...


Message = (
    Hello | Welcome | Observation | Horizon | Heartbeat | Close | Trajectory | Time | RoomMessage
)


class OrNone(NamedTuple):
    """Check of a field that is either None or an integer of a range."""

    integers: range


Check = range | OrNone | Callable[[object, Terms], object]
"""Range of an integer field, or a function that converts or refuses the received value."""


def _checked(values: list[object], checks: tuple[Check, ...], terms: Terms) -> list[object]:
    for i, check in enumerate(checks):
        if type(check) is range:
            # `type`, not `isinstance`: True is not an integer on this wire.
            if type(values[i]) is not int or values[i] not in check:
                raise ProtocolError(Drop.FIELD)
        elif isinstance(check, OrNone):
            if values[i] is not None:
                _checked(values[i : i + 1], (check.integers,), terms)
        else:
            values[i] = check(values[i], terms)
    return values


def _terms(value: object, ours: Terms) -> Terms:
    """The peer's terms. Their values may differ from ours, but their types must not."""
    if type(value) is not tuple or len(value) != len(ours):
        raise ProtocolError(Drop.FIELD)
    for theirs, our in zip(value, ours, strict=True):
        # Types must be exact: otherwise True would pass for 1, and 1 for 1.0.
        if type(theirs) is not type(our) or not is_plain(theirs):
            raise ProtocolError(Drop.FIELD)
    return Terms._make(value)


def is_plain(value: object) -> bool:
    """Whether a term is a finite number, a short text, a flag, or a number per axis."""
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
    """State and input of an observation; the input is NO_INPUT if the scheme does not use it."""
    axes = ours.axes
    layout = _FLOATS[axes * (2 if ours.splines else 3)]
    if type(value) is not bytes or len(value) != layout.size:
        raise ProtocolError(Drop.SHAPE)
    # Struct takes 0.2 µs for six numbers, np.frombuffer and tolist 0.7 µs.
    numbers = layout.unpack(value)
    # The sum of float32 numbers is finite if and only if all of them are.
    if not math.isfinite(sum(numbers)):
        raise ProtocolError(Drop.NOT_FINITE)
    # zip with `strict` takes twice as long. With splines `numbers` has no inputs.
    for axis, u in enumerate(numbers[2 * axes :]):
        if abs(u) > ours.u_max[axis] * INPUT_TOLERANCE:
            raise ProtocolError(Drop.INPUT_OUT_OF_RANGE)
    motion = np.array(numbers)
    return motion[: 2 * axes].reshape(axes, 2), motion[2 * axes :]


def _inputs(value: object, ours: Terms) -> NDArray[np.float32]:
    if ours.splines:
        raise ProtocolError(Drop.TYPE)
    most = ours.horizon + ahead_max(ours)
    inputs = _array(value, _FLOAT32, ours.axes, (ours.horizon, most))
    largest = np.abs(inputs).max(axis=1).tolist()  # NaN if the row contains a NaN
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


def knots_in(value: object, ours: Terms) -> NDArray[np.float32]:
    if not ours.splines:
        raise ProtocolError(Drop.TYPE)
    numbers = _array(value, _FLOAT32, ours.axes, (2, 2 * KNOTS_MAX))
    if numbers.shape[1] % 2:
        raise ProtocolError(Drop.SHAPE)
    if not all(map(math.isfinite, numbers.ravel().tolist())):
        raise ProtocolError(Drop.NOT_FINITE)
    return numbers.reshape(ours.axes, -1, 2)


def ahead_max(terms: Terms) -> int:
    """Largest delay bound d with which d + H inputs fit in a packet [steps]; at least 1."""
    return max(1, min(INPUTS_MAX // terms.axes - terms.horizon, terms.age_max))


def _array(value: object, dtype: np.dtype[Any], axes: int, counts: tuple[int, int]) -> NDArray[Any]:
    """Array of `axes` rows; the number of columns must be in `counts`."""
    if type(value) is not bytes:
        raise ProtocolError(Drop.SHAPE)
    count, rest = divmod(len(value), axes * dtype.itemsize)
    if rest or not counts[0] <= count <= counts[1]:
        raise ProtocolError(Drop.SHAPE)
    # A read-only view of the datagram's own bytes, without copying.
    return np.ndarray((axes, count), dtype, value)


_FLOAT32 = np.dtype("<f4")
_FLOATS = {count: Struct(f"<{count}f") for count in range(1, 3 * AXES_MAX + 1)}
FLAG = range(2)
U16 = range(2**16)
U31, U32 = range(2**31), range(2**32)
U64 = range(2**64)
_CLOCK = range(2**63)
_STAMP = range(STAMPS)
_NUMBER = range(NUMBERS)
# An age is negative if the step precedes the observation's step. This happens after the server's
# clock was set, until its clock map has followed.
_AGE = range(-(2**15), 2**32)
_SPACING = range(1, 2**16)
_DOES = 2 * len(Mode)
"""Number of combinations of an observation's mode and `takes`."""

_TYPES: dict[int, tuple[type[Any], tuple[Check, ...]]] = {
    1: (Hello, (U16, U64, _terms)),
    2: (Welcome, (U16, U32, U64, U64, _CLOCK, range(len(Refusal)), _terms)),
    3: (
        Observation,
        (
            *(U16, U32, U32, _AGE, OrNone(_AGE), _STAMP, _NUMBER),
            *(range(2 * _DOES), _motion, _NUMBER, U16),
        ),
    ),
    4: (Horizon, (U16, U32, U32, _STAMP, _AGE, _inputs, _feedback, _NUMBER, U16)),
    5: (Heartbeat, (U16, U32, _STAMP, range(len(Idle)), FLAG, _NUMBER, U16)),
    6: (Close, (U16, U32)),
    7: (Trajectory, (U16, U32, U32, _STAMP, _AGE, _SPACING, knots_in, _NUMBER, U16)),
    8: (Time, (U16, U32, U32, _STAMP, U32)),
}
"""Message class of each type number (from 1), and a check for each of the message's fields."""
_ROOMS = {9: "skytether.shared.wire.path_proof", 10: "skytether.shared.wire.lead"}
"""Modules of optional messages, by type number; imported when such a message first occurs."""

_OBSERVATION = 3
"""Type number of the message that a server receives most."""
_FIELDS = _TYPES[_OBSERVATION][1]


def _kind(check: Check) -> Any:
    if isinstance(check, OrNone):
        return _kind(check.integers) | None
    return Annotated[int, Meta(ge=check[0], le=check[-1])] if isinstance(check, range) else bytes


_QUICK = msgspec.msgpack.Decoder(tuple[int, int, *map(_kind, _FIELDS)])  # type: ignore[misc]
"""Decoder of an observation that checks types and ranges at once. A packet that this decoder
refuses is decoded again field by field to find the reason."""
_MADE = [(i, check) for i, check in enumerate(_FIELDS) if callable(check)]
"""Converters of the fields of an observation that are sent as bytes, by field index."""
# 0x90 + n is msgpack's header of an array of n < 16 elements.
_QUICK_START = bytes([0x90 | (2 + len(_FIELDS)), VERSION, _OBSERVATION])

_NUMBERS = {message: number for number, (message, _) in _TYPES.items()}


def add(number: int, message: type[Any], checks: tuple[Check, ...]) -> None:
    """Add a message of an optional package, and the check of each of its fields."""
    _TYPES[number], _NUMBERS[message] = (message, checks), number


# One packer for all messages: packb makes a packer per message, and takes three times as long.
_PACKER = msgpack.Packer(default=np.ndarray.tobytes)


def _observation_fields(sent: Observation) -> list[object]:
    vehicle, session, step, made_for, since, backward_us, heard, mode, takes, state, u, *rest = sent
    number, silence, unsaved = rest
    numbers = state.ravel().tolist() + u.tolist()
    return [
        # Steps are sent as differences, and mode and flags as one number, so that each usually
        # takes one byte instead of up to five.
        VERSION,
        _OBSERVATION,
        vehicle,
        session,
        step,
        step - since,
        None if made_for == NO_HORIZON else since - made_for,
        backward_us,
        heard,
        unsaved * _DOES + 2 * mode + takes,
        _FLOATS[len(numbers)].pack(*numbers),
        number,
        silence,
    ]


def _observation(fields: Iterable[Any]) -> Observation:
    vehicle, session, step, flown, delay, backward_us, heard, does, motion, number, silence = fields
    since = step - flown
    in_force = NO_HORIZON if delay is None else since - delay
    # Each difference is within its range, but the step computed from them may be below 0.
    if since < 0 or (delay is not None and in_force < 0):
        raise ProtocolError(Drop.FIELD)
    unsaved, does = divmod(does, _DOES)
    mode, takes = divmod(does, 2)
    state, u = motion
    return Observation(
        vehicle,
        session,
        step,
        in_force,
        since,
        backward_us,
        heard,
        mode,
        takes,
        state,
        u,
        number,
        silence,
        unsaved,
    )


def number_of(message: type[Any]) -> int:
    """Type number of a message, by its class."""
    return _NUMBERS[message]


def encode(message: Message) -> bytes:
    """Datagram of a message; arrays are sent as little-endian bytes."""
    if type(message) is Observation:
        payload: bytes = _PACKER.pack(_observation_fields(message))
    else:
        values: Any = message
        payload = _PACKER.pack([VERSION, _NUMBERS[type(message)], *values])
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
    """Datagram of a `Horizon` whose arrays are already bytes, for a server that sends many."""
    fields = (vehicle, session, step, server_us, age, inputs, feedback, number, silence)
    payload: bytes = _PACKER.pack((VERSION, _NUMBERS[Horizon], *fields))
    assert len(payload) <= PAYLOAD_BYTES_MAX
    return payload


def kind_of(payload: bytes) -> int | None:
    """Type number of a message, from its first bytes; None if no message of this protocol begins
    with these bytes.

    Array header, version and type must be in msgpack's shortest form, so that the bytes are
    unambiguous.
    """
    head = payload[:3]
    if len(head) < 3 or head[0] & 0xF0 != 0x90 or max(head[1:]) >= 0x80:
        return None
    return head[2]


def decode(payload: bytes, terms: Terms) -> Message:
    """Message in a datagram, every field checked against our own terms.

    Raises:
        ProtocolError: the datagram is not one of our messages.
    """
    if payload.startswith(_QUICK_START) and len(payload) <= PAYLOAD_BYTES_MAX:
        with suppress(msgspec.DecodeError):
            quick = list(_QUICK.decode(payload)[2:])
            for i, made_of in _MADE:
                quick[i] = made_of(quick[i], terms)
            return _observation(quick)
    return checked(unpacked(payload), terms)


def unpacked(payload: bytes) -> tuple[Any, ...]:
    """Version, type number and fields of a message, which are not checked yet.

    Raises:
        ProtocolError: the bytes are not one msgpack array of two elements or more.
    """
    # This check is the first, so that a packet that is too long is not parsed at all.
    if len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(Drop.TOO_LONG)
    try:
        # Messages contain no maps and no extensions, so these are never built from received bytes.
        fields = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError(Drop.NOT_MSGPACK) from error
    if type(fields) is not tuple or len(fields) < 2:
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    return fields


def checked(fields: tuple[Any, ...], terms: Terms) -> Message:
    """Message of unpacked fields; raises ProtocolError as `decode` does."""
    version, number, *body = fields
    if type(version) is not int or version != VERSION:
        raise ProtocolError(Drop.VERSION)
    if type(number) is not int or not (number in _TYPES or _is_of_a_room(number)):
        raise ProtocolError(Drop.TYPE)
    message, checks = _TYPES[number]
    if len(body) != len(checks):
        raise ProtocolError(Drop.NOT_A_MESSAGE)
    values = _checked(body, checks, terms)
    return _observation(values) if message is Observation else message._make(values)


def _is_of_a_room(number: int) -> bool:
    """Load the optional message of this type number; returns False if it is not installed."""
    if module := _ROOMS.pop(number, ""):
        with suppress(ModuleNotFoundError):
            import_module(module)
    return number in _TYPES


def preload() -> None:
    """Load all optional messages now, so that no received packet causes an import."""
    for number in tuple(_ROOMS):
        _is_of_a_room(number)
