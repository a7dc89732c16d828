"""The wire: what is written is read again, and nothing else is."""

import math

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skytether.shared.law.terms import Difference, Terms
from skytether.shared.scenario import reading
from skytether.shared.scenario.catalogue import differences
from skytether.shared.wire import protocol
from skytether.shared.wire.protocol import (
    FEEDBACK,
    INPUTS_MAX,
    NO_FEEDBACK,
    NO_HORIZON,
    PAYLOAD_BYTES_MAX,
    TEXT_MAX,
    VERSION,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    ProtocolError,
    Trajectory,
    Welcome,
    decode,
    encode,
    encode_horizon,
)

TERMS = (
    reading.load("paper")
    .terms()
    ._replace(dt_ns=50_000_000, horizon=40, axes=2, tau_s=(0.81, 0.7), u_max=(1.8, 2.5))
)

u16 = st.integers(0, 2**16 - 1)
u32 = st.integers(0, 2**32 - 1)
u64 = st.integers(0, 2**64 - 1)
stamp = st.integers(0, 2**63 - 1)
step = st.integers(0, 2**40)
positive = st.floats(1e-3, 1e3)


axes = st.lists(positive, min_size=1, max_size=3).map(tuple)
text = st.text(max_size=TEXT_MAX)
terms = st.builds(
    Terms,
    dt_ns=stamp,
    horizon=st.integers(1, INPUTS_MAX),
    axes=st.integers(1, 3),
    tau_s=axes,
    gain=axes,
    dead_time_s=axes,
    u_max=axes,
    scheme=text,
    exhausted=text,
    brake_mps2=positive,
    age_max_s=positive,
    shape=text,
    radius_m=positive,
    period_s=positive,
    altitude_m=st.floats(-1e3, 1e3),
    points=text,
    speed_mps=positive,
    loop=st.booleans(),
    table=text,
)
"""Any terms that another end may have."""


messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(Hello, u16, u64, terms),
    st.builds(Welcome, u16, u32, u64, u64, stamp, st.integers(0, 3), terms),
    st.builds(
        Observation,
        u16,
        u32,
        step,
        stamp,
        st.integers(NO_HORIZON, 2**40),
        step,
        stamp,
        stamp,
        st.sampled_from(Mode),
        st.integers(0, 1),
        arrays("<f8", (2, 2), elements=st.floats(allow_nan=False, allow_infinity=False)),
        arrays("<f8", 2, elements=st.floats(-1.8, 1.8)),
        u32,
        u16,
    ),
    st.builds(
        Horizon,
        u16,
        u32,
        step,
        stamp,
        stamp,
        arrays(
            "<f4",
            st.tuples(st.just(2), st.integers(40, 135)),
            elements=st.floats(-1.75, 1.75, width=32),
        ),
        arrays(
            "<f4",
            st.tuples(st.just(2), st.sampled_from([0, FEEDBACK])),
            elements=st.floats(allow_nan=False, allow_infinity=False, width=32),
        ),
        u32,
        u16,
    ),
    st.builds(Heartbeat, u16, u32, stamp, st.sampled_from(Idle), st.integers(0, 1), u32, u16),
    st.builds(Close, u16, u32),
)
trajectories = st.builds(
    Trajectory,
    u16,
    u32,
    step,
    stamp,
    st.integers(-(2**15), 2**32 - 1),
    st.integers(1, 2**16 - 1),
    arrays(
        "<f4",
        st.tuples(st.just(2), st.integers(1, 16), st.just(2)),
        elements=st.floats(allow_nan=False, allow_infinity=False, width=32),
    ),
    u32,
    u16,
)


def same(one: Message, other: Message) -> bool:
    """Equal type and equal fields, arrays to the bit."""
    return type(one) is type(other) and all(
        np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
        for a, b in zip(one, other, strict=True)
    )


@given(messages)
def test_every_message_is_read_as_it_was_written(message: Message) -> None:
    """Round trip of all six of a scheme that plans."""
    assert same(decode(encode(message), TERMS), message)


@given(trajectories)
def test_a_trajectory_is_read_as_it_was_written(message: Message) -> None:
    """By a vehicle that flies along one."""
    assert same(decode(encode(message), TERMS._replace(scheme="trajectory")), message)


@pytest.mark.parametrize("axes", [2, 3])
def test_the_longest_horizon_fits_one_datagram(axes: int) -> None:
    """All numbers at their largest, and as many inputs as the limit allows."""
    longest = INPUTS_MAX // axes
    horizon = Horizon(
        2**16 - 1,
        2**32 - 1,
        2**40,
        2**63 - 1,
        2**63 - 1,
        np.ones((axes, longest), np.float32),
        np.ones((axes, FEEDBACK), np.float32),
        2**32 - 1,
        2**16 - 1,
    )
    assert len(encode(horizon)) <= PAYLOAD_BYTES_MAX


