"""Shell: driver that runs any endpoint on real UDP sockets and the real clock.

asyncio and signals are used only here and in `shell.host.timer`, sockets only in `shell.host.udp`
and `shell.host.batch`. The shell has no knowledge of control or protocol: it passes datagrams and
time to the endpoint, sends the endpoint's datagrams, and reports its events.
"""

import asyncio
import contextlib
import gc
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import groupby
from operator import itemgetter
from socket import socket
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, Form, make_datagram
from skytether.shared.endpoints.line import Line
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import Event, Fault
from skytether.shared.events.processes import HostFound, HostMissing, PathFound, PathMissing
from skytether.shell.host import system
from skytether.shell.host.batch import BATCH_MAX, DatagramBatch, Segments
from skytether.shell.host.paths import NetworkPath, PathSockets
from skytether.shell.host.timer import make_timer
from skytether.shell.host.udp import (
    AddressError,
    Names,
    admit_only,
    from_kernel,
    heed_refusals,
    is_loopback,
    kernel_drops,
    open_socket,
    refusals,
    within_reach_of,
)

if TYPE_CHECKING:
    from skytether.ros2.graph import Node
    from skytether.shared.endpoints.line import Listen
    from skytether.shell.driving.control import Control
    from skytether.shell.driving.feed import Feed
    from skytether.shell.driving.memory import MemoryFile
    from skytether.shell.driving.program import Program

    AnyLine: TypeAlias = Line | Node | Program | Listen | Callable[..., "OpenLine"]

LINES = {"Line": "stream", "Listen": "connections", "Node": "graph", "Program": "program"}
"""Module of `shell.driving` that opens a line, by the name of the class that describes the line."""
BURST_MAX = BATCH_MAX
"""Largest number of datagrams read from one socket before timers and other sockets have their
turn."""
TOGETHER_MIN = 4
"""Smallest number of datagrams for a batch call; for fewer datagrams, single calls are faster."""
CROWD_MIN = 2 * TOGETHER_MIN
"""A socket is read in batches if this many datagrams arrive within `Endpoint.patience_ns`."""
BATCHES_MAX = 4
"""Largest number of batches read from one socket before timers and other sockets have their
turn."""
SOCKET = itemgetter(2)
"""Function that returns the socket number of a datagram."""
CAME = itemgetter(0)
"""Function that returns the arrival time, from a pair of arrival time and datagram."""
DATAGRAM_BYTES_MAX = 65535
RESOLVE_EVERY_S = 2.0
"""Interval at which host names are resolved again [s]: a restarted host may have a new address."""
CHECK_PATHS_EVERY_S = 1.0
Numbers = dict[Address, Address]
"""Numeric address of each peer, by the peer's address as the user gave it."""


class OpenLine(Protocol):
    """Line: connection of another kind than the UDP sockets of a `Shell`.

    Each module in LINES has `open_line(line, hear, refused) -> OpenLine`: `hear` is called with
    datagrams that arrive together, `refused` with the reason why a sent datagram cannot arrive.
    """

    @property
    def address(self) -> Address | None:
        """Address at which the line accepts connections; None if the line accepts none."""

    def send(self, payload: bytes, peer: Address) -> bool:
        """Send bytes to a peer; False if they cannot be sent now."""
        ...

    async def run(self) -> None:
        """Receive until the task is cancelled."""
        ...


@dataclass(slots=True)
class Arrivals:
    since_ns: int
    count: int = 0


def new_event_loop() -> asyncio.AbstractEventLoop:
    """Event loop: uvloop's if it is installed, otherwise asyncio's."""
    try:
        import uvloop
    except ImportError:
        return asyncio.SelectorEventLoop()  # on Windows, only this loop watches sockets
    return uvloop.new_event_loop()


