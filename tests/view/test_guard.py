"""The page's websocket: admission, and allowed messages.

The guard listens in a virtual loop, where browsers and the page are coroutines; at the end stands a
real page with its threads.
"""

import asyncio
import base64
import gzip
import os
import socket
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, closing, suppress
from typing import Any
from unittest import mock

import msgspec
import pytest
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Response
from websockets.sync import client as in_threads
from websockets.typing import Subprotocol

from helpers import PATIENCE_S, until
from skytether.shared.scenario import reading
from skytether.sim import flight as virtual
from skytether.view.browser import guard
from skytether.view.browser.access import TurnedAway
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import Page
from skytether.view.frames import of_flight
from virtual_loop import virtually

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
BINARY, PING = 2, 9
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 5.0],
    "fov": 0.7,
    "near": 0.1,
    "far": 100.0,
    "image_height": 900,
    "image_width": 1400,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
"""First message of a viser browser; without it the server creates no panel."""


def frame(opcode: int, payload: bytes, *, last: bool = True) -> bytes:
    """Websocket frame of a browser, with a mask of zeros."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 1 << 16:
        length = bytes([0x80 | 126]) + struct.pack(">H", size)
    else:
        length = bytes([0x80 | 127]) + struct.pack(">Q", size)
    return bytes([opcode | (0x80 if last else 0)]) + length + bytes(4) + payload


# -- the guard in a virtual loop -------------------------------------------------------------------


class Guarded:
    """Page that keeps the messages it accepts, and sends `told` to who opens it."""

    def __init__(self, token: str = "", told: bytes = b"flight", many: int = 1) -> None:
        self.guard = guard.Guard(token)
        self.heard: list[bytes] = []
        self.port = 0
        self._told, self._many = told, many

    async def _talk(self, connection: Any) -> None:
        async def tell() -> None:
            with suppress(ConnectionClosed):
                for _ in range(self._many):
                    await connection.send(self._told)

        telling = asyncio.create_task(tell())
        with suppress(ConnectionClosed):
            while True:
                self.heard.append(await connection.recv())
        telling.cancel()

    def _answer(self, connection: Any, request: Any) -> Any:
        """Files of the page, where no websocket is asked for, as viser answers them."""
        if request.headers.get("Upgrade") == "websocket":
            return None
        return connection.respond(200 if request.path == "/" else 404, "page\n")

    @asynccontextmanager
    async def served(self) -> AsyncIterator["Guarded"]:
        with self.guard.served():
            listening = guard.sockets.serve(
                self._talk,
                "127.0.0.1",
                0,
                process_request=self._answer,
                select_subprotocol=lambda _, given: next(iter(given), None),
                compression=None,
            )
            async with listening as server:
                self.port = server.sockets[0].getsockname()[1]
                yield self
                asyncio.get_running_loop().set_exception_handler(None)

    def joined(self, origin: str | None = None, host: str = "127.0.0.1", path: str = "/") -> Any:
        """Open the page's websocket, as a website of some origin under some name."""
        return connect(
            f"ws://{host}:{self.port}{path}",
            host="127.0.0.1",
            port=self.port,
            origin=origin,  # type: ignore[arg-type]
            subprotocols=[PROTOCOL],
            compression=None,
            max_size=None,
            proxy=None,
        )

    async def opened(self) -> socket.socket:
        """Open the websocket on a raw socket that is not read any further."""
        loop, sock = asyncio.get_running_loop(), socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sock.setblocking(False)
        await loop.sock_connect(sock, ("127.0.0.1", self.port))
        lines = [
            "GET / HTTP/1.1",
            f"Host: 127.0.0.1:{self.port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {PROTOCOL}",
        ]
        await loop.sock_sendall(sock, "\r\n".join([*lines, "", ""]).encode())
        assert b" 101 " in await loop.sock_recv(sock, 64)
        return sock

    @property
    def counts(self) -> dict[TurnedAway, int]:
        return dict(self.guard.counts)


async def once(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(100):
        while not holds():
            await asyncio.sleep(0.01)


async def send(browser: ClientConnection, **message: Any) -> None:
    await browser.send(msgspec.msgpack.encode(message))


@pytest.mark.parametrize(
    ("origin", "host", "why"),
    [
        ("http://evil.example", "127.0.0.1", TurnedAway.ORIGIN),
        ("http://127.0.0.1:1", "127.0.0.1", TurnedAway.ORIGIN),
        ("null", "127.0.0.1", TurnedAway.ORIGIN),
        ("http://evil.example:{port}", "evil.example", TurnedAway.HOST),
        (None, "evil.example", TurnedAway.HOST),
    ],
)
@virtually
async def test_a_website_of_a_stranger_reads_nothing(
    origin: str | None, host: str, why: TurnedAway
) -> None:
    async with Guarded().served() as page:
        with pytest.raises(InvalidStatus) as refused:
            await page.joined(origin and origin.format(port=page.port), host)
        assert refused.value.response.status_code == 403
        assert refused.value.response.body == f"{why}\n".encode()
        headers = refused.value.response.headers
        assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert headers["X-Frame-Options"] == "DENY"
        assert page.counts == {why: 1}
        assert [str(event) for event in page.guard.events()] == [f"refused, 1 so far: {why}"]
        assert not page.guard.events()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "192.0.2.7", "[::1]"])
