"""`skytether ros2`: plans and goals of a flight, for RViz and other tools of ROS 2.

The command reads the server's feed, publishes plans as nav_msgs/Path, and sends each goal that
arrives as geometry_msgs/PoseStamped to the server's control socket. So a goal is checked like any
other change in flight, and the server needs no ROS.
"""

import asyncio
import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tyro

from skytether.ros2 import messages
from skytether.ros2.graph import Node
from skytether.ros2.messages import MessageError, Vector
from skytether.shared.base import toml
from skytether.shared.endpoints.change import Answer
from skytether.shared.endpoints.endpoint import VEHICLES_SHOWN_MAX, Datagram
from skytether.shared.endpoints.line import Line, parse_line
from skytether.shared.events.flight import ChangeRefused
from skytether.shared.missions.mission import format_goals, parse_goals
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import FeedError, Frame, Opened, Rows, columns_of, table
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read
from skytether.shell.driving.control import Caller, ControlError
from skytether.shell.driving.feed import Subscriber
from skytether.shell.driving.graph import GraphSession
from skytether.shell.host import system
from skytether.shell.processes.log import Log
from skytether.view.rows import check_columns, planned

REPEAT_S = 1.0
"""Interval at which the newest paths are published again [s], for tools that started later."""
GOALS, POINT, VELOCITY = "mission.goals", "reference.points_m", "reference.velocity_mps"


@dataclass(frozen=True)
class Ros2Options:
    folder: Annotated[Path, Argument(positional=True, metavar="FOLDER")]
    """Folder of the flight, with the feed and the control socket of its server."""
    address: str = "tcp:127.0.0.1:7447"
    """Address of a Zenoh router, tcp:HOST:PORT."""
    domain: int = 0
    """Domain id of the ROS tools (ROS_DOMAIN_ID)."""
    frame: str = "map"
    """Name of the scenario's frame in ROS; goals in another frame are refused."""


def connect(argv: Sequence[str]) -> None:
    """Publish the plans of a flight in ROS 2, and accept goals from ROS 2, until SIGINT or SIGTERM.

    For each vehicle N the command publishes nav_msgs/Path on /skytether_N/plan, and subscribes to
    geometry_msgs/PoseStamped on /skytether_N/goal_pose: a goal of a mission, or the position of a
    live point. FOLDER is the folder given to `fly --control`; a server started by hand needs --feed
    FOLDER/server.feed and --control FOLDER/server. The flight may start, or restart, later than
    this command.
    """
    options = read(Ros2Options(tyro.MISSING), argv, "skytether ros2", connect.__doc__)
    line = parse_line("--address", options.address)
    if line.kind != "tcp":
        expected = "expected tcp:HOST:PORT of a Zenoh router"
        raise CommandError(f"--address: got {options.address!r}, {expected}", CONFIGURATION)
    if not 0 <= options.domain <= 232:
        message = f"--domain: got {options.domain}, expected a number from 0 to 232"
        raise CommandError(message, CONFIGURATION)

    async def until_interrupted() -> None:
        task = asyncio.ensure_future(Bridge(options, line, out).run())
        for number in (signal.SIGINT, signal.SIGTERM):
            system.handle(asyncio.get_running_loop(), number, task.cancel)
        with suppress(asyncio.CancelledError):
            await task

    with closing(Log("ros2", "text")) as out:
        asyncio.run(until_interrupted())


