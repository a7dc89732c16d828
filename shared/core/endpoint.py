"""Endpoints: server, client and netem are driven by datagrams and time only.

An endpoint opens no socket, reads no clock, draws no unseeded number and prints nothing. It
speaks in three ways: by datagrams (`outbox`), by typed events (`events`), and by numbers when it
is asked for them (`figures`). `shell.driver` drives one on real UDP sockets; `sim.world` drives
many in virtual time.
"""

import ipaddress
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

from skytether.shared.core.events import Event, Omitted
from skytether.shared.scenario.schema import Scenario

Address = tuple[str, int]
"""Host and port of a UDP socket. The host is a name, an IPv4 address or an IPv6 address without
brackets, as in `fe80::1%eth0` where it needs a scope."""

NETWORK_BYTES = 8
"""Length of the part of an IPv6 address that stands for a host [B]: whoever has one address of a
network of 64 bits has them all."""

EVENTS_MAX = 1024
"""Events kept until the driver reads them; older ones give way, and are counted."""

VEHICLES_TOLD_MAX = 16
"""Vehicles that `figures` tells of one by one."""


class Datagram(NamedTuple):
    """UDP datagram as an endpoint sees it."""

    payload: bytes
    """UDP payload."""
    peer: Address
    """Address of the sender, or of the receiver."""
    socket: int = 0
    """Number of the endpoint's own socket that it uses; 0 is the one that is bound."""


make_datagram: Callable[[tuple[bytes, Address, int]], Datagram] = partial(tuple.__new__, Datagram)
"""A datagram, of its three values: in half of the time that `Datagram` takes."""


def host_of(address: Address) -> str:
    """Host that a sender counts for where each may have a share: IPv4 address or IPv6 network."""
    name = address[0]
    if ":" not in name:
        return name
    try:
        return ipaddress.IPv6Address(name).packed[:NETWORK_BYTES].hex()
    except ValueError:
        return name


class Form(NamedTuple):
    """Form of the packets of one kind: their first bytes, and bounds of their length."""

    head: bytes
    """Bytes that they begin with."""
    least: int
    """Size of the shortest [B]."""
    most: int
    """Size of the longest [B]."""


def by_name(counts: Mapping[Any, int]) -> dict[str, int]:
    """A group of figures: counts by the names of what is counted."""
    return {str(each): count for each, count in counts.items()}


class Events(deque[Event]):
    """Events that wait for the driver."""

    def __init__(self) -> None:
        super().__init__()
        self._omitted: Counter[str] = Counter()

    def append(self, event: Event) -> None:
        """Append an event; where there are too many, the oldest is only counted."""
        if len(self) == EVENTS_MAX:
            self._omitted[type(self.popleft()).__name__] += 1
        super().append(event)

    def __iadd__(self, events: Iterable[Event]) -> Self:
        for event in events:
            self.append(event)
        return self

    def take(self) -> Sequence[Event]:
        """Remove and return all events; first of them how many were left out."""
        omitted = (Omitted(kind=kind, count=count) for kind, count in self._omitted.items())
        events = (*omitted, *self)
        self.clear()
        self._omitted.clear()
        return events


class Endpoint(ABC):
    """Base of whatever talks UDP. `now_ns` is always the driver's monotonic clock [ns]."""

    changeable: frozenset[str] = frozenset()
    """Keys of its scenario that may change in flight, see `shared.core.change`."""
    keeps = False
    """Whether there is anything that the next life of the process must know, see `keep`."""
    patience_ns = 0
    """Longest time that datagrams wait to be received together, on sockets to which many come [ns].

    Each is received with its own time of arrival, and before the next wake. While many come, wakes
    are at least this far apart. 0: each datagram is received at once."""

    def __init__(self) -> None:
        # Both are handed to the parts that an endpoint is made of: they stay the same objects.
        self._out: list[Datagram] = []
        self._events = Events()

    @abstractmethod
    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Take a datagram that arrived. Never raises for anything a peer can put into it."""

    @abstractmethod
    def wake(self, *, now_ns: int) -> None:
        """Do what is due now; the driver may call it early or late."""

    @abstractmethod
    def next_wake_ns(self) -> int | None:
        """Time of the next wake, or None: only a datagram matters now."""

    def close(self, *, now_ns: int) -> None:  # noqa: B027 - most have nothing to say
        """Say what peers must know before the driver ends; nothing else is called after it."""

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        """Why a change cannot be made just now, in words; empty: it can.

        Args:
            scenario: what would be flown, checked.
            keys: keys that would get a value, all of them `changeable`.
        """
        return ""

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:  # noqa: ARG002
        """Fly another scenario from now on; called between two steps. Never fails.

        Args:
            scenario: the scenario with all that was changed so far, checked.
            keys: keys that were given a value just now, all of them `changeable`.
            now_ns: time now.
        """
        assert not keys  # there are none that may change

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:  # noqa: B027
        """Learn the time of day, where the host knows it to within an error; most need it not.

        Args:
            utc_ns: the time since 1970 [ns].
            error_ns: largest error of that [ns].
            now_ns: the same time on the endpoint's own clock [ns].
        """

    def send(self, payload: bytes, peer: Address, socket: int = 0) -> None:
        """Put a datagram into the outbox.

        Args:
            payload: UDP payload.
            peer: address of the receiver.
            socket: number of the endpoint's own socket that sends it.
        """
        self._out.append(Datagram(payload, peer, socket))

    def tell(self, event: Event) -> None:
        """Report an event about the endpoint that comes from outside it."""
        self._events.append(event)

    def figures(self) -> dict[str, Any]:
        """Numbers counted so far, by name; a nested dictionary is a group of them.

        Names are those of fields, or what a group is told by: a vehicle's number in `by_vehicle`, a
        reason in `dropped`, an edge [ms] in `ticks_within_ms`.
        """
        return {}

    def keep(self, *, now_ns: int) -> bytes | None:  # noqa: ARG002 - most keep nothing
        """What the next life of this process must know, where it has changed.

        It is handed out once, and to be written where that life finds it.
        """
        return None

    def kept(self) -> None:  # noqa: B027 - see `keep`
        """Take note that what was handed out last was written."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do, so that the driver may end."""
        return False

    def outbox(self) -> list[Datagram]:
        """Datagrams to be sent; each is handed out once."""
        if not self._out:
            return []
        # Copied and cleared, not replaced: the parts of an endpoint hold this very list.
        out = self._out.copy()
        self._out.clear()
        return out

    def events(self) -> Sequence[Event]:
        """Events since the last call; each is handed out once."""
        return self._events.take() if self._events else ()