@virtually
async def test_the_page_itself_reads_the_flight_under_any_number(host: str) -> None:
    """An IP address cannot be rebound; through a tunnel or a container it may be any."""
    async with (
        Guarded().served() as page,
        page.joined(f"http://{host}:{page.port}", host) as browser,
    ):
        assert await browser.recv() == b"flight"
        assert not page.counts


@virtually
async def test_who_has_the_token_in_the_address_is_asked_nothing_else() -> None:
    """The right token admits a browser under any host name; a wrong one has no effect."""
    fleet = "https://fleet.example", "fleet.example"
    async with Guarded("secret").served() as page:
        async with page.joined(*fleet, "/?token=secret") as browser:
            assert await browser.recv()
        with pytest.raises(InvalidStatus):
            await page.joined(*fleet, "/?token=guessed")


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"200"),
        (b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"404"),
        (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", b"403"),
        (b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"500"),
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n\r\n", None),
    ],
)
@virtually
async def test_no_answer_may_be_shown_in_a_frame(request_: bytes, status: bytes | None) -> None:
    async with Guarded().served() as page:
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        writer.write(request_)
        head = (await reader.readuntil(b"\r\n\r\n")).split(b"\r\n")
        writer.close()
    assert status is None or head[0].split()[1] == status
    assert b"Content-Security-Policy: frame-ancestors 'none'" in head
    assert b"X-Frame-Options: DENY" in head


@pytest.mark.parametrize("zipped", [True, False])
@virtually
async def test_the_page_gets_our_style_and_script(zipped: bool) -> None:
    """Before its end, compressed or not; other files stay as they are."""
    form = {"Content-Type": "text/html; charset=utf-8", "Content-Length": "3"}
    body = b"<html><body>viser</body></html>"
    if zipped:
        form, body = form | {"Content-Encoding": "gzip"}, gzip.compress(body)
    page, other = Response(200, "OK", Headers(form), body), Response(200, "OK", Headers(), body)
    guarded = Guarded()
    guarded._answer = lambda _, request: other if request.path == "/x" else page  # type: ignore[method-assign]
    async with guarded.served() as served:
        for path, dressed in (("/", True), ("/x", False)):
            reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
            writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            got = await reader.read()
            writer.close()
            text = gzip.decompress(got) if zipped else got
            assert (guard.DRESS.read_bytes() in text) is dressed
            assert text.startswith(b"<html><body>viser")
            assert text.endswith(b"</body></html>")
            if dressed:
                assert f"Content-Length: {len(got)}\r\n".encode() in head


@virtually
async def test_only_messages_of_the_page_are_accepted() -> None:
    """Uploads, requests to put the page on the internet, and other attributes are dropped."""
    async with Guarded().served() as page, page.joined() as browser:
        begin = {"part_count": 1 << 30, "size_bytes": 1 << 60}
        await send(browser, type="FileTransferStartUpload", source_component_uuid="1", **begin)
        await send(browser, type="FileTransferPart", part_index=0, content=bytes(60_000))
        await send(browser, type="GetRenderResponseMessage", uuid="1", payload=bytes(9))
        await send(browser, type="ShareUrlRequest")
        await send(browser, type="GuiUpdateMessage", uuid="1", updates={"update_cb": 1})
        await browser.send(b"\xc1")
        await browser.send(b"\x91" * 60_000)
        await send(browser, type="GuiUpdateMessage", uuid="1", updates={"value": "1"})
        await once(lambda: page.heard)
        (heard,) = map(msgspec.msgpack.decode, page.heard)
        assert heard["updates"] == {"value": "1"}
        assert page.counts == {TurnedAway.MESSAGE: 7}


@virtually
async def test_a_huge_frame_ends_the_connection() -> None:
    async with Guarded().served() as page, page.joined() as browser:
        await browser.send(bytes(guard.MESSAGE_BYTES_MAX))
        await once(lambda: page.counts.get(TurnedAway.MESSAGE))
        await browser.send(bytes(guard.MESSAGE_BYTES_MAX + 1))
        assert await browser.recv() == b"flight"
        with pytest.raises(ConnectionClosed) as closed:
            await browser.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


