"""Websocket connections to the robot program and to the policy server, with openpi's protocol.

When a client connects, the server sends the policy's metadata. Each later message of the client is
an observation. Each later message of the server is a binary reply, or an error as text. Websocket
compression is off at client and server, as in openpi.
"""

import asyncio
import http
from collections.abc import Callable
from contextlib import suppress
from itertools import count

from websockets.asyncio.client import connect
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.http11 import Request, Response
from websockets.uri import parse_uri

from skytether.policy.robot import LINE, FrameType
from skytether.policy.values import BYTES_MAX, MADE_BYTES_MAX
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shell.host.tcp import listen_tcp
from skytether.shell.host.udp import from_kernel

UNREAD_BYTES_MAX = 4 * BYTES_MAX
"""Size of answers that a program may leave unread [B]; then its connection is closed."""
PROGRAM = "program"
Hear = Callable[[Datagram], None]


class ProgramServer:
    """Websocket server for the robot program; a new connection replaces the previous one.

    Raises:
        AddressError: the address cannot be bound.
    """

    def __init__(self, bind: Address, hear: Hear, _: object = None) -> None:
        self._hear = hear
        self._connections: dict[int, ServerConnection] = {}
        self._closing = set[asyncio.Task[None]]()
        self._numbers = count(1)
        self._socket = listen_tcp(bind)
        self.address: Address = from_kernel(self._socket.getsockname())

    def send(self, payload: bytes, peer: Address) -> bool:
        connection = self._connections.get(peer[1])
        if connection is None:
            return False
        if connection.transport.get_write_buffer_size() > UNREAD_BYTES_MAX:
            self._close(connection, "the program does not read its answers")
            return False
        said = payload[1:]
        # `broadcast` does not wait, unlike `send`.
        broadcast([connection], said.decode() if payload[:1] == FrameType.ERROR else said)
        return True

    def _close(self, connection: ServerConnection, reason: str) -> None:
        """Close a connection without waiting for its program, which may not respond."""
        task = asyncio.get_running_loop().create_task(connection.close(reason=reason))
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    async def run(self) -> None:
        async with serve(
            self._serve,
            sock=self._socket,
            compression=None,
            max_size=2 * MADE_BYTES_MAX,
            # A page in a browser, which names its origin, must not replace the robot program.
            origins=[None],
            process_request=_health,
        ):
            await asyncio.get_running_loop().create_future()

    async def _serve(self, connection: ServerConnection) -> None:
        number = next(self._numbers)
        peer = PROGRAM, number
        for each in self._connections.values():
            self._close(each, "another program has connected")
        self._connections[number] = connection
        self._hear(Datagram(FrameType.OPENED.value, peer, LINE))
        try:
            with suppress(ConnectionClosed):
                async for message in connection:
                    said = message.encode() if isinstance(message, str) else message
                    self._hear(Datagram(FrameType.MESSAGE.value + said, peer, LINE))
        finally:
            del self._connections[number]
            self._hear(Datagram(FrameType.CLOSED.value, peer, LINE))


class PolicyLine:
    """Websocket clients of the policy server, one for each robot.

    Args:
        url: address of the policy server, as in ws://127.0.0.1:8000.
        api_key: API key, sent in the header `Authorization` as by openpi's client; empty: none.
    """

    address = None

    def __init__(self, url: str, api_key: str, hear: Hear, _: object = None) -> None:
        self._url, self._hear = url, hear
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._connections: dict[Address, Connection] = {}
        self._tasks: dict[Address, asyncio.Task[None]] = {}

    def send(self, payload: bytes, peer: Address) -> bool:
        match payload[:1]:
            case FrameType.OPENED:
                self._tasks[peer] = asyncio.get_running_loop().create_task(self._speak(peer))
            case FrameType.CLOSED if task := self._tasks.pop(peer, None):
                task.cancel()
            case FrameType.MESSAGE if connection := self._connections.get(peer):
                broadcast([connection], payload[1:])  # at most one observation at a time
        return True

    async def run(self) -> None:
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            for task in self._tasks.values():
                task.cancel()

    async def _speak(self, peer: Address) -> None:
        reason = ""
        try:
            async with connect(
                self._url,
                compression=None,
                max_size=2 * MADE_BYTES_MAX,
                additional_headers=self._headers,
                # openpi's server does not answer pings while its policy computes.
                ping_interval=None,
            ) as connection:
                metadata = await connection.recv()
                if isinstance(metadata, str):
                    raise TypeError("got text from the policy server, expected its metadata")
                self._connections[peer] = connection
                self._hear(Datagram(FrameType.OPENED.value + metadata, peer, LINE))
                async for reply in connection:
                    if isinstance(reply, str):
                        said = FrameType.ERROR.value + reply.encode()
                    else:
                        said = FrameType.MESSAGE.value + reply
                    self._hear(Datagram(said, peer, LINE))
        except (OSError, WebSocketException, TypeError) as error:
            reason = str(error) or type(error).__name__
        finally:
            self._connections.pop(peer, None)
        self._hear(Datagram(FrameType.CLOSED.value + reason.encode(), peer, LINE))


def check_url(url: str) -> str:
    """Reason why an address of a policy server is invalid; empty if it is valid."""
    try:
        parse_uri(url)
    except (InvalidURI, ValueError) as error:
        return str(error)
    return ""


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """Response to /healthz, as by openpi's server."""
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None
