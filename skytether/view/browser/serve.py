"""Page server: its address, its token, and its end."""

import errno
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import address_text
from skytether.shared.events.processes import PageServed
from skytether.shell.commandline.command import RUN, CommandError, interruptible
from skytether.shell.driving.control import PROCESSES
from skytether.shell.driving.feed import Subscriber
from skytether.shell.processes.log import Log, LogFormat
from skytether.view.browser.access import is_loopback
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.page import Page
from skytether.view.browser.panel import More

TOKEN_BYTES = 16
POLL_S = 0.1
"""Interval at which Ctrl-C is checked [s]."""
PORTS, PORTS_TRIED = 65536, 100
"""Number of existing ports, and number of ports tried, from the requested port on."""
ANYWHERE = ("0.0.0.0", "::")
"""Wildcard addresses, which mean every interface; a browser cannot connect to them."""


@contextmanager
def followed(folder: Path, title: str = "") -> Iterator[PageFlight]:
    """Follow a flight whose processes have their feeds and control sockets in a folder."""
    flight = PageFlight(title, folder)
    paths = {name: folder / f"{name}.feed" for name in PROCESSES}
    follows = Subscriber(paths, flight.take, flight.lose, lambda: feeds(folder))
    with closing(flight), closing(follows):
        yield flight


def feeds(folder: Path) -> dict[str, Path]:
    """Sockets of feeds in a folder, by process name; there may be several clients and workers."""
    found = sorted({*folder.glob("*.feed"), *folder.glob("*.feed.*")})
    return {each.name.replace(".feed", "", 1): each for each in found}


@contextmanager
def page(
    at: Address,
    flights: Sequence[PageFlight],
    *,
    now_ns: Callable[[], int] | None = None,
    more: More | None = None,
) -> Iterator[tuple[Page, PageServed]]:
    """Serve a page during the block; yields the page and its address.

    Args:
        at: address to listen at; if its port is taken, the next free one.
        now_ns, more: see `Page`.
    """
    host, port = at
    free = next_free(host, port)
    token = "" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES)
    with closing(Page(host, free, flights, token=token, more=more, now_ns=now_ns)) as shown:
        page_address = address_text("127.0.0.1" if host in ANYWHERE else host, shown.port)
        query = f"/?websocket=ws://{page_address}/?token={token}" if token else ""
        taken_address = address_text(*at) if port and shown.port != port else ""
        yield shown, PageServed(address=f"http://{page_address}{query}", taken=taken_address)


def next_free(host: str, port: int) -> int:
    """First free port, from `port` on; 0, which takes any free port, stays 0."""
    for candidate in range(port, min(port + PORTS_TRIED, PORTS)):
        try:
            addresses = socket.getaddrinfo(
                host, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )
            family, kind, _, _, address = addresses[0]
            with socket.socket(family, kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                continue
            why = error.strerror
            break
        return candidate
    else:
        why = f"it is taken, and so are the {PORTS_TRIED - 1} ports after it"
    raise CommandError(f"--page: {address_text(host, port)}: cannot listen: {why}", RUN)


def serve_until_interrupted(
    at: Address,
    flights: Sequence[PageFlight],
    log: LogFormat = "text",
    *,
    now_ns: Callable[[], int] | None = None,
    more: More | None = None,
) -> None:
    """Serve a page until SIGINT or SIGTERM, and print its address.

    Args:
        at, flights, now_ns, more: see `page`.
        log: form of the log.
    """
    with (
        interruptible() as interrupted,
        page(at, flights, now_ns=now_ns, more=more) as (shown, served),
        closing(Log("page", log)) as out,
    ):
        out.say(served)
        while not interrupted():
            time.sleep(POLL_S)
            for event in shown.events():
                out.say(event)
