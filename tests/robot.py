"""A scripted robot that speaks ROS 2, encoded and decoded by a library of its own (mcap).

It follows `cmd_vel` with a lag, stops when no command has come for TIME_OUT_NS, and publishes
odometry by its own clock. In virtual time it is two hosts, named like its topics.
"""

import json
import math
import socket
import threading
import time
from types import SimpleNamespace
from typing import Any

import zenoh
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_typestore

from skytether.client import vehicles
from skytether.client.endpoint import Client
from skytether.client.memory import SavedState, SavingClient, recall
from skytether.netem.proxy import Proxy
from skytether.ros2 import graph, messages
from skytether.ros2.graph import Node
from skytether.server.endpoint import Server
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Event
from skytether.shared.scenario.reading import check
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, Rows, client_columns
from skytether.shared.wire.protocol import Mode
from skytether.sim.hosts import Clock
from skytether.sim.world import World

SECOND, MS = 1_000_000_000, 1_000_000
EPOCH_NS = 1_790_000_000 * SECOND
"""The robot's clock at time 0 of the world: time since 1970."""
CLIENT_NS = 86_400 * SECOND
PERIOD_NS, TIME_OUT_NS = 20 * MS, 500 * MS
TAU_S = 0.2
STORE = get_typestore(Stores.ROS2_JAZZY)


def definition(kind: str) -> str:
    return STORE.generate_msgdef(kind, ros_version=2)[0]


def encode(kind: str, message: Any) -> bytes:
    return bytes(serialize_dynamic(kind, definition(kind))[kind](message))


def decode(kind: str, payload: bytes) -> Any:
    return generate_dynamic(kind, definition(kind))[kind](payload)


ODOMETRY, TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
POSE_STAMPED, PATH = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"
ENCODE = serialize_dynamic(ODOMETRY, definition(ODOMETRY))[ODOMETRY]
DECODE = {kind: generate_dynamic(kind, definition(kind))[kind] for kind in (TWIST, TWIST_STAMPED)}


def vector(x: float, y: float, z: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, z=z)


def odometry(
    stamp_ns: int,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    frames: tuple[str, str] = ("odom", "base_link"),
) -> bytes:
    """nav_msgs/Odometry at x, y and heading, with a velocity forwards, to the left, and a turn."""
    (x, y, heading), (forward, left, turn) = place, velocity
    stamp = SimpleNamespace(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    orientation = SimpleNamespace(
        x=0.0, y=0.0, z=math.sin(heading / 2.0), w=math.cos(heading / 2.0)
    )
    pose = SimpleNamespace(position=vector(x, y, 0.0), orientation=orientation)
    twist = SimpleNamespace(linear=vector(forward, left, 0.0), angular=vector(0.0, 0.0, turn))
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=frames[0]),
        child_frame_id=frames[1],
        pose=SimpleNamespace(pose=pose, covariance=[0.0] * 36),
        twist=SimpleNamespace(twist=twist, covariance=[0.0] * 36),
    )
    return bytes(ENCODE(message))


def goal(frame: str, place: tuple[float, float, float]) -> bytes:
    """geometry_msgs/PoseStamped, as RViz sends it."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=2), frame_id=frame)
    level = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=vector(*place), orientation=level)
    return encode(POSE_STAMPED, SimpleNamespace(header=header, pose=pose))


def base(kind: str) -> Node:
    """The robot's node, which takes commands of a type."""
    commands = messages.topic("/cmd_vel", kind)
    return Node("127.0.0.1", 0, 0, "base", messages.topic("/odom", ODOMETRY), commands)


