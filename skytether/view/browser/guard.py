"""The page's websocket, guarded: who may open it, what may be sent by it, and how much.

viser takes whoever connects, and whatever is sent: uploads of any size, requests to put the page on
the internet, values of any attribute. `Guard.served` has it listen with this guard's rules:

- who opens the websocket may look (`access.refusal`), and there are not too many already;
- a message is one that our page sends (`MESSAGES`), of at most 64 KiB in at most 64 pieces;
- a browser says at most `RATE_HZ` messages a second; what is more waits in its own kernel;
- for a browser that does not read nothing is drawn, and it is cut off: after 40 s, by pings that it
  does not answer, or at once if it pings itself.

What a browser breaks is its own connection, and no other.
"""

import asyncio
import logging
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from socket import SO_SNDBUF, SOL_SOCKET
from typing import Any

import msgspec
import viser
import websockets.asyncio.server as sockets
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response

from skytether.shared.core.events import BrowserRefused
from skytether.view.browser.access import TurnedAway, Visitor, refusal

BROWSERS_MAX = 16
"""Most browsers at once."""
CONNECTIONS_MAX = 32
"""Most connections at once, with those that only load the page or have not said what they want."""
MESSAGE_BYTES_MAX = 64 * 1024
PIECES_MAX = 64
"""Most frames of a message."""
FRAMES_MAX = 1024
"""Most frames that wait to be looked at."""
UNREAD_BYTES = 128 * 1024
"""Room that the kernel has for what a browser has not read yet [B]; it takes twice as much."""
RATE_HZ = 200.0
"""Messages a second of one browser that are looked at; a slider that is dragged makes 60."""
BURST_S = 2.0
"""Time for which a browser that has been silent may say twice as much [s]."""
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
"""Messages of viser's that the page's elements send."""
VALUE = "value"
"""The one attribute of an element that a browser sets."""
PROTOCOL = f"viser-v{viser.__version__}"

_QUIET = logging.getLogger(__name__)
_QUIET.disabled = True  # a stranger's bytes are no reason for a traceback


class _Outline(msgspec.Struct):
    """What is looked at of a message."""

    type: str
    updates: dict[str, msgspec.Raw] = {}


_OUTLINE = msgspec.msgpack.Decoder(_Outline)


def is_taken(message: bytes) -> bool:
    """Whether a message is one that the page's elements send."""
    try:
        outline = _OUTLINE.decode(message)
    except (msgspec.MsgspecError, RecursionError, ValueError):
        return False
    return outline.type in MESSAGES and outline.updates.keys() <= {VALUE}


