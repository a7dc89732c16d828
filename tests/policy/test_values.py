"""`policy.values` and `policy.images`: openpi's serialization, size limits, image compression."""

import io
from contextlib import suppress

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from openpi_client import image_tools, msgpack_numpy
from PIL import Image

from policy_lab import OPTIONS, ramp
from skytether.policy import values
from skytether.policy.images import Compressor, Unpacker
from skytether.policy.robot import FrameType
from skytether.policy.values import ValueRefused
from skytether.policy.virtual import Emulated

KINDS = st.sampled_from(["<f4", "<f8", "|u1", "<i8", "|b1", ">i2", "<U3", "|S2"]).map(np.dtype)
LEAVES = (
    st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=5)
    | st.binary(max_size=5)
    | st.none()
    | KINDS.flatmap(lambda kind: arrays.arrays(kind, arrays.array_shapes(max_dims=3, max_side=4)))
)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)


def same(one: object, other: object) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(
            one, other, equal_nan=one.dtype.kind == "f"
        )
    return type(one) is type(other) and one == other


@given(TREES)
def test_a_value_is_what_openpis_own_client_would_send(tree: object) -> None:
    packed = values.pack(tree)
    assert packed == msgpack_numpy.packb(tree)
    assert same(values.unpack(packed), tree)


def test_arrays_arrive_as_openpis_own_client_would_send_them() -> None:
    """In any memory layout, and a prompt as an array, which openpi's policies take too."""
    square = np.arange(12.0).reshape(3, 4)
    prompt = np.asarray("pick up the fork")
    for array in (prompt, square[:, ::2], np.asfortranarray(square), square[::-1], np.array(1.5)):
        packed = values.pack({"key": array})
        assert packed == msgpack_numpy.packb({"key": array})
        assert same(values.unpack(packed)["key"], array)


METADATA = bytes.fromhex(
    "82aa72657365745f706f736592cb0000000000000000cbbff8000000000000a46e616d65a87265636f72646564"
)
OBSERVATION = (
    b"\x83\xb1observation/state\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x08\0\0\0\0\0\0\x80?"
    b"\xc4\x05dtype\xa3<f4\xc4\x05shape\x91\x02\xb3observation/gripper\x83\xc4\r__npgeneric__\xc3"
    b"\xc4\x04data\xcb?\xd0\0\0\0\0\0\0\xc4\x05dtype\xa3<f4\xa6prompt\x84\xc4\x0b__ndarray__\xc3"
    b"\xc4\x04data\xc4\x08g\0\0\0o\0\0\0\xc4\x05dtype\xa3<U2\xc4\x05shape\x90"
)
REPLY = (
    b"\x83\xa7actions\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x18\0\0\0\0\0\0\x80?\0\0\0@\0\0@@"
    b"\0\0\x80@\0\0\xa0@\xc4\x05dtype\xa3<f4\xc4\x05shape\x92\x03\x02\xa5state\x84\xc4\x0b__ndarray__"
    b"\xc3\xc4\x04data\xc4\x08\0\0\0\0\0\0\xe0?\xc4\x05dtype\xa3<f8\xc4\x05shape\x91\x01"
    b'\xadserver_timing\x82\xa8infer_ms\xcb?\x85\x81\x06"\0\0\0\xadprev_total_ms\xcb@)\t8\xdex\x80\0'
)


def test_what_openpis_server_and_client_exchange_passes_unchanged() -> None:
    """Messages recorded between openpi's own server (15a9616) and its client from PyPI (0.1.2)."""
    lab = Emulated(ramp, OPTIONS, metadata=values.unpack(METADATA), thinking=None)
    lab.connect()
    lab.say(FrameType.MESSAGE.value + OBSERVATION)
    asked: list[bytes] = []
    lab._ask = lambda payload, _: asked.append(payload)  # type: ignore[method-assign]
    lab.sleep(0.05)
    lab.policy_says(FrameType.MESSAGE.value + REPLY, ("policy", 1))
    lab.sleep(0.05)
    assert asked == [FrameType.MESSAGE.value + OBSERVATION]
    assert [said for _, said in lab.answers] == [b"m" + METADATA, b"m" + REPLY]


@given(st.binary(max_size=200))
def test_bytes_are_a_value_or_refused(data: bytes) -> None:
    with suppress(ValueRefused):
        values.pack(values.unpack(data))


ARRAY = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f8", b"shape": [1]}


@pytest.mark.parametrize(
    "change",
    [
        {b"dtype": "|O"},
        {b"dtype": "<U0", b"data": b""},
        {b"dtype": "<U3"},
        {b"dtype": "<M8[ns]"},
        {b"dtype": 3},
        {b"shape": [2]},
        {b"shape": [-1]},
        {b"shape": [10**9, 10**9, 0]},
        {b"shape": [1] * 9},
        {b"shape": 1},
        {b"data": "text"},
    ],
)
def test_an_array_is_of_numbers_and_no_larger_than_its_bytes(change: dict[bytes, object]) -> None:
    assert values.unpack(msgpack.packb(ARRAY)) == np.zeros(1)
    with pytest.raises(ValueRefused):
        values.unpack(msgpack.packb(ARRAY | change))


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), 2**70, float])
def test_what_is_no_value_is_refused_before_it_is_sent(value: object) -> None:
    with pytest.raises(ValueRefused):
        values.pack(value)


def test_nested_too_deep_is_refused() -> None:
    with pytest.raises(ValueRefused):
        values.unpack(b"\x91" * 100_000 + b"\xc0")


def picture(height: int, width: int) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    shades = (rows * 255 // height, columns * 255 // width, (rows + columns) % 256)
    return np.stack(shades, axis=2).astype(np.uint8)


@pytest.mark.parametrize("first", [False, True])
def test_images_are_resized_as_openpi_does_and_arrive_in_their_axes(*, first: bool) -> None:
    image = picture(120, 160)
    given_ = image.transpose(2, 0, 1) if first else image
    sent = values.pack(Compressor(64)({"images": {"wrist": given_}, "state": np.zeros(3)}))
    came = values.unpack(sent, Unpacker())["images"]["wrist"]
    assert came.shape == ((3, 64, 64) if first else (64, 64, 3))
    expected = image_tools.resize_with_pad(image, 64, 64).astype(int)
    difference = (came.transpose(1, 2, 0) if first else came).astype(int) - expected
    assert np.abs(difference).mean() < 4.0
    assert len(sent) < 64 * 64 * 3 / 2


def test_a_raw_image_and_what_is_no_image_are_unchanged() -> None:
    observation = {"a": picture(40, 40), "mask": np.zeros((40, 40, 2), np.uint8), "n": 3}
    observation["list"] = picture(40, 40).tolist()
    came = values.unpack(values.pack(Compressor(raw=["a"])(observation)), Unpacker())
    assert same(came, observation)


@pytest.mark.parametrize("jpeg", [b"", b"no image", 3, b"\xff\xd8\xff" + bytes(50)])
def test_an_image_that_is_none_is_refused(jpeg: object) -> None:
    with pytest.raises(ValueRefused):
        values.unpack(msgpack.packb({b"__jpeg__": jpeg}), Unpacker())


def test_images_that_take_too_much_memory_are_refused_before_it_is_taken() -> None:
    file = io.BytesIO()
    Image.new("L", (4096, 4096)).save(file, "JPEG", quality=1)
    assert file.tell() < 300_000
    images = msgpack.packb([{b"__jpeg__": file.getvalue()}] * 2)
    with pytest.raises(ValueRefused, match="more than"):
        values.unpack(images, Unpacker())