class Robot:
    """Body of the robot, and what came on `cmd_vel`; `kind` is the type of its commands."""

    def __init__(self, heading: float = 0.0, kind: str = TWIST_STAMPED) -> None:
        self.place = [0.0, 0.0, heading]
        self.velocity = [0.0, 0.0, 0.0]
        self.heard: list[tuple[int, Any]] = []
        """Commands, and when they came [ns; the robot's clock]."""
        self.kind = kind
        self.token = base(kind).tokens("ab")[2]
        """Token of the subscriber of its commands."""
        self._now_ns: int | None = None

    def hear(self, payload: bytes, now_ns: int) -> None:
        self.heard.append((now_ns, DECODE[self.kind](payload)))

    def twist(self, message: Any) -> tuple[float, float, float]:
        twist = message.twist if self.kind == TWIST_STAMPED else message
        return twist.linear.x, twist.linear.y, twist.angular.z

    def step(self, now_ns: int) -> None:
        dt = 0.0 if self._now_ns is None else (now_ns - self._now_ns) / 1e9
        self._now_ns = now_ns
        is_commanded = self.heard and now_ns - self.heard[-1][0] <= TIME_OUT_NS
        wanted = self.twist(self.heard[-1][1]) if is_commanded else (0.0, 0.0, 0.0)
        for i in range(3):
            self.velocity[i] += (wanted[i] - self.velocity[i]) * min(dt / TAU_S, 1.0)
        forward, left, turn = self.velocity
        cos, sin = math.cos(self.place[2]), math.sin(self.place[2])
        self.place[0] += dt * (cos * forward - sin * left)
        self.place[1] += dt * (sin * forward + cos * left)
        self.place[2] += dt * turn

    def odometry(self, now_ns: int) -> bytes:
        x, y, heading = self.place
        forward, left, turn = self.velocity
        return odometry(now_ns, (x, y, heading), (forward, left, turn))


class Odometer(Endpoint):
    """Host `/odom` of a robot in virtual time."""

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        self._robot, self._next_ns = robot, EPOCH_NS
        self.is_mute = False
        self.payload: bytes | None = None
        """Bytes sent in place of each message."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        raise AssertionError(datagram, now_ns)

    def next_wake_ns(self) -> int:
        return self._next_ns

    def wake(self, *, now_ns: int) -> None:
        self._next_ns = now_ns + PERIOD_NS
        self._robot.step(now_ns)
        if not self.is_mute:
            self.send(self.payload or self._robot.odometry(now_ns), ("client", 1))


class Commanded(Endpoint):
    """Host `/cmd_vel` of a robot in virtual time; `extra` are commands of somebody else."""

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        self._robot = robot

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._robot.hear(datagram.payload, now_ns)

    def next_wake_ns(self) -> None:
        return None

    def wake(self, *, now_ns: int) -> None:
        raise AssertionError(now_ns)


class Announcing(Endpoint):
    """Host that is named like a token of the robot's node, which tells of it again and again."""

    def __init__(self) -> None:
        super().__init__()
        self._next_ns = 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        raise AssertionError(datagram, now_ns)

    def next_wake_ns(self) -> int:
        return self._next_ns

    def wake(self, *, now_ns: int) -> None:
        self._next_ns = now_ns + SECOND
        self.send(b"1", ("client", 1))


class Cut(Proxy):
    """Netem that can be cut off."""

    is_cut = False

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if not self.is_cut:
            super().receive(datagram, now_ns=now_ns)


def scenario(**table: Any) -> Scenario:
    default: dict[str, Any] = {
        "duration": 20.0,
        "control": {"dt": 0.05},
        "model": {"axes": 2, "tau_s": [TAU_S], "u_max": [1.0]},
        "reference": {"shape": "figure-eight", "radius_m": 2.0, "period_s": 30.0},
        "vehicle": {"kind": "ros2", "address": "tcp:127.0.0.1:7447"},
        "network": {"uplink": "constant(0.05)", "downlink": "constant(0.05)"},
    }
    for key, value in table.items():
        default[key] = default.get(key, {}) | value if isinstance(value, dict) else value
    return check(default, "test")


