"""Lines to a vehicle's own hardware: their texts, and UDP, TCP and serial ports in virtual time."""

import asyncio
import os
import pty
import socket
import tty
from contextlib import suppress
from typing import Any

import pytest

from helpers import Idle
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.endpoints.line import LINE, Line, parse_line
from skytether.shell.driving.driver import Shell
from skytether.shell.host.udp import AddressError
from virtual_loop import run_virtually


@pytest.mark.parametrize(
    ("text", "line", "peer"),
    [
        ("udp:0.0.0.0:14550", Line("udp", "0.0.0.0", 14550), None),
        ("udpout:[::1]:14550", Line("udpout", "::1", 14550), ("::1", 14550)),
        ("tcp:autopilot:5760", Line("tcp", "autopilot", 5760), LINE),
        ("serial:/dev/ttyACM0:57600", Line("serial", "/dev/ttyACM0", 57600), LINE),
    ],
)
def test_a_line_is_what_is_written(text: str, line: Line, peer: Address | None) -> None:
    assert parse_line("vehicle.address", text) == line
    assert line.peer == peer


@pytest.mark.parametrize(
    "text", ["", "udp", "udp:14550", "http:h:1", "tcp:h:70000", "serial:57600", "serial:/dev/x:0"]
)
def test_what_is_no_line_is_refused_with_its_key(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^vehicle.address: got .*, expected udp:HOST:PORT"):
        parse_line("vehicle.address", text)


class Echo(Idle):
    """Endpoint that echoes what arrives at socket 1; ends after `enough` bytes."""

    def __init__(self, enough: bytes) -> None:
        super().__init__()
        self._enough = enough
        self.heard = b""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        assert datagram.socket == 1
        self.heard += datagram.payload
        self.send(datagram.payload, datagram.peer, 1)

    @property
    def finished(self) -> bool:
        return self.heard.endswith(self._enough)


def drive(coroutine: Any) -> Any:
    async def within_time() -> Any:
        return await asyncio.wait_for(coroutine, 180)

    return run_virtually(within_time)


def shell(endpoint: Endpoint, line: str) -> Shell:
    return Shell(endpoint, ("127.0.0.1", 0), line=parse_line("line", line))


def test_tcp_is_heard_and_opened_again_where_it_has_ended() -> None:
    """The autopilot's end closes in between; earlier bytes arrive."""

    async def main() -> tuple[bytes, list[bytes]]:
        answers: list[bytes] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"first" if not answers else b"last")
            answers.append(await reader.read(5))
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        echo = Echo(b"last")
        await shell(echo, f"tcp:127.0.0.1:{port}").run()
        while len(answers) < 2:
            await asyncio.sleep(0.01)
        server.close()
        return echo.heard, answers

    heard, answers = drive(main())
    assert heard == b"firstlast"
    assert answers[0] == b"first"


def test_a_serial_port_carries_bytes_as_they_are() -> None:
    """Including those that a terminal would interpret as an end of line or of input."""
    master, slave = pty.openpty()
    tty.setraw(master)
    sent = bytes(range(256))

    async def main() -> bytes:
        echo = Echo(sent)
        running = asyncio.create_task(shell(echo, f"serial:{os.ttyname(slave)}:57600").run())
        back = b""
        os.set_blocking(master, False)
        await asyncio.sleep(0.2)  # a terminal discards input from before its set-up
        os.write(master, sent)
        while not (running.done() and len(back) == len(sent)):
            await asyncio.sleep(0.01)
            with suppress(OSError):
                back += os.read(master, 4096)
        return back

    try:
        assert drive(main()) == sent
    finally:
        os.close(master)
        os.close(slave)


def test_a_rate_that_no_port_has_is_refused() -> None:
    with pytest.raises(AddressError, match="this system does not support 57601 bit/s"):
        shell(Echo(b""), "serial:/dev/ttyACM0:57601")


@pytest.mark.parametrize("kind", ["udp", "udpout"])
def test_udp_listens_or_speaks_first(kind: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.setblocking(False)
        host, port = autopilot.getsockname()

        async def main() -> bytes:
            echo, loop = Echo(b"fly"), asyncio.get_running_loop()
            if kind == "udp":
                driven = shell(echo, "udp:127.0.0.1:0")
                there = driven._sockets[1].getsockname()
            else:
                driven = shell(echo, f"udpout:{host}:{port}")
                echo.send(b"hello", (host, port), 1)
            running = asyncio.create_task(driven.run())
            if kind == "udpout":
                hello, there = await loop.sock_recvfrom(autopilot, 100)
                assert hello == b"hello"
            autopilot.sendto(b"fly", there)
            await running
            return await loop.sock_recv(autopilot, 100)

        assert drive(main()) == b"fly"
