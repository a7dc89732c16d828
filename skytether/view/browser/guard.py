"""Guard of the page's websocket, which limits connections, messages and their rate.

viser itself accepts any connection and any message: uploads of any size, requests to put the page
on the internet, values of any attribute. `Guard.served` makes it listen with these rules:

- no answer may be shown in a website's frame; the page itself gets our style and script (`DRESS`);
- a websocket is opened only for browsers that may watch (`access.refusal`), up to BROWSERS_MAX;
- if there are too many connections, the one that was silent longest is closed;
- only messages that our page sends (`MESSAGES`) are accepted, of at most 64 KiB in 64 pieces;
- at most `RATE_HZ` messages a second are read; further messages wait in the browser's kernel;
- a browser that does not read is sent nothing more; after 40 s it is disconnected, because it
  answers no pings, or at once if it sends pings itself.

A misbehaving browser loses its own connection, and affects no other.
"""

import asyncio
import gzip
import logging
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from http import HTTPStatus
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET
from typing import Any

import msgspec
import viser
import websockets.asyncio.server as sockets
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response

from skytether.shared.events.processes import BrowserRefused
from skytether.shell.host.web import HEADERS
from skytether.view.browser.access import TurnedAway, Visitor, refusal

BROWSERS_MAX = 16
CONNECTIONS_MAX = 32
"""Largest number of connections at once, including those that load the page or have not sent a
request yet."""
MESSAGE_BYTES_MAX = 64 * 1024
PIECES_MAX = 64
FRAMES_MAX = 1024
UNREAD_BYTES = 128 * 1024
"""Requested size of the kernel's send buffer of a connection [B]; the kernel doubles it."""
RATE_HZ = 200.0
"""Messages per second that are read from one browser [Hz]; a dragged slider sends 60 a second."""
BURST_S = 2.0
"""Largest burst of messages that are read at once, as the time that they take at RATE_HZ [s]."""
MESSAGES = frozenset(
    {
        "GuiUpdateMessage",
        "ScenePointerMessage",
        "TransformControlsDragEndMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsUpdateMessage",
        "ViewerCameraMessage",
    }
)
"""Types of viser messages that elements of the page send."""
VALUE = "value"
"""Name of the only attribute of an element that a browser may set."""
PROTOCOL = f"viser-v{viser.__version__}"
DRESS = Path(__file__).with_name("dress.html")
"""Style and script that this module adds to viser's page."""

_QUIET = logging.getLogger(__name__)
_QUIET.disabled = True  # invalid bytes from the network must not print a traceback


class _Outline(msgspec.Struct):
    type: str
    updates: dict[str, msgspec.Raw] = {}


_OUTLINE = msgspec.msgpack.Decoder(_Outline)


def is_taken(message: bytes) -> bool:
    try:
        outline = _OUTLINE.decode(message)
    except (msgspec.MsgspecError, RecursionError, ValueError):
        return False
    return outline.type in MESSAGES and outline.updates.keys() <= {VALUE}


class Guard:
    """Check of connections and messages, with a count of refusals.

    Args:
        token: secret that exempts a visitor from the other checks; empty if there is none.
    """

    def __init__(self, token: str) -> None:
        self._token = token
        self.counts: Counter[TurnedAway] = Counter()
        self.connections = 0
        self.browsers = 0
        self.idle: dict[_Connection, None] = {}
        """Connections without an accepted message, the longest silent first."""
        self._news: set[TurnedAway] = set()
        self._lock = threading.Lock()

    # -- counters ---------------------------------------------------------------------------

    def count(self, why: TurnedAway) -> None:
        with self._lock:
            self.counts[why] += 1
            if str(self.counts[why]).strip("0") == "1":  # report the 1st, 10th, 100th …
                self._news.add(why)

    def events(self) -> list[BrowserRefused]:
        with self._lock:
            news, self._news = self._news, set()
            return [BrowserRefused(why=str(why), count=self.counts[why]) for why in news]

    # -- the websocket -----------------------------------------------------------------------

    @contextmanager
    def served(self) -> Iterator[None]:
        """Make a viser server created in this block listen with this guard.

        Raises:
            RuntimeError: the server listened without the guard.
        """
        serve, used = sockets.serve, threading.Event()

        def guarded(handler: Any, *at: Any, process_request: Any, **own: Any) -> Any:
            used.set()
            asyncio.get_running_loop().set_exception_handler(self._fault)
            rules = {
                "max_size": MESSAGE_BYTES_MAX,
                "process_request": partial(self._opened, process_request),
                "process_response": _unframed,
                "create_connection": partial(_Connection, self),
                "logger": _QUIET,
            }
            return serve(partial(self._handle, handler), *at, **(own | rules))

        # viser has no hook for this, but looks up `sockets.serve` when it starts to listen.
        sockets.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            sockets.serve = serve  # type: ignore[misc]
        if not used.is_set():
            raise RuntimeError(f"this version of viser, {viser.__version__}, is unsupported")

    def _opened(
        self,
        answer: Callable[[sockets.ServerConnection, Request], Response | None],
        connection: sockets.ServerConnection,
        request: Request,
    ) -> Response | None:
        """Answer a request: None opens a websocket, any other answer is a file."""
        response = answer(connection, request)
        why = refusal(visitor(connection), self._token)
        if response is None and why:
            self.count(why)
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if (
            why is TurnedAway.HOST and request.path == "/"
        ):  # otherwise viser would wait endlessly for this client's websocket
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if response and response.headers.get("Content-Type", "").startswith("text/html"):
            _dress(response)
        return response

    async def _handle(
        self,
        handle: Callable[[sockets.ServerConnection], Awaitable[None]],
        connection: sockets.ServerConnection,
    ) -> None:
        if connection.subprotocol != PROTOCOL:
            self.count(TurnedAway.VERSION)
            await connection.close(CloseCode.PROTOCOL_ERROR, f"Version mismatch: {PROTOCOL}")
        elif self.browsers >= BROWSERS_MAX and not self._make_room(connection, opened=True):
            self.count(TurnedAway.FULL)
            await connection.close(CloseCode.TRY_AGAIN_LATER, str(TurnedAway.FULL))
        else:
            self.browsers += 1
            try:
                await handle(connection)
            except Exception:
                self.count(TurnedAway.MESSAGE)
            finally:
                self.browsers -= 1

    def arrive(self, newcomer: "_Connection") -> None:
        """Count a connection. If there are too many, end the longest silent or else the new one."""
        self.connections += 1
        self.idle[newcomer] = None
        if self.connections > CONNECTIONS_MAX and not self._make_room(newcomer):
            newcomer.cut(TurnedAway.FULL)

    def _make_room(self, newcomer: sockets.ServerConnection, *, opened: bool = False) -> bool:
        """End the longest silent connection other than the newcomer; returns whether there is one.

        Args:
            opened: whether the ended connection must be a websocket.
        """
        for each in self.idle:
            if each is not newcomer and (each.subprotocol or not opened):
                each.cut(TurnedAway.IDLE)
                return True
        return False

    def _fault(self, _: asyncio.AbstractEventLoop, __: dict[str, Any]) -> None:
        """Count a message that made one of viser's handlers fail."""
        self.count(TurnedAway.PANEL)


