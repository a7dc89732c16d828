"""TCP connections that an endpoint relays, beside the sockets of a `Shell`.

Each connected client gets its own connection to the server. Pieces of data from both go to the
endpoint as datagrams with the peers `(CLIENT, number)` and `(SERVER, number)`; an empty piece means
that the peer has sent its last data. While HELD_MAX pieces of a peer are under way, its socket is
not read, so that TCP slows the peer. If one connection is reset, the other is reset, too.
"""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable

from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.line import CLIENT, PIECE_BYTES, SERVER, Listen
from skytether.shell.host.tcp import listen_tcp
from skytether.shell.host.udp import from_kernel

HELD_MAX = 200
"""Number of a peer's pieces under way at which its socket is no longer read. Even with the data of
one more read, all connections together stay below the bounds of a link's queue."""
READ_BYTES = 32 * PIECE_BYTES
BREAKS_OFF = struct.pack("ii", 1, 0)
"""Value of SO_LINGER (on, 0 s) with which closing a socket sends a reset."""

Hear = Callable[[bytes, Address], None]


class SocketHalf:
    """One direction of a relayed connection, from source to target; `peer` names the source."""

    def __init__(
        self, source: socket.socket, target: socket.socket, peer: Address, hear: Hear
    ) -> None:
        self._source, self._target = source, target
        self._peer, self._hear = peer, hear
        self.pieces: asyncio.Queue[bytes] = asyncio.Queue()
        """Pieces of data that the endpoint has relayed and that are to be written to the target."""
        self._held, self._has_capacity = 0, asyncio.Event()
        self._has_capacity.set()
        self._has_ended = False

    async def read(self) -> None:
        loop = asyncio.get_running_loop()
        while data := await loop.sock_recv(self._source, READ_BYTES):
            for at in range(0, len(data), PIECE_BYTES):
                self._held += 1
                self._hear(data[at : at + PIECE_BYTES], self._peer)
            if self._held >= HELD_MAX:
                self._has_capacity.clear()
                await self._has_capacity.wait()
        self.end()

    async def write(self) -> None:
        loop = asyncio.get_running_loop()
        while piece := await self.pieces.get():
            await loop.sock_sendall(self._target, piece)
            self._held -= 1
            if self._held < HELD_MAX:
                self._has_capacity.set()
        self._target.shutdown(socket.SHUT_WR)

    def end(self) -> None:
        if not self._has_ended:
            self._has_ended = True
            self._hear(b"", self._peer)


class Connections:
    """Relay that listens for clients, and opens a connection to the server for each client.

    Args:
        hear: called with each piece of data.
        refused: called with the reason if the server cannot be reached.

    Raises:
        AddressError: the address cannot be bound.
    """

    def __init__(
        self, listen: Listen, hear: Callable[[Datagram], None], refused: Callable[[str], None]
    ) -> None:
        self._server, self._most, self._refused = listen.server, listen.most, refused
        self._hear: Hear = lambda piece, peer: hear(Datagram(piece, peer, 1))
        self._ways: dict[Address, SocketHalf] = {}
        """Directions of all connections, by the peer at the receiving end."""
        self._running: set[asyncio.Task[None]] = set()
        self._opened = 0
        self._socket = listen_tcp(listen.bind)
        self._socket.setblocking(False)
        self.address: Address = from_kernel(self._socket.getsockname())

    def send(self, payload: bytes, peer: Address) -> bool:
        if way := self._ways.get(peer):  # unless the connection was reset meanwhile
            way.pieces.put_nowait(payload)
        return True

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while True:
                client, _ = await loop.sock_accept(self._socket)
                if len(self._running) >= self._most:
                    client.close()
                    continue
                task = loop.create_task(self._serve(client))
                self._running.add(task)
                task.add_done_callback(self._running.discard)
        finally:
            self._socket.close()
            for task in self._running:
                task.cancel()

    async def _serve(self, client: socket.socket) -> None:
        with client:
            try:
                server = await self._connect()
            except OSError as error:
                self._refused(error.strerror or str(error))
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, BREAKS_OFF)
                return
            with server:
                await self._lead(client, server)

    async def _connect(self) -> socket.socket:
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(*self._server, type=socket.SOCK_STREAM)
        family, _, _, _, address = found[0]
        server = socket.socket(family, socket.SOCK_STREAM)
        try:
            server.setblocking(False)
            await loop.sock_connect(server, address)
        except BaseException:
            server.close()
            raise
        return server

    async def _lead(self, client: socket.socket, server: socket.socket) -> None:
        self._opened += 1
        ends = {(CLIENT, self._opened): client, (SERVER, self._opened): server}
        for each in ends.values():
            each.setblocking(False)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        (here, one), (there, other) = ends.items()
        down, up = (
            SocketHalf(one, other, here, self._hear),
            SocketHalf(other, one, there, self._hear),
        )
        self._ways |= {there: down, here: up}
        try:
            with contextlib.suppress(ExceptionGroup):  # an end has reset the connection
                async with asyncio.TaskGroup() as group:
                    for work in (down.read(), down.write(), up.read(), up.write()):
                        group.create_task(work)
                return
        finally:
            del self._ways[there], self._ways[here]
        for way, each in ((down, client), (up, server)):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, BREAKS_OFF)
            way.end()


open_line = Connections
"""Function that opens the line of a `Listen`, see `shell.driving.driver.OpenLine`."""
