"""Endpoints: server, client and netem are driven by datagrams and time only.

An endpoint opens no socket, reads no clock, draws no unseeded number and prints nothing. Its output
is datagrams (`outbox`), typed events (`events`) and, on request, numbers (`figures`).
`shell.driving.driver` drives one endpoint on UDP sockets, `sim.hosts` many in virtual time.
"""

import ipaddress
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.events.flight import Event, Omitted
from skytether.shared.scenario.schema import Scenario

Address = tuple[str, int]
"""Host and port of a UDP socket. The host is a name, an IPv4 address or an IPv6 address without
brackets, with a scope if needed, as in `fe80::1%eth0`."""

NETWORK_BYTES = 8
"""Length of the network part of an IPv6 address, which identifies a host [B]: the owner of one
address of a 64-bit network usually has all of its addresses."""

EVENTS_MAX = 1024
"""Number of events stored until the driver reads them; older events are dropped and counted."""

VEHICLES_SHOWN_MAX = 16
"""Largest number of vehicles for which figures are given individually."""


class Datagram(NamedTuple):
    """UDP datagram of an endpoint."""

    payload: bytes
    """UDP payload."""
    peer: Address
    """Address of the sender or receiver."""
    socket: int = 0
    """Number of the endpoint's own socket; 0 is the bound socket."""


make_datagram: Callable[[tuple[bytes, Address, int]], Datagram] = partial(tuple.__new__, Datagram)
"""Function that makes a Datagram from its three values, twice as fast as `Datagram`."""


def host_of(address: Address) -> str:
    """Key of a sender's host for fair shares: IPv4 address or IPv6 network."""
    name = address[0]
    if ":" not in name:
        return name
    try:
        return ipaddress.IPv6Address(name).packed[:NETWORK_BYTES].hex()
    except ValueError:
        return name


class Form(NamedTuple):
    """Format of one kind of packets: first bytes and bounds of the length [B]."""

    head: bytes
    least: int
    most: int


def by_name(counts: Mapping[Any, int]) -> dict[str, int]:
    return {str(each): count for each, count in counts.items()}


class Events(deque[Event]):
    def __init__(self) -> None:
        super().__init__()
        self._omitted: Counter[str] = Counter()

    def append(self, event: Event) -> None:
        """Append an event; if there are too many, the oldest is dropped and counted."""
        if len(self) == EVENTS_MAX:
            self._omitted[type(self.popleft()).__name__] += 1
        super().append(event)

    def __iadd__(self, events: Iterable[Event]) -> Self:
        for event in events:
            self.append(event)
        return self

    def take(self) -> Sequence[Event]:
        """Remove and return all events, after an `Omitted` for each class of dropped events."""
        omitted = (Omitted(kind=kind, count=count) for kind, count in self._omitted.items())
        events = (*omitted, *self)
        self.clear()
        self._omitted.clear()
        return events


class Endpoint(ABC):
    """Base of all ends of UDP links. `now_ns` is always the driver's monotonic clock [ns]."""

    changeable: frozenset[str] = frozenset()
    """Keys of the scenario that may change in flight, see `shared.endpoints.change`."""
    directions: Directions = FLIGHT
    """Names of both directions of the endpoint's network."""
    keeps = False
    """Whether the endpoint has state for the next run of the process, see `keep`."""
    waits_for_disk = False
    """Whether the state on disk is outdated, and must be replaced or removed before the next run
    reads it."""
    patience_ns = 0
    """Longest time for which datagrams are collected on busy sockets [ns].

    Each datagram is received with its own time of arrival, before the next wake. On busy sockets
    wakes are at least this far apart. 0: each datagram is received at once."""

    def __init__(self) -> None:
        # The parts of the endpoint share these lists, so the lists are never replaced.
        self._out: list[Datagram] = []
        self._events = Events()
        self.pending = self._out, self._events
        """Datagrams and events that `outbox` and `events` return next. A wrapper uses the lists of
        the wrapped endpoint: in virtual time neither method is called while both are empty."""

    @abstractmethod
    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Process a datagram. Never raises, even if the datagram is malformed."""

    @abstractmethod
    def wake(self, *, now_ns: int) -> None:
        """Do the work that is due now; the driver may call it early or late."""

    @abstractmethod
    def next_wake_ns(self) -> int | None:
        """Time of the next wake, or None to wait for datagrams only."""

    def leave(self, *, now_ns: int) -> int:
        """Start to shut down, on an operator's request.

        The driver continues until the endpoint has `finished`, or until the returned time [ns], by
        default now, and then calls `close`. A second request ends the driver at once.
        """
        return now_ns

    def close(self, *, now_ns: int) -> None:  # noqa: B027 - optional
        """Send the last datagrams before the driver ends; this is the last call of the endpoint."""

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        """Why a change is refused at present, in words; empty if it is accepted.

        Args:
            scenario: the changed scenario, checked.
            keys: keys with a new value, all of them `changeable`.
        """
        return ""

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:  # noqa: ARG002
        """Use a changed scenario from now on; called between two steps. Never fails.

        Args:
            scenario: the scenario with all changes so far, checked.
            keys: keys with a new value, all of them `changeable`.
        """
        assert not keys  # there are no changeable keys by default

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:  # noqa: B027
        """Accept the host's time of day; called only while the host knows the time and a bound of
        the time's error. The base class ignores the time.

        Args:
            utc_ns: time since 1970 [ns].
            error_ns: largest error of `utc_ns` [ns].
            now_ns: the same time on the endpoint's own clock [ns].
        """

    def send(self, payload: bytes, peer: Address, socket: int = 0) -> None:
        """Put a datagram into the outbox; `socket` is the number of the endpoint's own socket."""
        self._out.append(Datagram(payload, peer, socket))

    def tell(self, event: Event) -> None:
        """Report an event that originates outside the endpoint."""
        self._events.append(event)

    def undelivered(self, socket: int, reason: str) -> None:  # noqa: B027 - optional
        """Note that a datagram from a socket could not be sent, or was refused later."""

    def figures(self) -> dict[str, Any]:
        """Figures counted so far, by name; a nested dictionary is a group.

        A name is the name of a field, or a key of a group: a vehicle's number in `by_vehicle`, a
        reason in `dropped`, an edge [ms] in `ticks_within_ms`.
        """
        return {}

    def keep(self, *, now_ns: int) -> bytes | None:  # noqa: ARG002 - ignored by default
        """State for the next run of this process; None if unchanged since the last call."""
        return None

    def kept(self, *, nothing: bool = False) -> None:  # noqa: B027 - optional
        """Note that the latest bytes from `keep` were written; or, with `nothing`, that writing
        failed and the earlier bytes were removed.
        """

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do, so that the driver may end."""
        return False

    def outbox(self) -> list[Datagram]:
        """Datagrams to be sent; each is returned once."""
        if not self._out:
            return []
        # The list is copied and cleared, not replaced, because an endpoint's parts share it.
        out = self._out.copy()
        self._out.clear()
        return out

    def events(self) -> Sequence[Event]:
        """Events since the last call; each is returned once."""
        return self._events.take() if self._events else ()
