"""Several processes that serve one address, so that a server uses several cores.

Each process has its own socket at the address (SO_REUSEPORT): the kernel assigns peers to the
processes by a hash of their address, so a peer always reaches the same process while all of them
live. When one process ends, all others are ended.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import closing
from multiprocessing.connection import wait
from socket import socket

from skytether.shared.endpoints.endpoint import Address
from skytether.shell.host import system
from skytether.shell.host.udp import from_kernel, open_socket

FORK = multiprocessing.get_context("fork" if system.FORKS else None)
"""Start method of workers: fork shares imported and compiled code, which saves memory and time."""
ENDING = (signal.SIGINT, signal.SIGTERM)
PASSED_ON = (*ENDING, *system.signals("SIGUSR1"))
"""Signals that are passed on to every worker; SIGINT is sent as SIGTERM, and SIGTERM only once."""


def run(count: int, bind: Address, work: Callable[[int, socket], None]) -> int:
    """Run `count` processes until the first of them ends; returns the largest exit code.

    Args:
        bind: address of all processes; port 0 takes a free one.
        work: called in each process with its number, from 1, and its socket.

    Raises:
        AddressError: the address cannot be bound.
    """
    sockets = [open_socket(bind, shared=True)]
    address = from_kernel(sockets[0].getsockname())
    sockets += [open_socket(address, shared=True) for _ in range(count - 1)]
    children = [
        FORK.Process(target=_work, args=(work, number, sockets, os.getpid()))
        for number in range(1, count + 1)
    ]
    # Signals are blocked until parent and children have set their handlers, because an earlier
    # signal would call an inherited handler.
    signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)
    for child in children:
        child.start()
    for sock in sockets:
        sock.close()

    ending, terminated = False, set()

    def pass_on(number: int, _: object) -> None:
        nonlocal ending
        if number in ENDING:
            if ending:  # a second SIGTERM would interrupt the orderly end of a worker
                return
            number, ending = signal.SIGTERM, True
        terminated.add(-number)
        for child in children:
            if child.is_alive() and child.pid:
                os.kill(child.pid, number)

    for number in PASSED_ON:
        signal.signal(number, pass_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON)
    wait([child.sentinel for child in children])
    pass_on(signal.SIGTERM, None)
    for child in children:
        child.join()
    # A worker that a signal has killed before it had its own handler has not failed.
    return max(
        0 if child.exitcode in terminated else abs(child.exitcode or 0) for child in children
    )


def _work(
    work: Callable[[int, socket], None], number: int, sockets: list[socket], parent: int
) -> None:
    die_with_parent()
    if os.getppid() != parent:  # the parent ended before `die_with_parent`
        return
    for other, sock in enumerate(sockets, start=1):
        if other != number:
            sock.close()
    for passed_on in ENDING:
        signal.signal(passed_on, signal.SIG_DFL)
    system.on_usr1(signal.SIG_IGN)  # ignored until there are figures to print
    # SIGINT stays blocked: a terminal sends it to all, and the parent passes it on as SIGTERM.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON[1:])
    with closing(sockets[number - 1]) as sock:
        try:
            work(number, sock)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the worker is ending already


def die_with_parent() -> None:
    """Ask the kernel to send this process SIGTERM when its parent ends; runs in a child."""
    pr_set_pdeathsig = 1
    with contextlib.suppress(OSError, AttributeError):
        system.LIBC.prctl(pr_set_pdeathsig, signal.SIGTERM)
