"""Virtual time: any number of endpoints on one clock that jumps from instant to instant.

Between endpoints a datagram takes no time: delays come from netem, which is an endpoint here as
well. Every host has its own clock, with offset and drift. A host may take time to compute when it
is woken: only at the end of that time do its datagrams leave, and only then can it be woken again.
It receives datagrams meanwhile, so computing for one peer does not delay what another sends. A host
can be stopped and restarted, frozen for a while, and have its clock set, by actions scheduled with
their time (`World.at`). What an endpoint keeps for its next life stays with its host. Time is
integer nanoseconds, and events of one instant happen in a fixed order: equal inputs give equal
outcomes on every machine, and hosts that exchange no datagrams do not affect each other.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import Protocol

from skytether.shared.core.endpoint import Address, Datagram, Endpoint
from skytether.shared.core.events import Event

BILLION = 1_000_000_000
FROZEN_MAX = 6_500
"""Most datagrams queued for a frozen host: the number of 600 B that fit a socket's buffer."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Host's monotonic clock, as a function of the world's time."""

    offset_ns: int = 0
    """Time on the clock at time 0 of the world [ns]."""
    drift_ppb: int = 0
    """Rate by which the clock runs faster than the world's [10⁻⁹]."""

    def local(self, time_ns: int) -> int:
        """Time on the clock at a time of the world."""
        shown_ns = self.offset_ns + time_ns
        return shown_ns + time_ns * self.drift_ppb // BILLION if self.drift_ppb else shown_ns

    def world(self, local_ns: int) -> int:
        """First time of the world at which the clock shows at least this time."""
        passed_ns = local_ns - self.offset_ns
        if not self.drift_ppb:
            return passed_ns
        return passed_ns - passed_ns * self.drift_ppb // (BILLION + self.drift_ppb)

    def changed(self, time_ns: int, *, step_ns: int = 0, drift_ppb: int | None = None) -> "Clock":
        """Clock that continues this one, with a step or another rate.

        Args:
            time_ns: time of the world at which the change happens [ns].
            step_ns: jump of the clock then [ns].
            drift_ppb: new rate; None keeps the present one.
        """
        drift_ppb = self.drift_ppb if drift_ppb is None else drift_ppb
        offset_ns = self.local(time_ns) + step_ns - Clock(0, drift_ppb).local(time_ns)
        return Clock(offset_ns, drift_ppb)


class _Still(Endpoint):
    """Stand-in for the endpoint of a host that is down or frozen: it does nothing.

    Args:
        inner: the real endpoint.
        room: most datagrams queued for it; 0 for a host that is down.
        armed_ns: time of the world at which its timer ends, or None.
    """

    def __init__(self, inner: Endpoint, room: int, armed_ns: int | None = None) -> None:
        super().__init__()
        self.armed_ns = armed_ns
        self.inner = inner
        self.room = room
        self.waiting: deque[Datagram] = deque()
        """Queued datagrams, in order of arrival; later ones are dropped when the queue is full."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        """Queue the datagram if there is room."""
        if len(self.waiting) < self.room:
            self.waiting.append(datagram)

    def wake(self, *, now_ns: int) -> None:
        """Do nothing: the stand-in never asks to be woken."""

    def next_wake_ns(self) -> None:
        """None: the stand-in is never woken."""


@dataclass(slots=True)
class Host:
    """Endpoint in the world; its socket s has the address (name, s)."""

    name: str
    endpoint: Endpoint
    clock: Clock
    turn: int
    """Rank among hosts that are woken at one instant, from 1: the order of being added."""
    compute_ns: int
    """Computing time of each wake [ns]."""
    busy_until_ns: int
    """Time of the world until which the host computes, and cannot be woken."""
    on_finished: Callable[[], None] | None
    """Callback for the end of the endpoint, until it has been called."""
    armed_ns: int | None = None
    """Time of the world at which the host is to be woken, or None."""
    due_ns: int | None = None
    """Time on the host's clock that `armed_ns` was computed from; None to compute it again."""
    memory: tuple[bytes, int] | None = None
    """Content that its endpoints kept last, and when [ns; the host's clock]; None of none."""


