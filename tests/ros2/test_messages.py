"""Messages in CDR, compared with two independent libraries, and hashes with published ones."""

import math
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

import robot
from skytether.ros2 import messages
from skytether.ros2.messages import MessageError

NUMBERS = st.floats(allow_nan=False, width=64)
PUBLISHED = {
    messages.ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    messages.TWIST: "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    messages.POSE_STAMPED: "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    messages.PATH: "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    messages.TWIST_STAMPED: "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
}
"""As `ros2 topic info --verbose` prints them."""


@pytest.mark.parametrize("kind", PUBLISHED)
def test_type_hashes_are_the_published_ones(kind: str) -> None:
    assert messages.topic("/topic", kind).type_hash == f"RIHS01_{PUBLISHED[kind]}"


@settings(max_examples=10)
@given(st.integers(0, 2**31 * 10**9 - 1), st.text("abc/_"), st.tuples(*[NUMBERS] * 3), NUMBERS)
def test_a_stamped_twist_has_the_bytes_of_two_other_libraries(
    stamp_ns: int, frame: str, linear: tuple[float, float, float], turn: float
) -> None:
    payload = messages.twist_stamped(stamp_ns, frame, linear, turn)
    read = robot.decode(robot.TWIST_STAMPED, payload)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == divmod(stamp_ns, 10**9)
    assert read.header.frame_id == frame
    assert (read.twist.linear.x, read.twist.linear.y, read.twist.linear.z) == linear
    assert robot.encode(robot.TWIST_STAMPED, read) == payload
    store = get_typestore(Stores.LATEST)
    again = store.deserialize_cdr(payload, robot.TWIST_STAMPED)
    assert bytes(store.serialize_cdr(again, robot.TWIST_STAMPED)) == payload


def test_a_twist_has_the_bytes_of_another_library() -> None:
    payload = messages.twist((1.0, -2.0, 0.5), 0.25)
    assert robot.encode(robot.TWIST, robot.decode(robot.TWIST, payload)) == payload
    assert robot.decode(robot.TWIST, payload).angular.z == 0.25


@settings(max_examples=10)
@given(
    st.integers(0, 2**31 * 10**9 - 1),
    st.text("abc/_"),
    st.lists(st.tuples(*[NUMBERS] * 3), max_size=5),
)
def test_a_path_has_the_bytes_of_two_other_libraries(
    stamp_ns: int, frame: str, positions: list[tuple[float, float, float]]
) -> None:
    payload = messages.path(stamp_ns, frame, positions)
    read = robot.decode(robot.PATH, payload)
    for stamped in (read, *read.poses):
        assert (stamped.header.stamp.sec, stamped.header.stamp.nanosec) == divmod(stamp_ns, 10**9)
        assert stamped.header.frame_id == frame
    points = [each.pose.position for each in read.poses]
    assert [(at.x, at.y, at.z) for at in points] == positions
    assert {each.pose.orientation.w for each in read.poses} <= {1.0}
    assert robot.encode(robot.PATH, read) == payload
    store = get_typestore(Stores.LATEST)
    again = store.deserialize_cdr(payload, robot.PATH)
    assert bytes(store.serialize_cdr(again, robot.PATH)) == payload


def test_a_goal_of_another_library_is_read() -> None:
    read = messages.goal(robot.goal("map", (1.0, -2.5, 0.5)))
    assert read == ("map", (1.0, -2.5, 0.5))
    with pytest.raises(MessageError, match="the position is not finite"):
        messages.goal(robot.goal("map", (math.nan, 0.0, 0.0)))


def test_odometry_of_another_library_is_read() -> None:
    payload = robot.odometry(5 * 10**9 + 7, (1.0, 2.0, math.pi / 2), (0.5, -0.25, 0.1))
    read = messages.odometry(payload)
    assert (read.stamp_ns, read.frame, read.child) == (5 * 10**9 + 7, "odom", "base_link")
    assert (read.position, read.velocity) == ((1.0, 2.0, 0.0), (0.5, -0.25, 0.0))
    assert read.turn == (0.0, 0.0, 0.1)
    for row, expected in zip(read.rotation, ((0, -1, 0), (1, 0, 0), (0, 0, 1)), strict=True):
        assert row == pytest.approx(expected, abs=1e-12)


GOOD = robot.odometry(10**9)


@given(
    st.binary(max_size=800)
    | st.binary(max_size=800).map(b"\0\1\0\0".__add__)
    | st.builds(
        lambda at, byte: GOOD[:at] + bytes([byte]) + GOOD[at + 1 :],
        st.integers(0, 200),
        st.integers(0, 255),
    )
    | st.integers(0, len(GOOD) - 1).map(lambda size: GOOD[:size])
)
def test_bytes_that_are_no_odometry_raise_one_error(payload: bytes) -> None:
    with suppress(MessageError):
        messages.goal(payload)
    try:
        messages.odometry(payload)
    except MessageError:
        return
    assert len(payload) >= 700
