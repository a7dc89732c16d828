"""The socket through which keys are changed in flight: a Unix one, that its owner alone can use.

A datagram is a request of `shared.core.change`, and its answer goes back to whoever has sent it.
After each request the socket rests: whoever floods it waits, and the endpoint does not. An answer
that nobody takes is not kept.
"""

import asyncio
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from skytether.shared.core.change import REQUEST_BYTES_MAX, Answer, Running
from skytether.shell.local import Local

REST_S = 0.01
"""Least time from a request to the next that is read [s]."""
RESTS = 20
"""Ratio of that time to the time that the request took, at least: requests cost the endpoint no
more than a 21st of its time."""
PATIENCE_S = 5.0
"""Longest time to wait for an answer [s]."""
ANSWER_BYTES_MAX = 65_536
"""Largest size of an answer [B]."""


class ControlError(OSError):
    """Error: nobody answers at the socket; the message says why."""


class Control:
    """Heeds requests to an endpoint.

    Args:
        path: where the socket is made, with mode 0600; in place of one that nobody listens at.
        running: what may be changed.

    Raises:
        LocalError: it cannot be made there.
    """

    def __init__(self, path: Path, running: Running) -> None:
        self._running = running
        self._local = Local(path, socket.SOCK_DGRAM)
        self._socket = self._local.socket
        self._loop: asyncio.AbstractEventLoop | None = None
        self._after: Callable[[], None] = lambda: None

    def begin(self, loop: asyncio.AbstractEventLoop, after: Callable[[], None]) -> None:
        """Heed requests from now on.

        Args:
            loop: where it is woken.
            after: called after each request.
        """
        self._loop, self._after = loop, after
        self._listen()

    def _listen(self) -> None:
        if self._loop is not None:
            self._loop.add_reader(self._socket, self._read)

    def _read(self) -> None:
        assert self._loop is not None
        self._loop.remove_reader(self._socket)
        began_s = time.monotonic()
        try:
            request, sender = self._socket.recvfrom(REQUEST_BYTES_MAX + 1)
            answer = self._running.answer(request, now_ns=time.monotonic_ns())
            if sender:
                self._socket.sendto(answer, sender)
        except OSError:  # nothing there after all, or nobody takes the answer
            pass
        finally:
            rest_s = max(REST_S, RESTS * (time.monotonic() - began_s))
            self._loop.call_later(rest_s, self._listen)
            self._after()

    def end(self) -> None:
        """Heed no more requests."""
        if self._loop is not None:
            self._loop.remove_reader(self._socket)
            self._loop = None

    def close(self) -> None:
        """Remove the socket, if it is still ours."""
        self._local.close()


class Caller:
    """Asks for changes at a socket.

    Args:
        path: the socket of a server, netem or client.

    Raises:
        ControlError: nobody listens there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
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
        """Ask for other values, or without any for those that may change.

        Raises:
            ControlError: no answer has come.
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
        """Ask no more."""
        self._socket.close()
        self._folder.cleanup()

    def _failed(self, error: OSError) -> ControlError:
        late = f"no answer in {PATIENCE_S:g} s" if isinstance(error, TimeoutError) else None
        return ControlError(f"{self._path}: {late or error.strerror or error}")


def _answers(sock: socket.socket, path: Path) -> "tempfile.TemporaryDirectory[str]":
    """Bind a socket to an address for answers that is nobody else's; returns its folder.

    It lies beside the socket that is asked: in another container whoever answers may see no other
    folder of ours. Where nothing can be made there, it is a temporary one.

    Raises:
        OSError: there is no place for it.
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
    raise OSError("no address for answers can be made")


_DECODER = msgspec.json.Decoder(Answer)


def answer_of(text: bytes) -> Answer:
    """The answer in a datagram.

    Raises:
        ControlError: it is none.
    """
    try:
        return _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ControlError("whoever listens there answers as no process of ours does") from None


@contextmanager
def controlled(path: Path | None, running: Running) -> Iterator[Control | None]:
    """A socket at a path for as long as the block takes; none without a path.

    Raises:
        LocalError: it cannot be made.
    """
    if path is None:
        yield None
        return
    control = Control(path, running)
    try:
        yield control
    finally:
        control.close()
