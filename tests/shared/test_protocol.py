"""Messages on the wire: round trips, and refusals."""

import math

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.heartbeat import NUMBERS, Hearing
from skytether.shared.law.limits import Limits
from skytether.shared.law.terms import Difference, Terms
from skytether.shared.scenario import reading
from skytether.shared.scenario.catalogue import differences
from skytether.shared.wire import protocol
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.lead import Lead, decode_led, with_leadership
from skytether.shared.wire.protocol import (
    FEEDBACK,
    INPUTS_MAX,
    NO_FEEDBACK,
    NO_HORIZON,
    NO_INPUT,
    PAYLOAD_BYTES_MAX,
    STAMPS,
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
    Time,
    Trajectory,
    Welcome,
    decode,
    encode,
    encode_horizon,
    stamp_us,
    stamped_ns,
)

TERMS = (
    reading.load("paper")
    .terms()
    ._replace(dt_ns=50_000_000, horizon=40, axes=2, tau_s=(0.81, 0.7), u_max=(1.8, 2.5))
)

u16 = st.integers(0, 2**16 - 1)
u32 = st.integers(0, 2**32 - 1)
u31 = st.integers(0, 2**31 - 1)
u64 = st.integers(0, 2**64 - 1)
clock = st.integers(0, 2**63 - 1)
number = st.integers(0, NUMBERS - 1)
age = st.integers(-(2**15), 2**32 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False, width=32)
positive = st.floats(1e-3, 1e3)


axes = st.lists(positive, min_size=1, max_size=3).map(tuple)
text = st.text(max_size=TEXT_MAX)
terms = st.builds(
    Terms,
    dt_ns=clock,
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
    feedback=st.booleans(),
    join_s=positive,
    land_after_s=positive,
    separation_m=positive,
    height_m=positive,
    tube_m=positive,
)


@st.composite
def observed(draw: st.DrawFn, *, splines: bool = False) -> Observation:
    step = draw(u32)
    since = step - draw(st.integers(0, step))
    ahead = st.integers(max(0, since - 2**32 + 1), since + 2**15)
    return Observation(
        draw(u16),
        draw(u32),
        step,
        draw(st.one_of(st.just(NO_HORIZON), ahead)),
        since,
        draw(u32),
        draw(number),
        draw(st.sampled_from(Mode)),
        draw(st.integers(0, 1)),
        draw(arrays("<f8", (2, 2), elements=finite)),
        NO_INPUT if splines else draw(arrays("<f8", 2, elements=st.floats(-1.75, 1.75, width=32))),
        draw(number),
        draw(u16),
        draw(st.integers(0, 1)),
    )


limits = st.none() | st.builds(Limits, finite, finite, finite, text)
observations = observed()
messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(Hello, u16, u64, terms),
    st.builds(Welcome, u16, u32, u64, u64, clock, st.integers(0, 3), terms),
    observations,
    st.builds(
        Horizon,
        u16,
        u32,
        u32,
        u32,
        age,
        arrays(
            "<f4",
            st.tuples(st.just(2), st.integers(40, 135)),
            elements=st.floats(-1.75, 1.75, width=32),
        ),
        arrays(
            "<f4",
            st.tuples(st.just(2), st.sampled_from([0, FEEDBACK])),
            elements=finite,
        ),
        number,
        u16,
    ),
    st.builds(Heartbeat, u16, u32, u32, st.sampled_from(Idle), st.integers(0, 1), number, u16),
    st.builds(Close, u16, u32),
    st.builds(Time, u16, u32, u32, u32, u32),
    st.builds(
        Lead,
        *(u16, u32, u32, st.integers(0, 1), u32, u31, st.none() | u31, u16),
        knots=st.just(np.empty((2, 0, 2))),
        limits=limits,
        changes=u31,
    ),
)
knots = arrays("<f4", st.tuples(st.just(2), st.integers(1, 16), st.just(2)), elements=finite)
trajectories = st.builds(
    Trajectory,
    u16,
    u32,
    u32,
    u32,
    age,
    st.integers(1, 2**16 - 1),
    knots,
    number,
    u16,
)
leads = st.builds(
    Lead, u16, u32, u32, st.just(1), u32, u31, st.none() | u31, u16, knots, limits, u31
)
along_splines = TERMS._replace(scheme="trajectory")


