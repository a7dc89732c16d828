"""Worker processes that end with this process."""

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager

from skytether.shell.processes.workers import die_with_parent


@contextmanager
def processes(count: int, *, polite: bool = False) -> Iterator[Executor]:
    """Pool of processes, which are terminated at the end of the block.

    Args:
        polite: whether the processes have a low priority.
    """
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    started = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, started, _start, (os.getpid(), polite))
    before = set(multiprocessing.active_children())
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _start(parent: int, polite: bool) -> None:
    """Initialise a worker, which ends when its parent process ends."""
    die_with_parent()
    if os.getppid() != parent:  # the command had already ended
        os._exit(1)
    if polite and hasattr(os, "nice"):
        os.nice(19)
