"""The page's websocket with real clients: admission, and allowed messages."""

import base64
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import closing, suppress
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import viser
import zstandard
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from helpers import PATIENCE_S, until
from skytether.shared.scenario import reading
from skytether.sim import flight as virtual
from skytether.view.browser import guard
from skytether.view.browser.access import TurnedAway
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import Page
from skytether.view.frames import of_flight

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


def messages(payload: bytes) -> list[dict[str, Any]]:
    size = int.from_bytes(payload[8:16], "little")
    inner = msgspec.msgpack.decode(zstandard.decompress(payload[16 : 16 + size]))
    return [each[1] if isinstance(each, list) else each for each in inner["messages"]]


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


def opened(port: int) -> socket.socket:
    """Open the page's websocket on a raw socket with a small receive buffer.

    Raises OSError if the connection is refused.
    """
    sock = socket.socket()
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sock.settimeout(180.0)
        sock.connect(("127.0.0.1", port))
        lines = [
            "GET / HTTP/1.1",
            f"Host: 127.0.0.1:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {PROTOCOL}",
        ]
        sock.sendall("\r\n".join([*lines, "", ""]).encode())
        if b" 101 " not in sock.recv(64):
            raise ConnectionRefusedError
    except OSError:
        sock.close()
        raise
    return sock


def arriving(browser: ClientConnection) -> Iterator[dict[str, Any]]:
    """Messages that arrive at a browser.

    Raises ConnectionClosed if the browser is refused.
    """
    while True:
        payload = browser.recv(timeout=PATIENCE_S)
        assert isinstance(payload, bytes)
        yield from messages(payload)


def told(browser: ClientConnection, kind: str) -> dict[str, Any]:
    return next(message for message in arriving(browser) if message["type"] == kind)


def element(browser: ClientConnection) -> str:
    return str(told(browser, "GuiDropdownMessage")["uuid"])


def labelled(browser: ClientConnection, label: str) -> str:
    shown = (each for each in arriving(browser) if each.get("props", {}).get("label") == label)
    return str(next(shown)["uuid"])


def uploaded(uuid: str, number: int) -> tuple[bytes, bytes]:
    """Messages that begin an upload to an element, and send a part of it."""
    ids = {"source_component_uuid": uuid, "transfer_uuid": str(number)}
    named = {"filename": "x", "mime_type": "x", "part_count": 1 << 30, "size_bytes": 1 << 60}
    begin = {"type": "FileTransferStartUpload", **ids, **named}
    part = {"type": "FileTransferPart", **ids, "part_index": 0, "content": bytes(60_000)}
    return msgspec.msgpack.encode(begin), msgspec.msgpack.encode(part)


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


def joined(
    page: Page, origin: str | None = None, host: str = "127.0.0.1", path: str = "/"
) -> ClientConnection:
    """Open a page's websocket, as a website of some origin under some name."""
    return connect(
        f"ws://{host}:{page.port}{path}",
        sock=socket.create_connection(("127.0.0.1", page.port)),
        origin=origin,  # type: ignore[arg-type]
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
    )


def send(browser: ClientConnection, **message: Any) -> None:
    browser.send(msgspec.msgpack.encode(message))


def counts(page: Page) -> dict[TurnedAway, int]:
    return dict(page._guard.counts)


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
def test_a_website_of_a_stranger_reads_nothing(
    page: Page, origin: str | None, host: str, why: TurnedAway
) -> None:
    with pytest.raises(InvalidStatus) as refused:
        joined(page, origin and origin.format(port=page.port), host)
    assert refused.value.response.status_code == 403
    assert refused.value.response.body == f"{why}\n".encode()
    headers = refused.value.response.headers
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["X-Frame-Options"] == "DENY"
    assert counts(page) == {why: 1}
    assert [str(event) for event in page.events()] == [f"refused, 1 so far: {why}"]
    assert not page.events()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "192.0.2.7", "[::1]"])
def test_the_page_itself_reads_the_flight_under_any_number(page: Page, host: str) -> None:
    """An IP address cannot be rebound; through a tunnel or a container it may be any."""
    with joined(page, f"http://{host}:{page.port}", host) as browser:
        assert browser.recv(timeout=PATIENCE_S)
    assert not counts(page)


def test_who_has_the_token_in_the_address_is_asked_nothing_else(flown: PageFlight) -> None:
    """The right token admits a browser under any host name; a wrong one has no effect."""
    with closing(Page("127.0.0.1", 0, [flown], token="secret")) as page:
        with joined(page, "https://fleet.example", "fleet.example", "/?token=secret") as browser:
            assert browser.recv(timeout=PATIENCE_S)
        with pytest.raises(InvalidStatus):
            joined(page, "https://fleet.example", "fleet.example", "/?token=guessed")


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
def test_no_answer_may_be_shown_in_a_frame(
    page: Page, request_: bytes, status: bytes | None
) -> None:
    with socket.create_connection(("127.0.0.1", page.port)) as sock:
        sock.sendall(request_)
        head = sock.recv(4096).partition(b"\r\n\r\n")[0].split(b"\r\n")
    assert status is None or head[0].split()[1] == status
    assert b"Content-Security-Policy: frame-ancestors 'none'" in head
    assert b"X-Frame-Options: DENY" in head


