"""Virtual time: any number of endpoints on one clock that jumps from event to event.

Between endpoints a datagram takes no time (delays are netem's business, and netem is an endpoint
here as well). Every host has a clock of its own, with offset and drift, and may take time to
compute when it is woken: what it then sends leaves, and it can be woken again, only once it is
done. It hears all along, so that what one host costs another delays nobody who only talks to it.
Time is integer nanoseconds, and whatever happens at one instant happens in a fixed order: the same
inputs give the same events everywhere, and hosts that never meet do not change each other's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush

from shared.endpoint import Address, Datagram, Endpoint

BILLION = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Clock:
    """A host's monotonic clock, as a function of the world's time."""

    offset_ns: int = 0
    drift_ppb: int = 0
    """How much faster it runs than the world's [10⁻⁹]."""

    def local(self, time_ns: int) -> int:
        """What it shows at a time of the world."""
        return self.offset_ns + time_ns + time_ns * self.drift_ppb // BILLION

    def world(self, local_ns: int) -> int:
        """The first time of the world at which it shows at least this."""
        passed_ns = local_ns - self.offset_ns
        return passed_ns - passed_ns * self.drift_ppb // (BILLION + self.drift_ppb)


@dataclass(slots=True)
class Host:
    """One endpoint in the world; its socket s has the address (name, s)."""

    name: str
    endpoint: Endpoint
    clock: Clock
    turn: int
    """At one instant hosts are woken in the order in which they were added, from 1."""
    compute_ns: int
    busy_until_ns: int
    on_finished: Callable[[], None] | None
    armed_ns: int | None = None


ARRIVAL = 0
"""Turn of a datagram: what has arrived is heard before anybody acts on the time."""


class World:
    """Hosts, and what happens to them."""

    def __init__(self) -> None:
        self.now_ns = 0
        self._hosts: dict[str, Host] = {}
        self._events: list[tuple[int, int, int, Host, Datagram | None]] = []
        """Time, turn, order of entry; to whom, and what arrives."""
        self._scheduled = 0

    def add(
        self,
        name: str,
        endpoint: Endpoint,
        *,
        clock: Clock = Clock(),
        start_ns: int = 0,
        compute_ns: int = 0,
        on_finished: Callable[[], None] | None = None,
    ) -> Address:
        """A new host, called like no other.

        Args:
            start_ns: it is not woken before this time of the world.
            compute_ns: how long it works whenever it is woken.
            on_finished: called once, when the endpoint has just finished.

        Returns:
            its address.
        """
        assert name not in self._hosts
        turn = len(self._hosts) + 1
        host = Host(name, endpoint, clock, turn, compute_ns, start_ns, on_finished)
        self._hosts[name] = host
        self._arm(host)
        return (name, 0)

    def run(self, until: Callable[[], bool], *, limit_ns: int) -> None:
        """Let time pass until a condition holds, or until a time of the world."""
        while self._events and not until():
            time_ns, _, _, host, datagram = heappop(self._events)
            if time_ns > limit_ns:
                return
            self.now_ns = time_ns
            if datagram is None:
                self._wake(host)
            else:
                self._receive(host, datagram)

    def _at(self, time_ns: int, turn: int, host: Host, datagram: Datagram | None) -> None:
        self._scheduled += 1
        heappush(self._events, (time_ns, turn, self._scheduled, host, datagram))

    def _arm(self, host: Host) -> None:
        due_ns = host.endpoint.next_wake_ns()
        if due_ns is None:
            host.armed_ns = None
            return
        time_ns = max(self.now_ns, host.busy_until_ns, host.clock.world(due_ns))
        if time_ns != host.armed_ns:
            host.armed_ns = time_ns
            self._at(time_ns, host.turn, host, None)

    def _wake(self, host: Host) -> None:
        if host.armed_ns != self.now_ns:
            return  # it has changed its mind since
        host.armed_ns = None
        host.endpoint.wake(now_ns=host.clock.local(self.now_ns))
        host.busy_until_ns = self.now_ns + host.compute_ns
        self._after(host, host.busy_until_ns)

    def _receive(self, host: Host, datagram: Datagram) -> None:
        host.endpoint.receive(datagram, now_ns=host.clock.local(self.now_ns))
        self._after(host, self.now_ns)

    def _after(self, host: Host, leaves_ns: int) -> None:
        """Its datagrams leave; then it waits again."""
        for payload, (name, socket), source in host.endpoint.outbox():
            receiver = self._hosts.get(name)
            if receiver is not None:
                arrived = Datagram(payload, (host.name, source), socket)
                self._at(leaves_ns, ARRIVAL, receiver, arrived)
        self._arm(host)
        if host.on_finished is not None and host.endpoint.finished:
            host.on_finished()
            host.on_finished = None