class Shell:
    """Driver of one endpoint.

    Args:
        bind: address of socket 0 (port 0 takes a free one), or a bound socket; or a list for
            sockets 0, 1 and so on. Further sockets are opened when the endpoint sends from them.
        peers: addresses that the endpoint will send to, with host names or numbers. The endpoint
            sees the addresses as written here, not as the kernel returns them.
        stopwatch: measures the time spent on receiving and on sending.
        forms: forms that datagrams at the bound sockets must have; empty to accept all datagrams.
        control: control socket for changes of keys in flight.
        feed: socket that sends rows and events to readers.
        line: connection to an autopilot, a robot, a program's packets or relayed clients, or a
            function `open_line(hear, refused)` that opens it. It becomes socket 1.
        paths: paths to the endpoint's peers, by socket number. Of several paths, those that cannot
            be opened at once are opened later.
        is_patient: whether to start if the name of a path's peer cannot be resolved yet; the lookup
            is then repeated.
        memory: file for the state that the endpoint keeps for the next run of its process.

    Raises:
        AddressError: an address cannot be bound, or a name cannot be resolved.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        bind: Address | socket | list[Address | socket] | None,
        peers: Sequence[Address] = (),
        stopwatch: Stopwatch | None = None,
        forms: Sequence[Form] = (),
        control: "Control | None" = None,
        feed: "Feed | None" = None,
        line: "AnyLine | None" = None,
        *,
        paths: Mapping[int, NetworkPath] = MappingProxyType({}),
        is_patient: bool = False,
        memory: "MemoryFile | None" = None,
    ) -> None:
        self.endpoint = endpoint
        self._memory = memory
        self._stopwatch = stopwatch or Stopwatch()
        self._control, self._feed = control, feed
        self.send_errors = 0
        self._drops = 0
        """Number of datagrams that the kernel dropped at sockets that are closed now."""
        self._names = Names(peers)
        self._elsewhere = within_reach_of(self._names.numbers())
        self._paths = {
            number: PathSockets(path, is_patient=is_patient) for number, path in paths.items()
        }
        self._watches_paths = any(path.local for path in paths.values()) or len(paths) > 1
        self._sockets: dict[int, socket] = {}
        self.addresses: dict[int, Address] = {}
        """Addresses of the bound sockets and of the paths' sockets, by socket number."""
        self._line: OpenLine | None = None
        bound = bind if isinstance(bind, list) else [bind] if bind else []
        excused = (AddressError,) if len(paths) > 1 else ()
        with contextlib.ExitStack() as failed:
            failed.callback(self._close_sockets)
            for place, each in enumerate(bound):
                number = place + (place > 0 and line is not None)  # socket 1 is the line
                sock = each if isinstance(each, socket) else open_socket(each)
                self._put(number, sock)
                if forms:
                    admit_only(sock, forms)
            for number, path in self._paths.items():
                with contextlib.suppress(*excused):
                    self._put(number, path.open())
            if line is not None:
                self._add(line)
            failed.pop_all()
        self._buffer = memoryview(bytearray(DATAGRAM_BYTES_MAX))
        """Buffer into which all datagrams are read: faster than a new buffer for each datagram."""
        self._batches: dict[int, DatagramBatch | None] = {}
        self._patience_ns = endpoint.patience_ns
        self._arrivals: dict[int, Arrivals] = {}
        self._crowded: dict[int, DatagramBatch] = {}
        """Arrays of the sockets that are read in batches, by socket number."""
        self._heard_ns = 0
        """Newest time passed to the endpoint [ns]; times must not decrease."""
        self._woken_ns = 0
        self._segments = Segments()

    @property
    def address(self) -> Address:
        return self.addresses[0]

    @property
    def is_local(self) -> bool:
        """Whether the bound sockets, the paths and all peers are on this machine."""
        addresses = [*self.addresses.values(), self._elsewhere]
        are_local = [path.is_local for path in self._paths.values()]
        return all(are_local) and all(map(is_loopback, addresses))

    def _put(self, number: int, sock: socket) -> None:
        self.addresses[number] = from_kernel(sock.getsockname())
        self._sockets[number] = sock

    def _close_sockets(self) -> None:
        for sock in self._sockets.values():
            sock.close()
        self._sockets.clear()

    def _names_at(self, number: int) -> Names:
        """Names and numeric addresses of the peers of a socket."""
        path = self._paths.get(number)
        return path.names if path else self._names

    def _add(self, line: "AnyLine") -> None:
        if not isinstance(line, Line) or line.kind in ("tcp", "serial"):
            if callable(line):
                opened = line(self._hear_line, self._hear_refusal)
            else:
                opens = import_module(f"skytether.shell.driving.{LINES[type(line).__name__]}")
                opened = opens.open_line(line, self._hear_line, self._hear_refusal)
            self._line = opened
            if opened.address:
                self.addresses[0] = opened.address
        elif line.kind == "udp":
            self._sockets[1] = open_socket(line.address)
        else:
            self._names.add(line.address)
            self._sockets[1] = open_socket(within_reach_of([self._names.number(line.address)]))

    def _hear_line(self, *datagrams: Datagram) -> None:
        try:
            for datagram in datagrams:
                self.endpoint.receive(datagram, now_ns=time.monotonic_ns())
        finally:
            self._after()

    def _hear_refusal(self, reason: str) -> None:
        try:
            self.endpoint.undelivered(1, reason)
        finally:
            self._after()

    async def run(self, on_event: Callable[[Event], None] = lambda _: None) -> None:
        self._loop = asyncio.get_running_loop()
        self._done = self._loop.create_future()
        self._on_event = on_event
        self._armed: int | None = None
        self._timer = make_timer(self._loop, self._wake)
        self._slices = make_timer(self._loop, self._hear_slice) if self._patience_ns else None
        for number in self._sockets:
            self._listen(number)
        if self._control:
            self._control.begin(self._loop, self.changed)
        if self._feed:
            self._feed.begin(self._loop)
        if self._memory:
            self._memory.begin(self.endpoint, self._loop)
        beside = [
            self._loop.create_task(self._keep_resolving()),
            self._loop.create_task(self._watch_paths()),
        ]
        if self._line:
            beside.append(self._loop.create_task(self._line.run()))
        try:
            self._after()
            await self._done
        finally:
            if self._control:
                self._control.end()
            if self._feed:
                self._feed.end()
            self._timer.close()
            if self._slices:
                self._slices.close()
            self.endpoint.close(now_ns=time.monotonic_ns())
            self._send_all(self.endpoint.outbox())
            if self._memory:
                self._memory.look()
            self._drops = self.kernel_drops()
            for sock in self._sockets.values():
                self._loop.remove_reader(sock)
            self._close_sockets()
            for task in beside:
                task.cancel()

    def kernel_drops(self) -> int:
        return self._drops + sum(map(kernel_drops, self._sockets.values()))

    def _listen(self, number: int) -> None:
        self._loop.add_reader(self._sockets[number], self._hear, number)

    def _hear(self, number: int) -> None:
        """Pass the datagrams at a socket to the endpoint, one by one, at most BURST_MAX."""
        receive, name = self._sockets[number].recvfrom_into, self._names_at(number).name
        buffer, hear, clock_ns = self._buffer, self.endpoint.receive, time.monotonic_ns
        stopwatch, is_refused = self._stopwatch, False
        try:
            for count in range(BURST_MAX):
                stopwatch.start()
                try:
                    size, sender = receive(buffer)
                    peer = name(from_kernel(sender))
                except BlockingIOError:
                    is_refused |= count == 0  # readable without a datagram: an error was pending
                    break
                except OSError:  # ICMP: the peer's port was closed when an earlier packet arrived
                    is_refused = True
                    continue
                stopwatch.lap("receive")
                hear(Datagram(buffer[:size].tobytes(), peer, number), now_ns=clock_ns())
            if is_refused:
                for reason in refusals(self._sockets[number]):
                    self.endpoint.undelivered(number, reason)
                if number not in self._crowded:  # libuv stops watching a socket that has an error
                    self._loop.remove_reader(self._sockets[number])
                    self._listen(number)
            if self._patience_ns:
                self._count(number, count)
        finally:  # the event loop handles an exception, and the flight goes on
            if self._patience_ns:
                self._heard_ns = clock_ns()
            self._after()

    def _count(self, number: int, count: int) -> None:
        """Count datagrams at a socket, and decide whether the socket is read in batches."""
        now_ns = time.monotonic_ns()
        arrivals = self._arrivals.setdefault(number, Arrivals(now_ns))
        if now_ns - arrivals.since_ns >= self._patience_ns:
            if number in self._crowded and arrivals.count < TOGETHER_MIN:
                del self._crowded[number]
                self._listen(number)
            arrivals.count, arrivals.since_ns = 0, now_ns
        arrivals.count += count
        if arrivals.count >= CROWD_MIN and number not in self._crowded:
            self._crowd(number, now_ns)

    def _crowd(self, number: int, now_ns: int) -> None:
        """From now on read a socket in batches, if the system has `recvmmsg`."""
        sock = self._sockets[number]
        batch = self._batch(sock)
        if batch is None or self._slices is None:
            return
        self._crowded[number] = batch
        batch.stamp(sock)
        self._loop.remove_reader(sock)
        self._slices.set(now_ns + self._patience_ns)

    def _hear_slice(self) -> None:
        try:
            self._read_slice()
        finally:
            self._after()

    def _read_slice(self) -> None:
        """Read the datagrams at each socket that is read in batches, in at most BATCHES_MAX calls
        per socket.

        Waking the process for each datagram would take twice the time, because caches are cold
        then. The arrival times are the kernel's timestamps.
        """
        is_left, nothing_came = False, list[int]()
        came: list[tuple[int, Datagram]] = []
        for number, batch in list(self._crowded.items()):
            count, last_ns = BURST_MAX, self._heard_ns
            for read in range(BATCHES_MAX):
                datagrams = self._read_batch(number, batch, last_ns)
                count = len(datagrams)
                last_ns = datagrams[-1][0] if datagrams else last_ns
                if not (count or read):
                    nothing_came.append(number)
                came += datagrams
                if count < BURST_MAX:
                    break
            is_left |= count == BURST_MAX
        came.sort(key=CAME)  # in order of arrival over all sockets
        hear = self.endpoint.receive
        for came_ns, datagram in came:
            self._heard_ns = came_ns
            try:
                hear(datagram, now_ns=came_ns)
            except Exception as error:  # report an exception, and go on with the next datagram
                self._loop.call_exception_handler({"message": str(error), "exception": error})
        for number in nothing_came:
            self._hear(number)  # a plain read, which reports an error if there was one
        if self._crowded and self._slices:
            self._slices.set(time.monotonic_ns() + (0 if is_left else self._patience_ns))

    def _batch(self, sock: socket) -> DatagramBatch | None:
        if sock.family not in self._batches:
            try:
                self._batches[sock.family] = DatagramBatch(sock.family)
            except OSError:
                self._batches[sock.family] = None
        return self._batches[sock.family]

    def _read_batch(
        self, number: int, batch: DatagramBatch, last_ns: int
    ) -> list[tuple[int, Datagram]]:
        """Datagrams that one call reads from a socket, each with its arrival time [ns], in order of
        arrival.

        Args:
            last_ns: arrival time of the datagram read last [ns].
        """
        self._stopwatch.start()
        payloads, raws, came_ns = batch.receive(self._sockets[number])
        if not payloads:
            return []
        self._count(number, len(payloads))
        # Timestamps can be wrong: CLOCK_REALTIME may be changed, and a socket's first datagrams get
        # the time of reading. Times must not fall: datagrams are read in order of arrival.
        now_ns = time.monotonic_ns()
        stamps_ns = [last_ns := min(max(stamp_ns, last_ns), now_ns) for stamp_ns in came_ns]
        try:
            peers = self._names_at(number).heard_all(raws)
        except OSError:  # a network interface is gone
            payloads, peers, stamps_ns = self._still_here(number, payloads, raws, stamps_ns)
        self._stopwatch.lap("receive")
        return [
            (came_ns, make_datagram((payload, peer, number)))
            for came_ns, payload, peer in zip(stamps_ns, payloads, peers, strict=True)
        ]

    def _still_here(
        self,
        number: int,
        payloads: Sequence[bytes],
        raws: Sequence[bytes],
        stamps_ns: Sequence[int],
    ) -> tuple[list[bytes], list[Address], list[int]]:
        """Keep the datagrams from interfaces that still exist."""
        received: list[bytes] = []
        peers: list[Address] = []
        kept_ns: list[int] = []
        for payload, raw, came_ns in zip(payloads, raws, stamps_ns, strict=True):
            with contextlib.suppress(OSError):
                peers.append(self._names_at(number).heard(raw))
                received.append(payload)
                kept_ns.append(came_ns)
        return received, peers, kept_ns

    def _wake(self) -> None:
        self._armed = None
        try:
            if self._crowded:  # datagrams that have arrived are read before due work
                self._read_slice()
            now_ns, due_ns = time.monotonic_ns(), self.endpoint.next_wake_ns()
            if due_ns is not None and due_ns <= now_ns:
                self._heard_ns = self._woken_ns = now_ns
                self.endpoint.wake(now_ns=now_ns)
        finally:
            self._after()

    def leave(self) -> int:
        """Ask the endpoint to end; returns the time at which it must be ended by force [ns]."""
        latest_ns = self.endpoint.leave(now_ns=time.monotonic_ns())
        self._after()
        return latest_ns

    def changed(self) -> None:
        """After a change of the endpoint's keys, send its datagrams and report its events."""
        self._heard_ns = time.monotonic_ns()
        self._after()

    def _after(self) -> None:
        """Send the endpoint's datagrams, arm its timer, and pass on its events and rows."""
        endpoint = self.endpoint
        self._stopwatch.start()
        out = endpoint.outbox()
        if len(out) == 1:
            self._send(out[0])
        elif out:
            self._send_all(out)
        self._stopwatch.lap("send")
        due_ns = endpoint.next_wake_ns()
        if self._crowded and due_ns is not None:
            due_ns = max(due_ns, self._woken_ns + self._patience_ns)
        if due_ns != self._armed:
            self._armed = due_ns
            self._timer.set(due_ns)
        if endpoint.finished and not self._done.done():
            self._done.set_result(None)
        for event in endpoint.events():
            self._on_event(event)
        if self._memory:
            self._memory.look()
        if self._feed:
            self._feed.take()

    def _send_all(self, datagrams: Sequence[Datagram]) -> None:
        """Send datagrams in order; consecutive ones from one socket go in one call."""
        for _, group in groupby(datagrams, SOCKET):
            same = list(group)
            for first in range(0, len(same), BURST_MAX):
                row = same[first : first + BURST_MAX]
                sent = self._send_together(row) if len(row) > 1 else 0
                # The rest is sent one by one, so that a datagram that failed in the batch raises
                # its own error.
                for datagram in row[sent:]:
                    self._send(datagram)

    def _send_together(self, row: Sequence[Datagram]) -> int:
        """Send datagrams of one socket in few calls; returns how many were sent."""
        sock = self._sockets.get(row[0].socket)
        if sock is None:
            return 0
        payloads, peers, _ = zip(*row, strict=True)
        names = self._names_at(row[0].socket)
        try:
            if peers.count(peers[0]) == len(peers) and self._segments.suits(payloads):
                return self._segments.send(sock, payloads, names.kernel(peers[0]))
            batch = self._batch(sock) if len(row) >= TOGETHER_MIN else None
            return batch.send(sock, payloads, list(map(names.raw, peers))) if batch else 0
        except OSError:  # an invalid address
            return 0

    def _send(self, datagram: Datagram) -> None:
        payload, peer, number = datagram
        if self._line and number == 1:
            self.send_errors += not self._line.send(payload, peer)
            return
        try:
            sock = self._sockets.get(number)
            if sock is None:
                if number in self._paths:
                    raise AddressError(self._paths[number].problem or "the path is not open yet")
                sock = self._sockets[number] = open_socket(self._elsewhere)
                heed_refusals(sock)
                self._listen(number)
            sock.sendto(payload, self._names_at(number).kernel(peer))
        except OSError as error:  # buffer full, port closed, network down
            self.send_errors += 1
            self.endpoint.undelivered(number, error.strerror or str(error))

    async def _keep_resolving(self) -> None:
        all_names = [self._names, *(path.names for path in self._paths.values())]
        missing = {peer: why for names in all_names for peer, why in names.missing.items()}
        for (host, _), reason in missing.items():
            self._on_event(HostMissing(host=host, reason=reason))
        while any(names.may_change for names in all_names):
            await asyncio.sleep(RESOLVE_EVERY_S)
            addresses: asyncio.Future[list[Numbers]] = self._loop.create_future()
            # In a thread: at its end, an event loop waits up to 20 s for a lookup in an executor.
            work = all_names, addresses
            threading.Thread(target=self._look_up, args=work, daemon=True).start()
            self._learn(all_names, await addresses)

    def _learn(self, all_names: Sequence[Names], found: Sequence[Numbers]) -> None:
        waiting = [number for number, path in self._paths.items() if path.names.missing]
        late: Numbers = {}
        for names, addresses in zip(all_names, found, strict=True):
            late |= {peer: addresses[peer] for peer in names.missing.keys() & addresses}
            names.learn(addresses)
        for (host, _), (address, _) in late.items():
            self._on_event(HostFound(host=host, address=address))
        for number in waiting:
            # The socket was bound before the peer's address family was known.
            path = self._paths[number]
            if not path.names.missing and path.choose_address():
                self._open_again(number)

    def _open_again(self, number: int) -> None:
        """Open a new socket for a path, instead of the path's old socket."""
        with contextlib.suppress(OSError):  # the path is down again
            before = self._sockets.get(number)
            self._put(number, self._paths[number].open())
            if before:
                self._drops += kernel_drops(before)
                self._loop.remove_reader(before)
                before.close()
            self._listen(number)

    async def _watch_paths(self) -> None:
        while self._watches_paths:
            for number, path in self._paths.items():
                was_up = not path.problem
                is_up = path.check()
                if is_up and path.is_outdated:
                    self._open_again(number)
                if was_up and not is_up:
                    self._on_event(PathMissing(path=str(path.path), reason=path.problem))
                elif is_up and not was_up:
                    self._on_event(PathFound(path=str(path.path)))
            await asyncio.sleep(CHECK_PATHS_EVERY_S)

    def _look_up(self, all_names: Sequence[Names], found: "asyncio.Future[list[Numbers]]") -> None:
        numbers = [names.look_up() for names in all_names]

        def tell() -> None:
            if not found.done():
                found.set_result(numbers)

        with contextlib.suppress(RuntimeError):  # the loop has closed meanwhile
            self._loop.call_soon_threadsafe(tell)


