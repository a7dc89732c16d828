"""Page of a flight, in its own process, so that the flight goes on if the page fails."""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from skytether.shared.base.printable import printable
from skytether.shell.commandline import command, plugins
from skytether.shell.host import temporary
from skytether.shell.processes.log import line_of
from skytether.shell.processes.workers import die_with_parent

STOP_S = 5.0
"""Longest time for the page to end after SIGTERM [s]."""
VARIABLE = "SKYTETHER_PAGE"
"""Environment variable with HOST:PORT of the page, or `none`."""
NONE = "none"


@contextlib.contextmanager
def paged(at: str | None, folder: Path | None = None) -> Iterator[Path | None]:
    """Serve a page of a flight during the block; yields the folder of the flight's sockets.

    Args:
        at: HOST:PORT of the page; NONE or None for no page.
        folder: folder of the flight's sockets; with a page, None makes a temporary folder.
    """
    if at is None or at == NONE:
        yield folder
        return
    command.address("--page", at)
    with contextlib.ExitStack() as stack:
        folder = folder or stack.enter_context(temporary.folder())
        stack.enter_context(beside([folder], at))
        yield folder


@contextlib.contextmanager
def beside(folders: Sequence[Path], at: str) -> Iterator[None]:
    """Serve a page of flights at HOST:PORT during the block; print its address or its error."""
    arguments = [*map(str, folders), "--page", at, "--log", "json", *plugins.flags()]
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "skytether.view.browser", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=die_with_parent,  # noqa: PLW1509 - no other thread runs yet
    )
    ended = threading.Event()

    def hear() -> None:
        last = ""
        assert child.stdout is not None
        for line in child.stdout:
            logged = line_of(line)
            if logged is not None:
                say(str(logged.event))
            else:
                last = line.decode(errors="replace").strip() or last
        if not ended.is_set():
            say(f"{last or 'page: it has ended'}; the flight goes on without a page")

    reader = threading.Thread(target=hear, daemon=True)
    reader.start()
    try:
        yield
    finally:
        ended.set()
        child.terminate()
        try:
            child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        reader.join(STOP_S)
        if child.stdout:
            child.stdout.close()


def say(line: object) -> None:
    """Print lines on stderr, ignoring errors."""
    # The flight goes on if the terminal has closed.
    with contextlib.suppress(OSError):
        print("\n".join(map(printable, str(line).splitlines())), file=sys.stderr)
