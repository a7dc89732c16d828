"""Program in its own namespaces, and both ends of its network: device and slirp4netns.

    program ── TUN device ── netem ── slirp4netns ── this machine's sockets

slirp4netns translates packets to sockets of this machine, as for a virtual machine. It gets
Ethernet frames through a Unix socket, as from User Mode Linux, and so needs no namespace.
`shell.driving.inside` has the program's side.
"""

import asyncio
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from skytether.shared.base.packets import (
    ADDRESS,
    OUTSIDE,
    PROGRAM,
    announcements,
    framed,
    unframed,
)
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shell.commandline.start import PARENT
from skytether.shell.driving.inside import ADMIN, ALL_ENDED, ENDED, READY, START
from skytether.shell.host import system, temporary
from skytether.shell.host.batch import BATCH_MAX
from skytether.shell.host.udp import BUFFER_BYTES

SLIRP = "slirp4netns"
GUARDED = """
ulimit -n "$(ulimit -Hn)"
exec 9<&0 </dev/null
(read -r _ <&9; kill -9 0) &
exec "$@" 9<&-
"""
"""Shell script that raises the limit of open files (slirp4netns needs one per flow), starts a guard
that kills slirp4netns when netem ends, and becomes slirp4netns. Only netem and the guard have the
two ends of the script's standard input, so each notices when the other ends. `--exit-fd` has no
effect before netem connects."""
FRAME_BYTES_MAX = 65_536
WAITING_MAX = 16_384
"""Largest number of packets waiting for slirp4netns; further packets count as send errors."""
PATIENCE_S = 30.0
"""Longest time for slirp4netns to start [s]."""
GRACE_S = 1.0
"""Time between SIGHUP and SIGKILL for the program after netem's parent has ended [s]."""
FLUSH_S = 1.0
"""Longest time at the end for slirp4netns to read the last packets [s]."""


class ProgramError(Exception):
    """The program cannot be started, or has lost its network; the message has one line."""


@dataclass(slots=True)
class Program:
    device: int
    """File descriptor of the program's TUN device."""
    outside: socket.socket
    """Connection to slirp4netns, with one Ethernet frame in each packet."""
    guard: socket.socket
    """Connection to the guard of slirp4netns (`GUARDED`): readable once the guard has ended."""
    control: socket.socket
    """Connection to process 1 of the program's namespaces."""
    status: int | None = None
    """Status of `os.waitpid`; None until the program has ended."""
    fault: str = ""
    """Reason why the program has lost its network; empty otherwise."""
    outlives_parent: bool = False
    """Whether the program continues after netem's parent process has ended, as under `nohup`."""

    def start(self) -> None:
        self.control.send(START)

    def signal(self, number: int) -> None:
        """Send the program a signal; after the program's end, any signal ends its children."""
        with suppress(OSError):
            self.control.send(bytes([number]))
        if number == signal.SIGTSTP:  # the shell waits until netem has stopped, too
            os.kill(os.getpid(), signal.SIGSTOP)


@contextmanager
def program(
    command: Sequence[str], mtu: int, *, path_mtu: int, exposed: Sequence[Address]
) -> Iterator[Program]:
    """Create namespaces for a program, which starts with `Program.start` and ends with the block.

    Args:
        mtu: MTU of the program's device [B].
        path_mtu: largest packet that slirp4netns sends to the program [B].
        exposed: addresses on this machine; TCP and UDP to them go to the same port of the program.

    Raises:
        ProgramError: something is missing, or an address cannot be exposed.
    """
    if sys.platform != "linux":
        raise ProgramError(
            "needs the namespaces of Linux; elsewhere use `skytether netem --server`"
        )
    with ExitStack() as stack:
        outside, guard = stack.enter_context(_slirp(path_mtu, exposed))
        control, inner = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        inner.set_inheritable(True)
        # Files that a shell has opened for the program, as in `<(command)`, are passed on.
        start = [sys.executable, "-P", "-m", "skytether.shell.driving.inside"]
        start += [str(inner.fileno()), str(mtu), *command]
        inside = subprocess.Popen(start, close_fds=False)
        stack.callback(inside.wait)
        stack.enter_context(control)
        inner.close()
        said, devices, _, _ = socket.recv_fds(control, 4096, 1)
        if said != READY:
            raise ProgramError(said.decode(errors="replace") or "its namespaces could not be made")
        stack.callback(os.close, devices[0])
        control.setblocking(False)
        outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        yield Program(devices[0], outside, guard, control, outlives_parent=outlives)