def test_documented_sizes_are_the_real_ones() -> None:
    """The example of docs/protocol.md: 40 inputs on two axes."""
    inputs = np.zeros((2, 40), np.float32)
    state = np.zeros((2, 2))
    stamp_ns, session = 3 * 10**14, 2**31
    asked = {"number": 500, "silence_ms": 300}
    none = NO_FEEDBACK
    assert len(encode(Horizon(1, session, 500, stamp_ns, stamp_ns, inputs, none, **asked))) == 361
    committed = np.zeros((2, 51), np.float32)
    committing = Horizon(1, session, 500, stamp_ns, stamp_ns, committed, none, **asked)
    assert len(encode(committing)) == 361 + 11 * 8
    aboard = np.zeros((2, FEEDBACK), np.float32)
    assert len(encode(committing._replace(feedback=aboard))) == 361 + 11 * 8 + 40
    told = 480, 490, stamp_ns, stamp_ns, Mode.TRACK, 1, state, np.zeros(2)
    assert len(encode(Observation(1, session, 500, stamp_ns, *told, **asked))) == 107
    assert len(encode(Heartbeat(1, session, stamp_ns, Idle.DELAY, 0, **asked))) == 26
    assert len(encode(Close(1, session))) == 9


def test_a_horizon_made_of_bytes_is_the_message() -> None:
    """What a server sends in numbers is what its arrays would make, with feedback and without."""
    inputs = np.arange(84, dtype=np.float32).reshape(2, 42) / 84
    for count in (0, FEEDBACK):
        feedback = np.ones((2, count), np.float32)
        horizon = Horizon(1, 2**31, 500, 10**15, 10**14, inputs, feedback, 7, 300)
        *fields, _, _, number, silence_ms = horizon
        bytes_of = (array.ravel().data.cast("B") for array in (inputs, feedback))
        assert encode_horizon(*fields, *bytes_of, number, silence_ms) == encode(horizon)


def body(message: Message) -> list[object]:
    """The message as the list that is packed."""
    fields: list[object] = msgpack.unpackb(encode(message))
    return fields


STATE = np.array([[1.0, 2.0], [3.0, 4.0]])
OBSERVATION = Observation(1, 7, 5, 10, 4, 5, 8, 9, Mode.TRACK, 1, STATE, np.array([0.5, -0.5]))
HORIZON = Horizon(1, 7, 5, 10, 9, np.full((2, 40), 0.5, np.float32))
HEARTBEAT = Heartbeat(1, 7, 10, Idle.PLANS, 0)
HELLO = Hello(1, 99, TERMS)
WELCOME = Welcome(1, 7, 99, 98, 10, 0, TERMS)


def terms_with(**wrong: object) -> list[object]:
    """Terms as they are packed, with a field that cannot be."""
    return list(TERMS._replace(**wrong))


