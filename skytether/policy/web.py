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
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.http11 import Request, Response

from skytether.policy.robot import LINE, Said
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import address_text
from skytether.shell.host.udp import AddressError, from_kernel, to_kernel

BYTES_MAX = 64_000_000
"""Largest message of a websocket [B]: a larger observation is refused by name before it is sent."""
PROGRAM = "program"
Hear = Callable[[Datagram], None]


class ProgramLine:
    """Websocket server for the robot's program: the newest connection is the program's.

    Raises:
        AddressError: the address cannot be bound.
    """

    def __init__(self, bind: Address, hear: Hear) -> None:
        self._hear = hear
        self._connections: dict[int, ServerConnection] = {}
        self._sending = set[asyncio.Task[None]]()
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
        connection = self._connections.get(peer[1])
        if connection is None:
            return False
        said = payload[1:]
        task = asyncio.get_running_loop().create_task(
            _send(connection, said.decode() if payload[:1] == Said.ERROR else said)
        )
        self._sending.add(task)
        task.add_done_callback(self._sending.discard)
        return True

    async def run(self) -> None:
        async with serve(
            self._serve,
            sock=self._socket,
            compression=None,
            max_size=BYTES_MAX,
            process_request=_health,
        ):
            await asyncio.get_running_loop().create_future()

    async def _serve(self, connection: ServerConnection) -> None:
        number = next(self._numbers)
        peer = PROGRAM, number
        before = list(self._connections.values())
        self._connections[number] = connection
        self._hear(Datagram(Said.OPENED.value, peer, LINE))
        try:
            for each in before:
                await each.close(reason="another program has connected")
            with suppress(ConnectionClosed):
                async for message in connection:
                    if isinstance(message, bytes):
                        self._hear(Datagram(Said.MESSAGE.value + message, peer, LINE))
        finally:
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
        self._waiting: dict[Address, asyncio.Queue[bytes]] = {}
        self._tasks: dict[Address, asyncio.Task[None]] = {}

    def send(self, payload: bytes, peer: Address) -> bool:
        match payload[:1]:
            case Said.OPENED:
                self._end(peer)
                self._waiting[peer] = asyncio.Queue()
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
                self._url, compression=None, max_size=BYTES_MAX, additional_headers=self._headers
            ) as connection:
                metadata = await connection.recv()
                if isinstance(metadata, str):
                    raise TypeError("it sends text where openpi sends its metadata")
                self._hear(Datagram(Said.OPENED.value + metadata, peer, LINE))
                while True:
                    await connection.send(await waiting.get())
                    reply = await connection.recv()
                    if isinstance(reply, str):
                        said = Said.ERROR.value + reply.encode()
                    else:
                        said = Said.MESSAGE.value + reply
                    self._hear(Datagram(said, peer, LINE))
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


async def _send(connection: ServerConnection, message: bytes | str) -> None:
    with suppress(ConnectionClosed):
        await connection.send(message)


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """Answer to /healthz, which openpi's server has, too."""
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None
