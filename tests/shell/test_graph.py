"""A node on an actual Zenoh network on loopback: router, robot, and another publisher.

Zenoh has threads of its own, so these tests are in real time; the queue between them and the loop
is also tested without.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from unittest import mock

import pytest
import zenoh

import helpers
import robot
from helpers import PATIENCE_S, Idle
from robot import CMD_VEL, ODOM, free_port, opened
from skytether.ros2 import graph, messages
from skytether.ros2.graph import Node
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shell.driving.driver import Shell, new_event_loop
from skytether.shell.driving.graph import MESSAGE_BYTES_MAX, QUEUE_MAX, GraphSession

LAST_MPS = 9.0
"""Last command, sent when the process ends."""


class Pilot(Idle):
    """Endpoint that commands every 20 ms until it is told to end, and keeps what it hears."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[tuple[str, bytes]] = []
        self.sent, self._next_ns, self.is_over = 0, 0, False

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        assert datagram.socket == 1
        self.heard.append((datagram.peer[0], datagram.payload))

    def next_wake_ns(self) -> int:
        return self._next_ns

    def wake(self, *, now_ns: int) -> None:
        self._next_ns = now_ns + 20_000_000
        self.sent += 1
        payload = messages.twist_stamped(now_ns, "base_link", (0.001 * self.sent, 0.0, 0.0), 0.0)
        self.send(payload, ("/cmd_vel", 0), 1)

    def close(self, *, now_ns: int) -> None:
        self.send(messages.twist_stamped(now_ns, "", (LAST_MPS, 0.0, 0.0), 0.0), ("/cmd_vel", 0), 1)

    @property
    def finished(self) -> bool:
        return self.is_over


