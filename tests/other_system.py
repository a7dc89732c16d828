"""Run Skytether as on another operating system: without what that system's Python does not have.

    python tests/other_system.py windows|macos COMMAND…

COMMAND is `skytether`'s; `--everything` imports each module and uses the library instead.
"""

import asyncio
import os
import pkgutil
import signal
import socket
import sys
import tempfile
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import Any

# Imported before: they have other ways on other systems.
BEFORE = (
    *("multiprocessing", "concurrent.futures", "subprocess", "shutil", "tempfile", "ctypes"),
    *("platform", "getpass", "http.server", "socketserver", "webbrowser", "urllib.request", "uuid"),
    *("numpy", "numba", "numba.core.caching", "gymnasium", "matplotlib.pyplot", "scipy.optimize"),
    *("osqp", "msgspec", "tyro", "rich.console", "pytest", "prometheus_client", "pymavlink"),
)
LINUX = "sched_getaffinity sched_setaffinity memfd_create pidfd_open eventfd posix_fallocate"
POSIX = (
    "O_NOFOLLOW O_NONBLOCK O_CLOEXEC O_DIRECTORY O_TMPFILE O_NOCTTY fchmod fchown chown getuid "
    "geteuid getgid killpg fork forkpty openpty mkfifo uname pread pwrite setsid getloadavg "
    "get_blocking set_blocking statvfs sysconf nice WIFSIGNALED WTERMSIG getpgid ttyname"
)
SIGNALS = (
    "SIGUSR1 SIGUSR2 SIGHUP SIGQUIT SIGALRM SIGCHLD SIGPIPE SIGKILL SIGSTOP SIGCONT SIGTSTP "
    "SIGXFSZ SIGWINCH pthread_sigmask SIG_BLOCK SIG_UNBLOCK SIG_SETMASK sigwait setitimer"
)
SOCKETS = "SO_BINDTODEVICE MSG_ERRQUEUE AF_PACKET AF_NETLINK"
UNIX_SOCKETS = "AF_UNIX SO_REUSEPORT recv_fds send_fds MSG_DONTWAIT SCM_RIGHTS sendmsg recvmsg"
MODULES = ("fcntl", "termios", "resource", "pwd", "grp", "tty", "pty", "uvloop")


def without(module: ModuleType, names: str) -> None:
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)


def become(name: str) -> None:
    for each in BEFORE:
        with suppress(ImportError):
            import_module(each)
    without(os, LINUX)
    without(socket, SOCKETS)
    if name == "windows":
        pair, unix = socket.socketpair, socket.AF_UNIX
        tempfile._O_TMPFILE_WORKS = False  # type: ignore[attr-defined]
        without(os, POSIX)
        without(signal, SIGNALS)
        without(socket, UNIX_SOCKETS)
        # What event loops here need themselves.
        socket.socketpair = lambda *_: pair(unix)
        asyncio.SelectorEventLoop.add_signal_handler = not_there  # type: ignore[method-assign]
        for each in MODULES:
            sys.modules[each] = None  # type: ignore[assignment]
    sys.platform = {"windows": "win32", "macos": "darwin"}[name]


def not_there(*_: Any) -> None:
    raise NotImplementedError


def everything() -> None:
    import skytether

    for module in pkgutil.walk_packages(skytether.__path__, "skytether."):
        import_module(module.name)
    import gymnasium

    import skytether.gym

    environment = gymnasium.make("Pendulum-v1")
    networked = skytether.gym.Networked(environment)
    networked.reset(seed=1)
    networked.step(networked.action_space.sample())
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        skytether.bad_network("constant(0.01)", to=listener.getsockname(), tcp=True) as net,
        socket.create_connection(net.address) as near,
    ):
        near.sendall(b"hello")
        with listener.accept()[0] as far:
            assert far.recv(5) == b"hello"
    flight = skytether.fly("demo", duration=3.0, settle=1.0)
    print(f"{flight.summary.rmse_xy:.3f} m")


if __name__ == "__main__":
    become(sys.argv[1])
    if sys.argv[2:] == ["--everything"]:
        everything()
    else:
        from skytether.__main__ import main

        sys.exit(main(sys.argv[2:]))
