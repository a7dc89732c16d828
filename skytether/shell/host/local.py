"""Unix sockets that only their owner can use; closing a socket removes its file."""

import os
import socket
import stat
from contextlib import suppress
from errno import EADDRINUSE, ECONNREFUSED
from pathlib import Path

from skytether.shell.host import system


class LocalError(OSError):
    """A Unix socket cannot be created; the message has the path and the reason."""


class Local:
    """Non-blocking Unix socket, bound to a path with mode 0600.

    Args:
        path: path of the socket; a socket at which no process listens is replaced, and a missing
            folder is created.
        kind: SOCK_DGRAM or SOCK_STREAM.

    Raises:
        LocalError: the socket cannot be created.
    """

    def __init__(self, path: Path, kind: socket.SocketKind) -> None:
        self._path = path
        try:
            self.socket = system.local_socket(kind)
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}") from None
        try:
            self.socket.setblocking(False)
            path.parent.mkdir(0o700, parents=True, exist_ok=True)
            _clear(path, kind)
            before = os.umask(0o177)
            try:
                self.socket.bind(str(path))
            finally:
                os.umask(before)
            status = path.lstat()
        except OSError as error:
            self.socket.close()
            reason = (
                "another process listens there" if error.errno == EADDRINUSE else error.strerror
            )
            raise LocalError(f"{path}: cannot create the socket: {reason or error}") from None
        self._made = status.st_dev, status.st_ino

    def close(self) -> None:
        """Remove the socket, unless another process has replaced it."""
        self.socket.close()
        with suppress(OSError):
            status = self._path.lstat()
            if (status.st_dev, status.st_ino) == self._made:
                self._path.unlink()


def _clear(path: Path, kind: socket.SocketKind) -> None:
    """Remove a socket of this user at which no process listens; refuse any other file.

    Raises:
        OSError: the path is in use.
    """
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(status.st_mode) or status.st_uid != system.user():
        raise OSError("expected a new path, or a socket that is no longer in use")
    with system.local_socket(kind) as caller:
        caller.setblocking(False)  # a listener whose queue is full counts as alive
        if caller.connect_ex(str(path)) == ECONNREFUSED:
            path.unlink()