class Ground:
    """Flight of a robot in virtual time: server, netem, client and robot."""

    def __init__(
        self, *, heading: float = 0.0, drift_ppm: float = 0.0, kind: str = "", **table: Any
    ) -> None:
        self.scenario = scenario(**table)
        kind = kind or (TWIST_STAMPED if self.scenario.ros2.stamped else TWIST)
        self.robot = Robot(heading, kind)
        self.odometer = Odometer(self.robot)
        self.events: list[tuple[int, Event]] = []

        def hear(time_ns: int, host: str, event: Event) -> None:
            if host == "client":
                self.events.append((time_ns, event))

        self.world = World(hear)
        self._recorder = MemoryRecorder(client_columns(2))
        self.flies: Any = None
        self.client = self._client(0, None)
        clock = Clock(EPOCH_NS, round(1000 * drift_ppm))
        self.world.add("/odom", self.odometer, clock=clock)
        self.world.add("/cmd_vel", Commanded(self.robot), clock=clock)
        self.world.add(self.robot.token, Announcing())
        self.netem = Cut(self.scenario, server=("server", 0), flows=1)
        self.world.add("netem", self.netem)
        self.world.add("client", self.client, clock=Clock(CLIENT_NS))
        server = Server(self.scenario, boot_id=2**60, entropy=bytes)
        self.world.add("server", server, clock=Clock(7 * SECOND))

    def _client(self, life: int, before: SavedState | None) -> Client:
        self.flies = vehicles.make(self.scenario, 1)
        return SavingClient(
            self.scenario,
            self.flies,
            server=("netem", 0),
            vehicle=1,
            boot_id=2**60 + life,
            recorder=self._recorder,
            before=before,
        )

    def restart(self) -> None:
        """Kill the client's process, and start another one a second later."""
        self.world.stop("client")
        self.run(1.0)
        kept = self.world.memory("client")
        assert kept is not None
        before = recall(*kept, CLIENT_NS + self.world.now_ns, self.scenario.terms())
        self.client = self._client(1, before)
        self.world.restart("client", self.client)

    def run(self, seconds: float) -> None:
        over: list[bool] = []
        until_ns = self.world.now_ns + round(1e9 * seconds)
        self.world.at(until_ns, lambda: over.append(True))
        self.world.run(lambda: bool(over), limit_ns=until_ns)

    @property
    def mode(self) -> Mode:
        return self.client._failsafe.mode

    def said(self) -> list[str]:
        return [str(event) for _, event in self.events]

    def of(self, kind: type[Event]) -> list[Any]:
        return [event for _, event in self.events if type(event) is kind]

    def commands(self, since_s: float = 0.0, until_s: float = math.inf) -> list[tuple[float, Any]]:
        """Times [s] and commands: forwards, to the left [m/s] and turn [rad/s]."""
        times = [((at_ns - EPOCH_NS) / 1e9, message) for at_ns, message in self.robot.heard]
        return [(at, self.robot.twist(message)) for at, message in times if since_s <= at < until_s]

    def rows(self) -> Rows:
        return self._recorder.rows()


# -- on an actual Zenoh network ------------------------------------------------------------

ODOM = messages.topic("/odom", messages.ODOMETRY)
CMD_VEL = messages.topic("/cmd_vel", messages.TWIST_STAMPED)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def opened(mode: str, port: int) -> Any:
    """Zenoh session of a router at a port, or of a peer that knows it."""
    settings = graph.session_settings(Node("127.0.0.1", port, 0, "other", ODOM, ODOM))
    settings["mode"] = mode
    if mode == "router":
        settings |= {"connect/endpoints": [], "listen/endpoints": [f"tcp/127.0.0.1:{port}"]}
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Live:
    """Router, and a robot that lives in a thread until the block ends."""

    def __init__(self, port: int, kind: str = TWIST_STAMPED) -> None:
        self._router, self._session = opened("router", port), opened("peer", port)
        self.robot = Robot(kind=kind)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._live)

    def __enter__(self) -> Robot:
        self._thread.start()
        return self.robot

    def _live(self) -> None:
        def hear(sample: Any) -> None:
            self.robot.hear(bytes(sample.payload), time.time_ns())

        node, zid = base(self.robot.kind), str(self._session.zid())
        alive = [self._session.liveliness().declare_token(each) for each in node.tokens(zid)]
        commands = self._session.declare_subscriber(node.subscribes.key(0), hear)
        out = self._session.declare_publisher(ODOM.key(0))
        while not self._is_over.wait(0.02):
            now_ns = time.time_ns()
            self.robot.step(now_ns)
            out.put(self.robot.odometry(now_ns))
        commands.undeclare()
        del alive

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()
        self._session.close()
        self._router.close()