class Bridge:
    """Nodes of a flight's vehicles in the ROS graph, each with its own Zenoh session."""

    def __init__(self, options: Ros2Options, line: Line, out: Log) -> None:
        self._options, self._line, self._out = options, line, out
        self._scenario = Scenario()
        self._columns: np.dtype[np.void] | None = None
        """Columns of the feed's rows of plans; None if the server records no plans."""
        self._nodes: dict[int, tuple[Node, GraphSession]] = {}
        """Nodes by number of the vehicle; at most VEHICLES_SHOWN_MAX nodes."""
        self._paths: dict[int, Sequence[Vector]] = {}
        """Newest path of each node's vehicle [m]."""
        self._wanted: dict[int, Vector] = {}
        """Newest goals [m] that were not sent to the server yet, by vehicle."""

    async def run(self) -> None:
        self._loop, self._asked = asyncio.get_running_loop(), asyncio.Event()
        feeds = {"server": self._options.folder / "server.feed"}
        async with asyncio.TaskGroup() as self._tasks:
            self._tasks.create_task(self._repeat())
            with closing(Subscriber(feeds, self._read)):
                await self._ask_for_goals()

    # -- plans -------------------------------------------------------------------------------

    def _read(self, _: str, frame: Frame) -> None:
        """Read a frame of the feed, in the subscriber's thread; raises FeedError."""
        if isinstance(frame, Opened):
            try:
                self._scenario = msgspec.convert(toml.loads(frame.scenario), Scenario)
                self._columns = None
                if "plan" in frame.parts:
                    columns = columns_of(frame.parts["plan"])
                    check_columns("plan", columns, self._scenario)
                    self._columns = columns
            except ValueError as error:
                raise FeedError(str(error)) from None
        elif isinstance(frame, Rows) and frame.part == "plan" and self._columns is not None:
            rows = table(frame.rows, self._columns)
            for vehicle, row in {int(row["vehicle"]): row for row in rows}.items():
                path = np.zeros((len(row["inputs"].T) + 1, 3))
                path[:, : self._scenario.model.axes] = planned(self._scenario, row)
                positions = [(x, y, z) for x, y, z in path.tolist()]
                with suppress(RuntimeError):  # raised if the loop has closed meanwhile
                    self._loop.call_soon_threadsafe(self._show, vehicle, positions)

    def _show(self, vehicle: int, positions: Sequence[Vector]) -> None:
        if vehicle not in self._nodes and len(self._nodes) < VEHICLES_SHOWN_MAX:
            self._nodes[vehicle] = self._opened(vehicle)
        if vehicle in self._nodes:
            self._paths[vehicle] = positions
            self._publish(vehicle)

    def _publish(self, vehicle: int) -> None:
        node, session = self._nodes[vehicle]
        path = messages.path(time.time_ns(), self._options.frame, self._paths[vehicle])
        session.send(path, (node.publishes.name, 0))

    async def _repeat(self) -> None:
        while True:
            await asyncio.sleep(REPEAT_S)
            for vehicle in self._nodes:
                self._publish(vehicle)

    def _opened(self, vehicle: int) -> tuple[Node, GraphSession]:
        name = f"/skytether_{vehicle}"
        node = Node(
            self._line.host,
            self._line.number,
            self._options.domain,
            f"skytether_plans_{vehicle}",
            messages.topic(f"{name}/plan", messages.PATH),
            messages.topic(f"{name}/goal_pose", messages.POSE_STAMPED),
        )
        session = GraphSession(node, partial(self._hear, vehicle, node))
        self._tasks.create_task(session.run())
        return node, session

    # -- goals -------------------------------------------------------------------------------

    def _hear(self, vehicle: int, node: Node, datagram: Datagram) -> None:
        payload, (topic, _), _ = datagram
        if topic != node.subscribes.name:
            return
        try:
            goal = messages.goal(payload)
        except MessageError as error:
            self._refuse(f"{topic}: it is no geometry_msgs/PoseStamped: {error}")
            return
        if goal.frame != (frame := self._options.frame):
            self._refuse(f"{topic}: got a goal in frame {goal.frame!r}, expected {frame!r}")
            return
        self._wanted[vehicle] = goal.position
        self._asked.set()

    async def _ask_for_goals(self) -> None:
        while True:
            await self._asked.wait()
            self._asked.clear()
            while self._wanted:
                vehicle, position = self._wanted.popitem()
                place = position[: self._scenario.model.axes]
                try:
                    answer = await asyncio.to_thread(self._ask, vehicle, place)
                except ControlError as error:
                    answer = Answer(refused=str(error))
                if answer.refused:
                    self._refuse(answer.refused)
                for event in answer.changed:
                    self._out.hear(event)

    def _ask(self, vehicle: int, place: Sequence[float]) -> Answer:
        with closing(Caller(self._options.folder / "server")) as caller:
            return caller.ask(changed(caller.ask({}).values, vehicle, place))

    def _refuse(self, reason: str) -> None:
        self._out.hear(ChangeRefused(reason=reason))


def changed(values: Mapping[str, Any], vehicle: int, place: Sequence[float]) -> dict[str, Any]:
    """Keys to change, and their new values, for a goal of a vehicle.

    Args:
        values: present values of the keys that may change.
        place: the goal, in the scenario's frame [m]; shape (axes,).
    """
    if GOALS in values:
        goals = parse_goals(values[GOALS], len(place)) | {vehicle: np.array(place)}
        return {GOALS: format_goals(goals)}
    return {POINT: [list(place)], VELOCITY: [0.0] * len(place)}