def same(one: Message, other: Message) -> bool:
    return type(one) is type(other) and all(
        np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
        for a, b in zip(one, other, strict=True)
    )


@given(messages)
def test_every_message_is_read_as_it_was_written(message: Message) -> None:
    assert same(decode(encode(message), TERMS), message)


@settings(max_examples=50)
@given(st.one_of(trajectories, leads, observed(splines=True)))
def test_a_trajectory_and_what_is_told_of_it_are_read_as_they_were_written(
    message: Message,
) -> None:
    assert same(decode(encode(message), along_splines), message)


@settings(max_examples=50)
@given(trajectories, u32)
def test_the_leadership_of_a_plan_is_read_as_it_was_written(plan: Trajectory, number: int) -> None:
    read, leadership = decode_led(with_leadership(number, encode(plan)), along_splines)
    assert same(read, plan)
    assert leadership == number


@given(st.floats(-1e6, 1e6))
def test_a_state_is_told_as_float32(position: float) -> None:
    """To 6 digits and a half: 0.06 mm at a kilometre."""
    observation = OBSERVATION._replace(state=np.full((2, 2), position))
    read = decode(encode(observation), TERMS)
    assert isinstance(read, Observation)
    assert read.state.dtype == np.float64
    assert np.abs(read.state - position).max() <= max(abs(position) * 2**-24, 1e-45)


MICROSECOND = 1000
HALF_NS = 2**31 * MICROSECOND


@given(clock, st.integers(-HALF_NS + MICROSECOND, HALF_NS - MICROSECOND))
def test_a_stamp_is_the_time_nearest_to_what_is_expected(time_ns: int, off_ns: int) -> None:
    """A stamp of 32 bits gives the full time if the expected time is less than 35 minutes off."""
    assert 0 <= stamp_us(time_ns) < STAMPS
    assert stamped_ns(stamp_us(time_ns), time_ns + off_ns) == time_ns // MICROSECOND * MICROSECOND


@given(u32, st.integers(-(2**64), 2**64))
def test_a_stamp_of_long_ago_is_taken_for_one_of_half_an_hour_about_now(
    stamp: int, near_ns: int
) -> None:
    """The decoded time has this stamp, and is at most half an hour from the expected one."""
    time_ns = stamped_ns(stamp, near_ns)
    assert stamp_us(time_ns) == stamp
    assert abs(time_ns - near_ns) <= HALF_NS + MICROSECOND


@given(
    st.integers(-(2**62), 2**62),
    clock,
    st.integers(0, 300 * 50_000_000),
    *[st.integers(0, 1000 * 10**9)] * 3,
)
def test_the_delays_of_both_directions_come_out(
    began_ns: int, sent_ns: int, held_ns: int, late_ns: int, slept_ns: int, back_ns: int
) -> None:
    """The delay of each direction follows from a server's packet and the observation that echoes
    it.

    Clocks may be centuries apart; delays and the time between the packets may be a quarter of an
    hour. Sealed packets are accepted for ten minutes.
    """
    received_ns = sent_ns + back_ns  # on the server's clock; step 0 was at began_ns
    welcomed_ns = sent_ns - slept_ns
    server_ns = stamped_ns(stamp_us(sent_ns), welcomed_ns + slept_ns + back_ns - late_ns)
    assert 0 <= sent_ns - server_ns < MICROSECOND
    stamp = stamp_us(received_ns - began_ns - server_ns + MICROSECOND - 1)
    observed_ns = received_ns + held_ns
    forward_ns = observed_ns + late_ns - (observed_ns - began_ns)
    backward_ns = stamped_ns(stamp, -forward_ns)
    assert 0 <= backward_ns + began_ns - back_ns < 2 * MICROSECOND


