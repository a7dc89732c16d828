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
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.http11 import Request, Response

from skytether.policy.robot import LINE, FrameType
from skytether.policy.values import MADE_BYTES_MAX
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shell.host.tcp import listen_tcp
from skytether.shell.host.udp import from_kernel

ANSWERS_MAX = 16
"""Largest number of answers that a program may leave unread; then its connection is closed."""
PROGRAM = "program"
Hear = Callable[[Datagram], None]
Messages = asyncio.Queue[bytes | str]


class ProgramServer:
    """Websocket server for the robot program; a new connection replaces the previous one.

    Raises:
        AddressError: the address cannot be bound.
    """

    def __init__(self, bind: Address, hear: Hear) -> None:
        self._hear = hear
        self._connections: dict[int, tuple[ServerConnection, Messages]] = {}
        self._closing = set[asyncio.Task[None]]()
        self._numbers = count(1)
        self._socket = listen_tcp(bind)
        self.address: Address = from_kernel(self._socket.getsockname())

    def send(self, payload: bytes, peer: Address) -> bool:
        if peer[1] not in self._connections:
            return False
        connection, answers = self._connections[peer[1]]
        if answers.full():
            self._close(connection, "the program does not read its answers")
            return False
        said = payload[1:]
        answers.put_nowait(said.decode() if payload[:1] == FrameType.ERROR else said)
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
            process_request=_health,
        ):
            await asyncio.get_running_loop().create_future()

    async def _serve(self, connection: ServerConnection) -> None:
        number = next(self._numbers)
        peer = PROGRAM, number
        for each, _ in self._connections.values():
            self._close(each, "another program has connected")
        answers = Messages(ANSWERS_MAX)
        self._connections[number] = connection, answers
        self._hear(Datagram(FrameType.OPENED.value, peer, LINE))
        writer = asyncio.get_running_loop().create_task(_write(connection, answers))
        try:
            with suppress(ConnectionClosed):
                async for message in connection:
                    said = message.encode() if isinstance(message, str) else message
                    self._hear(Datagram(FrameType.MESSAGE.value + said, peer, LINE))
        finally:
            writer.cancel()
            del self._connections[number]
            self._hear(Datagram(FrameType.CLOSED.value, peer, LINE))


class PolicyLine:
    """Websocket clients of the policy server, one for each robot.

    Args:
        url: address of the policy server, as in ws://127.0.0.1:8000.
        api_key: API key, sent in the header `Authorization` as by openpi's client; empty: none.
    """

    address = None

    def __init__(self, url: str, api_key: str, hear: Hear) -> None:
        self._url, self._hear = url, hear
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._waiting: dict[Address, Messages] = {}
        """Observations to be sent on each connection; at most one at a time."""
        self._tasks: dict[Address, asyncio.Task[None]] = {}

    def send(self, payload: bytes, peer: Address) -> bool:
        match payload[:1]:
            case FrameType.OPENED:
                self._waiting[peer] = Messages()
                self._tasks[peer] = asyncio.get_running_loop().create_task(self._speak(peer))
            case FrameType.CLOSED:
                self._end(peer)
            case FrameType.MESSAGE if peer in self._waiting:
                self._waiting[peer].put_nowait(payload[1:])
        return True

    def _end(self, peer: Address) -> None:
        if task := self._tasks.pop(peer, None):
            task.cancel()
            del self._waiting[peer]

    async def run(self) -> None:
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            for peer in list(self._tasks):
                self._end(peer)

    async def _speak(self, peer: Address) -> None:
        waiting, reason = self._waiting[peer], ""
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
                self._hear(Datagram(FrameType.OPENED.value + metadata, peer, LINE))
                writer = asyncio.get_running_loop().create_task(_write(connection, waiting))
                try:
                    async for reply in connection:
                        if isinstance(reply, str):
                            said = FrameType.ERROR.value + reply.encode()
                        else:
                            said = FrameType.MESSAGE.value + reply
                        self._hear(Datagram(said, peer, LINE))
                finally:
                    writer.cancel()
        except (OSError, WebSocketException, TypeError) as error:
            reason = str(error) or type(error).__name__
        self._hear(Datagram(FrameType.CLOSED.value + reason.encode(), peer, LINE))


def check_url(url: str) -> str:
    """Reason why an address of a policy server is invalid; empty if it is valid."""
    from websockets.uri import parse_uri

    try:
        parse_uri(url)
    except (InvalidURI, ValueError) as error:
        return str(error)
    return ""


async def _write(connection: Connection, messages: Messages) -> None:
    """Send the messages of a queue until the connection is closed."""
    with suppress(ConnectionClosed):
        while True:
            await connection.send(await messages.get())


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """Response to /healthz, as by openpi's server. Pages of a browser, which name their origin,
    must not take the place of the robot program.
    """
    if "Origin" in request.headers:
        return connection.respond(http.HTTPStatus.FORBIDDEN, "not for browsers\n")
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None
