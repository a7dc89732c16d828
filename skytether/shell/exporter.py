"""Metrics over HTTP for Prometheus, and a health check.

    GET /metrics   counted figures, as text for Prometheus
    GET /healthz   200 while the process is healthy, else 503; JSON either way

The loop hands over its figures once a second; a thread renders them and answers. The thread never
touches the endpoint. A connection has a bounded time, and the oldest is closed where there are too
many, so that no client keeps others out; at most 50 are accepted per second. Who comes by the name
of a website is refused: a stranger may have pointed it here.
"""

import os
import selectors
import socket
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import msgspec
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.metrics_core import Metric as Exposed
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from skytether.shared.core.endpoint import Address
from skytether.shell.metrics import OWN, PREFIX, TABLES, families, trouble
from skytether.shell.udp import from_kernel, look_up
from skytether.shell.web import HEADERS, host_name, is_ours

CONNECTIONS_MAX = 8
"""Most connections at once; a new one closes the oldest."""
PATIENCE_S = 5.0
"""Longest time for a request and its answer [s]."""
REQUEST_BYTES_MAX = 8192
"""Largest size of a request [B]."""
REST_S = 0.02
"""Pause between two accepted connections [s]."""
FRESH_S = 3.0
"""Age from which figures count as stale, and the process as stuck [s]."""


class MetricsError(OSError):
    """Error: the metrics' address cannot be listened at; the message says which and why."""


class Collected(Collector):
    """Metrics of the newest figures of a process.

    Args:
        process: server, netem or client; `server.N` is worker N of a server.
        scenario: name of the scenario.
        step_s: length of a step [s].
    """

    def __init__(self, process: str, scenario: str, step_s: float) -> None:
        self._process = process
        self._kind = process.partition(".")[0]
        self._scenario, self._step_s = scenario, step_s
        # Replaced as a whole, so the thread sees either the old or the new figures.
        self._snapshot: tuple[Mapping[str, Any], float] | None = None

    def take(self, figures: Mapping[str, Any]) -> None:
        """Take new figures, which the caller must not change any more."""
        self._snapshot = figures, time.monotonic()

    def collect(self) -> Iterable[Exposed]:
        """Metrics for prometheus_client, which calls this method."""
        labels = {"process": self._process, "scenario": self._scenario}
        info, step_s, age_s, unmapped = (
            Exposed(PREFIX + metric.name, metric.help, metric.kind) for metric in OWN
        )
        info.add_sample(info.name, labels, 1.0)
        step_s.add_sample(step_s.name, {}, self._step_s)
        yield from (info, step_s)
        if self._snapshot is None:
            return
        figures, taken_s = self._snapshot
        told, unknown = families(self._kind, figures)
        age_s.add_sample(age_s.name, {}, time.monotonic() - taken_s)
        unmapped.add_sample(unmapped.name, {}, float(len(unknown)))
        yield from (age_s, unmapped)
        for metric, samples in told:
            kind = "gauge" if metric.kind == "modes" else metric.kind
            # prometheus_client adds the suffix of a counter's name itself.
            name = PREFIX + metric.name
            exposed = Exposed(name.removesuffix("_total"), metric.help, kind)
            exposed.samples += [
                Sample(name + suffix, labels, value) for suffix, labels, value in samples
            ]
            yield exposed

    def trouble(self) -> str:
        """Reason why the process is unhealthy; empty for a healthy one."""
        if self._snapshot is None:
            return "it has not begun"
        figures, taken_s = self._snapshot
        age_s = time.monotonic() - taken_s
        if age_s > FRESH_S:
            return f"it has been stuck for {age_s:.0f} s"
        return trouble(self._kind, figures)

    def health(self) -> tuple[int, bytes]:
        """Status and body of the answer to a health check."""
        why = self.trouble()
        told = {"process": self._process, "healthy": not why, "trouble": why}
        return 503 if why else 200, msgspec.json.encode(told) + b"\n"


@dataclass(slots=True)
class _Scrape:
    """Connection of one client."""

    socket: socket.socket
    until_s: float
    """Time at which the connection is closed, complete or not [s]."""
    request: bytearray = field(default_factory=bytearray)
    answer: memoryview | None = None
    """Remaining bytes of the answer; None until the request is complete."""