class _Connection(sockets.ServerConnection):
    def __init__(self, guard: Guard, *protocol: Any, **limits: Any) -> None:
        super().__init__(*protocol, **limits)
        self._guard = guard
        self._due_s = 0.0
        """Time at which the last message would have come if messages came at RATE_HZ [s]."""
        self._is_cut = False
        """Whether this guard has ended the connection."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # Otherwise the kernel would buffer 4 MB for a browser that does not read.
        transport.get_extra_info("socket").setsockopt(SOL_SOCKET, SO_SNDBUF, UNREAD_BYTES)
        self._guard.arrive(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._guard.connections -= 1
        self._guard.idle.pop(self, None)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self in self._guard.idle:
            del self._guard.idle[self]
            self._guard.idle[self] = None  # moves the connection to the end
        if len(self.recv_messages.frames) > FRAMES_MAX:
            self.cut(TurnedAway.ROOM)

    def process_event(self, event: Any) -> None:
        """End a connection that sends pings but does not read the answers, which would queue up."""
        if isinstance(event, Frame) and event.opcode is Opcode.PING and self.paused:
            self.cut(TurnedAway.ROOM)
        super().process_event(event)

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ARG002 - viser's are bytes
        """Next message that the page accepts; other messages are dropped.

        Raises:
            ConnectionClosed: the connection has ended.
        """
        while not self._is_cut:
            pieces = []
            async for piece in self._pieces():
                pieces.append(piece)
                if len(pieces) == PIECES_MAX:
                    self.cut(TurnedAway.ROOM)
            await self._wait_for_its_turn()
            if is_taken(message := b"".join(pieces)):
                self._guard.idle.pop(self, None)
                return message
            self._guard.count(TurnedAway.MESSAGE)
        # Reading the rest of a flood would take minutes, and block the place of another browser.
        await self.wait_closed()
        raise self.protocol.close_exc

    def _pieces(self) -> AsyncIterator[bytes]:
        return self.recv_streaming(decode=False)

    async def _wait_for_its_turn(self) -> None:
        now_s = self.loop.time()
        self._due_s = max(self._due_s, now_s - BURST_S) + 1 / RATE_HZ
        if self._due_s > now_s:
            await asyncio.sleep(self._due_s - now_s)

    def cut(self, why: TurnedAway) -> None:
        self._guard.count(why)
        self._guard.idle.pop(self, None)
        self._is_cut = True
        self.transport.abort()


def _dress(response: Response) -> None:
    """Insert DRESS before the end of a page."""
    zipped = response.headers.get("Content-Encoding") == "gzip"
    response.body = _dressed(bytes(response.body), zipped=zipped)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _dressed(page: bytes, *, zipped: bool) -> bytes:
    head, end, tail = (gzip.decompress(page) if zipped else page).rpartition(b"</body>")
    whole = b"".join((head, DRESS.read_bytes(), end, tail))
    return gzip.compress(whole) if zipped else whole


def _unframed(_: sockets.ServerConnection, __: Request, response: Response) -> None:
    response.headers.update(HEADERS)


def visitor(connection: sockets.ServerConnection) -> Visitor:
    """Fields of a browser's request on which its access depends.

    Raises:
        LookupError: a header occurs twice in the request.
    """
    request, address = connection.request, connection.remote_address
    assert request is not None
    headers = {name: request.headers[name] for name in request.headers}
    return Visitor(str(address[0]) if address else "", request.path, headers)
