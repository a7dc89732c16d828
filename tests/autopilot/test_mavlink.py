"""MAVLink codec: round trips, noise between frames, parameters, axes."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.mavlink import parameters
from skytether.mavlink.codec import FRAME_BYTES_MAX, Codec
from skytether.mavlink.dialect import dialect
from skytether.mavlink.frames import turned
from skytether.mavlink.text import UNFINISHED_MAX, Texts, chunks

HEARTBEAT = dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)
POSITION = dialect.MAVLink_local_position_ned_message(1234, 1.0, -2.0, -5.0, 0.5, 0.25, -0.125)
NOISE = st.binary(max_size=60)


def frames(count: int) -> list[bytes]:
    codec = Codec(1, 1)
    return [codec.encode((HEARTBEAT, POSITION)[n % 2]) for n in range(count)]


def names(messages: list[object]) -> list[str]:
    return [message.get_type() for message in messages]  # type: ignore[attr-defined]


def test_what_is_written_is_read() -> None:
    (heartbeat, position) = Codec(255, 190).decode(b"".join(frames(2)))
    assert (heartbeat.custom_mode, heartbeat.autopilot, heartbeat.get_srcSystem()) == (4, 3, 1)
    assert (position.x, position.z, position.vz, position.get_seq()) == (1.0, -5.0, -0.125, 1)


@settings(max_examples=60, deadline=None)
@given(st.lists(NOISE, min_size=4, max_size=4), st.booleans())
def test_frames_are_found_among_noise(noise: list[bytes], stream: bool) -> None:
    """All frames are found in order, in datagrams or a stream; an incomplete frame delays the rest
    by one frame's length at most.
    """
    sent = frames(3)
    mixed = b"".join(a + b for a, b in zip(noise, [*sent, bytes(FRAME_BYTES_MAX)], strict=True))
    codec = Codec(255, 190, stream=stream)
    assert names(codec.decode(mixed)) == ["HEARTBEAT", "LOCAL_POSITION_NED", "HEARTBEAT"]
    assert codec.garbage_bytes + sum(map(len, sent)) + len(codec._rest) == len(mixed)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_frame_that_was_cut_off_takes_no_other_with_it(data: st.DataObject) -> None:
    first, second = frames(2)
    cut = first[: data.draw(st.integers(0, len(first) - 1))]
    assert names(Codec(255, 190).decode(cut + second)) == ["LOCAL_POSITION_NED"]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 40), max_size=20))
def test_a_stream_may_come_in_any_pieces(sizes: list[int]) -> None:
    codec, sent, read = Codec(255, 190, stream=True), b"".join(frames(5)), []
    for size in [*sizes, len(sent)]:
        read += codec.decode(sent[:size])
        sent = sent[size:]
        assert len(codec._rest) <= FRAME_BYTES_MAX
    assert names(read) == ["HEARTBEAT", "LOCAL_POSITION_NED"] * 2 + ["HEARTBEAT"]
    assert codec.garbage_bytes == 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2), st.integers(0, 400), st.integers(1, 255))
def test_a_flipped_bit_is_no_message(which: int, at: int, flip: int) -> None:
    """The checksum covers all bytes but the first, without which no frame begins."""
    frame = bytearray(frames(3)[which])
    frame[at % len(frame)] ^= flip
    assert Codec(255, 190).decode(bytes(frame)) == []


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 2**24 - 1))
def test_a_frame_with_a_right_checksum_may_say_anything(payload: bytes, number: int) -> None:
    kinds = sorted(dialect.mavlink_map)
    kind = dialect.mavlink_map[kinds[number % len(kinds)]]
    payload = payload[:255]
    head = bytes([len(payload), 0, 0, 0, 1, 1]) + kind.id.to_bytes(3, "little")
    crc = dialect.x25crc(bytearray(head + payload + bytes([kind.crc_extra]))).crc
    frame = b"\xfd" + head + payload + crc.to_bytes(2, "little")
    for message in Codec(255, 190).decode(frame):
        assert message.get_msgId() == kind.id


@given(st.integers(-(2**31), 2**31 - 1).filter(lambda n: (n >> 22) & 0x1FF != 0x1FE))
def test_an_integer_goes_bit_by_bit(value: int) -> None:
    """Integers are sent bit by bit, as by PX4; signalling NaNs are excluded, as no float has
    them.
    """
    kind = parameters.type_of(value)
    sent = parameters.to_wire(value, bytewise=True)
    if not math.isnan(sent):
        assert parameters.from_wire(sent, kind, bytewise=True) == value


@given(st.integers(-(2**24), 2**24))
def test_an_integer_goes_as_a_number(value: int) -> None:
    sent = parameters.to_wire(value, bytewise=False)
    assert parameters.from_wire(sent, parameters.INTEGER, bytewise=False) == value


@pytest.mark.parametrize("bytewise", [False, True])
def test_what_is_no_number_is_no_value(bytewise: bool) -> None:
    assert parameters.from_wire(math.nan, parameters.FLOAT, bytewise=bytewise) is None
    assert parameters.from_wire(math.inf, parameters.FLOAT, bytewise=bytewise) is None
    assert parameters.from_wire(1.0, dialect.MAV_PARAM_TYPE_REAL64, bytewise=bytewise) is None
    assert parameters.from_wire(math.nan, parameters.INTEGER, bytewise=False) is None
    assert parameters.from_wire(2.5, parameters.FLOAT, bytewise=bytewise) == 2.5


@given(st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=250))
def test_a_long_text_is_put_together(text: str) -> None:
    """A long text is split into messages of 50 bytes; if one is lost, the whole text is dropped."""
    codec, texts = Codec(1, 1), Texts()
    sent = b"".join(map(codec.encode, chunks(4, text, 7)))
    read = Codec(255, 190).decode(sent)
    *before, last = [texts.take(message) for message in read]
    assert last == text
    assert all(each is None for each in before)
    if len(read) > 1:
        assert [texts.take(message) for message in read[1:]] == [None] * (len(read) - 1)
    assert not texts._begun


def test_texts_that_never_end_are_bounded() -> None:
    codec, texts = Codec(1, 1), Texts()
    for number in range(1, 100):
        frame = codec.encode(chunks(4, "x" * 60, number)[0])
        assert texts.take(Codec(255, 190).decode(frame)[0]) is None
    assert len(texts._begun) == UNFINISHED_MAX
    endless = b"".join(map(codec.encode, chunks(4, "x" * 2000, 200)))
    assert {texts.take(message) for message in Codec(255, 190).decode(endless)} == {None}


def test_down_is_altitude_with_the_other_sign() -> None:
    assert turned((1.0, 2.0, -5.0)) == (1.0, 2.0, 5.0)
    assert turned(turned((1.0, 2.0, -5.0))) == (1.0, 2.0, -5.0)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 255), st.data())
def test_a_frame_of_an_unknown_type_is_no_garbage_unless_it_is_damaged(
    payload: bytes, extra: int, data: st.DataObject
) -> None:
    number = 436  # CURRENT_MODE of PX4
    assert number not in dialect.mavlink_map
    head = bytes([len(payload), 0, 0, 0, 1, 1]) + number.to_bytes(3, "little")
    crc = dialect.x25crc(head + payload + bytes([extra])).crc
    frame = b"\xfd" + head + payload + crc.to_bytes(2, "little")
    (before, after), codec = frames(2), Codec(255, 190)
    assert names(codec.decode(before + frame + after)) == ["HEARTBEAT", "LOCAL_POSITION_NED"]
    assert (codec.unknown, codec.garbage_bytes) == (1, 0)
    damaged = bytearray(frame)
    damaged[data.draw(st.integers(10, len(frame) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert names(codec.decode(before + damaged + after)) == ["HEARTBEAT", "LOCAL_POSITION_NED"]
    assert (codec.unknown, codec.garbage_bytes) == (1, len(frame))