@contextmanager
def _slirp(mtu: int, exposed: Sequence[Address]) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Connections to slirp4netns and to its guard during the block."""
    found = shutil.which(SLIRP, path=os.environ.get("PATH", "") + ADMIN)
    if found is None:
        raise ProgramError(
            f"{SLIRP} is missing, which connects namespaces to the network (apt install {SLIRP}, "
            f"dnf install {SLIRP})"
        )
    guard, guard_end = socket.socketpair()
    with ExitStack() as stack:
        stack.enter_context(guard)
        outside = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        with temporary.folder() as folder, (folder / "said").open("w+b") as said:
            frames, orders = folder / "frames", folder / "orders"
            command = [found, "--target-type=bess", "--enable-ipv6", f"--mtu={mtu}"]
            command += [f"--api-socket={orders}", str(frames)]
            slirp = subprocess.Popen(
                ["sh", "-c", GUARDED, "sh", *command],
                stdin=guard_end.fileno(),
                stdout=said,
                stderr=said,
                start_new_session=True,  # Ctrl-C is for the program
            )
            stack.callback(_end_group, slirp)
            guard_end.close()
            _connect(outside, frames, slirp, said)

            def order(execute: str, **arguments: object) -> bool:
                asked = json.dumps({"execute": execute, "arguments": arguments})
                with socket.socket(socket.AF_UNIX) as sock:
                    _connect(sock, orders, slirp, said)
                    sock.send(asked.encode())
                    sock.shutdown(socket.SHUT_WR)
                    return "return" in json.loads(sock.recv(4096) or b"{}")

            order("list_hostfwd")  # slirp4netns needs the folder until it answers
            for address in exposed:
                _expose(order, address)
        for each in announcements():
            outside.send(each)
        outside.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        outside.setblocking(False)
        yield outside, guard
        _flush(outside)


def _end_group(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process that leads a process group, and the rest of the group."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _connect(
    sock: socket.socket, path: Path, slirp: "subprocess.Popen[bytes]", said: IO[bytes]
) -> None:
    """Connect to a socket of slirp4netns as soon as it exists."""
    until_s = time.monotonic() + PATIENCE_S
    while slirp.poll() is None and time.monotonic() < until_s:
        try:
            sock.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError):
            time.sleep(0.002)
        else:
            return
    raise _failed(said)


def _failed(said: IO[bytes]) -> ProgramError:
    said.seek(0)
    lines = said.read().decode(errors="replace").split("\n")
    what = next((line for line in lines if "unrecognized" in line), " ".join(lines).strip())
    return ProgramError(f"{SLIRP} does not start, expected version 1.2 or later: {what}")


def _expose(order: Callable[..., bool], address: Address) -> None:
    host, port = address
    at = {"host_addr": host, "host_port": port, "guest_addr": str(ADDRESS), "guest_port": port}
    for protocol, kind in (("tcp", socket.SOCK_STREAM), ("udp", socket.SOCK_DGRAM)):
        if not order("add_hostfwd", proto=protocol, **at):
            what = f"--expose: cannot listen on {host}:{port} ({protocol})"
            raise ProgramError(f"{what}: {_why_not(kind, address)}")


def _why_not(kind: socket.SocketKind, address: Address) -> str:
    """Reason why listening on an address fails; slirp4netns does not report the reason."""
    try:
        with socket.socket(socket.AF_INET, kind) as sock:
            sock.bind(address)
    except OSError as error:
        return error.strerror or str(error)
    return f"{SLIRP} refuses it"


def _flush(outside: socket.socket) -> None:
    """Wait until slirp4netns has read all packets that were sent."""
    until_s, left = time.monotonic() + FLUSH_S, struct.pack("i", 1)
    while any(left) and time.monotonic() < until_s:
        left = system.fcntl.ioctl(outside, system.termios.TIOCOUTQ, left)
        if any(left):
            time.sleep(0.001)


class ProgramLine:
    """Connection for a program's packets, beside the sockets of a `Shell`.

    Args:
        hear: called with packets that have arrived together, see `netem.tunnel.Tunnel`.
    """

    address = None

    def __init__(self, program: Program, hear: Callable[..., None]) -> None:
        self._program, self._hear = program, hear
        self._waiting: deque[bytes] = deque()
        """Frames that slirp4netns cannot take yet."""
        self._buffer = memoryview(bytearray(FRAME_BYTES_MAX))

    def send(self, payload: bytes, peer: Address) -> bool:
        """Send a packet; False if the packet is invalid, or too many packets wait."""
        try:
            if peer == PROGRAM:
                return os.write(self._program.device, payload) == len(payload)
            frame = framed(payload)
            if not self._waiting:
                try:
                    return self._program.outside.send(frame) > 0
                except BlockingIOError:
                    self._loop.add_writer(self._program.outside, self._send_waiting)
        except OSError:
            return False
        if len(self._waiting) >= WAITING_MAX:
            return False
        self._waiting.append(frame)
        return True

    def _send_waiting(self) -> None:
        with suppress(OSError):
            while self._waiting:
                self._program.outside.send(self._waiting[0])
                self._waiting.popleft()
            self._loop.remove_writer(self._program.outside)

    async def run(self) -> None:
        self._loop = loop = asyncio.get_running_loop()
        program, parent = self._program, self._watch_parent()
        loop.add_reader(program.device, self._read_device)
        loop.add_reader(program.outside, self._read_outside)
        loop.add_reader(program.control, self._read_control)
        loop.add_reader(program.guard, self._end, f"the guard of {SLIRP} has ended")
        program.start()
        try:
            await loop.create_future()
        finally:
            self._send_waiting()
            loop.remove_writer(program.outside)
            for each in (program.device, program.outside, program.control, program.guard, parent):
                if each is not None:
                    loop.remove_reader(each)
            if parent is not None:
                os.close(parent)

    def _read_device(self) -> int:
        """Read packets of the program and pass them on; returns the number of packets."""
        buffer, packets = self._buffer, list[Datagram]()
        with suppress(OSError):
            while len(packets) < BATCH_MAX:
                size = os.readv(self._program.device, [buffer])
                packets.append(Datagram(buffer[:size].tobytes(), PROGRAM, 1))
        self._hear(*packets)
        return len(packets)

    def _read_outside(self) -> None:
        buffer, packets = self._buffer, list[Datagram]()
        with suppress(OSError):
            for _ in range(BATCH_MAX):
                try:
                    size = self._program.outside.recv_into(buffer)
                except ConnectionError:
                    size = 0
                if not size:
                    self._end(f"{SLIRP} has ended: the program has no network any more")
                    return
                packet = unframed(buffer[:size].tobytes())
                if packet is not None:
                    packets.append(Datagram(packet, OUTSIDE, 1))
        self._hear(*packets)

    def _read_control(self) -> None:
        with suppress(BlockingIOError):
            message = self._program.control.recv(64)
            if message.startswith(ENDED):
                (self._program.status,) = struct.unpack("<i", message[len(ENDED) :])
            elif message == ALL_ENDED:
                while self._read_device():  # the program's last packets
                    pass
                self._hear(Datagram(b"", PROGRAM, 1))
            else:
                self._end("" if self._program.status is not None else "its namespaces have ended")

    def _end(self, fault: str) -> None:
        self._program.fault = fault
        for each in (self._program.outside, self._program.control, self._program.guard):
            self._loop.remove_reader(each)
        self._hear(Datagram(b"", OUTSIDE, 1))

    def _watch_parent(self) -> int | None:
        """File that is readable once netem's parent has ended; None under `nohup`."""
        if self._program.outlives_parent:
            return None
        try:
            parent = os.pidfd_open(PARENT)
        except (AttributeError, OSError) as error:  # Linux before 5.3, or the parent has ended
            if isinstance(error, ProcessLookupError):
                self._loop.call_soon(self._orphan)
            return None
        self._loop.add_reader(parent, self._orphan, parent)
        return parent

    def _orphan(self, parent: int | None = None) -> None:
        if parent is not None:
            self._loop.remove_reader(parent)
        self._program.signal(signal.SIGHUP)
        self._loop.call_later(GRACE_S, self._end, "the process that started it has ended")


def open_line(program: Program, hear: Callable[..., None], _: object) -> ProgramLine:
    """Connect to a program's network, see `shell.driving.driver.OpenLine`."""
    return ProgramLine(program, hear)