@pytest.mark.parametrize("minutes", [36, 71, 72, 143, 10_000])
def test_what_was_held_back_for_long_makes_a_round_trip_of_less_than_nothing(minutes: int) -> None:
    """Or a time that contradicts its own stamp, which is implausible."""
    delay_ns, held_ns, began_ns = 440 * 10**6, minutes * 60 * 10**9, 10**15
    stamp = stamp_us(delay_ns - began_ns)
    in_time_ns, late_ns = began_ns + delay_ns, began_ns + delay_ns + held_ns
    backward_ns = stamped_ns(stamp, -late_ns)
    assert backward_ns + in_time_ns < -35 * 60 * 10**9
    assert stamped_ns(stamp, -in_time_ns) + in_time_ns == 2 * delay_ns


@pytest.mark.parametrize("axes", [2, 3])
def test_the_longest_horizon_fits_one_datagram(axes: int) -> None:
    longest = INPUTS_MAX // axes
    horizon = Horizon(
        2**16 - 1,
        2**32 - 1,
        2**32 - 1,
        2**32 - 1,
        2**32 - 1,
        np.ones((axes, longest), np.float32),
        np.ones((axes, FEEDBACK), np.float32),
        NUMBERS - 1,
        2**16 - 1,
    )
    assert len(encode(horizon)) <= PAYLOAD_BYTES_MAX


SESSION = 2**31
USUAL = {"number": 100, "silence": 25}


def told_by(step: int, flown: int, *, splines: bool, silence: int = 25) -> Observation:
    """Observation of a vehicle that has flown a horizon for some steps."""
    since = step - flown
    return Observation(
        1,
        SESSION,
        step,
        since - 12,
        since,
        2**32 - 1,
        NUMBERS - 1,
        Mode.TRACK,
        1,
        np.ones((2, 2)),
        NO_INPUT if splines else np.ones(2),
        NUMBERS - 1,
        silence,
    )


def test_documented_sizes_are_the_real_ones() -> None:
    inputs = np.zeros((2, 40), np.float32)
    none = NO_FEEDBACK
    assert len(encode(Horizon(1, SESSION, 500, 2**31, 9, inputs, none, **USUAL))) == 345
    committed = np.zeros((2, 51), np.float32)
    committing = Horizon(1, SESSION, 500, 2**31, 9, committed, none, **USUAL)
    assert len(encode(committing)) == 345 + 11 * 8
    aboard = np.zeros((2, FEEDBACK), np.float32)
    assert len(encode(committing._replace(feedback=aboard))) == 345 + 11 * 8 + 40
    assert len(encode(told_by(500, 10, splines=True))) == 41
    assert len(encode(told_by(500, 10, splines=False))) == 49
    assert len(encode(Heartbeat(1, SESSION, 2**31, Idle.DELAY, 0, **USUAL))) == 18
    assert len(encode(Close(1, SESSION))) == 9
    assert len(encode(Time(1, SESSION, 500, 2**31, 900))) == 20
    session, stamp, most = 2**32 - 1, 2**32 - 1, {"number": 127, "silence": 2**16 - 1}
    longest = Horizon(2**16 - 1, session, 2**32 - 1, stamp, 2**32 - 1, inputs, none, **most)
    assert len(encode(longest)) == 355
    assert len(encode(Heartbeat(2**16 - 1, session, stamp, Idle.DELAY, 0, **most))) == 22
    assert len(encode(Close(2**16 - 1, session))) == 11
    assert len(encode(Time(2**16 - 1, session, 2**32 - 1, stamp, 2**32 - 1))) == 26


@pytest.mark.parametrize("step", [60, 72_000, 360_000])
def test_an_observation_is_small_for_an_hour(step: int) -> None:
    """At steps from 10 to 50 ms, of two axes, with a requested silence of a few seconds."""
    assert len(encode(told_by(step, 60, splines=True, silence=255))) <= 48
    assert len(encode(told_by(step, step, splines=True, silence=255))) <= 48


