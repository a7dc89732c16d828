"""Virtual time: endpoints on a common clock that jumps from event to event.

A datagram takes no time between endpoints; delays come from netem, which is an endpoint too. Every
host has its own clock, with offset and drift. A host may need computing time when it is woken: its
datagrams leave at the end of this time, and before that the host is not woken again. The host
receives datagrams meanwhile, so computing for one peer does not delay the datagrams of another
peer. A `sim.world.World` can stop hosts, too, and saves the state of their endpoints.

Time is integer nanoseconds, and events of one instant happen in a fixed order. So equal inputs give
equal outcomes on every machine, and hosts that exchange no datagrams do not affect each other.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Protocol

from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, make_datagram
from skytether.shared.events.flight import Event

BILLION = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Clock:
    """Host's monotonic clock, as a function of the world's time."""

    offset_ns: int = 0
    """Reading of the clock at time 0 of the world [ns]."""
    drift_ppb: int = 0
    """Rate by which the clock runs faster than the world's time [10⁻⁹]."""

    def local(self, time_ns: int) -> int:
        shown_ns = self.offset_ns + time_ns
        return shown_ns + time_ns * self.drift_ppb // BILLION if self.drift_ppb else shown_ns

    def world(self, local_ns: int) -> int:
        """First time of the world [ns] at which the clock shows `local_ns` or more."""
        passed_ns = local_ns - self.offset_ns
        if not self.drift_ppb:
            return passed_ns
        return passed_ns - passed_ns * self.drift_ppb // (BILLION + self.drift_ppb)


@dataclass(slots=True)
class Host:
    """Host with an endpoint; socket s of the endpoint has the address (name, s)."""

    name: str
    endpoint: Endpoint
    clock: Clock
    turn: int
    """Rank among hosts that are woken at one instant: 1, 2, … in the order of `Hosts.add`."""
    compute_ns: int
    busy_until_ns: int
    """Time of the world until which the host computes and cannot be woken [ns]."""
    on_finished: Callable[[], None] | None
    """Function to call once, when the endpoint has finished; None afterwards."""
    armed_ns: int | None = None
    """Time of the world at which the host is to be woken [ns]; None for never."""
    due_ns: int | None = None
    """Time on the host's clock from which `armed_ns` was computed [ns]; None: compute it again."""


ACTION, ARRIVAL = -1, 0
"""Order at one instant: actions run before datagrams arrive, and datagrams arrive before hosts are
woken.
"""


class Act(Protocol):
    """Action on an endpoint, at a time of the host's clock."""

    def __call__(self, *, now_ns: int) -> object:
        """Perform the action."""


