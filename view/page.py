"""The page: flights in a browser, live, by viser.

One thread draws for all browsers, as often as an eye needs and only while somebody looks.
"""

import contextlib
import io
import threading
import time
from collections.abc import Callable, Mapping, Sequence

import viser

from view.access import Visitor, knows, may_play
from view.flight import Flight
from view.panel import More, Panel
from view.scene import Scene

MOVES_HZ = 25
"""How often vehicles move [1/s]."""
MOVES_TO_A_DRAWING = 5
"""Number of moves to each drawing of lines, plots and words."""
BROWSERS_MAX = 16
"""Most browsers at once; others are turned away."""


class Server(viser.ViserServer):
    """A server of pages that never asks anybody outside to pass them on."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002 - viser's
        """Refuse: a browser could put the page on the internet by it."""
        return None


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """Keep what viser prints, even where it is told not to, off the standard output."""
    return contextlib.redirect_stdout(io.StringIO())


class Page:
    """Shows flights to browsers.

    Args:
        host, port: where it listens.
        flights: what is shown.
        now_ns: tells the time of the frames [ns]; the clock of this machine unless given.
        token: who knows it may change what flies from anywhere; empty for nobody.
        more: adds what else the page has to a browser.
    """

    def __init__(
        self,
        host: str,
        port: int,
        flights: Sequence[Flight],
        *,
        now_ns: Callable[[], int] | None = None,
        token: str = "",
        more: More | None = None,
    ) -> None:
        self._flights, self._token, self._more = flights, token, more
        self._now_ns = now_ns or time.monotonic_ns
        with _silence():
            self._server = Server(host, port, verbose=False)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("Skytether")
        self._panels: dict[int, Panel] = {}
        self._scene: Scene | None = None
        self._shown: tuple[object, ...] = ()
        """What the scene was made of."""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Port that it listens on."""
        return self._server.get_port()

    def close(self) -> None:
        """Show nothing more."""
        self._closed.set()
        self._thread.join()
        with _silence():
            self._server.stop()

    def _work(self) -> None:
        moves = 0
        due_s = time.monotonic()
        while not self._closed.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + 1 / MOVES_HZ, time.monotonic())
            clients = self._server.get_clients()
            for gone in self._panels.keys() - clients.keys():
                del self._panels[gone]
            if not clients:
                continue
            moves += 1
            with contextlib.ExitStack() as stack:
                for flight in self._flights:
                    stack.enter_context(flight.lock)
                self._show(clients, draws=moves % MOVES_TO_A_DRAWING == 0)

    def _show(self, clients: Mapping[int, viser.ClientHandle], *, draws: bool) -> None:
        states = [flight.state for flight in self._flights]
        if not all(state.name for state in states):
            return
        shown = tuple(state.flights for state in states)
        if self._scene is None or self._shown != shown:
            self._begin(shown)
        assert self._scene is not None
        for number, client in clients.items():
            if number not in self._panels and len(self._panels) < BROWSERS_MAX:
                self._panels[number] = self._panel(client)
                draws = True
        with self._server.atomic():
            self._scene.move(states)
            if draws:
                self._scene.draw(states)
        if draws:
            now_ns = self._now_ns()
            for panel in list(self._panels.values()):
                panel.show(now_ns)

    def _begin(self, shown: tuple[object, ...]) -> None:
        """Begin anew: other flights are flown."""
        self._server.scene.reset()
        for client in self._server.get_clients().values():
            client.gui.reset()
            client.scene.reset()
        self._panels.clear()
        titles = [flight.title for flight in self._flights]
        self._scene = Scene(self._server, [flight.state for flight in self._flights], titles)
        self._shown = shown

    def _panel(self, client: viser.ClientHandle) -> Panel:
        assert self._scene is not None
        return Panel(
            client,
            self._flights,
            self._scene,
            may_play=may_play(self._visitor(client), self._token),
            unlock=(lambda given: knows(self._token, given)) if self._token else None,
            more=self._more,
        )

    def _visitor(self, client: viser.ClientHandle) -> Visitor:
        """How a browser has connected; a stranger where viser does not tell."""
        try:
            # viser keeps what it knows of this to itself.
            connection = self._server._websock_server._live_connections[client.client_id]
            request = connection.request
            assert request is not None
            host = str(connection.remote_address[0])
            return Visitor(host, request.path, dict(request.headers.raw_items()))
        except (AttributeError, AssertionError, KeyError, TypeError, IndexError):
            return Visitor("", "", {})