@pytest.mark.parametrize(
    ("message", "field", "value", "reason"),
    [
        (OBSERVATION, 0, 1, "version"),
        (OBSERVATION, 0, True, "version"),
        (OBSERVATION, 1, 0, "type"),
        (OBSERVATION, 1, 8, "type"),
        (OBSERVATION, 1, "3", "type"),
        (OBSERVATION, 2, 2**16, "field"),
        (OBSERVATION, 2, True, "field"),
        (OBSERVATION, 3, -1, "field"),
        (OBSERVATION, 4, 1.0, "field"),
        (OBSERVATION, 4, 2**40 + 1, "field"),
        (OBSERVATION, 5, -1, "field"),
        (OBSERVATION, 5, 2**63, "field"),
        (OBSERVATION, 6, -2, "field"),
        (OBSERVATION, 7, -1, "field"),
        (OBSERVATION, 10, len(Mode), "field"),
        (OBSERVATION, 11, 2, "field"),
        (OBSERVATION, 11, True, "field"),
        (OBSERVATION, 12, b"", "shape"),
        (OBSERVATION, 12, [1.0, 2.0, 3.0, 4.0], "shape"),
        (OBSERVATION, 12, np.array([1, 2, 3, math.nan]).tobytes(), "not finite"),
        (OBSERVATION, 12, np.array([1, 2, 3, math.inf]).tobytes(), "not finite"),
        (OBSERVATION, 13, np.zeros(3).tobytes(), "shape"),
        (OBSERVATION, 13, np.array([0.0, math.nan]).tobytes(), "not finite"),
        (OBSERVATION, 13, np.array([1.81, 0.0]).tobytes(), "input out of range"),
        (HORIZON, 7, np.zeros(79, np.float32).tobytes(), "shape"),
        (HORIZON, 7, np.zeros(81, np.float32).tobytes(), "shape"),
        (HORIZON, 7, np.zeros(272, np.float32).tobytes(), "shape"),
        (HORIZON, 7, np.full(80, np.nan, np.float32).tobytes(), "not finite"),
        (HORIZON, 7, np.full(80, 1.81, np.float32).tobytes(), "input out of range"),
        (HORIZON, 7, np.full(80, -1.81, np.float32).tobytes(), "input out of range"),
        (HORIZON, 7, np.array([9] * 79 + [-math.inf], np.float32).tobytes(), "not finite"),
        (HORIZON, 7, b"\x00\x00\xa0\x7f" * 80, "not finite"),  # signalling NaNs
        (HORIZON, 8, np.zeros(2, np.float32).tobytes(), "shape"),
        (HORIZON, 8, np.zeros(12, np.float32).tobytes(), "shape"),
        (HORIZON, 8, [], "shape"),
        (HORIZON, 8, np.array([9] * 9 + [math.nan], np.float32).tobytes(), "not finite"),
        (HORIZON, 8, np.array([9] * 9 + [-math.inf], np.float32).tobytes(), "not finite"),
        (WELCOME, 7, -1, "field"),
        (WELCOME, 7, 4, "field"),
        (WELCOME, 7, False, "field"),
        (HEARTBEAT, 5, -1, "field"),
        (HEARTBEAT, 5, len(Idle), "field"),
        (HEARTBEAT, 5, True, "field"),
        (HEARTBEAT, 6, 2, "field"),
        (HELLO, 4, terms_with(dt_ns=0.05), "field"),
        (HELLO, 4, terms_with(age_max_s=5), "field"),
        (HELLO, 4, terms_with(horizon=True), "field"),
        (HELLO, 4, terms_with(tau_s=0.8), "field"),
        (HELLO, 4, terms_with(u_max=(1.8, math.nan)), "field"),
        (HELLO, 4, terms_with(u_max=(1.8, math.inf)), "field"),
        (HELLO, 4, terms_with(u_max=(1, 1)), "field"),
        (HELLO, 4, terms_with(u_max=(1.8,) * 4), "field"),
        (HELLO, 4, terms_with(scheme=b"committed"), "field"),
        (HELLO, 4, terms_with(shape="x" * (TEXT_MAX + 1)), "field"),
        (HELLO, 4, terms_with(brake_mps2=math.nan), "field"),
        (HELLO, 4, terms_with(loop=0), "field"),
        (HELLO, 4, list(TERMS)[:-1], "field"),
        (HELLO, 4, [*TERMS, 0], "field"),
        (HELLO, 4, None, "field"),
    ],
)
def test_a_wrong_field_is_the_peers_mistake(
    message: Message, field: int, value: object, reason: str
) -> None:
    """Each check of each field, with its reason."""
    fields = body(message)
    fields[field] = value
    with pytest.raises(ProtocolError) as error:
        decode(msgpack.packb(fields), TERMS)
    assert error.value.reason == reason


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not msgpack"),
        (b"\xc1", "not msgpack"),
        (encode(HELLO) + b"\x00", "not msgpack"),
        (encode(HELLO)[:-1], "not msgpack"),
        (b"\x80", "not a message"),
        (b"\x81\x01\x02", "not msgpack"),
        (msgpack.packb(7), "not a message"),
        (msgpack.packb([VERSION]), "not a message"),
        (msgpack.packb([VERSION, 5, 1, 7]), "not a message"),
        (msgpack.packb([VERSION, 5, 1, 7, 8, 9, 9, 9]), "not a message"),
        (msgpack.packb([[[[[[]]]]]]), "not a message"),
        (b"\xdd\xff\xff\xff\xff", "not msgpack"),
        (b"\x91" * 1200, "not msgpack"),
        (bytes(PAYLOAD_BYTES_MAX + 1), "too long"),
    ],
)
def test_what_is_no_message_is_refused(payload: bytes, reason: str) -> None:
    """Truncated, overlong, nested, huge by its own word, or something else altogether."""
    with pytest.raises(ProtocolError) as error:
        decode(payload, TERMS)
    assert error.value.reason == reason


def test_no_field_of_any_message_goes_unchecked() -> None:
    """Each field in turn made a string: never accepted."""
    for message in (HELLO, WELCOME, OBSERVATION, HORIZON, HEARTBEAT):
        for field in range(len(message) + 2):
            fields = body(message)
            fields[field] = "x"
            with pytest.raises(ProtocolError):
                decode(msgpack.packb(fields), TERMS)


@settings(max_examples=300)
@given(st.binary(max_size=1300))
def test_random_bytes_are_refused_or_are_a_message(payload: bytes) -> None:
    """Nothing but a ProtocolError ever comes out of decoding."""
    try:
        message = decode(payload, TERMS)
    except ProtocolError:
        return
    assert same(decode(encode(message), TERMS), message)


def test_the_table_of_messages_is_complete() -> None:
    """As many checks as fields, for every message."""
    assert [len(checks) for _, checks in protocol._TYPES] == [
        len(message._fields) for message, _ in protocol._TYPES
    ]


@given(terms, terms)
def test_terms_differ_in_keys_exactly_where_they_are_not_equal(one: Terms, other: Terms) -> None:
    """Both ends name the same keys, with the values changed over."""
    assert bool(differences(one, other)) == (one != other)
    assert differences(one, other) == tuple(
        Difference(difference.key, here=difference.there, there=difference.here)
        for difference in differences(other, one)
    )
