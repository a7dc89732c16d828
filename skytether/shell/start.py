"""The first moment of every command, before what takes seconds to import.

A process may come to life without standard streams, with a terminal that knows no Greek, and be
told to end, or to count, before it knows what it is. All of that is settled here, once.
"""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module


def run(command: str, prog: str, argv: Sequence[str] | None = None) -> int:
    """Run a command from the first moment of its process; returns its exit code.

    Args:
        command: its function, as "module:name", which is imported here.
        prog: its name, for the one line of a mistake.
        argv: its arguments; those of the process unless given.
    """
    begin()
    module, _, name = command.partition(":")

    def call(argv: Sequence[str]) -> None:
        with _mortal():
            function = getattr(import_module(module), name)
        function(argv)

    try:
        with _mortal():
            from skytether.shell.command import main
        return main(call, argv, prog)
    except KeyboardInterrupt:  # between two of these lines
        return 128 + signal.SIGINT


def begin() -> None:
    """Give this process its three streams, and let SIGUSR1 wait until there is what to count.

    A stream that is closed becomes /dev/null, for the children as well: the next socket would take
    its number, and be printed to. What a stream cannot encode is written as an escape. SIGUSR1 is
    ignored until there is a handler, by the children as well.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL:
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)


@contextlib.contextmanager
def _mortal() -> Iterator[None]:
    """Let Ctrl-C end the process at once: what is being imported may swallow an exception."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