class Net:
    """Router and robot beside the node of a `Pilot`."""

    def __init__(self, stack: ExitStack) -> None:
        self.port = free_port()
        self.router = opened("router", self.port)
        stack.callback(self._close_router)
        self.robot = opened("peer", self.port)
        stack.callback(self.robot.close)
        self.commands: list[Any] = []
        self.tokens: dict[str, bool] = {}
        self._declared = [
            self.robot.declare_subscriber(CMD_VEL.key(0), self.commands.append),
            self.robot.liveliness().declare_subscriber("@ros2_lv/0/**", self._token, history=True),
        ]
        self.odometry = self.robot.declare_publisher(ODOM.key(0))
        self.pilot = Pilot()

    def _token(self, sample: Any) -> None:
        self.tokens[str(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT

    def _close_router(self) -> None:
        if not self.router.is_closed():
            self.router.close()

    def fly(self, story: Callable[[], Any]) -> None:
        """Run the node while a coroutine tells what happens meanwhile."""

        async def both() -> None:
            node = Node("127.0.0.1", self.port, 0, "skytether_1", CMD_VEL, ODOM)
            shell = Shell(self.pilot, None, line=node)
            running = asyncio.get_running_loop().create_task(shell.run())
            try:
                await asyncio.wait_for(story(), PATIENCE_S)
            finally:
                self.pilot.is_over = True
                await asyncio.wait_for(running, PATIENCE_S)

        with asyncio.Runner(loop_factory=new_event_loop) as runner:
            runner.run(both())


@pytest.fixture
def net() -> Iterator[Net]:
    with ExitStack() as stack:
        yield Net(stack)


async def until(so: Callable[[], object]) -> None:
    while not so():
        await asyncio.sleep(0.01)


def speed_mps(command: Any) -> float:
    return float(robot.decode(robot.TWIST_STAMPED, bytes(command.payload)).twist.linear.x)


@pytest.mark.realtime
def test_commands_and_odometry_pass_and_the_graph_shows_the_node(net: Net) -> None:
    async def story() -> None:
        await until(lambda: net.commands and len(net.tokens) == 3)
        payload = robot.odometry(time.time_ns())
        while (("/odom", payload)) not in net.pilot.heard:
            net.odometry.put(payload)
            await asyncio.sleep(0.05)

    net.fly(story)
    kinds = sorted(token.split("/")[5] for token in net.tokens)
    assert kinds == ["MP", "MS", "NN"]
    first, second = (bytes(each.attachment) for each in net.commands[:2])
    (number, stamp_ns, size, publisher), after = (
        graph.ATTACHMENT.unpack(each) for each in (first, second)
    )
    (token,) = (each for each in net.tokens if "/MP/" in each)
    assert after[0] > number
    assert (size, publisher) == (16, graph.identity(token))
    assert 0 < stamp_ns < time.time_ns()
    assert 0.0 < speed_mps(net.commands[0]) < 1.0
    assert not any(topic == "/cmd_vel" for topic, _ in net.pilot.heard)
    # When the node has ended, its last command has left, and its tokens are gone.
    helpers.until(lambda: not any(net.tokens.values()))
    helpers.until(lambda: speed_mps(net.commands[-1]) == LAST_MPS)


@pytest.mark.realtime
def test_the_first_message_decides_on_one_of_two_types(net: Net) -> None:
    plain = messages.topic(CMD_VEL.name, messages.TWIST)
    node = Node("127.0.0.1", net.port, 0, "skytether_1", CMD_VEL, ODOM, (plain,))
    taken: list[Any] = []
    net._declared.append(net.robot.declare_subscriber(plain.key(0), taken.append))

    async def story() -> None:
        session = GraphSession(node, lambda _: None)
        running = asyncio.get_running_loop().create_task(session.run())
        await until(lambda: len(net.tokens) == 2)
        await until(lambda: session.send(b"moves", (plain.name, 1)) and taken)
        await until(lambda: len(net.tokens) == 3)
        running.cancel()

    asyncio.run(story())
    (token,) = (each for each in net.tokens if "/MP/" in each)
    assert plain.dds_kind in token
    publisher = graph.ATTACHMENT.unpack(bytes(taken[0].attachment))[3]
    assert publisher == graph.identity(token)
    assert not net.commands


@pytest.mark.realtime
def test_the_loss_of_the_router_stops_nothing(net: Net) -> None:
    async def story() -> None:
        await until(lambda: net.commands)
        payload = robot.odometry(time.time_ns())
        await until(lambda: net.odometry.put(payload) or net.pilot.heard)
        net.router.close()
        await asyncio.sleep(0.2)
        commands, heard = len(net.commands), len(net.pilot.heard)
        await until(lambda: len(net.commands) > commands + 10)
        await until(lambda: net.odometry.put(payload) or len(net.pilot.heard) > heard)

    net.fly(story)


@pytest.mark.realtime
def test_another_publisher_and_its_node_are_heard(net: Net) -> None:
    node = Node("127.0.0.1", net.port, 0, "teleop", CMD_VEL, ODOM)
    with opened("peer", net.port) as other:
        token = node.publisher(str(other.zid()))
        alive = other.liveliness().declare_token(token)

        async def story() -> None:
            await until(lambda: (token, b"1") in net.pilot.heard)
            while ("/cmd_vel", b"rival") not in net.pilot.heard:
                other.put(CMD_VEL.key(0), b"rival")
                await asyncio.sleep(0.05)
            alive.undeclare()
            await until(lambda: (token, b"") in net.pilot.heard)

        net.fly(story)


class Loop:
    """Stand-in for the loop, which calls back when the test says so."""

    def __init__(self) -> None:
        self.called: list[Callable[[], None]] = []

    def call_soon_threadsafe(self, then: Callable[[], None]) -> None:
        self.called.append(then)


def test_the_queue_is_bounded_and_large_messages_are_dropped() -> None:
    """The oldest are dropped; the loop is called once for all that wait."""
    heard: list[Datagram] = []
    session = GraphSession.__new__(GraphSession)
    session._hear, session._is_called, session._loop = heard.append, False, Loop()  # type: ignore[assignment]
    session._queue = deque(maxlen=QUEUE_MAX)
    for number in range(QUEUE_MAX + 3):
        session._put("/odom", b"%d" % number)
    session._put("/odom", bytes(MESSAGE_BYTES_MAX + 1))
    (call,) = session._loop.called  # type: ignore[attr-defined]
    call()
    assert [each.payload for each in heard] == [b"%d" % i for i in range(3, QUEUE_MAX + 3)]
    assert {each.peer for each in heard} == {("/odom", 0)}
    session._put("/odom", bytes(MESSAGE_BYTES_MAX))
    assert len(session._loop.called) == 2  # type: ignore[attr-defined]


def test_only_our_topic_is_published() -> None:
    node = Node("127.0.0.1", 1, 0, "skytether_1", CMD_VEL, ODOM)
    session = GraphSession.__new__(GraphSession)
    session._node, session._sent, session._identity = node, 0, bytes(16)
    session._zenoh, session._publisher = zenoh, None
    assert not session.send(b"early", (CMD_VEL.name, 0))
    session._publisher = mock.Mock()
    assert not session.send(b"other", (ODOM.name, 0))
    assert session.send(b"first", (CMD_VEL.name, 0))
    assert session.send(b"second", (CMD_VEL.name, 0))
    puts = session._publisher.put.call_args_list
    assert [each.args for each in puts] == [(b"first",), (b"second",)]
    assert [graph.ATTACHMENT.unpack(each.kwargs["attachment"])[0] for each in puts] == [1, 2]
    session._publisher.put.side_effect = zenoh.ZError("closed")
    assert not session.send(b"third", (CMD_VEL.name, 0))