@pytest.mark.parametrize(
    "sent",
    [frame(BINARY, b"", last=False) + frame(0, b"", last=False) * 100, frame(BINARY, b"") * 20_000],
)
@virtually
async def test_a_message_of_countless_frames_ends_the_connection(sent: bytes) -> None:
    """Even if they are short, because each takes memory."""
    async with Guarded().served() as page:
        with closing(await page.opened()) as sock:
            with suppress(OSError):
                await asyncio.get_running_loop().sock_sendall(sock, sent)
            await once(lambda: page.counts.get(TurnedAway.ROOM))
            await once(lambda: not page.guard.connections)
        # Nor does it occupy a browser's place until its data was read at the allowed rate.
        await asyncio.sleep(0.1)
        assert not page.guard.browsers


@virtually
async def test_who_never_reads_is_cut_off_once_he_pings() -> None:
    """The answers would fill the memory; other clients are cut off by the page's pings."""
    async with Guarded(told=bytes(60_000), many=100).served() as page:
        with closing(await page.opened()) as sock:
            with suppress(OSError):  # reset, or a broken pipe
                while not page.counts:
                    ping = frame(PING, bytes(125)) * 50
                    await asyncio.get_running_loop().sock_sendall(sock, ping)
                    await asyncio.sleep(0.01)
            await once(lambda: page.counts.get(TurnedAway.ROOM))
            await once(lambda: not page.guard.connections)


@virtually
async def test_browsers_beyond_the_most_are_turned_away() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guard, "BROWSERS_MAX", 1)
        async with Guarded().served() as page, page.joined() as first:
            assert await first.recv()
            await send(first, **CAMERA)
            await once(lambda: page.heard)
            async with page.joined() as second:
                with pytest.raises(ConnectionClosed) as closed:
                    await second.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1013
            await once(lambda: page.guard.connections == 1)
            patch.setattr(guard, "CONNECTIONS_MAX", 1)
            reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
            with suppress(ConnectionError):
                assert await reader.read() == b""
            writer.close()
            assert page.counts == {TurnedAway.FULL: 2}
            await (await first.ping())


@virtually
async def test_idle_connections_make_room_and_browsers_in_use_stay() -> None:
    """Two hundred connections that send nothing, or open a websocket and say nothing over it."""
    async with Guarded().served() as page, page.joined() as user:
        await send(user, **CAMERA)
        await once(lambda: page.heard)
        writers = []
        for number in range(200):
            _, writer = await asyncio.open_connection("127.0.0.1", page.port)
            writers.append(writer)
            if number % 4 == 0:
                writers[-1].write(b"GET / HTTP/1.1\r\n")
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert (await reader.readuntil(b"\r\n")).split()[1] == b"200"
        mute = [await page.opened() for _ in range(guard.BROWSERS_MAX + 4)]
        async with page.joined() as newcomer:
            assert await newcomer.recv()
            await send(newcomer, **CAMERA)
            await once(lambda: len(page.heard) == 2)
        await (await user.ping())
        await once(lambda: page.guard.connections <= guard.CONNECTIONS_MAX)
        assert page.guard.browsers <= guard.BROWSERS_MAX
        assert page.counts.keys() == {TurnedAway.IDLE}
        for each in (writer, *writers, *mute):
            each.close()
    await once(lambda: not page.guard.connections)
    assert not page.guard.idle


@virtually
async def test_a_page_of_another_version_is_told_so() -> None:
    """By the close code that viser's browsers show; nothing is printed."""
    async with Guarded().served() as page:
        address = f"ws://127.0.0.1:{page.port}/"
        async with connect(address, subprotocols=[Subprotocol("viser-v0")], proxy=None) as browser:
            with pytest.raises(ConnectionClosed) as closed:
                await browser.recv()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1002
        assert page.counts == {TurnedAway.VERSION: 1}


@virtually
async def test_messages_wait_for_their_turn() -> None:
    connection, loop = guard._Connection.__new__(guard._Connection), asyncio.get_running_loop()
    connection._due_s, connection.loop = 0.0, loop
    begun_s = loop.time()
    for _ in range(round(guard.RATE_HZ * guard.BURST_S)):
        await connection._wait_for_its_turn()
    assert loop.time() == pytest.approx(begun_s)
    for _ in range(20):
        await connection._wait_for_its_turn()
    assert loop.time() - begun_s == pytest.approx(20 / guard.RATE_HZ, rel=1e-3)


def test_a_page_is_not_served_where_viser_would_listen_without_the_guard() -> None:
    """Another version of viser, which opens its websocket differently, is refused."""
    with pytest.raises(RuntimeError, match="unsupported"), guard.Guard("").served():
        pass


def test_the_first_the_tenth_and_the_hundredth_are_told() -> None:
    refuses = guard.Guard("")
    said = []
    for _ in range(1000):
        refuses.count(TurnedAway.ORIGIN)
        said += [event.count for event in refuses.events()]
    assert said == [1, 10, 100, 1000]


