"""`python -m skytether.view`: the page as a process."""

import sys

from skytether.shell.start import run

if __name__ == "__main__":  # before the imports below, which take a while
    sys.exit(run("skytether.view.__main__:show", "page"))

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skytether.shell import command
from skytether.shell.command import CONFIGURATION, CommandError
from skytether.shell.log import LogFormat
from skytether.shell.options import read
from skytether.view.browser.access import HOST_PORT
from skytether.view.browser.serve import followed, until_told

NICE = 5
"""How far the page stands back behind the processes that fly."""


@dataclass(frozen=True)
class PageOptions:
    """Options of `skytether page`."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folders of flights, each with the feeds and control sockets of its processes."""
    page: str = HOST_PORT
    """HOST:PORT to serve the page on; where that is taken, the next free port. Where other machines
    can reach it, they may only look, unless they know the token that is printed."""
    log: LogFormat = "text"
    """What is printed for each event: a sentence, or a line of JSON for a program."""
    plugin: command.Plugins = ()


def show(argv: Sequence[str]) -> None:
    """Show flights in a browser while they fly, until SIGINT or SIGTERM.

    A flight's folder is one that `fly --control` was given, or in which server, netem and client
    have their sockets: `--feed FOLDER/server.feed --control FOLDER/server` and so on. Flights may
    begin later, or anew.
    """
    options = read(PageOptions(tyro.MISSING), argv, "skytether page", show.__doc__)
    if not options.folders:
        raise CommandError("got no folder, expected at least one", CONFIGURATION)
    at = command.address("--page", options.page)
    alone = len(options.folders) == 1
    os.nice(NICE)
    with ExitStack() as stack:
        flights = [
            stack.enter_context(followed(each, "" if alone else each.name))
            for each in options.folders
        ]
        until_told(at, flights, options.log)
