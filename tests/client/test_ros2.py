"""A robot that speaks ROS 2, in virtual time: frames, clock, failsafe, commands tick by tick."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot
from robot import EPOCH_NS, MS, SECOND, Ground
from skytether.client import vehicles
from skytether.client.ros2 import drive
from skytether.client.ros2.odometry import OdometryFilter
from skytether.client.ros2.port import Port
from skytether.lab.identify.fit import fit
from skytether.lab.identify.flight import Identifying
from skytether.lab.identify.responses import responses
from skytether.lab.identify.steps import Experiment, ExperimentPlan
from skytether.ros2 import messages
from skytether.shared.base import extras
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.extras import ExtraMissing
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.aboard import OdometryDropped, SecondPublisher
from skytether.shared.events.ground import AutopilotWaits
from skytether.shared.wire.protocol import Mode
from skytether.sim.hosts import Clock
from skytether.sim.world import World

STEP = 0.05


def heard(payload: bytes) -> messages.Odometry:
    return messages.odometry(payload)


@pytest.mark.parametrize("ahead", [0.0, 0.3])
@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_the_velocity_of_the_point_is_the_change_of_its_position(
    heading: float, ahead: float
) -> None:
    left = 0.2 if ahead == 0.0 else 0.0
    body, dt = robot.Robot(heading), 1e-6
    body.velocity[:] = 0.5, left, 0.4
    before, velocity = drive.point(heard(body.odometry(0)), ahead)
    x, y, angle = body.place
    cos, sin = math.cos(angle), math.sin(angle)
    body.place[:] = (
        x + dt * (cos * 0.5 - sin * left),
        y + dt * (sin * 0.5 + cos * left),
        angle + dt * 0.4,
    )
    after, _ = drive.point(heard(body.odometry(0)), ahead)
    change = [(b - a) / dt for a, b in zip(before, after, strict=True)]
    assert velocity == pytest.approx(change, abs=1e-5)


@pytest.mark.parametrize(("kind", "ahead"), [("holonomic", 0.0), ("differential", 0.3)])
@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_a_command_gives_the_point_its_velocity(kind: str, ahead: float, heading: float) -> None:
    wanted = (0.3, -0.4, 0.0)
    frame, (x, y, _), turn = drive.command(
        wanted, heard(robot.odometry(0, (0.0, 0.0, heading))), kind, ahead
    )
    reached = heard(robot.odometry(0, (0.0, 0.0, heading), (x, y, turn)))
    assert frame == "base_link"
    assert y == 0.0 or kind == "holonomic"
    assert drive.point(reached, ahead)[1] == pytest.approx(wanted)


def test_a_velocity_in_the_fixed_frame_is_not_rotated() -> None:
    message = heard(robot.odometry(0, (0.0, 0.0, 1.0), (0.5, 0.0, 0.0), ("odom", "odom")))
    assert drive.point(message, 0.0)[1] == pytest.approx((0.5, 0.0, 0.0))
    assert drive.command((1.0, 0.0, 0.0), message, "fixed", 0.2) == (
        "odom",
        (1.0, 0.0, 0.0),
        0.0,
    )


def test_the_robots_clock_is_followed_through_drift_and_jitter() -> None:
    """Clock 100 ppm fast; messages take 0.3 ms, and half of them up to 30 ms more."""
    rng, odometry = np.random.default_rng(1), OdometryFilter(robot.scenario(), 1)
    errors = []
    for k in range(1500):
        time_ns = k * 20 * MS
        late_ns = 0.3 * MS + rng.choice([0.0, rng.uniform(0.0, 15.0 * MS)])
        now_ns = 5 * SECOND + time_ns + round(late_ns)
        odometry.hear(robot.odometry(EPOCH_NS + time_ns + time_ns // 10_000), now_ns=now_ns)
        for stamp_ns, *_ in odometry.positions.take(now_ns=now_ns):
            errors.append((stamp_ns - 5 * SECOND - time_ns) / MS)
    assert len(errors) > 1400
    assert np.abs(errors).max() < 6.0
    assert abs(np.median(errors)) < 3.0


def test_a_jump_of_the_robots_clock_is_followed() -> None:
    odometry = OdometryFilter(robot.scenario(), 1)
    for k in range(1000):
        now_ns = 5 * SECOND + k * 20 * MS
        jumped_ns = 3600 * SECOND if k > 500 else 0
        odometry.hear(robot.odometry(EPOCH_NS + k * 20 * MS + jumped_ns), now_ns=now_ns)
    assert odometry.clock.jumps == 1
    assert odometry.fault == ""


@pytest.mark.parametrize("frames", [("", "base_link"), ("odom", "")])
def test_odometry_without_frames_is_refused(frames: tuple[str, str]) -> None:
    odometry = OdometryFilter(robot.scenario(), 1)
    odometry.hear(robot.odometry(EPOCH_NS, frames=frames), now_ns=SECOND)
    assert odometry.positions.dropped == {"frame": 1}
    assert odometry.newest is None


def test_odometry_in_another_frame_is_dropped() -> None:
    odometry = OdometryFilter(robot.scenario(), 1)
    odometry.hear(robot.odometry(EPOCH_NS), now_ns=SECOND)
    odometry.hear(robot.odometry(EPOCH_NS + 1, frames=("map", "base_link")), now_ns=SECOND)
    assert odometry.positions.dropped["frame"] == 1


@pytest.mark.parametrize(
    "table",
    [
        {},
        {"ros2": {"drive": "differential", "stamped": False}},
    ],
)
def test_a_robot_follows_its_reference(table: dict[str, Any]) -> None:
    ground = Ground(heading=0.7, drift_ppm=50.0, **table)
    ground.run(12.0)
    rows = ground.rows()
    wanted = ground.scenario.make_reference()(rows["step"] * STEP)[:, :2, 0]
    error = np.linalg.norm(rows["state"][:, :2, 0] - wanted, axis=1)[200:]
    assert ground.mode in (Mode.TRACK, Mode.COAST)
    assert error.max() < 0.25, ground.said()


@pytest.mark.parametrize("kind", [robot.TWIST, robot.TWIST_STAMPED])
def test_commands_are_of_the_type_that_the_robot_takes(kind: str) -> None:
    ground = Ground(kind=kind)
    ground.run(8.0)
    assert ground.mode in (Mode.TRACK, Mode.COAST)
    assert math.hypot(*ground.robot.place[:2]) > 0.5


def waiting(ground: Ground) -> str:
    """What the client waits for in the end; it has not moved the robot."""
    ground.run(12.0)
    assert not ground.robot.heard
    waits_for: str = ground.of(AutopilotWaits)[-1].waits_for
    return waits_for


def told(ground: Ground, token: str, payload: bytes = b"1") -> None:
    """Let the client hear that a token of the graph is there, or by b"" that it is gone."""
    datagram = Datagram(payload, (token, 0), 1)
    ground.world.act("client", lambda now_ns: ground.client.receive(datagram, now_ns=now_ns))


def test_without_a_subscriber_of_its_commands_no_flight_begins() -> None:
    ground = Ground()
    ground.world.stop(ground.robot.token)
    assert "geometry_msgs/TwistStamped or geometry_msgs/Twist on /cmd_vel" in waiting(ground)
    told(ground, ground.robot.token)
    ground.run(3.0)
    assert ground.mode in (Mode.TRACK, Mode.COAST)


@pytest.mark.parametrize(
    ("stamped", "change"),
    [
        ("auto", ("RIHS01_", "TypeHashNotSupported")),
        ("auto", ("dds_::TwistStamped_", "dds_::Twist_")),
        (True, ("", "")),
        (False, ("", "")),
    ],
)
def test_a_subscriber_of_another_type_or_hash_is_named(
    stamped: str | bool, change: tuple[str, str]
) -> None:
    """ROS 2 before Jazzy has no hashes of types."""
    kind = robot.TWIST if stamped is True else robot.TWIST_STAMPED
    ground = Ground(kind=kind, ros2={"stamped": stamped})
    token = ground.robot.token
    if any(change):
        ground.world.stop(token)
        told(ground, token.replace(*change))
    assert "; got /base with geometry_msgs/Twist" in waiting(ground)


def test_odometry_of_another_hash_is_named() -> None:
    ground = Ground()
    ground.odometer.is_mute = True
    publisher = robot.base(robot.TWIST).publisher("ab")
    told(ground, publisher.replace("RIHS01_", "TypeHashNotSupported"))
    assert "/odom" in (waits_for := waiting(ground))
    assert "; got /base with nav_msgs/Odometry, TypeHashNotSupported" in waits_for


def test_a_subscriber_that_leaves_before_the_flight_is_not_counted() -> None:
    ground = Ground()
    ground.run(0.5)
    port = ground.client._port
    assert isinstance(port, Port)
    assert port.is_ready
    ground.world.stop(ground.robot.token)
    told(ground, ground.robot.token, b"")
    ground.run(0.1)
    assert not port.is_ready
    assert not ground.robot.heard


def test_commands_are_stamped_by_the_robots_clock() -> None:
    ground = Ground()
    ground.run(5.0)
    ages_ns = [
        at_ns - message.header.stamp.sec * SECOND - message.header.stamp.nanosec
        for at_ns, message in ground.robot.heard
    ]
    assert ages_ns
    assert max(map(abs, ages_ns)) < 5 * MS


@pytest.mark.long
def test_a_minute_with_losses_and_a_link_that_dies_twice() -> None:
    """Every tick of `cmd_vel`: a command at each step; zeros while the link is dead."""
    lossy = "constant(0.05) & loss(0.3)"
    ground = Ground(
        duration=60.0,
        network={"uplink": lossy, "downlink": lossy},
        ros2={"drive": "differential"},
    )
    for began_s, ends_s in ((15.0, 21.0), (36.0, 44.0)):
        ground.run(began_s - ground.world.now_ns / 1e9)
        assert ground.mode in (Mode.TRACK, Mode.COAST)
        ground.netem.is_cut = True
        ground.run(ends_s - began_s)
        assert ground.mode is Mode.HOVER
        ground.netem.is_cut = False
    ground.run(56.0 - 44.0)
    assert ground.mode in (Mode.TRACK, Mode.COAST)
    times = [at for at, _ in ground.commands(0.0, 56.0)]
    assert times[0] < 7.0
    assert all(b - a == pytest.approx(STEP, abs=0.001) for a, b in pairwise(times))
    for dead_s, alive_s in ((15.0 + 2.0, 21.0), (36.0 + 2.0, 44.0)):
        assert {command for _, command in ground.commands(dead_s, alive_s)} == {(0.0, 0.0, 0.0)}
        again = [command for _, command in ground.commands(alive_s, alive_s + 3.0)]
        assert max(math.hypot(*command[:2]) for command in again) > 0.2
    for since_s in (8.0, 27.0, 50.0):
        speeds = [math.hypot(*command[:2]) for _, command in ground.commands(since_s, since_s + 5)]
        assert max(speeds) > 0.2


def test_a_restarted_client_keeps_the_origin() -> None:
    ground = Ground(heading=0.5, duration=40.0)
    ground.robot.place[:2] = 30.0, -20.0
    ground.run(7.0)
    origin = ground.flies._positions.origin
    assert origin == pytest.approx((30.0, -20.0, 0.0))
    ground.restart()
    ground.run(4.0)
    assert ground.flies._positions.origin == pytest.approx(origin)
    assert ground.mode in (Mode.TRACK, Mode.COAST)


def test_the_origin_is_that_of_the_odometry_if_asked() -> None:
    ground = Ground(duration=8.0, ros2={"origin": "odometry"})
    ground.robot.place[:2] = 0.5, -0.25
    ground.run(7.0)
    assert ground.rows()["state"][0, :2, 0] == pytest.approx([0.5, -0.25], abs=0.05)


def test_after_a_landing_come_zeros_and_then_silence() -> None:
    ground = Ground(vehicle={"land_after_s": 3.0})
    ground.run(8.0)
    ground.netem.is_cut = True
    ground.run(10.0)
    assert ground.mode is Mode.LAND
    (last, _), landed = ground.commands()[-1], ground.commands(12.0)
    assert 12.0 < last < 16.0
    assert all(command == (0.0, 0.0, 0.0) for _, command in landed[-10:])
    assert ground.client.finished or ground.flies.is_down


def test_a_process_that_ends_stops_the_robot() -> None:
    ground = Ground()
    ground.run(8.0)
    before = len(ground.robot.heard)
    ground.world.act("client", ground.client.close)
    ground.run(0.001)
    ends = [ground.robot.twist(message) for _, message in ground.robot.heard[before:]]
    assert ends[-3:] == [(0.0, 0.0, 0.0)] * 3


@pytest.mark.parametrize("payload", [None, b"\0\1\0\0" + bytes(716)])
def test_silent_or_wrong_odometry_stops_the_robot(payload: bytes | None) -> None:
    ground = Ground()
    ground.run(8.0)
    ground.odometer.is_mute, ground.odometer.payload = payload is None, payload
    ground.run(4.0)
    assert ground.mode is Mode.HOVER
    assert all(command == (0.0, 0.0, 0.0) for _, command in ground.commands(11.0))
    assert len(ground.of(OdometryDropped)) == (payload is not None)
    ground.odometer.is_mute, ground.odometer.payload = False, None
    ground.run(4.0)
    assert ground.mode in (Mode.TRACK, Mode.COAST)


@settings(max_examples=20)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/odom", "/cmd_vel", "@ros2_lv/0/a/0/1/MP/%/%/n/%t/T/H/Q", "/x"])
            | st.text(),
            st.binary(max_size=40)
            | st.sampled_from([robot.odometry(EPOCH_NS + k) for k in (1, 2)]),
            st.integers(0, 2 * SECOND),
        ),
        max_size=12,
    )
)
def test_any_datagrams_raise_nothing_and_move_nothing(
    datagrams: list[tuple[str, bytes, int]],
) -> None:
    port, now_ns = vehicles.make(robot.scenario(), 1).port, SECOND
    assert port is not None
    for topic, payload, later_ns in datagrams:
        now_ns += later_ns
        port.receive(Datagram(payload, (topic, 0), 1), now_ns=now_ns)
        port.wake(now_ns=now_ns)
    assert not port.outbox()


@pytest.mark.long
@pytest.mark.parametrize(("drive_by", "within"), [("holonomic", 0.02), ("differential", 0.1)])
def test_identify_finds_the_model_of_a_robot(drive_by: str, within: float) -> None:
    """The lag of a differential base turns with it, so its point is only nearly of first order."""
    scenario = robot.scenario(ros2={"drive": drive_by}, fence={"radius_m": 6.0, "wind_mps": 0.1})
    plan = ExperimentPlan((0.5, 0.5), 3.0, 1)
    body, flies, world = robot.Robot(0.3), vehicles.make(scenario, 1), World()
    experiment = Experiment(scenario, plan)
    flight = Identifying(scenario, flies, experiment)
    clock = Clock(EPOCH_NS)
    world.add("/odom", robot.Odometer(body), clock=clock)
    world.add("/cmd_vel", robot.Commanded(body), clock=clock)
    world.add(body.token, robot.Announcing())
    world.add("client", flight, clock=Clock(robot.CLIENT_NS))
    world.run(lambda: flight.finished, limit_ns=300 * SECOND)
    for axis in range(2):
        found = fit(responses(flight.inputs, flight.measured, experiment.steps, axis))
        assert found is not None
        assert found.numbers.tau_s == pytest.approx(robot.TAU_S, abs=0.03)
        assert found.numbers.gain == pytest.approx(1.0, abs=within)


def test_another_publisher_is_reported_by_name_and_stops_the_robot() -> None:
    ground = Ground()
    ground.run(8.0)
    port, token = (
        ground.client._port,
        "@ros2_lv/0/ab/0/1/MP/%/%robot/teleop/%cmd_vel/T/H/::,1:,:,:,,",
    )
    assert port is not None

    def say(topic: str, payload: bytes) -> None:
        datagram = Datagram(payload, (topic, 0), 1)
        ground.world.act("client", lambda now_ns: ground.client.receive(datagram, now_ns=now_ns))

    say(token, b"1")
    say("/cmd_vel", b"one is a stray")
    ground.run(2.0)
    assert ground.mode in (Mode.TRACK, Mode.COAST)
    for _ in range(30):
        say("/cmd_vel", b"")
        ground.run(0.1)
    (event,) = ground.of(SecondPublisher)
    assert event.nodes == ("/robot/teleop",)
    assert ground.mode is Mode.LAND


@pytest.mark.parametrize("address", ["udp:127.0.0.1:14550", "serial:/dev/ttyS0:57600"])
def test_an_address_that_is_no_router_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match=r"^vehicle.address: got .*tcp:HOST:PORT"):
        vehicles.make(robot.scenario(vehicle={"address": address}), 1)


def test_a_differential_robot_does_not_fly_in_space() -> None:
    space = {"axes": 3, "tau_s": [0.5], "u_max": [1.0]}
    with pytest.raises(ConfigError, match=r"^ros2\.drive"):
        vehicles.make(robot.scenario(model=space, ros2={"drive": "differential"}), 1)


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.util, "find_spec", lambda _: None)
    with pytest.raises(ExtraMissing, match=r"pip install 'skytether\[ros2\]'"):
        vehicles.make(robot.scenario(), 1)