class Hosts:
    """Hosts, and the queue of their future events.

    Args:
        on_event: called for each event of an endpoint with the time of the world, the host's name
            and the event, before `on_finished` of that host.
    """

    def __init__(self, on_event: Callable[[int, str, Event], None] = lambda *_: None) -> None:
        self.now_ns = 0
        self._on_event = on_event
        self._hosts: dict[str, Host] = {}
        self._agenda: list[
            tuple[int, int, int, Host, Datagram | None]
            | tuple[int, int, int, None, Callable[[], None]]
        ] = []
        """Heap of future events: time, rank, order of entry, host, and the arriving datagram, or
        None for a wake; an action has None as host, and a function as last entry.
        """
        self._scheduled = 0
        self._look_ns = 0
        """Time of the world before which `run` does not check its condition again [ns]."""
        self._arriving: deque[tuple[Host, Datagram]] = deque()
        """Datagrams that arrive at the present time, in the order in which they were sent."""

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
        """Add a host, and return its address.

        Args:
            name: unique name of the host.
            start_ns: time of the world before which the host is not woken [ns].
            compute_ns: computing time of each wake [ns].
            on_finished: called once, when the endpoint has finished.
        """
        assert name not in self._hosts
        turn = len(self._hosts) + 1
        host = Host(name, endpoint, clock, turn, compute_ns, start_ns, on_finished)
        self._hosts[name] = host
        self._arm(host)
        return (name, 0)

    def at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Schedule an action for a time of the world [ns], which must not be in the past."""
        assert time_ns >= self.now_ns
        self._scheduled += 1
        heappush(self._agenda, (time_ns, ACTION, self._scheduled, None, action))

    def act(self, name: str, act: Act) -> None:
        """Act on a host's endpoint now, and send its datagrams and report its events.

        `act` is called with the time on the host's clock.
        """
        host = self._hosts[name]
        try:
            act(now_ns=host.clock.local(self.now_ns))
        finally:
            self._after(host, self.now_ns)

    def run(self, until: Callable[[], bool], *, limit_ns: int, every_ns: int = 0) -> None:
        """Run the world until a condition holds, or until a time.

        Args:
            limit_ns: time of the world at which the run ends at the latest [ns].
            every_ns: shortest time between two checks of the condition [ns]; the condition is also
                checked when an endpoint finishes.
        """
        agenda, arriving = self._agenda, self._arriving
        self._look_ns = self.now_ns
        while agenda or arriving:
            if self.now_ns >= self._look_ns:
                if until():
                    return
                self._look_ns = self.now_ns + every_ns
            # Datagrams sent at an earlier time are in `agenda`, and arrive first.
            if arriving and not (agenda and agenda[0][:2] <= (self.now_ns, ARRIVAL)):
                self._receive(*arriving.popleft())
                continue
            if agenda[0][0] > limit_ns:
                return
            entry = heappop(agenda)
            self.now_ns = entry[0]
            if entry[3] is None:
                entry[4]()
            elif entry[4] is not None:
                self._receive(entry[3], entry[4])
            elif entry[3].armed_ns == self.now_ns:  # otherwise the wake was rescheduled
                host = entry[3]
                host.armed_ns = None
                host.endpoint.wake(now_ns=host.clock.local(self.now_ns))
                host.busy_until_ns = self.now_ns + host.compute_ns
                self._after(host, host.busy_until_ns)

    def _at(self, time_ns: int, turn: int, host: Host, datagram: Datagram | None) -> None:
        self._scheduled += 1
        heappush(self._agenda, (time_ns, turn, self._scheduled, host, datagram))

    def _arm(self, host: Host) -> None:
        due_ns = host.endpoint.next_wake_ns()
        if due_ns is None:
            host.armed_ns = None
            return
        if due_ns == host.due_ns and host.armed_ns is not None:
            return  # the wake is already set for this time
        host.due_ns = due_ns
        time_ns = host.clock.world(due_ns)
        time_ns = max(time_ns, host.busy_until_ns)
        time_ns = max(time_ns, self.now_ns)
        if time_ns != host.armed_ns:
            host.armed_ns = time_ns
            self._scheduled += 1
            heappush(self._agenda, (time_ns, host.turn, self._scheduled, host, None))

    def _receive(self, host: Host, datagram: Datagram) -> None:
        host.endpoint.receive(datagram, now_ns=host.clock.local(self.now_ns))
        self._after(host, self.now_ns)

    def _after(self, host: Host, leaves_ns: int) -> None:
        """Send the datagrams that a host has queued, report its events, and set its next wake."""
        endpoint = host.endpoint
        out, events = endpoint.pending
        if out:
            for payload, (name, socket), source in endpoint.outbox():
                receiver = self._hosts.get(name)
                if receiver is None:
                    continue
                arrived = make_datagram((payload, (host.name, source), socket))
                if leaves_ns == self.now_ns:
                    self._arriving.append((receiver, arrived))
                else:
                    self._at(leaves_ns, ARRIVAL, receiver, arrived)
        if events:
            for event in endpoint.events():
                self._on_event(self.now_ns, host.name, event)
        self._arm(host)
        if host.on_finished is not None and endpoint.finished:
            host.on_finished()
            host.on_finished = None
            self._look_ns = self.now_ns
