"""Compilation of kernels, in as many processes as there are cores.

Numba compiles one function at a time in a process. So other processes compile, and leave the
machine code on disk, where this one finds it. Each takes the next kernel when it has finished one,
because nobody knows beforehand how long a kernel takes.
"""

import os
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

# for type checking alone: what flies aboard has no kernels
if TYPE_CHECKING:
    from skytether.shared.base.kernel import Missing


def compile_kernels(kernels: Sequence["Missing"], on_done: Callable[[], None]) -> None:
    """Compile kernels, side by side where there are several cores.

    Args:
        kernels: kernels to compile; those that take longest should come first.
        on_done: called after each kernel, from any thread.
    """
    kept = deque(each for each in kernels if each.is_stored)
    cores = min(len(os.sched_getaffinity(0)), len(kept))
    if cores > 1:
        with ThreadPoolExecutor(cores) as helpers:
            for _ in range(cores):
                helpers.submit(_have_compiled, kept, on_done)
    for each in kernels:
        # What others have compiled is only read now; what they have failed to is compiled.
        each.compile()
        if cores < 2 or not each.is_stored:
            on_done()


def _have_compiled(kernels: "deque[Missing]", on_done: Callable[[], None]) -> None:
    """Have another process compile kernels from the front of a queue, until it is empty."""
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
    """Compile the kernels that are named on stdin, one a line, and answer each by a line."""
    from skytether.shared.base.kernel import compile_named

    for line in sys.stdin:
        compile_named(line.rstrip("\n"))
        print(flush=True)


if __name__ == "__main__":
    _help()
