"""Page that shows flights in a browser, drawn with viser.

One thread draws for all browsers, 25 times a second, and only while a browser is open.
"""

import contextlib
import io
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence

import viser
from websockets.asyncio.server import ServerConnection

from skytether.shared.events.processes import BrowserRefused
from skytether.view.browser.access import TurnedAway, knows, may_play
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.guard import Guard, visitor
from skytether.view.browser.panel import More, Panel
from skytether.view.page.scene import Scene

MOVES_HZ = 25
MOVES_TO_A_DRAWING = 5
"""Number of marker updates per redraw of lines, plots and texts."""


STOPPED_S = 30.0
"""Time after which a viser server that does not end is abandoned [s]."""

# viser warns if a browser leaves during a redraw.
warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """Hide viser's output on standard output, which its options cannot turn off."""
    return contextlib.redirect_stdout(io.StringIO())


def stop(server: viser.ViserServer) -> None:
    """Stop a viser server, and wait for the end of its thread.

    viser itself waits only for a second; the thread could print later, between other output.
    """
    thread = server._websock_server._server_thread
    with _silence():
        server.stop()
        if thread:
            thread.join(STOPPED_S)


class Page:
    """Page that shows flights to browsers.

    Args:
        host, port: address that the page's server listens at.
        now_ns: function that returns the time of the frames [ns]; by default this machine's clock.
        token: secret that lets a visitor watch and change the flight from any machine; empty for
            none.
        more: adds further controls to a browser.
    """

    def __init__(
        self,
        host: str,
        port: int,
        flights: Sequence[PageFlight],
        *,
        now_ns: Callable[[], int] | None = None,
        token: str = "",
        more: More | None = None,
    ) -> None:
        self._flights, self._token, self._more = flights, token, more
        self._now_ns = now_ns or time.monotonic_ns
        self._guard = Guard(token)
        with _silence(), self._guard.served():
            self._server = viser.ViserServer(host, port, verbose=False)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("Skytether")
        self._panels: dict[int, Panel] = {}
        self._waiting: viser.GuiMarkdownHandle | None = None
        """Text that says what flights wait for, shown until they begin."""
        self._scene: Scene | None = None
        self._shown: tuple[object, ...] = ()
        """Properties of the flights for which the scene was built."""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return self._server.get_port()

    def events(self) -> Sequence[BrowserRefused]:
        return self._guard.events()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        stop(self._server)

    def _work(self) -> None:
        moves = 0
        due_s = time.monotonic()
        while not self._closed.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + 1 / MOVES_HZ, time.monotonic())
            clients = self._server.get_clients()
            for number in self._panels.keys() - clients.keys():
                del self._panels[number]
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
            if draws:
                self._wait()
            return
        shown = tuple((state.flights, state.flies) for state in states)
        if self._scene is None or self._shown != shown:
            self._begin(shown)
        assert self._scene is not None
        for number, client in clients.items():
            if number not in self._panels:
                with self._alone(number):
                    self._panels[number] = self._panel(client)
                draws = True
                break  # one panel per redraw bounds the cost of a browser that keeps reconnecting
        with self._server.atomic():
            self._scene.move(states)
            if draws:
                self._scene.draw(states)
        if draws:
            now_ns = self._now_ns()
            for number, panel in list(self._panels.items()):
                if self._reads(number):
                    with self._alone(number), clients[number].atomic():
                        panel.show(now_ns)

    def _wait(self) -> None:
        """Show what the flights that have not begun are waiting for."""
        waits = [flight.waits for flight in self._flights if not flight.state.name]
        text = "\n\n".join(waits)
        if self._waiting is None:
            self._waiting = self._server.gui.add_markdown(text)
        elif self._waiting.content != text:
            self._waiting.content = text

    def _reads(self, number: int) -> bool:
        """Whether a browser has read everything that was sent; otherwise nothing more is sent."""
        connection = self._connections.get(number)
        return connection is not None and not connection.paused

    @contextlib.contextmanager
    def _alone(self, number: int) -> Iterator[None]:
        """If the panel raises an error in this block, close only this browser's connection.

        viser accepts any value from a browser: texts for numbers, lists of any length.
        """
        try:
            yield
        except Exception:
            self._panels.pop(number, None)
            self._guard.count(TurnedAway.PANEL)
            if connection := self._connections.get(number):
                self._server.get_event_loop().call_soon_threadsafe(connection.transport.abort)

    def _begin(self, shown: tuple[object, ...]) -> None:
        if self._waiting:
            self._waiting.remove()
            self._waiting = None
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
            may_play=may_play(visitor(self._connections[client.client_id]), self._token),
            unlock=(lambda given: knows(self._token, given)) if self._token else None,
            more=self._more,
        )

    @property
    def _connections(self) -> dict[int, ServerConnection]:
        """Connections of the browsers, from viser's private attribute."""
        return self._server._websock_server._live_connections