class Guard:
    """Turns browsers away, and counts them.

    Args:
        token: who gives it is asked for nothing else; empty where there is none.
    """

    def __init__(self, token: str) -> None:
        self._token = token
        self.counts: Counter[TurnedAway] = Counter()
        """How often somebody was turned away, or something dropped."""
        self.connections = 0
        """Number of connections."""
        self.browsers = 0
        """Number of websockets that are open."""
        self._news: set[TurnedAway] = set()
        self._lock = threading.Lock()

    # -- what is counted ---------------------------------------------------------------------

    def count(self, why: TurnedAway) -> None:
        """Count somebody who is turned away, or something that is dropped."""
        with self._lock:
            self.counts[why] += 1
            if str(self.counts[why]).strip("0") == "1":  # the first, tenth, hundredth
                self._news.add(why)

    def events(self) -> list[BrowserRefused]:
        """What there is to be told since this was called last."""
        with self._lock:
            news, self._news = self._news, set()
            return [BrowserRefused(why=str(why), count=self.counts[why]) for why in news]

    # -- the websocket -----------------------------------------------------------------------

    @contextmanager
    def served(self) -> Iterator[None]:
        """Have a server of viser's that is made in this block listen with this guard.

        Raises:
            RuntimeError: it has listened without.
        """
        serve, used = sockets.serve, threading.Event()

        def guarded(handler: Any, *at: Any, process_request: Any, **own: Any) -> Any:
            used.set()
            asyncio.get_running_loop().set_exception_handler(self._fault)
            rules = {
                "max_size": MESSAGE_BYTES_MAX,
                "process_request": partial(self._opened, process_request),
                "create_connection": partial(_Connection, self),
                "logger": _QUIET,
            }
            return serve(partial(self._handle, handler), *at, **(own | rules))

        # viser has no place for any of this, but it looks this name up when it listens.
        sockets.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            sockets.serve = serve  # type: ignore[misc]
        if not used.is_set():
            raise RuntimeError(f"viser {viser.__version__} listens in a way that is not known")

    def _opened(
        self,
        answer: Callable[[sockets.ServerConnection, Request], Response | None],
        connection: sockets.ServerConnection,
        request: Request,
    ) -> Response | None:
        """Answer a request: None opens a websocket, anything else is a file."""
        response = answer(connection, request)
        why = refusal(visitor(connection), self._token)
        if response is None and why:
            self.count(why)
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if (
            why is TurnedAway.HOST and request.path == "/"
        ):  # it would wait for its websocket for ever
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        return response

    async def _handle(
        self,
        handle: Callable[[sockets.ServerConnection], Awaitable[None]],
        connection: sockets.ServerConnection,
    ) -> None:
        """Let viser talk to a browser."""
        if connection.subprotocol != PROTOCOL:
            self.count(TurnedAway.VERSION)
            await connection.close(CloseCode.PROTOCOL_ERROR, f"Version mismatch: {PROTOCOL}")
        elif self.browsers >= BROWSERS_MAX:
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

    def _fault(self, _: asyncio.AbstractEventLoop, __: dict[str, Any]) -> None:
        """Count a message that a handler of viser's could not make sense of."""
        self.count(TurnedAway.PANEL)


class _Connection(sockets.ServerConnection):
    """A connection of one browser."""

    def __init__(self, guard: Guard, *protocol: Any, **limits: Any) -> None:
        super().__init__(*protocol, **limits)
        self._guard = guard
        self._due_s = 0.0
        """Time at which a browser that says RATE_HZ messages a second would have said them all."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        super().connection_made(transport)
        # The kernel would keep 4 MB for a browser that does not read.
        transport.get_extra_info("socket").setsockopt(SOL_SOCKET, SO_SNDBUF, UNREAD_BYTES)
        self._guard.connections += 1
        if self._guard.connections > CONNECTIONS_MAX:
            self._cut(TurnedAway.FULL)

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self._guard.connections -= 1
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        super().data_received(data)
        if len(self.recv_messages.frames) > FRAMES_MAX:
            self._cut(TurnedAway.ROOM)

    def process_event(self, event: Any) -> None:
        """See `websockets`: a ping is answered whether or not somebody reads the answers."""
        if isinstance(event, Frame) and event.opcode is Opcode.PING and self.paused:
            self._cut(TurnedAway.ROOM)
        super().process_event(event)

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ARG002 - viser's are bytes
        """Next message that the page takes; others are dropped."""
        while True:
            pieces = []
            async for piece in self._pieces():
                pieces.append(piece)
                if len(pieces) == PIECES_MAX:
                    self._cut(TurnedAway.ROOM)
            await self._wait_for_its_turn()
            if is_taken(message := b"".join(pieces)):
                return message
            self._guard.count(TurnedAway.MESSAGE)

    def _pieces(self) -> AsyncIterator[bytes]:
        return self.recv_streaming(decode=False)

    async def _wait_for_its_turn(self) -> None:
        now_s = self.loop.time()
        self._due_s = max(self._due_s, now_s - BURST_S) + 1 / RATE_HZ
        if self._due_s > now_s:
            await asyncio.sleep(self._due_s - now_s)

    def _cut(self, why: TurnedAway) -> None:
        self._guard.count(why)
        self.transport.abort()


def visitor(connection: sockets.ServerConnection) -> Visitor:
    """How a browser has connected.

    Raises:
        LookupError: a header stands twice in its request.
    """
    request, address = connection.request, connection.remote_address
    assert request is not None
    headers = {name: request.headers[name] for name in request.headers}
    return Visitor(str(address[0]) if address else "", request.path, headers)
