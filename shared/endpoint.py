"""The one idea: server, client and netem are endpoints, driven by datagrams and time only.

An endpoint opens no socket, reads no clock, draws no unseeded number and prints nothing.
`shell.driver` drives one on real UDP sockets; `sim.world` drives many in virtual time.
"""

from abc import ABC, abstractmethod
from collections import deque
from typing import Any, NamedTuple

Address = tuple[str, int]

SECOND_NS = 1_000_000_000
MILLISECOND_NS = 1_000_000

NEWS_MAX = 64
"""News kept until the driver reads it; older news gives way."""


def seconds_to_ns(seconds: float) -> int:
    """Whole nanoseconds nearest to a duration [s]."""
    return round(seconds * SECOND_NS)


class Datagram(NamedTuple):
    """One UDP datagram as an endpoint sees it."""

    payload: bytes
    peer: Address
    """Who sent it, or for whom it is."""
    socket: int = 0
    """Which of the endpoint's own sockets it uses; 0 is the one that is bound."""


class Endpoint(ABC):
    """Something that talks UDP. `now_ns` is always the driver's monotonic clock [ns]."""

    def __init__(self) -> None:
        self._out: list[Datagram] = []
        self._news: deque[str] = deque(maxlen=NEWS_MAX)

    @abstractmethod
    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """A datagram arrived. Never raises for anything a peer can put into it."""

    @abstractmethod
    def wake(self, *, now_ns: int) -> None:
        """The time asked for has come (drivers may be late, and may be early)."""

    @abstractmethod
    def next_wake_ns(self) -> int | None:
        """When to be woken, or None: only a datagram matters now."""

    @abstractmethod
    def report(self) -> str:
        """What was counted so far, as a few lines for the operator."""

    def figures(self) -> dict[str, Any]:
        """The same as numbers, by name, for a program."""
        return {}

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do, so that the driver may end."""
        return False

    def outbox(self) -> list[Datagram]:
        """What is to be sent; each datagram is handed out once."""
        out, self._out = self._out, []
        return out

    def news(self) -> list[str]:
        """What the operator should hear; each line is handed out once."""
        news = list(self._news)
        self._news.clear()
        return news
