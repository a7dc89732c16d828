"""Metrics over HTTP for Prometheus, and a health check.

    GET /metrics   figures, as text for Prometheus
    GET /healthz   200 while the process is healthy, else 503; JSON either way

Once a second the event loop stores the endpoint's figures; threads answer requests from the stored
figures, and never touch the endpoint. Connections are bounded in time and in number (the oldest is
closed), so that no client blocks others; at most 50 are accepted per second. A request is refused
if its Host header is a website's name, which may have been pointed at this machine (DNS rebinding).
"""

import io
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer
from wsgiref.types import StartResponse, WSGIEnvironment

import msgspec
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.metrics_core import Metric as Exposed
from prometheus_client.registry import Collector

from skytether.shared.endpoints.endpoint import Address
from skytether.shell.host.udp import from_kernel, look_up
from skytether.shell.host.web import HEADERS, host_name, is_ours
from skytether.shell.processes.metrics import OWN, Metric, families, trouble

CONNECTIONS_MAX = 8
"""Largest number of connections at once; a new connection closes the oldest."""
PATIENCE_S = 5.0
"""Longest time from connecting to the end of the answer [s]."""
REQUEST_BYTES_MAX = 8192
POLL_S = 0.1
"""Interval between the checks that close connections that take too long [s]."""
REST_S = 0.02
"""Pause between two accepted connections [s]."""
FRESH_S = 3.0
"""Age above which figures count as stale, and the process as stuck [s]."""
OK, JSON = "200 OK", "application/json"
Answer = tuple[str, str, bytes]
"""Status, type and content of an answer."""
BY_NAME = b"Host: expected an IP address, localhost, a name without a dot, or the bound name\n"


class MetricsError(OSError):
    """Listening at an address failed; the message gives the reason."""


class Collected(Collector):
    """Collector of the newest figures of a process.

    Args:
        process: server, netem or client; `server.N` is worker N of a server, `netem N` is netem of
            path N.
        table: metrics of the figures, for a process without a table in `metrics`.
    """

    def __init__(
        self, process: str, scenario: str, step_s: float, table: Sequence[Metric] = ()
    ) -> None:
        self._process = process
        self._kind = process.partition(" ")[0].partition(".")[0]
        self._scenario, self._step_s, self._table = scenario, step_s, table
        # The snapshot is replaced as a whole: threads see either the old or the new figures.
        self._snapshot: tuple[Mapping[str, Any], float] | None = None

    def take(self, figures: Mapping[str, Any]) -> None:
        """Replace the figures; the caller must not change them afterwards."""
        self._snapshot = figures, time.monotonic()

    def collect(self) -> Iterable[Exposed]:
        labels = {"process": self._process, "scenario": self._scenario}
        info, step_s, age_s, unmapped = (metric.exposed() for metric in OWN)
        info.add_sample(info.name, labels, 1.0)
        step_s.add_sample(step_s.name, {}, self._step_s)
        yield from (info, step_s)
        if self._snapshot is None:
            return
        figures, taken_s = self._snapshot
        metrics, unknown = families(self._kind, figures, self._table)
        age_s.add_sample(age_s.name, {}, time.monotonic() - taken_s)
        unmapped.add_sample(unmapped.name, {}, float(len(unknown)))
        yield from (age_s, unmapped, *metrics)

    def trouble(self) -> str:
        if self._snapshot is None:
            return "it has not begun"
        figures, taken_s = self._snapshot
        age_s = time.monotonic() - taken_s
        if age_s > FRESH_S:
            return f"it has been stuck for {age_s:.0f} s"
        return trouble(self._kind, figures)

    def health(self) -> tuple[str, bytes]:
        why = self.trouble()
        answer = {"process": self._process, "healthy": not why, "trouble": why}
        return "503 Service Unavailable" if why else OK, msgspec.json.encode(answer) + b"\n"


class _Bounded(io.BufferedReader):
    left = REQUEST_BYTES_MAX

    def readline(self, _: int | None = -1, /) -> bytes:
        line = super().readline(self.left + 1)
        self.left -= len(line)
        if self.left < 0:
            raise OSError("the request is too long")
        return line


