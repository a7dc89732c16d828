"""Node of the ROS graph on a Zenoh network, beside the sockets of a `Shell`.

Zenoh has its own sockets and threads. Its threads only put received messages into a queue. The
event loop passes the messages to the endpoint as datagrams; the peer's host is the topic's name.
If the router is lost, Zenoh itself connects again.
"""

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from skytether.ros2.graph import IDENTITY_BYTES, Node, attachment, identity, session_settings
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shell.host.udp import AddressError

QUEUE_MAX = 256
"""Largest number of messages waiting for the event loop; the oldest are dropped."""
MESSAGE_BYTES_MAX = 65_535
"""Size above which a message is ignored [B]: the largest size of a datagram."""


class GraphSession:
    """Zenoh session of one node.

    Args:
        hear: called with each message, and each token of another publisher or subscriber.

    Raises:
        AddressError: Zenoh refuses the address.
    """

    address = None
    _is_open, _form = False, 0

    def __init__(self, node: Node, hear: Callable[[Datagram], None]) -> None:
        import zenoh  # the import takes 0.1 s, and needs an extra

        self._zenoh, self._node, self._hear = zenoh, node, hear
        config = zenoh.Config()
        for key, value in session_settings(node).items():
            config.insert_json5(key, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise AddressError(f"Zenoh at {node.host}:{node.port}: {error}") from None
        self._identity, self._sent = bytes(IDENTITY_BYTES), 0
        self._publisher: Any = None
        self._queue: deque[tuple[str, bytes]] = deque(maxlen=QUEUE_MAX)
        self._is_called = False
        """Whether the event loop is scheduled to empty the queue."""

    async def run(self) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            declared = self._declare()
            await self._loop.create_future()
            del declared
        finally:
            self._session.close()

    def _declare(self) -> list[Any]:
        """Declare the subscribers and tokens; they end when the returned objects are freed."""
        zenoh, node, session = self._zenoh, self._node, self._session
        out, into, zid = node.publishes, node.subscribes, str(session.zid())
        liveliness, (alive, publisher, subscriber) = session.liveliness(), node.tokens(zid)
        own = {alive, publisher, subscriber}
        own |= {node.publisher(zid, form) for form in range(len(node.forms))}
        self._is_open = True
        if not node.alternatives:
            self._publish(0)

        def put(topic: str) -> Callable[[Any], None]:
            return lambda sample: self._put(topic, bytes(sample.payload))

        def token(sample: Any) -> None:
            if (key := str(sample.key_expr)) not in own:
                self._put(key, b"1" if sample.kind == zenoh.SampleKind.PUT else b"")

        remote = zenoh.Locality.REMOTE
        return [
            session.declare_subscriber(into.key(node.domain), put(into.name)),
            # Commands of other nodes, of any type: they show that another node steers the robot.
            session.declare_subscriber(
                f"{node.domain}/{out.name.strip('/')}/*/*", put(out.name), allowed_origin=remote
            ),
            *(liveliness.declare_subscriber(each, token, history=True) for each in node.others),
            *map(liveliness.declare_token, (alive, subscriber)),
        ]

    def _publish(self, form: int) -> None:
        """Publish the topic with one of its message types, instead of the present type."""
        node, session = self._node, self._session
        # Commands are dropped while there is no connection, because they would be stale later.
        self._publisher = session.declare_publisher(
            node.forms[form].key(node.domain),
            congestion_control=self._zenoh.CongestionControl.DROP,
            express=True,
        )
        token = node.publisher(str(session.zid()), form)
        self._identity, self._form = identity(token), form
        self._token = session.liveliness().declare_token(token)

    def _put(self, topic: str, payload: bytes) -> None:
        """Queue a message; called by Zenoh's threads."""
        if len(payload) > MESSAGE_BYTES_MAX:
            return
        self._queue.append((topic, payload))
        if not self._is_called:
            self._is_called = True
            with contextlib.suppress(RuntimeError):  # the loop has closed meanwhile
                self._loop.call_soon_threadsafe(self._pass_on)

    def _pass_on(self) -> None:
        self._is_called = False
        for _ in range(len(self._queue)):
            topic, payload = self._queue.popleft()
            self._hear(Datagram(payload, (topic, 0), 1))

    def send(self, payload: bytes, peer: Address) -> bool:
        """Publish a message; False if Zenoh refuses it, or the node does not publish this topic.

        Args:
            peer: name of the topic, and index of its type in the node's `forms`.
        """
        name, form = peer
        if name != self._node.publishes.name:
            return False
        if self._is_open and (self._publisher is None or form != self._form):
            self._publish(form)
        if self._publisher is None:
            return False
        self._sent += 1
        attached = attachment(self._sent, time.time_ns(), self._identity)
        try:
            self._publisher.put(payload, attachment=attached)
        except self._zenoh.ZError:
            return False
        return True


def open_line(node: Node, hear: Callable[[Datagram], None], _: object) -> GraphSession:
    """Open the Zenoh session of a node, see `shell.driving.driver.OpenLine`."""
    return GraphSession(node, hear)
