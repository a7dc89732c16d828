"""Plans and goals of a flight in ROS 2: what is asked for, and a flight over an actual Zenoh."""

import subprocess
import time
from collections import deque
from pathlib import Path
from typing import Any

import pytest

import robot
from helpers import PATIENCE_S, SKYTETHER, refused
from skytether.cli.ros2 import Bridge, Ros2Options, changed
from skytether.ros2 import messages
from skytether.ros2.graph import Node
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.endpoints.line import parse_line

GOAL = messages.topic("/skytether_1/goal_pose", messages.POSE_STAMPED)
PLAN = messages.topic("/skytether_1/plan", messages.PATH)


def test_a_goal_of_a_mission_leaves_those_of_the_others() -> None:
    values = {"mission.goals": "goal(1, 1, 2) & goal(2, 3, 4)", "control.trigger": "periodic(1)"}
    goals = "goal(1, 1, 2) & goal(2, 5, -0.5)"
    assert changed(values, 2, (5.0, -0.5)) == {"mission.goals": goals}
    assert changed({"mission.goals": ""}, 3, (0.0, 1.0, 2.0)) == {
        "mission.goals": "goal(3, 0, 1, 2)"
    }


def test_a_goal_without_a_mission_is_the_place_of_a_live_point() -> None:
    asked = changed({"reference.points_m": [[0.0, 0.0]]}, 1, (1.5, 2.0))
    assert asked == {"reference.points_m": [[1.5, 2.0]], "reference.velocity_mps": [0.0, 0.0]}


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (robot.goal("odom", (1.0, 2.0, 0.0)), "got a goal in frame 'odom', expected 'map'"),
        (b"garbage", "it is no geometry_msgs/PoseStamped: "),
    ],
)
def test_a_goal_that_cannot_be_understood_is_refused(payload: bytes, said: str) -> None:
    events: list[Any] = []

    class Out:
        hear = events.append

    line = parse_line("--address", "tcp:127.0.0.1:7447")
    bridge = Bridge(Ros2Options(Path()), line, Out())  # type: ignore[arg-type]
    bridge._hear(1, Node("h", 1, 0, "n", PLAN, GOAL), Datagram(payload, (GOAL.name, 0), 1))
    assert not bridge._wanted
    (refused,) = events
    assert refused.reason.startswith(f"/skytether_1/goal_pose: {said}")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (("--address", "udp:127.0.0.1:1"), "--address: got 'udp:127.0.0.1:1', expected tcp:HOST:"),
        (("--address", "router"), "--address: got 'router', expected"),
        (("--domain", "233"), "--domain: got 233, expected a number from 0 to 232"),
    ],
)
def test_options_that_lead_nowhere_are_refused(
    option: tuple[str, str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(["ros2", ".", *option], capfd)


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_is_seen_and_led_over_zenoh(tmp_path: Path) -> None:
    """A vehicle at a live point is sent elsewhere, and a path that comes then ends there."""
    port = robot.free_port()
    router, tools = robot.opened("router", port), robot.opened("peer", port)
    came: deque[Any] = deque(maxlen=100)
    topics = tools.declare_subscriber(
        PLAN.key(0), lambda sample: came.append(robot.decode(robot.PATH, bytes(sample.payload)))
    )

    def ends_at() -> tuple[float, float]:
        at = came[-1].poses[-1].pose.position
        return at.x, at.y

    live = "--reference.shape", "live", "--reference.points_m", "[[0.0, 0.0]]"
    flight = [*SKYTETHER, "fly", "demo", *live, "--control", "flying", "--duration", "300"]
    bridge = [*SKYTETHER, "ros2", "flying", "--address", f"tcp:127.0.0.1:{port}"]
    with (
        subprocess.Popen(flight, cwd=tmp_path, stdout=subprocess.DEVNULL) as flies,
        subprocess.Popen(bridge, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as shows,
    ):
        try:
            until = time.monotonic() + PATIENCE_S
            while not came or ends_at() != pytest.approx((0.5, -0.25), abs=0.1):
                assert time.monotonic() < until
                assert flies.poll() is None
                assert shows.poll() is None
                tools.put(GOAL.key(0), robot.goal("map", (0.5, -0.25, 0.0)))
                time.sleep(0.5)
        finally:
            flies.terminate()
            shows.terminate()
            said, _ = shows.communicate(timeout=PATIENCE_S)
    topics.undeclare()
    tools.close()
    router.close()
    assert came[-1].header.frame_id == "map"
    assert "reference.points_m is [[0.5,-0.25]] from now on" in said
    assert shows.returncode == 0
