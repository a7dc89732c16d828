"""Programs of the runs, forked from a process that has imported all modules: `python -m
bench.policies.forks SOCKET MODULE…`. The CPU time of imports would disturb the other runs.

A run starts the command `line(...)`, a Python process without modules. It passes its namespaces,
output and arguments to the process above, which forks, and waits for the exit code.
"""

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TextIO

from skytether.shell.commandline import start
from skytether.shell.driving import program
from skytether.shell.host import system
from skytether.shell.processes.workers import die_with_parent

CALLER = """
import os, socket, sys
kinds = ("user", "net")
line = socket.socket(socket.AF_UNIX)
line.connect(sys.argv[1])
fds = [os.open(f"/proc/self/ns/{kind}", os.O_RDONLY) for kind in kinds]
socket.send_fds(line, ["\\0".join(sys.argv[2:]).encode()], [*fds, 1, 2])
sys.exit(int(line.recv(16) or b"1"))
"""
NAMESPACES = {"user": 0x10000000, "net": 0x40000000}
"""Flag of setns(2) for each kind of namespace."""
BYTES_MAX = 65_536


def line(path: str, function: str, arguments: Sequence[str]) -> list[str]:
    """Command that calls a function with arguments.

    Args:
        path: socket of the process that forks.
        function: the function as "module:name".
    """
    return [sys.executable, "-I", "-S", "-c", CALLER, path, function, *arguments]


@contextmanager
def forked(function: Callable[[], object]) -> Iterator[tuple[int, TextIO]]:
    """Run a function in a forked process, which is ended after the block; yields its process ID and
    its output.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        die_with_parent()
        os._exit(_code(function, [os.open(os.devnull, os.O_RDONLY), writing]))
    os.close(writing)
    with os.fdopen(reading) as output:
        try:
            yield pid, output
        finally:
            os.kill(pid, signal.SIGTERM)
            os.waitpid(pid, 0)


def _code(function: Callable[[], object], streams: Sequence[int]) -> int:
    """Exit code of a function that is called with these files as standard streams."""
    for number, file in enumerate(streams):
        os.dup2(file, number)
    sys.stdin, sys.stdout, sys.stderr = (
        os.fdopen(number, "w" if number else "r", closefd=False) for number in range(3)
    )
    code = 0
    try:
        function()
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:  # whatever it is, the process must not return to the caller's code
        traceback.print_exc()
        code = 1
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    return code


def _serve(connection: socket.socket) -> None:
    """Call the function that the process at the other end asks for, in the namespaces of that
    process; does not return.
    """
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    said, files, _, _ = socket.recv_fds(connection, BYTES_MAX, 4)
    name, *arguments = said.decode().split("\0")
    for (kind, flag), file in zip(NAMESPACES.items(), files, strict=False):
        if not os.path.samestat(os.fstat(file), Path(f"/proc/self/ns/{kind}").stat()):
            system.LIBC.setns(file, flag)

    def call() -> None:
        module, _, function = name.partition(":")
        sys.exit(getattr(import_module(module), function)(arguments))

    def watch() -> None:
        if not connection.recv(1):  # the process at the other end has ended
            os.kill(os.getpid(), signal.SIGTERM)

    for each in (start, program):  # the parent of the command
        each.PARENT = os.getppid()  # type: ignore[attr-defined]
    threading.Thread(target=watch, daemon=True).start()
    code = _code(call, [os.open(os.devnull, os.O_RDONLY), *files[2:]])
    with suppress(OSError):
        connection.send(str(code).encode())
    os._exit(code)


@contextmanager
def forking(path: str, modules: Sequence[str]) -> Iterator[None]:
    """In the block, a process with these modules forks programs at the socket `path`."""
    command = [sys.executable, "-P", "-m", __name__, path, *modules]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as running:
        assert running.stdout
        running.stdout.readline()  # it listens
        try:
            yield
        finally:
            running.terminate()


def main(path: str, modules: Sequence[str]) -> None:
    die_with_parent()
    for name in modules:
        import_module(name)
    # In each program, garbage collection would scan all these objects, which takes 13 ms.
    gc.collect()
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen(128)
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        print("listening", flush=True)
        while True:
            connection, _ = listening.accept()
            if os.fork() == 0:
                listening.close()
                _serve(connection)
            connection.close()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
