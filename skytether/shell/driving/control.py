"""Control socket: a Unix socket, usable only by its owner, through which keys change in flight.

Each datagram is a request (`shared.endpoints.change`); the answer is sent back to the sender. The
socket pauses after each request, so that a flood of requests delays the sender, not the endpoint.
An answer that cannot be delivered is dropped.
"""

import asyncio
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from skytether.shared.endpoints.change import REQUEST_BYTES_MAX, Answer, Running
from skytether.shared.events.processes import NotKept
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shell.driving.journal import Journal
from skytether.shell.host import system
from skytether.shell.host.local import Local

NETEMS = ("netem", *(f"netem {number}" for number in range(2, PATHS_MAX + 2)))
"""Names of the netem processes: one for each path of a session, and one for the standby server."""
PROCESSES = ("server", "server 2", *NETEMS, "client")
"""Names of the processes, and of their sockets in a flight's folder."""

REST_S = 0.01
"""Shortest pause after a request [s]."""
RESTS = 20
"""Pause after a request, as a multiple of its duration: requests take at most 1/21 of the time."""
PATIENCE_S = 5.0
"""Longest time to wait for an answer [s]."""
ANSWER_BYTES_MAX = 65_536


class ControlError(OSError):
    """A control socket gave no answer, or an invalid answer; the message has the reason."""


class Control:
    """Server side of a control socket.

    Args:
        path: path of the socket, mode 0600; a socket at which no process listens is replaced.
        running: the endpoint's keys that may change.
        journal: file in which new values are kept for the next run of the process.

    Raises:
        LocalError: the socket cannot be created.
    """

    def __init__(self, path: Path, running: Running, journal: Journal | None = None) -> None:
        self._running, self._journal = running, journal
        self._local = Local(path, socket.SOCK_DGRAM)
        self._socket = self._local.socket
        self._loop: asyncio.AbstractEventLoop | None = None
        self._after: Callable[[], None] = lambda: None

    def begin(self, loop: asyncio.AbstractEventLoop, after: Callable[[], None]) -> None:
        """Answer requests in this event loop; `after` is called after each request."""
        self._loop, self._after = loop, after
        self._listen()

    def _listen(self) -> None:
        if self._loop is not None:
            self._loop.add_reader(self._socket, self._read)

    def _read(self) -> None:
        assert self._loop is not None
        self._loop.remove_reader(self._socket)
        began_s, is_writing = time.monotonic(), False
        try:
            request, sender = self._socket.recvfrom(REQUEST_BYTES_MAX + 1)
            before = self._running.settings
            answer = self._running.answer(request, now_ns=time.monotonic_ns())
            is_writing = self._journal is not None and self._running.settings is not before
            if is_writing:
                # In a thread, so that a slow disk does not delay the endpoint.
                threading.Thread(target=self._keep, args=(answer, sender), daemon=True).start()
            else:
                self._answer(answer, sender)
        except OSError:  # no datagram was there
            pass
        finally:
            if not is_writing:
                rest_s = max(REST_S, RESTS * (time.monotonic() - began_s))
                self._loop.call_later(rest_s, self._listen)
            self._after()

    def _keep(self, answer: bytes, sender: Any) -> None:
        """Write new values to the journal, then acknowledge them; runs in a thread."""
        assert self._journal is not None
        fault = ""
        try:
            self._journal.write(self._running.settings)
        except OSError as error:
            fault = str(error.strerror or error)
            message = f"it is in force, but will be lost when the process restarts: {fault}"
            answer = msgspec.json.encode(Answer(refused=message))
        self._answer(answer, sender)
        if loop := self._loop:
            with suppress(RuntimeError):  # the loop has closed meanwhile
                loop.call_soon_threadsafe(self._go_on, fault)

    def _go_on(self, fault: str) -> None:
        if fault:
            self._running.tell(NotKept(reason=fault))
        if self._loop is not None:
            self._loop.call_later(REST_S, self._listen)
        self._after()

    def _answer(self, answer: bytes, sender: Any) -> None:
        if sender:
            with suppress(OSError):  # the sender's socket is full or gone
                self._socket.sendto(answer, sender)

    def end(self) -> None:
        if self._loop is not None:
            self._loop.remove_reader(self._socket)
            self._loop = None

    def close(self) -> None:
        """Remove the socket, unless another process has replaced it."""
        self._local.close()


class Caller:
    """Client side of a control socket.

    Args:
        path: socket of a server, netem or client.

    Raises:
        ControlError: no process listens there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._socket = system.local_socket(socket.SOCK_DGRAM)
        except OSError as error:
            raise self._failed(error) from None
        try:
            self._folder = _answers(self._socket, path)
        except OSError as error:
            self._socket.close()
            raise self._failed(error) from None
        try:
            self._socket.settimeout(PATIENCE_S)
            self._socket.connect(str(path))
        except OSError as error:
            self.close()
            raise self._failed(error) from None

    def ask(self, values: Mapping[str, Any]) -> Answer:
        """Request new values; without values, request the list of keys that may change.

        Raises:
            ControlError: no answer arrived.
        """
        try:
            self._socket.send(msgspec.json.encode(values))
            answer = self._socket.recv(ANSWER_BYTES_MAX)
        except OSError as error:
            raise self._failed(error) from None
        try:
            return answer_of(answer)
        except ControlError as error:
            raise ControlError(f"{self._path}: {error}") from None

    def close(self) -> None:
        self._socket.close()
        self._folder.cleanup()

    def _failed(self, error: OSError) -> ControlError:
        reason = error.strerror or str(error)
        if isinstance(error, TimeoutError):
            reason = f"no answer in {PATIENCE_S:g} s"
        elif isinstance(error, FileNotFoundError | ConnectionRefusedError):
            expected = "expected the --control socket of a server, netem or client that runs"
            reason = f"no process listens there ({reason}), {expected}"
        return ControlError(f"{self._path}: {reason}")


def _answers(sock: socket.socket, path: Path) -> "tempfile.TemporaryDirectory[str]":
    """Bind a socket to a new path, at which answers arrive; returns the new folder of this path.

    The folder is beside the control socket, because a process in another container may have no
    access to other folders. If it cannot be created there, it is created as a temporary folder.

    Raises:
        OSError: the address cannot be created anywhere.
    """
    for beside in (path.parent.absolute(), None):
        with suppress(OSError):
            folder = tempfile.TemporaryDirectory(prefix=".skytether-", dir=beside)
            try:
                sock.bind(str(Path(folder.name) / "answers"))
            except OSError:
                folder.cleanup()
            else:
                return folder
    raise OSError("no socket for the answer can be created")


_DECODER = msgspec.json.Decoder(Answer)


def answer_of(text: bytes) -> Answer:
    try:
        return _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ControlError("got an answer that is not from skytether") from None


@contextmanager
def controlled(path: Path, running: Running, journal: Journal | None = None) -> Iterator[Control]:
    """Control socket that exists during the block.

    Raises:
        LocalError: the socket cannot be created.
    """
    control = Control(path, running, journal)
    try:
        yield control
    finally:
        control.close()
