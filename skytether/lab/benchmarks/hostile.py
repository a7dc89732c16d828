"""Hostile browsers during a flight: their cost in the page's memory and the server's ticks.

`python -m skytether.lab.benchmarks.hostile` connects 20 of them to the page of a flight for a
minute in total, and none for another, in turns of five seconds: websites of other origins that try
to open its websocket, uploads, frames of a megabyte, and browsers that never read and ping. They
reconnect whenever they are refused. docs/page.md has the results.
"""

import base64
import contextlib
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import tyro
import viser
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from skytether.lab.benchmarks.children import ChildProcess
from skytether.lab.benchmarks.feed import (
    WITHIN,
    FeedBenchmarkOptions,
    Looker,
    measure,
    ratio,
    table,
)
from skytether.lab.benchmarks.harness import CONSOLE
from skytether.lab.benchmarks.page import messages, process_mb
from skytether.shared.core.events import PageServed

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
BROWSERS = 20
"""Number of hostile browsers."""
PAUSE_S = 0.02
"""Pause between two actions of a hostile browser [s]."""
GROWTH_MB = 50.0
"""Largest growth of the page's memory [MB]."""
WEIGH_S = 0.25
TEXT, BINARY, PING = 1, 2, 9
"""Opcodes of websocket frames."""
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
    """Websocket frame of a browser; its mask is zeros."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 1 << 16:
        length = bytes([0x80 | 126]) + struct.pack(">H", size)
    else:
        length = bytes([0x80 | 127]) + struct.pack(">Q", size)
    return bytes([opcode | (0x80 if last else 0)]) + length + bytes(4) + payload


def opened(port: int, origin: str = "") -> socket.socket:
    """Open the page's websocket on a raw socket with a small receive buffer.

    Raises:
        OSError: the connection is refused.
    """
    sock = socket.socket()
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sock.settimeout(5.0)
        sock.connect(("127.0.0.1", port))
        lines = [
            "GET / HTTP/1.1",
            f"Host: 127.0.0.1:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {PROTOCOL}",
            *([f"Origin: {origin}"] if origin else []),
        ]
        sock.sendall("\r\n".join([*lines, "", ""]).encode())
        if b" 101 " not in sock.recv(64):
            raise ConnectionRefusedError
    except OSError:
        sock.close()
        raise
    return sock


def foreign(port: int) -> None:
    """Connect and read as a website of another origin."""
    with closing(opened(port, "http://evil.example")) as sock:
        while sock.recv(65536):
            pass


def element(browser: Connection) -> str:
    """Id of an element of the page that the browser could change.

    Raises:
        ConnectionClosed: the browser is refused.
    """
    while True:
        payload = browser.recv()
        assert isinstance(payload, bytes)
        for told in messages(payload):
            if told["type"] == "GuiDropdownMessage":
                return str(told["uuid"])


def uploaded(uuid: str, number: int) -> tuple[bytes, bytes]:
    """Messages that begin an upload to an element, and send a part of it."""
    ids = {"source_component_uuid": uuid, "transfer_uuid": str(number)}
    named = {"filename": "x", "mime_type": "x", "part_count": 1 << 30, "size_bytes": 1 << 60}
    begin = {"type": "FileTransferStartUpload", **ids, **named}
    part = {"type": "FileTransferPart", **ids, "part_index": 0, "content": bytes(60_000)}
    return msgspec.msgpack.encode(begin), msgspec.msgpack.encode(part)


def upload(port: int) -> None:
    """Upload endlessly."""
    with connect(
        f"ws://127.0.0.1:{port}/",
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
        ping_interval=None,
    ) as browser:
        browser.send(msgspec.msgpack.encode(CAMERA))
        uuid = element(browser)
        for number in count():
            for message in uploaded(uuid, number):
                browser.send(message)
            time.sleep(PAUSE_S)


def huge(port: int) -> None:
    """Send frames of a megabyte, and messages of ever more frames."""
    with closing(opened(port)) as sock:
        sock.sendall(frame(BINARY, msgspec.msgpack.encode(CAMERA)) + frame(BINARY, b"", last=False))
        for _ in range(50):
            sock.sendall(frame(0, b"", last=False) * 500)
            time.sleep(PAUSE_S)
        sock.sendall(frame(BINARY, bytes(1 << 20)))


def deaf(port: int) -> None:
    """Never read, and send pings."""
    with closing(opened(port)) as sock:
        sock.sendall(frame(BINARY, msgspec.msgpack.encode(CAMERA)))
        while True:
            sock.sendall(frame(PING, bytes(125)) * 50)
            time.sleep(PAUSE_S)


KINDS: tuple[Callable[[int], None], ...] = (foreign, upload, huge, deaf)


def attack(port: str) -> None:
    """Attack a page between the commands "come" and "go" on the standard input."""
    os.nice(10)  # browsers usually run on other machines, so here they yield to the server
    come = threading.Event()

    def act(kind: Callable[[int], None]) -> None:
        while come.wait():
            with contextlib.suppress(OSError, WebSocketException):
                kind(int(port))
            time.sleep(PAUSE_S)

    for number in range(BROWSERS):
        threading.Thread(target=act, args=(KINDS[number % len(KINDS)],), daemon=True).start()
    for word in sys.stdin:
        (come.set if word.strip() == "come" else come.clear)()


def main(seconds: int = 60) -> int:
    """Measure the cost of hostile browsers; the exit code is 1 if a limit is exceeded.

    Args:
        seconds: time with hostile browsers, and again without [s].
    """
    options = FeedBenchmarkOptions(rounds=-(-seconds // FeedBenchmarkOptions.seconds))
    weighed_mb: list[float] = []

    def lookers_at(stack: ExitStack, folder: Path) -> list[Looker]:
        page = ChildProcess(stack, "view", str(folder), "--page", "127.0.0.1:0")
        served = page.wait_for(PageServed).event
        assert isinstance(served, PageServed)
        done = threading.Event()

        def weigh() -> None:
            while not done.wait(WEIGH_S) and page.process.poll() is None:
                weighed_mb.append(process_mb(page.process.pid))

        stack.callback(done.set)
        threading.Thread(target=weigh, daemon=True).start()
        return [Looker(stack, "hostile.attack", str(urlsplit(served.address).port))]

    results = measure(options, (0, BROWSERS), lookers_at)
    table(results).show("a tick; in brackets, times that with no hostile browser")
    growth_mb = max(weighed_mb) - weighed_mb[0]
    CONSOLE.print(
        f"page: {weighed_mb[0]:.1f} MB before anybody came, {growth_mb:.1f} MB more at most"
    )
    return int(ratio(results) > WITHIN or growth_mb > GROWTH_MB)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
