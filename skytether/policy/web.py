"""The lines of both ends to what people run: openpi's websocket protocol.

After the connection the server sends the policy's metadata; then each message of the client is an
observation, and each of the server a reply in bytes, or an error as text. Compression is off at
both ends, as openpi has it.
"""

import asyncio
import http
import socket
from collections.abc import Callable
from contextlib import suppress
from itertools import count

from websockets.asyncio.client import connect
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.http11 import Request, Response

from skytether.policy.robot import LINE, Said
from skytether.policy.values import MADE_BYTES_MAX
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import address_text
from skytether.shell.host.udp import AddressError, from_kernel, to_kernel

ANSWERS_MAX = 16
"""Number of answers that may wait until a program reads them; then its connection is closed."""
PROGRAM = "program"
Hear = Callable[[Datagram], None]
Messages = asyncio.Queue[bytes | str]


class ProgramLine:
    """Websocket server for the robot's program: the newest connection is the program's.

    Raises:
        AddressError: the address cannot be bound.
    """

    def __init__(self, bind: Address, hear: Hear) -> None:
        self._hear = hear
        self._connections: dict[int, tuple[ServerConnection, Messages]] = {}
        self._closing = set[asyncio.Task[None]]()
        self._numbers = count(1)
        host, port = bind
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server(to_kernel((host, port)), family=family)
        except OSError as error:
            at = address_text(host, port)
            raise AddressError(f"cannot listen on {at}: {error.strerror or error}") from None
        self.address: Address = from_kernel(self._socket.getsockname())

    def send(self, payload: bytes, peer: Address) -> bool:
        if peer[1] not in self._connections:
            return False
        connection, answers = self._connections[peer[1]]
        if answers.full():
            self._close(connection, "the answers are not read")
            return False
        said = payload[1:]
        answers.put_nowait(said.decode() if payload[:1] == Said.ERROR else said)
        return True

    def _close(self, connection: ServerConnection, reason: str) -> None:
        """Close a connection, without waiting for its program, which may be frozen."""
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
        self._hear(Datagram(Said.OPENED.value, peer, LINE))
        writer = asyncio.get_running_loop().create_task(_write(connection, answers))
        try:
            with suppress(ConnectionClosed):
                async for message in connection:
                    said = message.encode() if isinstance(message, str) else message
                    self._hear(Datagram(Said.MESSAGE.value + said, peer, LINE))
        finally:
            writer.cancel()
            del self._connections[number]
            self._hear(Datagram(Said.CLOSED.value, peer, LINE))


class PolicyLine:
    """Websocket clients of the policy's server, one for each robot.

    Args:
        url: address of the policy's server, as in ws://127.0.0.1:8000.
        api_key: key that is sent as openpi's client sends it; empty for none.
    """

    address = None

    def __init__(self, url: str, api_key: str, hear: Hear) -> None:
        self._url, self._hear = url, hear
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._waiting: dict[Address, Messages] = {}
        """Observations for each connection, of which `PolicyEnd` sends one at a time."""
        self._tasks: dict[Address, asyncio.Task[None]] = {}

    def send(self, payload: bytes, peer: Address) -> bool:
        match payload[:1]:
            case Said.OPENED:
                self._waiting[peer] = Messages()
                self._tasks[peer] = asyncio.get_running_loop().create_task(self._speak(peer))
            case Said.CLOSED:
                self._end(peer)
            case Said.MESSAGE if peer in self._waiting:
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
                ping_interval=None,  # openpi's server answers no ping while its policy thinks
            ) as connection:
                metadata = await connection.recv()
                if isinstance(metadata, str):
                    raise TypeError("it sends text where openpi sends its metadata")
                self._hear(Datagram(Said.OPENED.value + metadata, peer, LINE))
                writer = asyncio.get_running_loop().create_task(_write(connection, waiting))
                try:
                    async for reply in connection:
                        if isinstance(reply, str):
                            said = Said.ERROR.value + reply.encode()
                        else:
                            said = Said.MESSAGE.value + reply
                        self._hear(Datagram(said, peer, LINE))
                finally:
                    writer.cancel()
        except (OSError, WebSocketException, TypeError) as error:
            reason = str(error) or type(error).__name__
        self._hear(Datagram(Said.CLOSED.value + reason.encode(), peer, LINE))


def check_url(url: str) -> str:
    """Reason why a policy's server cannot have this address; empty if it can."""
    from websockets.uri import parse_uri

    try:
        parse_uri(url)
    except (InvalidURI, ValueError) as error:
        return str(error)
    return ""


async def _write(connection: Connection, messages: Messages) -> None:
    """Send what is put into a queue, until the connection is closed."""
    with suppress(ConnectionClosed):
        while True:
            await connection.send(await messages.get())


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """Answer to /healthz, which openpi's server has, too."""
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None
