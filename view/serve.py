"""Serving a page: where it listens, who may change what, and how it ends."""

import secrets
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from shared.endpoint import Address
from shared.events import PageServed, address_text
from shell.command import RUN, CommandError, interruptible
from shell.feed import Subscriber
from shell.log import Log, LogFormat
from view.access import is_loopback
from view.flight import Flight
from view.page import Page
from view.panel import More
from view.play import PROCESSES

HOST_PORT = "127.0.0.1:8080"
"""Address of a page unless another is given."""
TOKEN_BYTES = 16
POLL_S = 0.1
"""Time after which Ctrl-C is noticed [s]."""
ANYWHERE = ("0.0.0.0", "::")
"""Hosts that are none to connect to."""


@contextmanager
def followed(folder: Path, title: str = "") -> Iterator[Flight]:
    """Follow a flight whose processes have their feeds and control sockets in a folder."""
    flight = Flight(title, folder)
    paths = {name: folder / f"{name}.feed" for name in PROCESSES}
    paths |= {each.name.replace(".feed", ""): each for each in folder.glob("*.feed.*")}
    with closing(flight), closing(Subscriber(paths, flight.take, flight.lose)):
        yield flight


@contextmanager
def page(
    at: Address,
    flights: Sequence[Flight],
    *,
    now_ns: Callable[[], int] | None = None,
    more: More | None = None,
) -> Iterator[PageServed]:
    """Serve a page for as long as the block takes; yields its address.

    Args:
        at: where it listens; on another port where that one is taken.
        flights: what is shown.
        now_ns, more: see `Page`.

    Raises:
        CommandError: it cannot listen there.
    """
    host, port = at
    taken = _is_taken(host, port)
    token = "" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES)
    served = Page(host, 0 if taken else port, flights, token=token, more=more, now_ns=now_ns)
    with closing(served):
        here = address_text("127.0.0.1" if host in ANYWHERE else host, served.port)
        query = f"/?websocket=ws://{here}/?token={token}" if token else ""
        yield PageServed(address=f"http://{here}{query}", taken=address_text(*at) if taken else "")


def _is_taken(host: str, port: int) -> bool:
    """Whether somebody else listens there.

    Raises:
        CommandError: nobody can.
    """
    shown = address_text(host, port)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, _, _, address = found[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == 98:
            return True
        raise CommandError(
            f"--page: {shown}: cannot be listened on: {error.strerror}", RUN
        ) from None
    return False


def until_told(
    at: Address,
    flights: Sequence[Flight],
    log: LogFormat = "text",
    *,
    now_ns: Callable[[], int] | None = None,
    more: More | None = None,
) -> None:
    """Serve a page until SIGINT or SIGTERM, and say where.

    Args:
        at, flights, now_ns, more: see `page`.
        log: form of the log.

    Raises:
        CommandError: it cannot listen there.
    """
    with (
        interruptible() as interrupted,
        page(at, flights, now_ns=now_ns, more=more) as served,
        closing(Log("page", log)) as out,
    ):
        out.say(served)
        while not interrupted():
            time.sleep(POLL_S)
