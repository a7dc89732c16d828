"""The shell: one driver that runs any endpoint on real UDP sockets and the real clock.

All of asyncio, sockets and signals is in here and in `shared.timer`. It knows nothing of control or
of the protocol: datagrams and time go in, datagrams and lines of news come out.
"""

import asyncio
import contextlib
import gc
import ipaddress
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterable

from shared.endpoint import Address, Datagram, Endpoint
from shared.timer import make_timer

BUFFER_BYTES = 4 * 1024 * 1024
"""The default receive buffer holds 166 datagrams of 600 B."""
BURST_MAX = 128
"""Datagrams read from one socket before timers and other sockets have their turn."""
DATAGRAM_BYTES_MAX = 65535
ANYWHERE: Address = ("0.0.0.0", 0)
"""A free port on every interface: what an endpoint's further sockets are bound to."""
RESOLVE_EVERY_S = 2.0
"""Names are looked up again so often, off the loop: a restarted host may have a new address."""

_SO_MEMINFO, _MEMINFO_DROPS = 55, 8


def new_event_loop() -> asyncio.AbstractEventLoop:
    """A uvloop where it exists, else asyncio's own."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop()
    return uvloop.new_event_loop()


class AddressError(Exception):
    """An address that the user gave is of no use; the message says which and why."""


class Shell:
    """Drives one endpoint.

    Args:
        endpoint: what to drive.
        bind: address of its socket 0; port 0 takes a free one. Other sockets open as it uses them.
        peers: addresses it will send to; where they are names they are looked up here, and the
            endpoint sees the name in place of whatever address it stands for.

    Raises:
        AddressError: the address cannot be bound, or a name cannot be found.
    """

    def __init__(self, endpoint: Endpoint, bind: Address, peers: Iterable[Address] = ()) -> None:
        self.endpoint = endpoint
        self.send_errors = 0
        self._drops = 0
        self._names = [peer for peer in peers if not _is_numeric(peer[0])]
        self._numeric: dict[Address, Address] = {}
        self._named: dict[Address, Address] = {}
        for peer in self._names:
            try:
                self._learn(peer, _look_up(peer))
            except OSError as error:
                raise AddressError(f"cannot find {peer[0]}: {error.strerror}") from None
        try:
            self._sockets = {0: _open(bind)}
        except OSError as error:
            reason = f"cannot listen on {bind[0]}:{bind[1]}: {error.strerror}"
            raise AddressError(reason) from None
        self.address: Address = self._sockets[0].getsockname()

    async def run(self, on_news: Callable[[str], None] = lambda _: None) -> None:
        """Drive the endpoint until it has finished, or this task is cancelled."""
        self._loop = asyncio.get_running_loop()
        self._done = self._loop.create_future()
        self._on_news = on_news
        self._armed: int | None = None
        self._timer = make_timer(self._loop, self._wake)
        for number in self._sockets:
            self._listen(number)
        resolver = self._loop.create_task(self._keep_resolving())
        try:
            self._after()
            await self._done
        finally:
            resolver.cancel()
            self._timer.close()
            self._drops = self.kernel_drops()
            for sock in self._sockets.values():
                self._loop.remove_reader(sock)
                sock.close()
            self._sockets.clear()

    def kernel_drops(self) -> int:
        """Datagrams the kernel dropped because a receive buffer was full (0 where it won't say)."""
        return self._drops + sum(map(_drops, self._sockets.values()))

    def _listen(self, number: int) -> None:
        self._loop.add_reader(self._sockets[number], self._read, number)

    def _read(self, number: int) -> None:
        receive, endpoint = self._sockets[number].recvfrom, self.endpoint
        for _ in range(BURST_MAX):
            try:
                payload, peer = receive(DATAGRAM_BYTES_MAX)
            except BlockingIOError:
                break
            except OSError:  # an earlier packet of ours found the peer's port closed
                continue
            sender: Address = self._named.get(peer) or peer
            datagram = Datagram(payload, sender, number)
            endpoint.receive(datagram, now_ns=time.monotonic_ns())
        self._after()

    def _wake(self) -> None:
        self._armed = None
        now_ns, due_ns = time.monotonic_ns(), self.endpoint.next_wake_ns()
        if due_ns is not None and due_ns <= now_ns:
            self.endpoint.wake(now_ns=now_ns)
        self._after()

    def _after(self) -> None:
        """Send what the endpoint wants sent, say its news, arm its timer."""
        endpoint = self.endpoint
        for datagram in endpoint.outbox():
            self._send(datagram)
        for line in endpoint.news():
            self._on_news(line)
        due_ns = endpoint.next_wake_ns()
        if due_ns != self._armed:
            self._armed = due_ns
            self._timer.set(due_ns)
        if endpoint.finished and not self._done.done():
            self._done.set_result(None)

    def _send(self, datagram: Datagram) -> None:
        if datagram.socket not in self._sockets:
            self._sockets[datagram.socket] = _open(ANYWHERE)
            self._listen(datagram.socket)
        peer = self._numeric.get(datagram.peer, datagram.peer)
        try:
            self._sockets[datagram.socket].sendto(datagram.payload, peer)
        except OSError:  # buffer full, port closed, network down: to the endpoint, a lost packet
            self.send_errors += 1

    async def _keep_resolving(self) -> None:
        while self._names:
            await asyncio.sleep(RESOLVE_EVERY_S)
            for peer in self._names:
                with contextlib.suppress(OSError):  # the name server may be as lost as the peer
                    self._learn(peer, await self._loop.run_in_executor(None, _look_up, peer))

    def _learn(self, name: Address, numeric: Address) -> None:
        self._named.pop(self._numeric.get(name, name), None)
        self._numeric[name], self._named[numeric] = numeric, name


def run(
    shells: list[Shell],
    *,
    on_start: Callable[[], None] = lambda: None,
    on_news: Callable[[str], None] = lambda _: None,
    on_report: Callable[[], None] = lambda: None,
) -> None:
    """Drive several endpoints in this process until all have finished, or SIGINT or SIGTERM comes.

    Args:
        on_start: called once signals are heeded and the endpoints are about to be driven.
        on_news: called with each line of news.
        on_report: called at SIGUSR1.
    """
    # Everything imported so far lives on; without this, a collection of it pauses for 13 ms.
    gc.collect()
    gc.freeze()

    async def main() -> None:
        loop = asyncio.get_running_loop()
        task = asyncio.gather(*(shell.run(on_news) for shell in shells))
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, task.cancel)
        loop.add_signal_handler(signal.SIGUSR1, on_report)
        on_start()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(main())


def _open(address: Address) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        for option, forced in ((socket.SO_RCVBUF, 33), (socket.SO_SNDBUF, 32)):
            sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
            # SO_…BUFFORCE goes over the system's limit, for those who may.
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, forced, BUFFER_BYTES)
        sock.bind(address)
    except OSError:
        sock.close()
        raise
    return sock


def _drops(sock: socket.socket) -> int:
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
    except OSError:
        return 0
    return int(struct.unpack("=9I", info)[_MEMINFO_DROPS])


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _look_up(peer: Address) -> Address:
    found = socket.getaddrinfo(*peer, socket.AF_INET, socket.SOCK_DGRAM)
    host, port = found[0][4][:2]
    return str(host), int(port)
