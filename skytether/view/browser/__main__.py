"""`python -m skytether.view.browser`: the page as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # called first, because the imports below are slow
    sys.exit(run("skytether.view.browser.__main__:show", "page"))

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from socket import SOCK_STREAM
from typing import Annotated

import tyro

from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read
from skytether.shell.host import system
from skytether.shell.host.web import HOST_PORT
from skytether.shell.processes.log import LogFormat
from skytether.view.browser.serve import followed, serve_until_interrupted

NICE = 5
"""Niceness of the page's process, so that the processes of a flight have priority."""


@dataclass(frozen=True)
class PageOptions:
    folders: Annotated[tuple[Path, ...], Argument(positional=True, metavar="FOLDER")]
    """Folders of flights, each with the feeds and control sockets of its processes."""
    page: str = HOST_PORT
    """HOST:PORT to serve the page on; if the port is taken, the next free one. Visitors from other
    machines may only watch, unless they have the printed token.
    """
    log: LogFormat = "text"
    """Format of printed events: sentences, or JSON lines for programs."""
    plugin: command.Plugins = ()


def show(argv: Sequence[str]) -> None:
    """Show flights in a browser while they fly, until SIGINT or SIGTERM.

    A flight's folder is the one given to `fly --control`, or one in which server, netem and client
    have their sockets: `--feed FOLDER/server.feed --control FOLDER/server` and so on. Several
    clients need different names, such as `client-2`. Flights may start, or restart, later.
    """
    options = read(PageOptions(tyro.MISSING), argv, "skytether page", show.__doc__)
    if not options.folders:
        raise CommandError("got no folder, expected at least one", CONFIGURATION)
    at = command.address("--page", options.page)
    alone = len(options.folders) == 1
    try:
        system.local_socket(SOCK_STREAM).close()
    except OSError as error:
        raise CommandError(str(error.strerror)) from None
    system.be_nice(NICE)
    with ExitStack() as stack:
        flights = [
            stack.enter_context(followed(each, "" if alone else each.name))
            for each in options.folders
        ]
        serve_until_interrupted(at, flights, options.log)
