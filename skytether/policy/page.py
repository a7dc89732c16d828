"""Live page of `skytether policy join`: calls of the last minute, network, images and events.

    GET /        the page, `page.html`
    GET /state   what the page shows, as JSON; the page requests it four times a second

The event loop only appends to bounded histories and keeps the newest observation. Threads of
`shell.processes.exporter` answer the browsers, so that no call waits for a browser.
"""

import time
from base64 import b64encode
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from skytether.policy.images import JPEG, leaves
from skytether.policy.robot import AnsweredCall
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Event
from skytether.shell.processes.exporter import JSON, OK, Answer, BoundedServer

SPAN_S = 60
"""Time that the page shows [s]."""
CALLS_MAX, EVENTS_MAX = 60 * SPAN_S, 50
"""Number of newest calls and log events that are kept."""
IMAGE_BYTES_MAX = 512 * 1024
"""Largest size of an image that is shown [B]."""
PAGE = Path(__file__).with_name("page.html")


class CallPage:
    """Page of the calls of a robot program.

    Args:
        address: address to listen at; port 0 takes a free one.
        about: options of the robot end that the page shows.

    Raises:
        MetricsError: listening at the address failed.
    """

    def __init__(self, address: Address, about: Mapping[str, Any]) -> None:
        self._about = about
        self._offset_ms = _ms(time.time_ns() - time.monotonic_ns())
        """Time of day of this machine minus the times of the histories [ms]."""
        self._calls: deque[tuple[Any, ...]] = deque(maxlen=CALLS_MAX)
        self._seconds: deque[tuple[float, Any]] = deque(maxlen=SPAN_S + 1)
        self._events: deque[tuple[float, str, str, str]] = deque(maxlen=EVENTS_MAX)
        self._figures: Mapping[str, Any] = {}
        self._sent: Any = None
        """Newest observation that was sent."""
        html = PAGE.read_bytes()
        answers = {
            "/": lambda: (OK, "text/html; charset=utf-8", html),
            "/state": self._state,
        }
        self._server = BoundedServer(address, answers)
        self.address = self._server.address

    def note(self, call: AnsweredCall) -> None:
        """Keep a call of the robot program and its answer."""
        age_ms = None if call.chunk_age_ns < 0 else _ms(call.chunk_age_ns)
        times_ms = _ms(call.time_ns), _ms(call.waited_ns), age_ms
        self._calls.append((*times_ms, call.left, call.kind, call.number))
        if call.sent is not None:
            self._sent = call.sent

    def hear(self, event: Event) -> None:
        """Keep a log event."""
        about = type(event).__name__, str(event), getattr(event, "reason", "")
        self._events.append((_ms(time.monotonic_ns()), *about))

    def take(self, figures: Mapping[str, Any]) -> None:
        """Keep the figures of a second; the caller must not change them afterwards."""
        self._figures = figures
        self._seconds.append((_ms(time.monotonic_ns()), figures.get("link")))

    def close(self) -> None:
        self._server.close()

    def _state(self) -> Answer:
        """Answer to /state; called in threads, so each history is copied at once."""
        state = {
            "about": self._about,
            "now_ms": _ms(time.monotonic_ns()),
            "offset_ms": self._offset_ms,
            "calls": tuple(self._calls),
            "seconds": tuple(self._seconds),
            "events": tuple(self._events),
            "figures": self._figures,
            "images": {
                key: b64encode(image[JPEG]).decode()
                for key, image in leaves(self._sent)
                if isinstance(image, dict) and len(image[JPEG]) <= IMAGE_BYTES_MAX
            },
        }
        return OK, JSON, msgspec.json.encode(state)


def _ms(time_ns: int) -> float:
    return round(time_ns / MILLISECOND_NS, 1)