class _Handler(WSGIRequestHandler):
    """Handler of a request; its error answers have the common headers, too."""

    def setup(self) -> None:
        super().setup()
        self.rfile = _Bounded(self.rfile.detach())

    def log_message(self, *_: object) -> None:
        pass

    def end_headers(self) -> None:
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()


class BoundedServer(ThreadingMixIn, WSGIServer):
    """HTTP server in a process that must not wait for it, with one thread per connection.

    Args:
        address: address to listen at; port 0 takes a free one.
        answers: function for each path that gives the answer, called in a thread.

    Raises:
        MetricsError: listening at the address failed.
    """

    daemon_threads = True

    def __init__(self, address: Address, answers: Mapping[str, Callable[[], Answer]]) -> None:
        listening = _listening(address)
        super().__init__(listening.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self.address = from_kernel(listening.getsockname())
        # set here, because `server_bind` would look up the name in the DNS
        self.server_name, self.server_port = self.address
        self.setup_environ()
        self.set_app(self._answer)
        self._answers = answers
        self._name = address[0].lower()
        self._connections: dict[socket.socket, float] = {}
        """Time at which each connection is closed, even without an answer [s]; oldest first."""
        self._thread = threading.Thread(target=self.serve_forever, args=(POLL_S,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()

    def get_request(self) -> tuple[socket.socket, Any]:
        time.sleep(REST_S)
        return super().get_request()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread; with CONNECTIONS_MAX open, the oldest is closed."""
        for oldest in list(self._connections)[: 1 - CONNECTIONS_MAX]:
            self._hang_up(oldest)
        self._connections[request] = time.monotonic() + PATIENCE_S
        super().process_request(request, client_address)

    def service_actions(self) -> None:
        now_s = time.monotonic()
        for connection, until_s in list(self._connections.items()):
            if now_s >= until_s:
                self._hang_up(connection)

    def _hang_up(self, connection: socket.socket) -> None:
        self._connections.pop(connection, None)
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)

    def shutdown_request(self, request: Any) -> None:
        self._connections.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, *_: object) -> None:
        """Ignore the error: the client has disconnected, or is too slow."""

    def _answer(self, environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        status, kind = "404 Not Found", "text/plain; charset=utf-8"
        body = " or ".join(self._answers).encode() + b"\n"
        more = list(HEADERS.items())
        if not self._is_ours(environ.get("HTTP_HOST")):
            status, body = "403 Forbidden", BY_NAME
        elif environ["REQUEST_METHOD"] != "GET":
            status, body = "405 Method Not Allowed", b"only GET is supported\n"
            more.append(("Allow", "GET"))
        elif answer := self._answers.get(environ["PATH_INFO"]):
            status, kind, body = answer()
        start_response(status, [("Content-Type", kind), *more])
        return [body]

    def _is_ours(self, host: str | None) -> bool:
        """Whether a Host header names this machine by a name that no website can have."""
        if host is None or "," in host:  # no Host header, or several
            return host is None
        name = host_name(host)
        return is_ours(name) or name == self._name or (name != "" and "." not in name)


class Metrics(BoundedServer):
    """HTTP server of a process's metrics.

    Args:
        address: see `BoundedServer`.
    """

    def __init__(self, address: Address, collected: Collected) -> None:
        self._collected = collected
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(collected)
        super().__init__(address, {"/metrics": self._figures, "/healthz": self._health})

    def take(self, figures: Mapping[str, Any]) -> None:
        self._collected.take(figures)

    def _figures(self) -> Answer:
        return OK, CONTENT_TYPE_LATEST, generate_latest(self._registry)

    def _health(self) -> Answer:
        status, body = self._collected.health()
        return status, JSON, body


def _listening(address: Address) -> socket.socket:
    try:
        host, port = look_up(address)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.create_server((host, port), family=family, backlog=CONNECTIONS_MAX)
    except OSError as error:
        # The text of an OSError contains the address, so only a gaierror's own text is used.
        number = error.errno or 0
        raise MetricsError(os.strerror(number) if number > 0 else str(error.strerror)) from None
    return sock