def test_the_longest_silence_is_told_as_far_as_the_wire_has_numbers() -> None:
    asked = Hearing(SECOND_NS, MILLISECOND_NS, 3600 * SECOND_NS)
    beat = Heartbeat(1, 1, 0, 0, 0, 0, asked.silence)
    assert decode(encode(beat), TERMS) == beat
    with pytest.raises(ProtocolError) as refused:
        decode(encode(beat._replace(silence=asked.silence + 1)), TERMS)
    assert refused.value.reason is Drop.FIELD


def test_the_longest_observation() -> None:
    """With all numbers at their largest: 55 bytes of two axes, and 8 more with inputs."""
    longest = told_by(2**32 - 1, 2**20, splines=True, silence=2**16 - 1)
    longest = longest._replace(vehicle=2**16 - 1, session=2**32 - 1, in_force=0)
    assert len(encode(longest)) == 55
    assert len(encode(longest._replace(input=np.ones(2)))) == 63


def test_a_horizon_made_of_bytes_is_the_message() -> None:
    inputs = np.arange(84, dtype=np.float32).reshape(2, 42) / 84
    for count in (0, FEEDBACK):
        feedback = np.ones((2, count), np.float32)
        horizon = Horizon(1, 2**31, 500, 2**32 - 1, 9, inputs, feedback, 7, 300)
        *fields, _, _, number, silence = horizon
        bytes_of = (array.ravel().data.cast("B") for array in (inputs, feedback))
        plan = encode_horizon(*fields, *bytes_of, number, silence)
        assert plan == encode(horizon)
        for leadership in (1, 127, 128, 2**32 - 1):
            led = with_leadership(leadership, plan)
            assert msgpack.unpackb(led) == [*msgpack.unpackb(plan), leadership]
            with pytest.raises(ProtocolError, match="not a message"):
                decode(led, TERMS)
        assert with_leadership(0, plan) == plan


def body(message: Message) -> list[object]:
    fields: list[object] = msgpack.unpackb(encode(message))
    return fields


STATE = np.array([[1.0, 2.0], [3.0, 4.0]])
OBSERVATION = Observation(1, 7, 5, 4, 5, 8, 9, Mode.TRACK, 1, STATE, np.array([0.5, -0.5]))
HORIZON = Horizon(1, 7, 5, 10, 1, np.full((2, 40), 0.5, np.float32))
HEARTBEAT = Heartbeat(1, 7, 10, Idle.PLANS, 0)
HELLO = Hello(1, 99, TERMS)
WELCOME = Welcome(1, 7, 99, 98, 10, 0, TERMS)


def terms_with(**wrong: object) -> list[object]:
    return list(TERMS._replace(**wrong))


