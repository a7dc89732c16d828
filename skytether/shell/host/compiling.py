"""Compilation of kernels, with one process per core.

Numba compiles one function at a time in a process. So other processes compile at the same time, and
store machine code on disk, which this process then reads. Each process takes the next kernel from a
queue, because compile times are not known beforehand. A second command waits for the first, and
loads what the first has compiled.
"""

import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from skytether.shared.base import files, input_files
from skytether.shell.host import system

# for type checking only: on a vehicle the client is installed without numba
if TYPE_CHECKING:
    from skytether.shared.base.machine_code import Missing

LOCK = "compiling.lock"
POLL_S = 0.1
"""Time between two attempts to get the lock [s]."""


@contextmanager
def alone(folder: Path | None, on_wait: Callable[[], None]) -> Iterator[None]:
    """During the block, keep other commands from compiling machine code for the same folder.

    Args:
        folder: folder of the stored machine code; None if no code is stored.
        on_wait: called once if another command is compiling.
    """
    try:
        lock = folder and (folder / LOCK).open("ab")
    except OSError:  # the folder is read-only
        lock = None
    if not lock:
        yield
        return
    with lock:
        waits = False
        while not _locked(lock.fileno()):
            if not waits:
                waits = True
                on_wait()
            time.sleep(POLL_S)
        yield


def _locked(descriptor: int) -> bool:
    try:
        files.lock(descriptor)
    except BlockingIOError:
        return False
    except OSError:  # no locks on this system: each command compiles for itself
        pass
    return True


PROGRESS = "compiling"
"""Name of the file in a flight's folder with the progress of compilation, for the page."""
PROGRESS_BYTES = 200


def tell(folder: Path | None, text: str) -> None:
    """Write the text that `progress` returns into a flight's folder; an empty text removes it."""
    if folder is None:
        return
    with suppress(OSError):
        if text:
            with files.replacing(folder / PROGRESS, is_synced=False) as file:
                file.write(text.encode())
        else:
            (folder / PROGRESS).unlink(missing_ok=True)


def progress(folder: Path | None) -> str:
    """Progress of the compilation of kernels, as text; empty while nothing is compiled."""
    with suppress(OSError, ValueError):
        return input_files.read(folder / PROGRESS, PROGRESS_BYTES).decode() if folder else ""
    return ""


def compile_kernels(kernels: Sequence["Missing"], on_done: Callable[[], None]) -> None:
    """Compile kernels, in parallel where there are several cores.

    Args:
        kernels: kernels to compile; kernels that take longest should come first.
        on_done: called after each kernel, from any thread.
    """
    queue = deque(each for each in kernels if each.is_stored)
    helpers = min(system.cores(), len(queue)) - 1
    with ThreadPoolExecutor(max(helpers, 1)) as pool:
        for _ in range(helpers):
            pool.submit(_have_compiled, queue, on_done)
        while each := _next(queue):
            each.compile()
            on_done()
    for each in kernels:
        # Loads code that other processes have compiled, and compiles kernels that failed there.
        each.compile()
        if not each.is_stored:
            on_done()


def _next(kernels: "deque[Missing]") -> "Missing | None":
    """Take a kernel from the front of a queue shared by several threads; None if it is empty."""
    try:
        return kernels.popleft()
    except IndexError:
        return None


def _have_compiled(kernels: "deque[Missing]", on_done: Callable[[], None]) -> None:
    """Start a process, and let it compile kernels from a queue until the queue is empty."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as helper:
        assert helper.stdin
        assert helper.stdout
        while each := _next(kernels):
            print(each.name, file=helper.stdin, flush=True)
            if not helper.stdout.readline():  # the helper was killed, by the system or by Ctrl-C
                return
            on_done()


def _help() -> None:
    """Compile the kernels named on stdin, one per line; answer each with a line on stdout."""
    from skytether.shared.base.machine_code import compile_named

    for line in sys.stdin:
        compile_named(line.rstrip("\n"))
        print(flush=True)


if __name__ == "__main__":
    _help()
