"""Start of every command, before imports that take seconds. The module handles missing standard
streams, terminals that cannot print Greek letters, and Ctrl-C or SIGUSR1 during the imports.
"""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module

from skytether.shell.host import system

PARENT = os.getppid()
"""Id of the parent process, read before the slow imports, during which the parent may end."""


def run(command: str, prog: str, argv: Sequence[str] | None = None) -> int:
    """Run a command from the start of its process; returns its exit code.

    Args:
        command: the command's function as "module:name", imported here.
        prog: name of the command, for errors.
        argv: arguments; if None, the arguments of the process.
    """
    begin()
    module, _, name = command.partition(":")

    def call(argv: Sequence[str]) -> None:
        with _mortal():
            function = getattr(import_module(module), name)
        function(argv)

    try:
        with _mortal():
            from skytether.shell.commandline.command import main
        return main(call, argv, prog)
    except KeyboardInterrupt:  # Ctrl-C outside `call`
        return 128 + signal.SIGINT


def begin() -> None:
    """Open missing standard streams, and ignore SIGUSR1 until there are figures to print.

    A closed stream becomes /dev/null, also for child processes: otherwise the next socket would get
    the stream's descriptor, and output would go to the socket. Characters that a stream cannot
    encode are escaped. SIGUSR1 is ignored, also by child processes, until a handler is set.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # open() returns the lowest free descriptor, which is the closed one
            os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if any(signal.getsignal(each) is signal.SIG_DFL for each in system.signals("SIGUSR1")):
        system.on_usr1(signal.SIG_IGN)


@contextlib.contextmanager
def _mortal() -> Iterator[None]:
    """Let Ctrl-C end the process at once, because an import could ignore KeyboardInterrupt."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
