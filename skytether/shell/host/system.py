"""Features that not every operating system has; only this module checks for them.

Flights in virtual time, the environments of `skytether.gym`, netem's relay and its pytest fixture
run on every system with Python and numba. Other modules ask this module which features exist.
"""

import ctypes
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from errno import EAFNOSUPPORT
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # `start` imports this module first, so it imports nothing slow
    import asyncio


def _module(name: str) -> Any:
    """Module of the standard library; None if this system lacks the module."""
    try:
        return import_module(name)
    except ImportError:
        return None


fcntl, resource, termios, tty = map(_module, ("fcntl", "resource", "termios", "tty"))
LIBC: Any = None if sys.platform == "win32" else ctypes.CDLL(None, use_errno=True)
"""C library of this system; None on Windows."""
SERIAL_ERROR: type[Exception] = OSError if termios is None else termios.error
"""Type of the error raised for a file that is not a serial port."""
FORKS = hasattr(os, "fork")
"""Whether this system has `fork`; without it, flights over UDP are not started."""


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def signals(*names: str) -> tuple[signal.Signals, ...]:
    """Signals by their names, without those that this system lacks."""
    return tuple(signal.Signals[name] for name in names if hasattr(signal, name))


def passable() -> tuple[int, ...]:
    """Signals that a process can pass on to another.

    Excluded are signals that cannot be handled, that report on the process itself (faults,
    children, files and terminal), and SIGUSR1, which asks for counters.
    """
    own = ("SIGKILL", "SIGSTOP", "SIGUSR1", "SIGCHLD", "SIGPIPE", "SIGXFSZ", "SIGTTIN", "SIGTTOU")
    faults = ("SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGSEGV", "SIGSYS", "SIGTRAP")
    return tuple(sorted(signal.valid_signals() - {*signals(*own, *faults)}))


def user() -> int:
    """Number of the user who owns this process's files; 0 on a system without user numbers."""
    return os.geteuid() if hasattr(os, "geteuid") else 0


def handle(loop: "asyncio.AbstractEventLoop", number: int, action: Callable[[], object]) -> None:
    """Call a function in an event loop at a signal."""
    try:
        loop.add_signal_handler(number, action)
    except NotImplementedError:  # on Windows, whose loops handle no signals
        signal.signal(number, lambda *_: loop.call_soon_threadsafe(action))


@contextmanager
def blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals during the `with` block, also in processes that it starts."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)


def local_socket(kind: socket.SocketKind) -> socket.socket:
    """Unix socket.

    Raises:
        OSError: this system has no Unix sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        raise OSError(EAFNOSUPPORT, f"needs Unix sockets, which this system ({sys.platform}) lacks")
    return socket.socket(socket.AF_UNIX, kind)


def on_usr1(handler: Callable[[int, Any], Any] | signal.Handlers) -> None:
    """Set the handler of SIGUSR1, on systems with this signal."""
    for number in signals("SIGUSR1"):
        signal.signal(number, handler)


def files_max() -> int:
    """Largest number of open files to which this process may raise its limit."""
    if resource is None:
        return sys.maxsize
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if hard == resource.RLIM_INFINITY else hard


def allow_files(count: int) -> None:
    """Raise the limit of open files, as far as the system allows."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and count > soft:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(count, files_max()), hard))


def dump_no_core() -> None:
    """Turn off core dumps for this process."""
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def be_nice(by: int) -> None:
    """Lower this process's priority, on systems with `nice`."""
    if hasattr(os, "nice"):
        os.nice(by)