class Metrics:
    """HTTP server of a process's metrics, in a thread.

    Args:
        address: address to listen at; port 0 takes a free one.
        collected: metrics that it serves.

    Raises:
        MetricsError: the address cannot be listened at.
    """

    def __init__(self, address: Address, collected: Collected) -> None:
        self._collected = collected
        self._name = address[0].lower()
        """Name that the user has given this machine."""
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(collected)
        self._socket = _listening(address)
        self.address = from_kernel(self._socket.getsockname())
        """Address that the server listens at."""
        self._selector = selectors.DefaultSelector()
        self._ours, self._waker = socket.socketpair()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._selector.register(self._ours, selectors.EVENT_READ)
        self._connections: dict[int, _Scrape] = {}
        """Connections by file descriptor, the oldest first."""
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def take(self, figures: Mapping[str, Any]) -> None:
        """Serve these figures from now on."""
        self._collected.take(figures)

    def close(self) -> None:
        """Stop serving."""
        self._closed = True
        with suppress(BrokenPipeError):  # the thread has ended already
            self._waker.send(b"\0")
        self._thread.join()
        self._waker.close()

    def _work(self) -> None:
        try:
            while not self._closed:
                self._turn()
        finally:
            for connection in self._connections.values():
                connection.socket.close()
            self._selector.close()
            self._socket.close()
            self._ours.close()

    def _turn(self) -> None:
        oldest = next(iter(self._connections.values()), None)
        wait_s = None if oldest is None else max(oldest.until_s - time.monotonic(), 0.0)
        for key, _ in self._selector.select(wait_s):
            if key.fileobj is self._socket:
                self._accept()
            elif key.fd in self._connections:
                self._go_on(self._connections[key.fd])
        now_s = time.monotonic()
        for connection in tuple(self._connections.values()):
            if now_s >= connection.until_s:
                self._end(connection)

    def _accept(self) -> None:
        time.sleep(REST_S)
        try:
            sock, _ = self._socket.accept()
        except OSError:  # the client is gone already, or too many files are open
            return
        if len(self._connections) == CONNECTIONS_MAX:
            self._end(next(iter(self._connections.values())))
        sock.setblocking(False)
        self._connections[sock.fileno()] = _Scrape(sock, time.monotonic() + PATIENCE_S)
        self._selector.register(sock, selectors.EVENT_READ)

    def _go_on(self, connection: _Scrape) -> None:
        """Read more of a request, or send more of its answer."""
        try:
            if connection.answer is None:
                piece = connection.socket.recv(REQUEST_BYTES_MAX)
                if not piece:
                    self._end(connection)
                    return
                connection.request += piece
                if not _is_whole(connection.request):
                    return
                connection.answer = memoryview(self._answer(bytes(connection.request)))
                self._selector.modify(connection.socket, selectors.EVENT_WRITE)
            connection.answer = connection.answer[connection.socket.send(connection.answer) :]
        except BlockingIOError:
            return
        except OSError:
            self._end(connection)
            return
        if not connection.answer:
            self._end(connection)

    def _end(self, connection: _Scrape) -> None:
        del self._connections[connection.socket.fileno()]
        self._selector.unregister(connection.socket)
        # data left unread would reset the connection and discard the answer
        with suppress(OSError):
            connection.socket.shutdown(socket.SHUT_WR)
        connection.socket.close()

    def _answer(self, request: bytes) -> bytes:
        if len(request) > REQUEST_BYTES_MAX:
            return _response(431, b"too long\n")
        words = request.split(b"\r\n", 1)[0].split()
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return _response(400, b"no request\n")
        if words[0] != b"GET":
            return _response(405, b"GET alone\n", "Allow: GET\r\n")
        if not all(map(self._is_ours, _hosts(request))):
            return _response(403, BY_NAME)
        return self._page(words[1].split(b"?")[0])

    def _page(self, path: bytes) -> bytes:
        """Answer to a request for a path."""
        match path:
            case b"/metrics":
                return _response(200, generate_latest(self._registry), kind=CONTENT_TYPE_LATEST)
            case b"/healthz":
                status, body = self._collected.health()
                return _response(status, body, kind="application/json")
        return _response(404, b"/metrics or /healthz\n")

    def _is_ours(self, host: str) -> bool:
        """Whether a Host header is no name that a stranger can point at this machine."""
        name = host_name(host)
        return is_ours(name) or name == self._name or (name != "" and "." not in name)


def _hosts(request: bytes) -> list[str]:
    """Values of the Host headers of a request."""
    lines = (line.partition(b":") for line in request.split(b"\r\n")[1:])
    return [value.decode("latin-1").strip() for name, _, value in lines if name.lower() == b"host"]


BY_NAME = b"by a name; a number, localhost, a name without a dot or that of --metrics is expected\n"
"""Answer to who comes by the name of a website."""
_REASONS = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    405: "Method Not Allowed",
    431: "Request Header Fields Too Large",
    503: "Service Unavailable",
}


def _response(
    status: int, body: bytes, more: str = "", kind: str = "text/plain; charset=utf-8"
) -> bytes:
    framing = "".join(f"{name}: {value}\r\n" for name, value in HEADERS.items())
    head = (
        f"HTTP/1.1 {status} {_REASONS[status]}\r\nContent-Type: {kind}\r\n"
        f"Content-Length: {len(body)}\r\n{framing}{more}Connection: close\r\n\r\n"
    )
    return head.encode() + body


def _is_whole(request: bytearray) -> bool:
    """Whether the request is complete, or too long."""
    return b"\r\n\r\n" in request or len(request) > REQUEST_BYTES_MAX


def _listening(address: Address) -> socket.socket:
    """Listening TCP socket.

    Raises:
        MetricsError: the address cannot be listened at.
    """
    try:
        host, port = look_up(address)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.create_server((host, port), family=family, backlog=CONNECTIONS_MAX)
    except OSError as error:
        # The text of an OSError contains the address, that of a gaierror does not.
        number = error.errno or 0
        raise MetricsError(os.strerror(number) if number > 0 else str(error.strerror)) from None
    sock.setblocking(False)
    return sock


def names() -> frozenset[str]:
    """Names of all metrics that any process may serve."""
    told = {metric for table in TABLES.values() for metric in table} | set(OWN)
    return frozenset(
        PREFIX + metric.name + suffix
        for metric in told
        for suffix in (("_bucket", "_count") if metric.kind == "histogram" else ("",))
    )