@pytest.mark.parametrize(
    ("message", "field", "value", "reason"),
    [
        (OBSERVATION, 0, 2, "version"),
        (OBSERVATION, 0, True, "version"),
        (OBSERVATION, 1, 0, "type"),
        (OBSERVATION, 1, 11, "type"),
        (OBSERVATION, 1, "3", "type"),
        (OBSERVATION, 2, 2**16, "field"),
        (OBSERVATION, 2, True, "field"),
        (OBSERVATION, 3, -1, "field"),
        (OBSERVATION, 4, 1.0, "field"),
        (OBSERVATION, 4, 2**32, "field"),
        (OBSERVATION, 5, -(2**15) - 1, "field"),
        (OBSERVATION, 5, 6, "field"),
        (OBSERVATION, 5, None, "field"),
        (OBSERVATION, 6, -(2**15) - 1, "field"),
        (OBSERVATION, 6, 6, "field"),
        (OBSERVATION, 6, True, "field"),
        (OBSERVATION, 7, -1, "field"),
        (OBSERVATION, 7, 2**32, "field"),
        (OBSERVATION, 8, NUMBERS, "field"),
        (OBSERVATION, 9, 4 * len(Mode), "field"),
        (OBSERVATION, 9, True, "field"),
        (OBSERVATION, 10, b"", "shape"),
        (OBSERVATION, 10, [1.0, 2.0, 3.0, 4.0, 0.0, 0.0], "shape"),
        (OBSERVATION, 10, np.zeros(4, np.float32).tobytes(), "shape"),
        (OBSERVATION, 10, np.zeros(6).tobytes(), "shape"),
        (OBSERVATION, 10, np.array([1, 2, 3, math.nan, 0, 0], np.float32).tobytes(), "not finite"),
        (OBSERVATION, 10, np.array([1, 2, 3, math.inf, 0, 0], np.float32).tobytes(), "not finite"),
        (OBSERVATION, 10, np.array([1, 2, 3, 4, 0, math.nan], np.float32).tobytes(), "not finite"),
        (
            OBSERVATION,
            10,
            np.array([1, 2, 3, 4, 1.81, 0], np.float32).tobytes(),
            "input out of range",
        ),
        (
            OBSERVATION,
            10,
            np.array([1, 2, 3, 4, 0, -2.51], np.float32).tobytes(),
            "input out of range",
        ),
        (OBSERVATION, 11, NUMBERS, "field"),
        (OBSERVATION, 12, 2**16, "field"),
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
    """Truncated, overlong, nested, with a false length, or of another kind."""
    with pytest.raises(ProtocolError) as error:
        decode(payload, TERMS)
    assert error.value.reason == reason


def test_no_field_of_any_message_goes_unchecked() -> None:
    for message in (HELLO, WELCOME, OBSERVATION, HORIZON, HEARTBEAT):
        for field in range(len(body(message))):
            fields = body(message)
            fields[field] = "x"
            with pytest.raises(ProtocolError):
                decode(msgpack.packb(fields), TERMS)


@settings(max_examples=300)
@given(st.binary(max_size=1300))
def test_random_bytes_are_refused_or_are_a_message(payload: bytes) -> None:
    try:
        message = decode(payload, TERMS)
    except ProtocolError:
        return
    assert same(decode(encode(message), TERMS), message)


def test_the_table_of_messages_is_complete() -> None:
    """Every message has as many checks as fields; an observation has three fewer on the wire."""
    for message, checks in protocol._TYPES.values():
        # Mode, takes and unsaved are one number, and so are state and input.
        fewer = 3 if message is Observation else 0
        assert len(checks) == len(message._fields) - fewer
        assert len(checks) + 2 < 16  # the length has one byte


@settings(max_examples=25)
@given(terms, terms)
def test_terms_differ_in_keys_exactly_where_they_are_not_equal(one: Terms, other: Terms) -> None:
    assert bool(differences(one, other)) == (one != other)
    assert differences(one, other) == tuple(
        Difference(difference.key, here=difference.there, there=difference.here)
        for difference in differences(other, one)
    )


anything = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.binary(max_size=40),
    st.text(max_size=4),
    st.integers(-(2**63), 2**64 - 1),
    st.lists(st.integers(0, 3), max_size=2),
)


def verdict(payload: bytes) -> Message | Drop:
    try:
        return decode(payload, TERMS)
    except ProtocolError as error:
        return error.reason


@settings(max_examples=60)
@given(observations, st.integers(0, 12), anything, st.binary(max_size=2))
def test_an_observation_is_read_at_once_as_it_is_field_by_field(
    observation: Observation, field: int, value: object, more: bytes
) -> None:
    """The fast decoder accepts only what the field checks accept, and gives their reasons."""
    fields = list(msgpack.unpackb(encode(observation)))
    for payload in (encode(observation) + more, replaced(fields, field, value)):
        quick = verdict(payload)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(protocol, "_QUICK_START", b"\xc1")
            slow = verdict(payload)
        if isinstance(quick, Drop) or isinstance(slow, Drop):
            assert quick is slow
        else:
            assert same(quick, slow)


def replaced(fields: list[object], field: int, value: object) -> bytes:
    return msgpack.packb([*fields[:field], value, *fields[field + 1 :]])