ACTION, ARRIVAL = -1, 0
"""Priorities at one instant: actions run before datagrams arrive, and these before any host is
woken."""


class Act(Protocol):
    """Action on an endpoint, at a time of its own clock."""

    def __call__(self, *, now_ns: int) -> object:
        """Perform the action."""


class World:
    """Hosts, and the agenda of events that happen to them.

    Args:
        on_event: called with the time of the world, the host's name and the event, for each event
            of every endpoint, before the end of that endpoint is told.
    """

    def __init__(self, on_event: Callable[[int, str, Event], None] = lambda *_: None) -> None:
        self.now_ns = 0
        """Time of the world [ns]."""
        self._on_event = on_event
        self._hosts: dict[str, Host] = {}
        self._agenda: list[
            tuple[int, int, int, Host, Datagram | None]
            | tuple[int, int, int, None, Callable[[], None]]
        ] = []
        """Heap of future events: time, rank, order of entry, host, and the arriving datagram, or
        None for a wake; an action has no host but a function."""
        self._scheduled = 0
        """Number of entries made so far."""
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
        """Add a host.

        Args:
            name: name of the host, unlike any other's.
            endpoint: endpoint that runs on it.
            clock: its clock.
            start_ns: time of the world before which it is not woken.
            compute_ns: computing time of each wake [ns].
            on_finished: called once, when the endpoint has just finished.

        Returns:
            Address of the host.
        """
        assert name not in self._hosts
        turn = len(self._hosts) + 1
        host = Host(name, endpoint, clock, turn, compute_ns, start_ns, on_finished)
        self._hosts[name] = host
        self._arm(host)
        return (name, 0)

    def at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Schedule an action for a time of the world that has not passed."""
        assert time_ns >= self.now_ns
        self._scheduled += 1
        heappush(self._agenda, (time_ns, ACTION, self._scheduled, None, action))

    def stop(self, name: str) -> None:
        """Take a host down: it receives nothing, and datagrams it was about to send are lost."""
        host = self._hosts[name]
        host.endpoint, host.armed_ns = _Still(host.endpoint, 0), None
        self._agenda[:] = [
            entry
            for entry in self._agenda
            if not (isinstance(entry[4], Datagram) and entry[4].peer[0] == name)
            or entry[0] == self.now_ns
        ]
        heapify(self._agenda)

    def restart(self, name: str, endpoint: Endpoint) -> None:
        """Start a new endpoint on a host, at its address and with its clock, from now on.

        Args:
            name: name of the host, which may be up, down or frozen.
            endpoint: endpoint that runs on it from now on; its end is reported unless one was
                before.
        """
        self.stop(name)
        host = self._hosts[name]
        host.endpoint, host.busy_until_ns = endpoint, self.now_ns
        self._arm(host)

    def memory(self, name: str) -> tuple[bytes, int] | None:
        """Content that an endpoint on a host kept last, and when [ns; its clock]; None of none."""
        return self._hosts[name].memory

    def freeze(self, name: str) -> None:
        """Freeze a host: datagrams are queued for it, up to a bound.

        A host that is down or frozen already stays as it is.
        """
        host = self._hosts[name]
        if not isinstance(host.endpoint, _Still):
            host.endpoint = _Still(host.endpoint, FROZEN_MAX, host.armed_ns)
            host.armed_ns = None

    def thaw(self, name: str) -> None:
        """Let a frozen host go on: it receives the queued datagrams, and is then woken if it wants
        to be.

        A host that is not frozen stays as it is.
        """
        host = self._hosts[name]
        still = host.endpoint
        if isinstance(still, _Still) and still.room:
            host.endpoint = still.inner
            for datagram in still.waiting:
                self._receive(host, datagram)
            if not still.waiting and still.armed_ns is not None:
                host.armed_ns, host.due_ns = max(self.now_ns, still.armed_ns), None
                self._at(host.armed_ns, host.turn, host, None)

    def set_clock(self, name: str, *, step_ns: int = 0, drift_ppb: int | None = None) -> None:
        """Step a host's clock now, or change its rate from now on.

        The host is not informed. Its pending wake is on a timer, which is independent of the clock,
        and comes when it would have come.

        Args:
            name: name of the host.
            step_ns: jump of the clock, forward or back [ns].
            drift_ppb: rate by which the clock runs faster than the world's [10⁻⁹]; None leaves it.
        """
        host = self._hosts[name]
        host.clock = host.clock.changed(self.now_ns, step_ns=step_ns, drift_ppb=drift_ppb)
        host.due_ns = None

    def set_compute(self, name: str, compute_ns: int) -> None:
        """Change the computing time of each wake of a host [ns]."""
        self._hosts[name].compute_ns = compute_ns

    def rearm(self, name: str) -> None:
        """Ask a host for its next wake, after an action has given it something to do."""
        self._arm(self._hosts[name])

    def act(self, name: str, act: Act) -> None:
        """Act on a host's endpoint now, and let its datagrams and events out.

        Args:
            name: name of the host.
            act: called with the time on the host's clock.
        """
        host = self._hosts[name]
        try:
            act(now_ns=host.clock.local(self.now_ns))
        finally:
            self._after(host, self.now_ns)

    def run(self, until: Callable[[], bool], *, limit_ns: int) -> None:
        """Run the world until a condition holds, or until a time."""
        agenda, arriving, receive = self._agenda, self._arriving, self._receive
        while (agenda or arriving) and not until():
            # Datagrams sent at an earlier time are on the agenda, and arrive first.
            if arriving and not (agenda and agenda[0][:2] <= (self.now_ns, ARRIVAL)):
                receive(*arriving.popleft())
                continue
            if agenda[0][0] > limit_ns:
                return
            entry = heappop(agenda)
            self.now_ns = entry[0]
            if entry[3] is None:
                entry[4]()
            elif entry[4] is None:
                self._wake(entry[3])
            else:
                receive(entry[3], entry[4])

    def _at(self, time_ns: int, turn: int, host: Host, datagram: Datagram | None) -> None:
        self._scheduled += 1
        heappush(self._agenda, (time_ns, turn, self._scheduled, host, datagram))

    def _arm(self, host: Host) -> None:
        due_ns = host.endpoint.next_wake_ns()
        if due_ns is None:
            host.armed_ns = None
            return
        if due_ns == host.due_ns and host.armed_ns is not None:
            return  # armed for this time already
        host.due_ns = due_ns
        time_ns = host.clock.world(due_ns)
        time_ns = max(time_ns, host.busy_until_ns)
        time_ns = max(time_ns, self.now_ns)
        if time_ns != host.armed_ns:
            host.armed_ns = time_ns
            self._at(time_ns, host.turn, host, None)

    def _wake(self, host: Host) -> None:
        now_ns = self.now_ns
        if host.armed_ns != now_ns:
            return  # the endpoint has changed its next wake since
        host.armed_ns = None
        host.endpoint.wake(now_ns=host.clock.local(now_ns))
        host.busy_until_ns = now_ns + host.compute_ns
        self._after(host, host.busy_until_ns)

    def _receive(self, host: Host, datagram: Datagram) -> None:
        host.endpoint.receive(datagram, now_ns=host.clock.local(self.now_ns))
        self._after(host, self.now_ns)

    def _after(self, host: Host, leaves_ns: int) -> None:
        """Send the datagrams that a host has queued, report its events, and set its next wake."""
        endpoint = host.endpoint
        if endpoint.keeps:
            now_ns = host.clock.local(self.now_ns)
            if (content := endpoint.keep(now_ns=now_ns)) is not None:
                host.memory = content, now_ns
                endpoint.kept()
        for payload, (name, socket), source in endpoint.outbox():
            receiver = self._hosts.get(name)
            if receiver is None:
                continue
            arrived = Datagram(payload, (host.name, source), socket)
            if leaves_ns == self.now_ns:
                self._arriving.append((receiver, arrived))
            else:
                self._at(leaves_ns, ARRIVAL, receiver, arrived)
        for event in endpoint.events():
            self._on_event(self.now_ns, host.name, event)
        self._arm(host)
        if host.on_finished is not None and endpoint.finished:
            host.on_finished()
            host.on_finished = None