class Asked:
    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def ask(self, process: str, values: dict[str, Any]) -> None:
        self.asked.append((process, values))

    def close(self) -> None:
        """See `Operator`."""


@pytest.mark.parametrize(
    ("label", "value", "yes", "expected"),
    [
        ("Cut the link", True, "Yes, cut it", "netem"),
        ("Loss [%]", 100.0, "Yes, cut it", "netem"),
        ("Armed", False, "Yes, disarm", "client"),
    ],
)
def test_what_may_end_a_flight_is_asked_once_more(
    flown: PageFlight, label: str, value: object, yes: str, expected: str
) -> None:
    """One click changes nothing; a second one, elsewhere, does."""
    flight, operator = PageFlight(), Asked()
    flight.state, flight.operator = flown.state, operator  # type: ignore[assignment]
    table = reading.to_table(flown.state.scenario)["network"]
    keys = {f"network.{way}": table[way] for way in ("uplink", "downlink")}
    flight.values = {"netem": keys, "client": {"armed": True}}
    served = Page("127.0.0.1", 0, [flight], now_ns=lambda: flown.state.newest_ns)
    with closing(served), joined(served) as browser:
        send(browser, **CAMERA)
        pressed = labelled(browser, label)
        until(lambda: served._panels)
        send(browser, type="GuiUpdateMessage", uuid=pressed, updates={"value": value})
        meant = labelled(browser, yes)
        assert operator.asked == []
        send(browser, type="GuiUpdateMessage", uuid=meant, updates={"value": True})
        until(lambda: operator.asked)
    assert [process for process, _ in operator.asked] == [expected]


def test_an_upload_is_dropped_and_a_message_of_the_page_is_not(page: Page) -> None:
    with joined(page) as browser:
        send(browser, **CAMERA)
        uuid = element(browser)
        for number in range(20):
            for message in uploaded(uuid, number):
                browser.send(message)
        send(browser, type="GetRenderResponseMessage", uuid=uuid, payload=bytes(9))
        send(browser, type="ShareUrlRequest")
        send(browser, type="GuiUpdateMessage", uuid=uuid, updates={"update_cb": 1})
        browser.send(b"\xc1")
        browser.send(b"\x91" * 60_000)
        send(browser, type="GuiUpdateMessage", uuid=uuid, updates={"value": "1"})
        until(lambda: counts(page).get(TurnedAway.MESSAGE) == 45)
        (client,) = page._server.get_clients().values()
        assert not client.gui._current_file_upload_states
        assert not page._server.gui._current_file_upload_states
        assert told(browser, "GuiUpdateMessage")
    assert counts(page) == {TurnedAway.MESSAGE: 45}


def test_a_huge_frame_ends_the_connection(page: Page) -> None:
    with joined(page) as browser:
        browser.send(bytes(guard.MESSAGE_BYTES_MAX))
        until(lambda: counts(page).get(TurnedAway.MESSAGE))
        with suppress(ConnectionClosed):
            browser.send(bytes(guard.MESSAGE_BYTES_MAX + 1))
        with pytest.raises(ConnectionClosed) as closed:
            told(browser, "nothing")
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


@pytest.mark.parametrize(
    "sent",
    [frame(BINARY, b"", last=False) + frame(0, b"", last=False) * 100, frame(BINARY, b"") * 20_000],
)
def test_a_message_of_countless_frames_ends_the_connection(page: Page, sent: bytes) -> None:
    """Even if they are short, because each takes memory."""
    with closing(opened(page.port)) as sock:
        with suppress(OSError):
            sock.sendall(sent)
        until(lambda: counts(page).get(TurnedAway.ROOM))
        until(lambda: not page._guard.connections)
    # Nor does it occupy a browser's place until its data was read at the allowed rate.
    until(lambda: not page._guard.browsers)


def test_who_never_reads_is_cut_off_once_he_pings(page: Page) -> None:
    """The answers would fill the memory; other clients are cut off by the page's pings."""
    with closing(opened(page.port)) as sock:
        sock.sendall(frame(BINARY, msgspec.msgpack.encode(CAMERA)))
        with suppress(OSError):  # reset, or a broken pipe
            while not counts(page):
                sock.sendall(frame(PING, bytes(125)) * 50)
    until(lambda: counts(page).get(TurnedAway.ROOM))
    until(lambda: not page._guard.connections)


