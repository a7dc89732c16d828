"""Byte streams, TCP and serial, driven by asyncio beside the sockets of a `Shell`.

A stream that has ended, for example because a cable was unplugged, or that cannot be opened yet, is
opened again every second while its endpoint runs.
"""

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable

from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.line import LINE, Line
from skytether.shell.host import system
from skytether.shell.host.udp import AddressError

AGAIN_S = 1.0
"""Time from the end of a stream until it is opened again [s]."""
PIECE_BYTES = 4096


class ByteStream:
    """Byte stream to an autopilot, over TCP or a serial port.

    Args:
        hear: called with the bytes of each read, from the peer `LINE`.

    Raises:
        AddressError: the system has no serial ports, or does not support this bit rate.
    """

    address = None

    def __init__(self, line: Line, hear: Callable[[Datagram], None]) -> None:
        if line.kind == "serial" and system.termios is None:
            raise AddressError(f"{line.host}: this system has no termios, which serial ports need")
        if line.kind == "serial" and not hasattr(system.termios, f"B{line.number}"):
            raise AddressError(f"{line.host}: this system does not support {line.number} bit/s")
        self._line, self._hear = line, hear
        self._end: int | None = None

    def send(self, payload: bytes, peer: Address) -> bool:  # noqa: ARG002 - there is only one
        """Send bytes; False if the stream is not open or cannot take all of them."""
        if self._end is None:
            return False
        try:
            return os.write(self._end, payload) == len(payload)
        except OSError:
            return False

    async def run(self) -> None:
        while True:
            with contextlib.suppress(OSError, system.SERIAL_ERROR):
                await self._carry(await self._open())
            await asyncio.sleep(AGAIN_S)

    async def _carry(self, end: int) -> None:
        loop = asyncio.get_running_loop()
        ended = loop.create_future()

        def read() -> None:
            try:
                piece = os.read(end, PIECE_BYTES)
            except BlockingIOError:
                return
            except OSError:  # the device was unplugged
                piece = b""
            if piece:
                self._hear(Datagram(piece, LINE, 1))
            elif not ended.done():
                ended.set_result(None)

        loop.add_reader(end, read)
        self._end = end
        try:
            await ended
        finally:
            self._end = None
            loop.remove_reader(end)
            os.close(end)

    async def _open(self) -> int:
        """Open the stream; returns a non-blocking file descriptor.

        Raises:
            OSError: no peer listens, or there is no device.
            termios.error: the file is not a serial port.
        """
        with contextlib.ExitStack() as failed:
            if self._line.kind == "serial":
                end = os.open(self._line.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                failed.callback(os.close, end)
                prepare(end, self._line.number)
            else:
                loop = asyncio.get_running_loop()
                addresses = await loop.getaddrinfo(*self._line.address, type=socket.SOCK_STREAM)
                family, _, _, _, address = addresses[0]
                sock = failed.enter_context(socket.socket(family, socket.SOCK_STREAM))
                sock.setblocking(False)
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                await loop.sock_connect(sock, address)
                end = sock.detach()
            failed.pop_all()
        return end


def prepare(port: int, baud: int) -> None:
    """Configure a serial port, given as a file descriptor, for raw bytes at a supported bit rate.

    Raises:
        termios.error: the file is not a serial port.
    """
    termios = system.termios
    rate = getattr(termios, f"B{baud}")
    system.tty.setraw(port)
    settings = termios.tcgetattr(port)
    settings[2] |= termios.CLOCAL | termios.CREAD
    settings[4] = settings[5] = rate
    termios.tcsetattr(port, termios.TCSANOW, settings)


def open_line(line: Line, hear: Callable[[Datagram], None], _: object) -> ByteStream:
    """Open a byte stream to an autopilot, see `shell.driving.driver.OpenLine`."""
    return ByteStream(line, hear)