def run(
    shells: list[Shell],
    *,
    on_start: Callable[[], None] = lambda: None,
    on_event: Callable[[Event], None] = lambda _: None,
    on_usr1: Callable[[], None] = lambda: None,
    on_second: Callable[[], None] = lambda: None,
    on_signal: Callable[[int], None] | None = None,
) -> None:
    """Drive several endpoints in this process until all have finished.

    SIGINT or SIGTERM asks the endpoints to end (`Endpoint.leave`); a second signal ends them.

    Args:
        on_start: called once signals are handled, before the endpoints run.
        on_event: called with each event of an endpoint, and with each exception of its code.
        on_usr1: called at SIGUSR1.
        on_second: called about once a second.
        on_signal: called with the number of a signal that is to be passed on to a program.
    """
    # Without `freeze`, garbage collection would scan all imported objects, which takes 13 ms.
    gc.collect()
    gc.freeze()

    async def main() -> None:
        loop = asyncio.get_running_loop()
        task = asyncio.gather(*(shell.run(on_event) for shell in shells))
        leaves = False

        def leave() -> None:
            nonlocal leaves
            left_ns = 0
            if not leaves:
                leaves = True
                left_ns = max(shell.leave() for shell in shells) - time.monotonic_ns()
            loop.call_later(max(left_ns, 0) / SECOND_NS, task.cancel)

        for number in (signal.SIGINT, signal.SIGTERM):
            system.handle(loop, number, leave)
        if on_signal:
            for passed in system.passable():
                system.handle(loop, passed, partial(on_signal, passed))
        # A closed loop restores the default action of SIGUSR1, which would end the process.
        system.on_usr1(lambda *_: loop.call_soon_threadsafe(on_usr1))
        loop.set_exception_handler(lambda _, context: on_event(_fault(context)))

        def tick() -> None:
            loop.call_later(1.0, tick)
            on_second()

        tick()
        on_start()
        try:
            with contextlib.suppress(asyncio.CancelledError):
                await task
        finally:
            system.on_usr1(signal.SIG_IGN)

    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(main())


def _fault(context: dict[str, Any]) -> Fault:
    error = context.get("exception")
    trace = traceback.format_exception(error) if error else [context["message"]]
    return Fault(traceback="".join(trace))