@pytest.mark.long
def test_what_a_reader_leaves_unread_is_bounded(page: Page) -> None:
    with closing(opened(page.port)) as sock:
        sock.sendall(frame(BINARY, msgspec.msgpack.encode(CAMERA)))
        until(lambda: page._panels)
        (panel,) = page._panels.values()
        buffer = panel._client._websock_connection.get_message_buffer()
        (connection,) = page._connections.values()
        until(lambda: connection.paused)
        kept = []
        for _ in range(3):
            for _ in range(10):
                panel.show(0)
            kept.append((len(buffer.message_from_id), len(buffer.id_from_redundancy_key)))
        assert kept[0] == kept[1] == kept[2]
        assert connection.transport.get_write_buffer_size() < 1_000_000


@pytest.mark.long
def test_nothing_is_drawn_for_who_does_not_read(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(opened(page.port)) as sock, joined(page) as reader:
        sock.sendall(frame(BINARY, msgspec.msgpack.encode(CAMERA)))
        until(lambda: any(each.paused for each in page._connections.values()))
        (deaf,) = (number for number, each in page._connections.items() if each.paused)
        send(reader, **CAMERA)
        until(lambda: len(page._panels) == 2)
        drawn: list[int] = []
        for number, panel in page._panels.items():
            monkeypatch.setattr(panel, "show", lambda _, number=number: drawn.append(number))
        until(lambda: len(drawn) >= 5)
        assert deaf not in drawn


@pytest.mark.parametrize(
    "message",
    [
        CAMERA | {"position": ["x"] * 9, "image_width": "wide", "image_height": 0},
        {"type": "GuiUpdateMessage", "updates": {"value": "none"}},
        {"type": "GuiUpdateMessage", "updates": {"value": {}}},
        {"type": "ViewerCameraMessage"},
    ],
)
def test_a_value_that_makes_no_sense_costs_nobody_else_the_page(
    page: Page, message: dict[str, Any]
) -> None:
    with joined(page) as other, joined(page) as browser:
        send(other, **CAMERA)
        assert element(other)
        send(browser, **CAMERA)
        uuid = element(browser)
        send(browser, **({"uuid": uuid} if "updates" in message else {}), **message)
        until(lambda: counts(page))
        for _ in range(5):
            assert told(other, "GuiUpdateMessage")
    assert page._thread.is_alive()


def test_browsers_beyond_the_most_are_turned_away(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "BROWSERS_MAX", 1)
    with joined(page) as first:
        assert first.recv(timeout=PATIENCE_S)
        with joined(page) as second, pytest.raises(ConnectionClosed) as closed:
            second.recv(timeout=PATIENCE_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1013
        until(lambda: page._guard.connections == 1)
        monkeypatch.setattr(guard, "CONNECTIONS_MAX", 1)
        third = socket.create_connection(("127.0.0.1", page.port))
        with closing(third), suppress(ConnectionError):
            assert third.recv(1) == b""
        assert counts(page) == {TurnedAway.FULL: 2}
        assert first.ping().wait(PATIENCE_S)


def test_a_page_of_another_version_is_told_so(page: Page) -> None:
    """By the close code that viser's browsers show; nothing is printed."""
    with (
        connect(f"ws://127.0.0.1:{page.port}/", subprotocols=["viser-v0"]) as browser,  # type: ignore[list-item]
        pytest.raises(ConnectionClosed) as closed,
    ):
        browser.recv(timeout=PATIENCE_S)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1002
    assert counts(page) == {TurnedAway.VERSION: 1}


async def test_messages_wait_for_their_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1000.0

    async def sleep(pause_s: float) -> None:
        nonlocal now_s
        now_s += pause_s

    monkeypatch.setattr(guard.asyncio, "sleep", sleep)
    connection = guard._Connection.__new__(guard._Connection)
    connection._due_s = 0.0
    connection.loop = SimpleNamespace(time=lambda: now_s)  # type: ignore[assignment]
    burst = round(guard.RATE_HZ * guard.BURST_S)
    for _ in range(burst):
        await connection._wait_for_its_turn()
    assert now_s == pytest.approx(1000.0)
    for _ in range(600):
        await connection._wait_for_its_turn()
    assert now_s == pytest.approx(1000.0 + 600 / guard.RATE_HZ)


def test_a_page_is_not_served_where_viser_would_listen_without_the_guard() -> None:
    """Another version of viser, which opens its websocket differently, is refused."""
    with pytest.raises(RuntimeError, match="not known"), guard.Guard("").served():
        pass


def test_the_first_the_tenth_and_the_hundredth_are_told() -> None:
    refuses = guard.Guard("")
    said = []
    for _ in range(1000):
        refuses.count(TurnedAway.ORIGIN)
        said += [event.count for event in refuses.events()]
    assert said == [1, 10, 100, 1000]
