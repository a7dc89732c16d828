"""Compilation of kernels, in as many processes as there are cores.

Numba compiles one function at a time in a process. So several processes compile, and this process
reads the machine code that they store on disk. Each takes the next kernel from a queue, because
compile times are not known beforehand.
"""

import subprocess
import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from skytether.shell import system

# for type checking only: the client aboard is installed without numba
if TYPE_CHECKING:
    from skytether.shared.base.kernel import Missing


def compile_kernels(kernels: Sequence["Missing"], on_done: Callable[[], None]) -> None:
    """Compile kernels, in parallel where there are several cores.

    Args:
        kernels: kernels to compile; those that take longest should come first.
        on_done: called after each kernel, from any thread.
    """
    queue = deque(each for each in kernels if each.is_stored)
    cores = min(system.cores(), len(queue))
    if cores > 1:
        with ThreadPoolExecutor(cores) as helpers:
            for _ in range(cores):
                helpers.submit(_have_compiled, queue, on_done)
    for each in kernels:
        # Loads code that other processes have compiled, and compiles kernels for which they failed.
        each.compile()
        if cores < 2 or not each.is_stored:
            on_done()


def _have_compiled(kernels: "deque[Missing]", on_done: Callable[[], None]) -> None:
    """Let another process compile kernels from the front of a queue, until the queue is empty."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as helper:
        assert helper.stdin
        assert helper.stdout
        while kernels:
            try:
                name = kernels.popleft().name
            except IndexError:  # another thread took the last one
                return
            print(name, file=helper.stdin, flush=True)
            if not helper.stdout.readline():  # killed, by the system or by Ctrl-C
                return
            on_done()


def _help() -> None:
    """Compile the kernels named on stdin, one a line; answer each with a line on stdout."""
    from skytether.shared.base.kernel import compile_named

    for line in sys.stdin:
        compile_named(line.rstrip("\n"))
        print(flush=True)


if __name__ == "__main__":
    _help()