# -- drawing for several browsers ------------------------------------------------------------------


class Drawn:
    """Page without a server: three browsers, of which one does not read and one's panel fails."""

    def __init__(self) -> None:
        self.panels = {number: mock.Mock() for number in (1, 2, 3)}
        self.connections = {1: mock.Mock(paused=False), 2: mock.Mock(paused=True)}
        self.connections[3] = mock.Mock(paused=False)
        self.panels[3].show.side_effect = ValueError("a text for a number")
        self.page = page = Page.__new__(Page)
        page._flights = [PageFlight()]
        page._flights[0].state.name = "demo"
        page._guard, page._panels = guard.Guard(""), dict(self.panels)
        page._scene, page._shown = mock.Mock(), ((0, False),)
        page._now_ns, page._server = (lambda: 7), mock.MagicMock()
        page._server._websock_server._live_connections = self.connections
        state = page._flights[0].state
        page._shown = ((state.flights, state.flies),)

    def show(self) -> None:
        clients = {number: mock.MagicMock() for number in self.panels}
        self.page._show(clients, draws=True)


def test_nothing_is_drawn_for_who_does_not_read() -> None:
    drawn = Drawn()
    drawn.show()
    assert drawn.panels[1].show.call_args_list == [mock.call(7)]
    assert not drawn.panels[2].show.called


def test_a_value_that_makes_no_sense_costs_nobody_else_the_page() -> None:
    drawn = Drawn()
    drawn.show()
    assert sorted(drawn.page._panels) == [1, 2]
    assert drawn.page._guard.counts == {TurnedAway.PANEL: 1}
    (ends,) = drawn.page._server.get_event_loop().call_soon_threadsafe.call_args.args
    assert ends == drawn.connections[3].transport.abort


# -- a real page, with its threads -----------------------------------------------------------------


@pytest.fixture(scope="module")
def flown() -> PageFlight:
    scenario = msgspec.structs.replace(reading.load("demo"), duration=10.0)
    flight = PageFlight()
    for _, process, frame_of_it in of_flight(scenario, "demo", virtual.fly(scenario)):
        flight.take(process, frame_of_it)
    return flight


@pytest.fixture
def page(flown: PageFlight) -> Iterator[Page]:
    with closing(Page("127.0.0.1", 0, [flown], now_ns=lambda: flown.state.newest_ns)) as served:
        yield served


def messages(payload: bytes) -> list[dict[str, Any]]:
    size = int.from_bytes(payload[8:16], "little")
    inner = msgspec.msgpack.decode(zstandard.decompress(payload[16 : 16 + size]))
    return [each[1] if isinstance(each, list) else each for each in inner["messages"]]


def told(browser: in_threads.ClientConnection, kind: str) -> dict[str, Any]:
    """First message of a kind that arrives.

    Raises ConnectionClosed if the browser is refused.
    """
    while True:
        payload = browser.recv(timeout=PATIENCE_S)
        assert isinstance(payload, bytes)
        for message in messages(payload):
            if message["type"] == kind:
                return message


def joined(page: Page) -> in_threads.ClientConnection:
    return in_threads.connect(
        f"ws://127.0.0.1:{page.port}/",
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
        proxy=None,
    )


def say(browser: in_threads.ClientConnection, **message: Any) -> None:
    browser.send(msgspec.msgpack.encode(message))


@pytest.mark.realtime
def test_viser_hands_on_only_what_the_guard_accepts(page: Page) -> None:
    """An invalid value of one browser does not end another's page."""
    with pytest.raises(InvalidStatus):
        in_threads.connect(
            f"ws://127.0.0.1:{page.port}/",
            origin="http://evil.example",  # type: ignore[arg-type]
            proxy=None,
        )
    with joined(page) as other, joined(page) as browser:
        say(other, **CAMERA)
        assert told(other, "GuiDropdownMessage")
        say(browser, **CAMERA)
        uuid = str(told(browser, "GuiDropdownMessage")["uuid"])
        upload = {"source_component_uuid": uuid, "transfer_uuid": "1", "filename": "x"}
        upload |= {"mime_type": "x", "part_count": 1 << 30, "size_bytes": 1 << 60}
        say(browser, type="FileTransferStartUpload", **upload)
        until(lambda: page._guard.counts[TurnedAway.MESSAGE] == 1)
        assert not page._server.gui._current_file_upload_states
        for client in page._server.get_clients().values():
            assert not client.gui._current_file_upload_states
        say(browser, type="GuiUpdateMessage", uuid=uuid, updates={"value": {}})
        until(lambda: sum(page._guard.counts.values()) > 2)
        for _ in range(2):
            assert told(other, "GuiUpdateMessage")
    assert page._thread.is_alive()
